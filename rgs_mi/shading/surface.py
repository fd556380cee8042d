"""Surfaces as estimators of what they reflect see them."""

from typing import NamedTuple

import drjit as dr
import mitsuba as mi


class Surface(NamedTuple):
    """Points of surfaces, one entry per surface in all fields.

    normal, view  unit vectors in world space, ``view`` from the surface to the camera
    roughness, metallic, base_color   parameters of the principled BSDF
    point         where they are in world space; None where neither what reflects nor a room is near
    """

    normal: "mi.Vector3f"
    view: "mi.Vector3f"
    roughness: "mi.Float"
    metallic: "mi.Float"
    base_color: "mi.Color3f"
    point: "mi.Point3f | None" = None

    @property
    def cosine(self) -> "mi.Float":
        """The cosine n·ω_o of the angle under which they are seen."""
        return dr.dot(self.normal, self.view)

"""The G-buffer: all maps of a view from one walk (docs/method.md §2)."""

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from ..core.camera import Camera
from .composite import Layout, composite, planes
from .hit import PACKET, fetch
from .intersect import isect_tiles
from .project import project
from .tiles import Cutoffs

if TYPE_CHECKING:
    from ..surfels.surfels import SurfelColumns


@dataclass
class Maps:
    """Accumulated attributes, one entry per pixel; each is Σ w · attribute, so divide by ``alpha`` for means.

    diffuse        Σ w c, linear radiance
    normal         Σ w (n(u, v) + Δn), world space
    base_color, roughness, metallic   Σ w times each, material parameters in [0, 1]
    depth          Σ w z, camera-space z
    alpha          Σ w, coverage in [0, 1]
    delta_normal   Σ w Δn, world space
    square         Σ w z²; this and delta_normal where `render_gbuffer` was asked for all maps, else None
    contribution   Σ w times each of `render_gbuffer`'s argument of that name, None without it
    """

    diffuse: "mi.Color3f"
    normal: "mi.Vector3f"
    base_color: "mi.Color3f"
    roughness: "mi.Float"
    metallic: "mi.Float"
    depth: "mi.Float"
    alpha: "mi.Float"
    delta_normal: "mi.Vector3f | None" = None
    square: "mi.Float | None" = None
    contribution: "mi.Vector2f | None" = None


@dataclass
class GBuffer:
    """All maps of a view of ``size`` (width, height) pixels, interleaved in ``image`` as `composite` writes them (row-major);
    ``seen`` says of each surfel whether any tile of this view lists it, ``full`` whether all maps are there, and ``weighed``
    whether that of contributions is."""

    size: tuple[int, int]
    image: "mi.Float"
    seen: "mi.Bool"
    full: bool = False
    weighed: bool = False

    @functools.cached_property
    def all(self) -> Maps:
        """The maps of every pixel."""
        return self._maps(planes(self.image, self._stride))

    def maps(self, index: "mi.UInt32") -> Maps:
        """Return the maps at the pixels ``index`` (row-major)."""
        return self._maps(fetch(self.image, index, self._stride))

    @property
    def _stride(self):
        """Floats in a pixel."""
        return 5 * PACKET if self.full else 4 * PACKET

    def _maps(self, m):
        """The maps that pixels' floats ``m`` are."""
        delta, m[11:] = (mi.Vector3f(*m[11:14]), m[14:]) if self.full else (None, m[11:])
        contribution = mi.Vector2f(m.pop(11), m.pop(11)) if self.weighed else None
        return Maps(
            mi.Color3f(*m[0:3]),
            mi.Vector3f(*m[3:6]),
            mi.Color3f(*m[6:9]),
            m[9],
            m[10],
            m[11],
            m[12],
            delta,
            m[13] if self.full else None,
            contribution,
        )


def render_gbuffer(
    surfels: "SurfelColumns",
    camera: Camera,
    means2d_offset: "mi.Vector2f | None" = None,
    cutoffs: Cutoffs = Cutoffs(),
    full: bool = False,
    contribution: "mi.Vector2f | None" = None,
) -> GBuffer:
    """Splat ``surfels`` into ``camera``; differentiable in all fields. ``means2d_offset`` is that of `project`; ``full`` asks
    for the maps that only regularizers want, too. Where there is a ``contribution``, two zeros for each surfel, the gradients in
    it of a sum of the map of this name over pixels p, Σ_p a_p contribution_p, are Σ_p a_p w_p: how much each surfel weighs in
    all of them together."""
    surfels = surfels.split()
    projected = project(surfels, camera, means2d_offset)
    delta = surfels.column(mi.Vector3f, "delta_normal")
    features = [
        *surfels.radiance(projected.view),
        *(projected.normal + delta),
        *surfels.column(mi.Color3f, "base_color"),
        surfels.column(mi.Float, "roughness"),
        surfels.column(mi.Float, "metallic"),
        *(delta if full else ()),
        *(() if contribution is None else contribution),
    ]
    dr.eval(projected.geometry, features, projected.normal_derivatives)
    isects = isect_tiles(projected, camera.size, cutoffs)
    image = composite(projected, features, isects, Layout(camera.size, len(features), cutoffs, squares=full))
    return GBuffer(camera.size, image, isects.seen, full, contribution is not None)

"""The object reflected in itself: what a pixel reflects is traced, by Mitsuba's ray tracer, through the surfels as quads.

Where the reflected ray meets a surfel, the light that comes along it is that surfel's own radiance, diffuse and specular
(`one_bounce`), or nothing (`visibility`), instead of the environment. The hit itself is piecewise constant in what moves it:
gradients flow into the radiance of what is hit and its direction, not into which surfel is hit.
"""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..proxies import Proxies
from ..surfel import Surfels

KINDS = ("none", "visibility", "one_bounce")


@dataclass
class Indirect:
    """How surfels see each other: ``kind``, `visibility` or `one_bounce`; ``proxies``, perhaps of a few steps ago; and the
    ``surfels`` as they are."""

    kind: str
    proxies: Proxies
    surfels: Surfels

    def cover(self, incoming, point, normal, direction, lighting):
        """``incoming`` radiance along ``direction``, a lane a pixel, where nothing stands in the way; that of the surfels
        elsewhere."""
        dr.eval(incoming, point, normal, direction)
        found, number = self.proxies.meet(dr.detach(point), dr.detach(normal), dr.detach(direction))
        lanes = dr.compress(found)
        light = dr.zeros(mi.Color3f, dr.width(found))
        if self.kind == "one_bounce" and dr.width(lanes) > 0:
            d = mi.Vector3f(*(dr.gather(mi.Float, c, lanes, mode=dr.ReduceMode.NoConflicts) for c in direction))
            dr.scatter(light, self._radiance(dr.gather(mi.UInt32, number, lanes), d, lighting), lanes)
        return dr.select(found, light, incoming)

    def _radiance(self, number, direction, lighting):
        """What the surfels ``number`` send against ``direction``; they in turn reflect the environment alone."""
        met = self.surfels.take(number)
        normal = dr.normalize(met.frames()[2] + met.column(mi.Vector3f, "delta_normal"))
        if met.two_sided:
            normal = dr.mulsign(normal, -dr.dot(direction, normal))
        lighting = lighting.seen_again()
        surface = (normal, -direction, met.column(mi.Float, "roughness"), met.column(mi.Float, "metallic"),
                   met.column(mi.Color3f, "base_color"))
        return (lighting.diffuse(*surface) if lighting.lit else met.radiance(direction)) + lighting.specular(*surface)

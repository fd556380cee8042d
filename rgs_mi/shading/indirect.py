"""The object reflected in itself: what a pixel reflects is traced, by Mitsuba's ray tracer, through the surfels as quads.

Where the reflected ray meets a surfel, the light that comes along it is that surfel's own radiance, diffuse and specular
(`one_bounce`), or nothing (`visibility`), instead of the environment. The hit itself is piecewise constant in what moves it:
gradients flow into the radiance of what is hit and its direction, not into which surfel is hit. One ray says little about
the wide lobe of a rough surface: where that has a radiance of its own, which carries such light blurred, no ray is traced.

A diffuse lobe has no one direction to trace. Of it each surfel knows how much of the light L that the environment has for it
the others let through, or send in its place:

    a = ∫ L_s(ω) max(0, n·ω) dω / ∫ L(ω) max(0, n·ω) dω                                                              (9)

by rays that start from its centre, one number a channel. It is splatted as a radiance is, and a pixel's lit diffuse radiance
multiplied by it. Both integrals take the same rays, so that a is 1, free of noise, wherever nothing is met.
"""

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..surfels.proxies import Proxies
from ..surfels.surfels import SH_0, Surfels
from .sequence import points

KINDS = ("none", "visibility", "one_bounce")
_RAYS = 32  # a surfel, of (9)
_BLUR = 0.5  # the roughness as whose lobe sees it the environment is taken there: few rays then see small lights, too


@dataclass
class Indirect:
    """How surfels see each other: ``kind``, `visibility` or `one_bounce`; ``proxies``, perhaps of a few steps ago; the
    ``surfels`` as they are; and their ``share`` of diffuse light, a of (9) (None: all)."""

    kind: str
    proxies: Proxies
    surfels: Surfels
    share: "mi.Color3f | None" = None

    def cover(self, incoming, point, normal, direction, lighting, part=1):
        """``incoming`` radiance along ``direction``, a lane a pixel, where nothing stands in the way; elsewhere the surfels'
        takes the place of a ``part`` of it."""
        part = mi.Float(part)
        dr.eval(incoming, point, normal, direction, part)
        found, number, place = self.proxies.meet(*(dr.detach(v) for v in (point, normal, direction)), dr.detach(part) > 0)
        lanes = dr.compress(found)
        light = dr.zeros(mi.Color3f, dr.width(found))
        if self.kind == "one_bounce" and dr.width(lanes) > 0:
            d = mi.Vector3f(*(dr.gather(mi.Float, c, lanes, mode=dr.ReduceMode.NoConflicts) for c in direction))
            number, place = dr.gather(mi.UInt32, number, lanes), dr.gather(mi.Point2f, place, lanes)
            dr.scatter(light, self._radiance(number, place, d, lighting), lanes)
        return dr.select(found, dr.lerp(incoming, light, part), incoming)

    def with_share(self, lighting, seed) -> "Indirect":
        """The same with `share`, where surfels are lit by ``lighting``, whose estimator is the split sum; ``seed``:
        ``mi.UInt32``."""
        with dr.suspend_grad():
            share = self._share(self.surfels.normals(), lighting, seed)
            if self.surfels.two_sided:  # the side that shows is the one that light reaches
                share = dr.maximum(share, self._share(-self.surfels.normals(), lighting, seed))
            dr.eval(share)
        return replace(self, share=share)

    def _share(self, normal, lighting, seed):
        n = len(self.surfels)
        index = dr.arange(mi.UInt32, n * _RAYS)
        surfel, number = index // _RAYS, index % _RAYS
        at = lambda v: dr.gather(type(v), v, surfel)
        normal, point = at(normal), at(self.surfels.column(mi.Vector3f, "centers"))
        local = mi.warp.square_to_cosine_hemisphere(points(n, seed, surfel, number)[0])
        direction = mi.Frame3f(normal).to_world(local)
        radiance = lighting.estimator.environment.eval(direction, mi.Float(_BLUR))
        coming = self.cover(radiance, point, normal, direction, lighting)
        total = lambda color: mi.Color3f(*(dr.block_sum(c, _RAYS) for c in color))
        return total(coming) / dr.maximum(total(radiance), 1e-6)

    def carried(self, surfels, box) -> Surfels:
        """``surfels`` whose radiance is their `share`, in the ``box`` (None: everywhere), to be splatted."""
        shape = surfels.sh.shape
        sh, row = dr.copy(surfels.sh.array), dr.arange(mi.UInt32, len(surfels)) * shape[1]
        inside = mi.Bool(True) if box is None else box.holds(surfels.column(mi.Point3f, "centers"))
        for k in range(shape[1]):
            dr.scatter(sh, (self.share[k] - 0.5) / SH_0 if k < 3 else mi.Float(0), row + k, inside)
        return replace(surfels, sh=mi.TensorXf(sh, shape))

    def _radiance(self, number, place, direction, lighting):
        """What the surfels ``number`` send against ``direction`` from a ``place`` on them; they in turn reflect the
        environment alone."""
        met = self.surfels.take(number)
        normal = met.normals(place)
        if met.two_sided:
            normal = dr.mulsign(normal, -dr.dot(direction, normal))
        lighting = lighting.seen_again()
        surface = (
            normal,
            -direction,
            met.column(mi.Float, "roughness"),
            met.column(mi.Float, "metallic"),
            met.column(mi.Color3f, "base_color"),
        )
        specular = lighting.specular(*surface)
        if not lighting.lit:
            return met.radiance(direction) + specular
        share = 1 if self.share is None else dr.gather(mi.Color3f, self.share, number)
        return lighting.diffuse(*surface, share=share) + specular

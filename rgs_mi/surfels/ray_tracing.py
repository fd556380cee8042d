"""Surfels along any ray, one after the other: what splatting makes of a pixel, for paths of light.

A ray crosses the quads of `Proxies` front to back. With α_i = o_i exp(−(u² + v²)/2) where it crosses surfel i,

    w_i = α_i Π_{j<i} (1 − α_j),   A = Σ w_i,   x̄ = Σ w_i x_i / A                                       (10)

are weights, coverage, and the means of distance, normal (n + u ∂n/∂u + v ∂n/∂v) and material: a G-buffer's
(`splat/composite.py`), in the exact order of the ray and without the low-pass of pixels. The ray ends on the surfels with
probability A, and then on the one whose share of A a random number falls into: that one's own radiance has the right mean,
Σ w_i c_i.
"""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.bounding_box import BoundingBox
from ..splat.hit import fetch, pack
from ..splat.tiles import Cutoffs
from .proxies import Proxies
from .surfels import Surfels, sh_order

_CUTOFFS = Cutoffs(alpha_min=0.01, transmittance_min=0.01)  # against 1/255 and 1e-3: three times as fast, normals 0.2° off
_STEP = 2e-6  # past a crossing, relative to coordinates: a dozen float32 roundings
_NONE = 0xFFFFFFFF
_SHAPE, _MATERIAL = 12, 8  # floats in a row


@dataclass
class SurfelIntersection:
    """Where rays end on surfels, one entry per ray.

    found   whether they do
    t       mean distance along the ray
    normal  unit mean of n + Δn, world space, turned against the ray
    roughness, metallic, base_color   means
    index   the surfel whose radiance they bring
    """

    found: "mi.Bool"
    t: "mi.Float"
    normal: "mi.Vector3f"
    roughness: "mi.Float"
    metallic: "mi.Float"
    base_color: "mi.Color3f"
    index: "mi.UInt32"


class SurfelRayTracer:
    """Surfels as rays meet them, those in the ``box`` where there is one; not differentiated. Its methods may be called
    within symbolic loops."""

    def __init__(self, surfels: Surfels, box: BoundingBox | None = None) -> None:
        with dr.suspend_grad():
            self.proxies = Proxies(surfels, _CUTOFFS.alpha_min, box)
            column = surfels.column
            self.shape = pack(
                [
                    column(mi.Float, "opacities"),
                    self.proxies.extent,
                    *self.proxies.normal,
                    *(value for slope in surfels.normal_derivatives() for value in slope),
                ]
            )
            self.material = pack(
                [
                    *column(mi.Vector3f, "delta_normal"),
                    *column(mi.Color3f, "base_color"),
                    column(mi.Float, "roughness"),
                    column(mi.Float, "metallic"),
                ]
            )
            self.sh, self.channels = dr.detach(surfels.sh.array), surfels.sh.shape[1]
            dr.eval(self.shape, self.material, self.sh)
        self.two_sided = surfels.two_sided

    @dr.syntax
    def intersect(
        self, ray: "mi.Ray3f", maxt: "mi.Float", leaves: "mi.Bool", sample: "mi.Float", active: "mi.Bool"
    ) -> SurfelIntersection:
        """Intersect each world-space ``ray`` by (10) up to the distance ``maxt``. ``leaves`` says whether it comes from
        surfels (see `_cross`); the uniform random numbers ``sample`` decide which surfel is found."""
        active, found = mi.Bool(active), mi.Bool(False)
        passed, remaining = mi.Float(0), mi.Float(1)
        index, last = mi.UInt32(0), mi.UInt32(_NONE)
        t, normal = mi.Float(0), mi.Vector3f(0)
        roughness, metallic, base_color = mi.Float(0), mi.Float(0), mi.Color3f(0)
        while active:
            active, distance, i, alpha, facing = self._cross(ray, passed, maxt, leaves, last, active)
            weight = remaining * alpha
            remaining -= weight
            goes_on = remaining > _CUTOFFS.transmittance_min
            picked = ~found & ((1 - remaining > sample) | ~goes_on)
            index = dr.select(picked, i, index)
            found |= picked
            row = fetch(self.material, i, _MATERIAL, active & (alpha > 0))
            t += weight * distance
            normal += weight * (facing + mi.Vector3f(*row[:3]))
            base_color += weight * mi.Color3f(*row[3:6])
            roughness += weight * row[6]
            metallic += weight * row[7]
            last, passed = i, self._past(ray, distance)
            active &= goes_on
        mean = dr.rcp(dr.maximum(1 - remaining, _CUTOFFS.alpha_min))
        length = dr.norm(normal)
        return SurfelIntersection(
            found & (length > 0),
            t * mean,
            normal / dr.select(length > 0, length, 1),
            roughness * mean,
            metallic * mean,
            base_color * mean,
            index,
        )

    @dr.syntax
    def transmittance(self, ray: "mi.Ray3f", maxt: "mi.Float", leaves: "mi.Bool", active: "mi.Bool") -> "mi.Float":
        """Return Π (1 − α_i) along each ``ray`` up to the distance ``maxt``; see `intersect`."""
        active = mi.Bool(active)
        passed, remaining, last = mi.Float(0), mi.Float(1), mi.UInt32(_NONE)
        while active:
            active, distance, last, alpha, _ = self._cross(ray, passed, maxt, leaves, last, active)
            remaining *= 1 - alpha
            passed = self._past(ray, distance)
            active &= remaining > _CUTOFFS.transmittance_min
        return dr.select(remaining > _CUTOFFS.transmittance_min, remaining, 0)

    def radiance(self, index: "mi.UInt32", direction: "mi.Vector3f", active: "mi.Bool") -> "mi.Color3f":
        """Return the diffuse radiance that the surfel ``index`` itself sends against ``direction``; see
        `Surfels.radiance`."""
        value = mi.Color3f(0.5)
        for k, Y in enumerate(dr.sh_eval(direction, sh_order(self.channels))):
            at = index * self.channels + 3 * k
            value += Y * mi.Color3f(*(dr.gather(mi.Float, self.sh, at + c, active) for c in range(3)))
        return dr.maximum(value, 0)

    def above(self, point: "mi.Point3f", normal: "mi.Vector3f") -> "mi.Point3f":
        """Return where rays that leave surfels at ``point`` start: above their neighbours."""
        return point + self.proxies.clearance * normal

    def _cross(self, ray, passed, maxt, leaves, last, active):
        """(whether there is a next crossing beyond the distance ``passed``, its distance, the surfel's index, α, and its
        normal turned against the ray); α is 0 where the surfel does not show, or is the ``last`` one again.

        A ray that ``leaves`` surfels is not stopped by the backs of others near its start: these are of the same surface,
        which is as thick as surfels lie unevenly."""
        onward = mi.Ray3f(ray.o + passed * ray.d, ray.d)
        onward.maxt = maxt - passed
        hit = self.proxies.scene.ray_intersect_preliminary(onward, coherent=False, active=active)
        valid, index = active & hit.is_valid(), hit.prim_index // 2
        distance = passed + dr.select(valid, hit.t, 0)
        opacity, extent, *vectors = fetch(self.shape, index, _SHAPE, valid)[:11]
        normal, dn_du, dn_dv = (mi.Vector3f(*vectors[k : k + 3]) for k in (0, 3, 6))
        u, v = (extent * value for value in self.proxies.position(hit))
        alpha = opacity * dr.exp(-0.5 * (u * u + v * v))
        away = dr.dot(normal, ray.d) > 0
        shows = valid & (alpha > _CUTOFFS.alpha_min) & (index != last)
        shows &= ~(away & (leaves & (distance < self.proxies.thickness))) if self.two_sided else ~away
        alpha = dr.select(shows, dr.minimum(alpha, _CUTOFFS.alpha_max), 0)
        normal += u * dn_du + v * dn_dv
        return valid, distance, index, alpha, dr.select(away, -normal, normal)

    def _past(self, ray, distance):
        return distance + _STEP * (dr.max(dr.abs(ray.o)) + distance)

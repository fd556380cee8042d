"""The object reflected in itself (docs/method.md §3): what a pixel reflects is traced, by Mitsuba's ray tracer, through the
surfels as quads.

Where the reflected ray meets a surfel, the light that comes along it is that surfel's own radiance, diffuse and specular
(`one_bounce`), or nothing (`visibility`), instead of the environment. The hit itself is piecewise constant in what moves it:
gradients flow into the radiance of what is hit and its direction, not into which surfel is hit. One ray says little about
the wide lobe of a rough surface: where that has a radiance of its own, which carries such light blurred, no ray is traced.

A diffuse lobe has no one direction to trace. For it each surfel knows how much of the light L that the environment has for it
the others let through, or send in its place:

    a = ∫ L_s(ω) max(0, n·ω) dω / ∫ L(ω) max(0, n·ω) dω                                                              (9)

by rays that start from its center, one number per channel. It is splatted as a radiance is, and a pixel's lit diffuse radiance
multiplied by it. Both integrals take the same rays, so that a is 1, free of noise, wherever nothing is met. On a turntable they
are means over a whole turn of the light.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.bounding_box import BoundingBox
from ..surfels.proxies import Proxies
from ..surfels.surfels import SH_0, SurfelColumns
from .sequence import points

if TYPE_CHECKING:
    from .lighting import Lighting

KINDS = ("none", "visibility", "one_bounce")
_RAYS, _TURNS = 32, 8  # from each surfel, of (9); places about a turntable in which these see the light
_MOST_RAYS = 1 << 21  # at a time: of 300 000 surfels all together would take 800 MB
_BLUR = 0.5  # the roughness as whose lobe sees it the environment is taken there: few rays then see small lights, too


@dataclass
class Indirect:
    """How surfels see each other.

    kind                   what a ray brings from a surfel that it meets: nothing, or that surfel's radiance
    proxies                the quads that rays meet, perhaps of a few steps ago
    surfels                the surfels as they are, all that rays may meet
    irradiance_visibility  a of (9), one entry per surfel (None: 1 for all), 1 beyond the box
    """

    kind: Literal["visibility", "one_bounce"]
    proxies: Proxies
    surfels: SurfelColumns
    irradiance_visibility: "mi.Color3f | None" = None

    def incident_radiance(
        self,
        incoming: "mi.Color3f",
        point: "mi.Point3f",
        normal: "mi.Vector3f",
        direction: "mi.Vector3f",
        lighting: "Lighting",
        part: "mi.Float | float" = 1,
    ) -> "mi.Color3f":
        """Return ``incoming``, the environment's radiance along ``direction``, where nothing stands in the way of rays from
        ``point``, a surface with ``normal`` (unit, world space); elsewhere the radiance of the surfels that rays meet, under
        ``lighting``, takes the place of a ``part`` of it."""
        part = mi.Float(part)
        dr.eval(incoming, point, normal, direction, part)
        found, index, uv = self.proxies.intersect(
            dr.detach(point), dr.detach(normal), dr.detach(direction), dr.detach(part) > 0
        )
        indices = dr.compress(found)
        light = dr.zeros(mi.Color3f, dr.width(found))
        if self.kind == "one_bounce" and dr.width(indices) > 0:
            d = mi.Vector3f(*(dr.gather(mi.Float, c, indices, mode=dr.ReduceMode.NoConflicts) for c in direction))
            index, uv = dr.gather(mi.UInt32, index, indices), dr.gather(mi.Point2f, uv, indices)
            dr.scatter(light, self._radiance(index, uv, d, lighting), indices)
        return dr.select(found, dr.lerp(incoming, light, part), incoming)

    def with_irradiance_visibility(self, lighting: "Lighting", seed: "mi.UInt32") -> "Indirect":
        """Return the same with `irradiance_visibility`, where surfels are lit by ``lighting``, whose estimator is the split
        sum; not differentiated."""
        with dr.suspend_grad():
            n, center = len(self.surfels), self.surfels.column(mi.Vector3f, "centers")
            visibility = dr.full(mi.Color3f, 1, n)
            lit = dr.arange(mi.UInt32, n) if lighting.box is None else dr.compress(lighting.box.contains(center))
            if dr.width(lit) > 0:
                of_lit = lambda v: dr.gather(type(v), v, lit)
                center, normal = of_lit(center), of_lit(self.surfels.normals())
                found = self._irradiance_visibility(center, normal, lighting, seed)
                if self.surfels.two_sided:  # the side that shows is the one that light reaches
                    found = dr.maximum(found, self._irradiance_visibility(center, -normal, lighting, seed))
                dr.scatter(visibility, found, lit)
            dr.eval(visibility)
        return replace(self, irradiance_visibility=visibility)

    def _irradiance_visibility(self, center, normal, lighting, seed):
        n, coming, radiance = dr.width(center), mi.Color3f(0), mi.Color3f(0)
        rounds = 1 if lighting.turntable is None else _TURNS
        while n * _RAYS > rounds * _MOST_RAYS and rounds < _RAYS:
            rounds *= 2
        each = _RAYS // rounds  # rays that see the light in one place
        index = dr.arange(mi.UInt32, n * each)
        surfel = index // each
        at = lambda v: dr.gather(type(v), v, surfel)
        total = lambda color: mi.Color3f(*(dr.block_sum(c, each) for c in color))
        normal, point = at(normal), at(center)
        for k in range(rounds):
            light = lighting.turned(dr.opaque(mi.Float, 2 * np.pi * k / rounds))
            sample = index % each + dr.opaque(mi.UInt32, k * each)
            local = mi.warp.square_to_cosine_hemisphere(points(n, seed, surfel, sample)[0])
            direction = mi.Frame3f(normal).to_world(local)
            incoming = light.estimator.environment.eval(direction, mi.Float(_BLUR), point)
            coming += total(self.incident_radiance(incoming, point, normal, direction, light))
            radiance += total(incoming)
            dr.eval(coming, radiance)
        return coming / dr.maximum(radiance, 1e-6)

    def with_visibility_as_radiance(self, surfels: SurfelColumns, box: BoundingBox | None) -> SurfelColumns:
        """Return ``surfels`` whose radiance is their `irradiance_visibility`, in the ``box`` (None: everywhere), to be
        splatted. That must be known."""
        visibility, surfels = self.visibility_of(surfels), surfels.split()
        assert visibility is not None, "with_irradiance_visibility() comes first"
        sh = [(part - 0.5) / SH_0 for part in visibility]
        if box is not None:
            inside = box.contains(surfels.column(mi.Point3f, "centers"))
            own = surfels.all_columns("sh")
            sh += [mi.Float(0)] * (len(own) - len(sh))
            sh = [dr.select(inside, a, b) for a, b in zip(sh, own)]
        return surfels.with_columns({"sh": sh})

    def visibility_of(self, surfels: SurfelColumns) -> "mi.Color3f | None":
        """Return the `irradiance_visibility` of some ``surfels`` of the scene."""
        visibility = self.irradiance_visibility
        known = visibility is not None and surfels.index is not None
        return dr.gather(mi.Color3f, visibility, surfels.index) if known else visibility

    def _radiance(self, index, uv, direction, lighting):
        """What the surfels ``index`` send against ``direction`` from ``uv`` on them; they in turn reflect the environment
        alone."""
        surfels = self.surfels.take(index)
        visibility = self.visibility_of(surfels)
        return lighting.for_secondary_bounce().radiance(surfels, uv, -direction, 1 if visibility is None else visibility)

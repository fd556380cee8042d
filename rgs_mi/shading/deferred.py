"""From G-buffer to image: C = C_d + f_φ(C_s) per covered pixel (docs/method.md §3)."""

from dataclasses import dataclass, replace
from typing import Literal

import drjit as dr
import mitsuba as mi

from ..core.bounding_box import BoundingBox
from ..core.camera import Camera, opaque, pixel_directions
from ..splat.gbuffer import GBuffer, Maps, render_gbuffer
from ..surfels.surfels import Surfels
from .environment import IncidentRadiance
from .indirect import Indirect
from .monte_carlo import SAMPLES, MonteCarlo
from .shader import Shader
from .split_sum import DEFAULT_ETA, SplitSum

COVERED = 4e-3  # pixels with less alpha are left empty
# Roughness up to which a surface with a radiance of its own reflects the other surfels wholly, and from which on not at all:
# what it receives of them is blurred then, and already in that radiance.
_NARROW, _WIDE = 0.2, 0.4


@dataclass(frozen=True)
class Shading:
    """How a scene is shaded, as the parameters of its integrator `rgs_deferred` say; ``eta`` is the surfels' index of
    refraction, and ``box`` says where all this holds (None: everywhere)."""

    specular: Literal["split_sum", "monte_carlo", "none"] = "split_sum"
    diffuse: Literal["radiance", "lit"] = "radiance"
    samples: int = SAMPLES
    eta: float = DEFAULT_ETA
    box: BoundingBox | None = None
    indirect: Literal["none", "visibility", "one_bounce"] = "none"


@dataclass
class Lighting:
    """What surfels reflect, and how.

    estimator  estimates the BSDF's integrals, and holds the environment
    shader     f_φ (None: the identity)
    indirect   says how surfels reflect each other (None: they do not)
    lit        whether their diffuse radiance, too, is that of their base colour under the light, and not their own
    box        where all this holds (None: everywhere); beyond it they have their own diffuse radiance alone
    """

    estimator: SplitSum | MonteCarlo
    shader: Shader | None = None
    indirect: Indirect | None = None
    lit: bool = False
    box: BoundingBox | None = None

    def specular(
        self,
        normal: "mi.Vector3f",
        view: "mi.Vector3f",
        roughness: "mi.Float",
        metallic: "mi.Float",
        base_color: "mi.Color3f",
        point: "mi.Point3f | None" = None,
    ) -> "mi.Color3f":
        """Return f_φ(C_s), linear radiance that surfaces reflect towards ``view``; see `SplitSum.specular`. `indirect` needs
        their world-space ``point`` (None: they reflect the environment alone)."""
        incident_radiance = self._incident_radiance(normal, point, roughness)
        C_s = self.estimator.specular(normal, view, roughness, metallic, base_color, incident_radiance)
        return C_s if self.shader is None else self.shader(C_s, roughness, dr.dot(normal, view))

    def diffuse(
        self,
        normal: "mi.Vector3f",
        view: "mi.Vector3f",
        roughness: "mi.Float",
        metallic: "mi.Float",
        base_color: "mi.Color3f",
        point: "mi.Point3f | None" = None,
        irradiance_visibility: "mi.Color3f | float" = 1,
    ) -> "mi.Color3f":
        """Return C_d of lit surfaces, as `specular` does C_s; ``irradiance_visibility`` is a of (9) in `indirect.py`."""
        incident_radiance = self._incident_radiance(normal, point, roughness)
        return self.estimator.diffuse(
            normal, view, roughness, metallic, base_color, incident_radiance, irradiance_visibility
        )

    def _incident_radiance(self, normal, point, roughness) -> IncidentRadiance | None:
        """The callback for surfaces at ``point``; None where there is none."""

        def incident_radiance(light, direction, index):
            assert self.indirect is not None, "surfaces have a point where they reflect each other"
            at = lambda v: v if index is None else dr.gather(type(v), v, index)
            part = 1 if self.lit else dr.clip((_WIDE - at(roughness)) / (_WIDE - _NARROW), 0, 1)
            return self.indirect.incident_radiance(light, at(point), at(normal), direction, self, part)

        return None if point is None else incident_radiance

    @property
    def _with_visibility(self) -> Indirect | None:
        """`indirect` where lit diffuse light has an irradiance visibility."""
        known = self.lit and self.indirect is not None and self.indirect.irradiance_visibility is not None
        return self.indirect if known else None

    def with_irradiance_visibility(self, seed: "mi.UInt32 | int" = 0) -> "Lighting":
        """Return the same lighting with the part of its own light that the object hides from itself; see
        `Indirect.with_irradiance_visibility`. It must have `indirect`."""
        assert self.indirect is not None, "nothing hides light where surfels do not reflect each other"
        return replace(self, indirect=self.indirect.with_irradiance_visibility(self, dr.opaque(mi.UInt32, seed)))

    def as_splatted(self, surfels: Surfels) -> Surfels:
        """Return the surfels to splat: what is lit has no radiance of its own, but its irradiance visibility in its place."""
        indirect = self._with_visibility
        return surfels if indirect is None else indirect.with_visibility_as_radiance(surfels, self.box)

    def irradiance_visibility(self, maps: Maps, mean: "mi.Float") -> "mi.Color3f | float":
        """Return the irradiance visibility of pixels of these ``maps``, which ``mean`` divides by their coverage."""
        return 1 if self._with_visibility is None else maps.diffuse * mean

    def for_secondary_bounce(self) -> "Lighting":
        """Return the lighting of what a reflected ray meets: it reflects the environment alone."""
        return replace(self, estimator=self.estimator.for_secondary_bounce(), indirect=None)

    def learned(self) -> list:
        """Return the arrays that a fit changes: texels of the environment as the estimator has them, and the weights of the
        shader where there is one."""
        return [self.estimator.environment.texels, *([self.shader.weights] if self.shader else [])]

    def with_learned(self, arrays: list, surfels: Surfels) -> "Lighting":
        """Return the same lighting with other ``arrays`` in place of `learned`, and for other ``surfels``, moved ones."""
        return replace(
            self,
            estimator=self.estimator.with_texels(arrays[0]),
            shader=self.shader and Shader(arrays[1]),
            indirect=self.indirect and replace(self.indirect, surfels=surfels),
        )


@dataclass
class Image:
    """A rendered view of W × H pixels. ``color``, ``diffuse`` and ``specular``, of width W · H, row-major, are linear
    radiance, premultiplied by coverage, without what lies behind the surfels; they were shaded from ``gbuffer``."""

    color: "mi.Color3f"
    diffuse: "mi.Color3f"
    specular: "mi.Color3f"
    gbuffer: GBuffer


def shade(gbuffer: GBuffer, camera: Camera, lighting: Lighting | None) -> Image:
    """Shade the G-buffer that ``camera`` sees; without ``lighting`` by diffuse radiance alone. Differentiable."""
    if lighting is None:
        diffuse = gbuffer.all.diffuse
        return Image(diffuse, diffuse, dr.zeros(mi.Color3f, camera.size[0] * camera.size[1]), gbuffer)
    diffuse, specular = _reflected(gbuffer, camera, lighting)
    return Image(diffuse + specular, diffuse, specular, gbuffer)


def within(gbuffer: GBuffer, camera: Camera, box: BoundingBox | None) -> "mi.Bool":
    """Return which pixels are covered by what lies in ``box`` (None: by anything), of width W · H."""
    alpha, depth = dr.detach(gbuffer.all.alpha), dr.detach(gbuffer.all.depth)
    covered = alpha > COVERED
    if box is None:
        return covered
    directions = pixel_directions(camera, dr.arange(mi.UInt32, camera.size[0] * camera.size[1]))
    return covered & box.contains(_points(camera, directions, depth / dr.maximum(alpha, COVERED)))


def _points(camera, direction, depth):
    """World-space points along unit ``direction`` at a ``depth`` (z)."""
    rotation, origin, *_ = opaque(camera)
    return origin + direction * (depth / (rotation @ direction).z)


def _reflected(gbuffer, camera, lighting):
    """(C_d, f_φ(C_s)) times coverage, of width W · H. Only covered pixels are computed."""
    diffuse, specular = gbuffer.all.diffuse, dr.zeros(mi.Color3f, camera.size[0] * camera.size[1])
    shaded = within(gbuffer, camera, lighting.box)
    index = dr.compress(shaded)
    if lighting.lit:
        diffuse = dr.select(shaded, 0, diffuse)
    if dr.width(index) > 0:
        m = gbuffer.maps(index)
        mean = dr.rcp(m.alpha)
        normal, direction = dr.normalize(m.normal), pixel_directions(camera, index)
        point = None if lighting.indirect is None else _points(camera, direction, m.depth * mean)
        surfaces = normal, -direction, m.roughness * mean, m.metallic * mean, m.base_color * mean, point
        dr.scatter(specular, lighting.specular(*surfaces) * m.alpha, index)
        if lighting.lit:
            dr.scatter(diffuse, lighting.diffuse(*surfaces, lighting.irradiance_visibility(m, mean)) * m.alpha, index)
    return diffuse, specular


def render(
    surfels: Surfels,
    camera: Camera,
    lighting: Lighting | None,
    means2d_offset: "mi.Vector2f | None" = None,
    full: bool = False,
) -> Image:
    """Splat ``surfels`` (see `render_gbuffer`, also for the other arguments) and `shade` them; differentiable in their
    fields, the environment and the shader."""
    if lighting is not None:
        surfels = lighting.as_splatted(surfels)
    return shade(render_gbuffer(surfels, camera, means2d_offset, full=full), camera, lighting)

"""From G-buffer to image: C = C_d + f_φ(C_s) per covered pixel (`method.md` §3)."""

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..core.bounding_box import BoundingBox
from ..splat.gbuffer import render_gbuffer
from ..splat.project import opaque
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
    """How a scene is shaded, as its integrator (see `rgs_deferred`) and its surfels say; ``box``: where (None: all of
    it)."""

    specular: str = "split_sum"
    diffuse: str = "radiance"
    samples: int = SAMPLES
    eta: float = DEFAULT_ETA
    box: BoundingBox | None = None
    indirect: str = "none"


@dataclass
class Lighting:
    """What surfels reflect, and how: the ``estimator`` of the BSDF's integrals; f_φ (None: the identity); each other (None:
    not); ``lit``: whether their diffuse radiance, too, is that of their base colour under the light, and not their own;
    ``box``: where all this holds (None: everywhere), beyond it they have their own diffuse radiance alone."""

    estimator: SplitSum | MonteCarlo
    shader: Shader | None = None
    indirect: Indirect | None = None
    lit: bool = False
    box: BoundingBox | None = None

    def specular(self, normal, view, roughness, metallic, base_color, point=None):
        """f_φ(C_s), radiance that surfaces reflect towards ``view``, ``mi.Color3f``; see `SplitSum.specular`. ``point``:
        where the surfaces are, which `indirect` needs (None: they reflect the environment alone)."""
        incident_radiance = self._incident_radiance(normal, point, roughness)
        C_s = self.estimator.specular(normal, view, roughness, metallic, base_color, incident_radiance)
        return C_s if self.shader is None else self.shader(C_s, roughness, dr.dot(normal, view))

    def diffuse(self, normal, view, roughness, metallic, base_color, point=None, irradiance_visibility=1):
        """C_d where it is ``lit``; as `specular`. ``irradiance_visibility``: the part of the light that comes there."""
        incident_radiance = self._incident_radiance(normal, point, roughness)
        return self.estimator.diffuse(
            normal, view, roughness, metallic, base_color, incident_radiance, irradiance_visibility
        )

    def _incident_radiance(self, normal, point, roughness):
        """Callback that returns incident radiance after occlusion (see `SplitSum.specular`); None means the unoccluded
        environment."""

        def incident_radiance(light, direction, index):
            at = lambda v: v if index is None else dr.gather(type(v), v, index)
            part = 1 if self.lit else dr.clip((_WIDE - at(roughness)) / (_WIDE - _NARROW), 0, 1)
            return self.indirect.incident_radiance(light, at(point), at(normal), direction, self, part)

        return None if point is None else incident_radiance

    @property
    def _has_visibility(self):
        return self.lit and self.indirect is not None and self.indirect.irradiance_visibility is not None

    def with_irradiance_visibility(self, seed=0) -> "Lighting":
        """The same, where the object hides some of its own light from itself; see `Indirect.with_irradiance_visibility`."""
        return replace(self, indirect=self.indirect.with_irradiance_visibility(self, dr.opaque(mi.UInt32, seed)))

    def as_splatted(self, surfels):
        """The surfels to splat: what is lit has no radiance of its own, but its irradiance visibility in its place."""
        return self.indirect.with_visibility_as_radiance(surfels, self.box) if self._has_visibility else surfels

    def irradiance_visibility(self, maps, mean):
        """The irradiance visibility of pixels of these ``maps``, which ``mean`` divides by their coverage."""
        return maps.diffuse * mean if self._has_visibility else 1

    def for_secondary_bounce(self) -> "Lighting":
        """The lighting of what a reflected ray meets: it reflects the environment alone."""
        return replace(self, estimator=self.estimator.for_secondary_bounce(), indirect=None)

    def learned(self) -> list:
        """The arrays that a fit changes: texels of the environment, and the weights of the shader where there is one."""
        return [self.estimator.environment.texels, *([self.shader.weights] if self.shader else [])]

    def with_learned(self, arrays, surfels) -> "Lighting":
        """The same with other ``arrays`` in place of `learned`, and for other ``surfels``, moved ones."""
        return replace(
            self,
            estimator=self.estimator.with_texels(arrays[0]),
            shader=self.shader and Shader(arrays[1]),
            indirect=self.indirect and replace(self.indirect, surfels=surfels),
        )


@dataclass
class Image:
    """A rendered view, a lane a pixel, row-major. ``color``, ``diffuse``, ``specular``: linear radiance, premultiplied by
    coverage, without what lies behind the surfels; ``gbuffer``: the maps it was shaded from."""

    color: "mi.Color3f"
    diffuse: "mi.Color3f"
    specular: "mi.Color3f"
    gbuffer: object


def pixel_directions(camera, index):
    """Unit world-space directions through the centres of pixels number ``index`` (row-major)."""
    R, _, f, principal = opaque(camera)
    width = camera.size[0]
    x = (mi.Float(index % width) + 0.5 - principal.x) / f.x
    y = (mi.Float(index // width) + 0.5 - principal.y) / f.y
    return dr.normalize(R.T @ mi.Vector3f(x, y, 1))


def shade(gbuffer, camera, lighting: Lighting | None) -> Image:
    """Shade a G-buffer; without ``lighting``: diffuse radiance only."""
    if lighting is None:
        diffuse = gbuffer.all.diffuse
        return Image(diffuse, diffuse, dr.zeros(mi.Color3f, camera.size[0] * camera.size[1]), gbuffer)
    diffuse, specular = _reflected(gbuffer, camera, lighting)
    return Image(diffuse + specular, diffuse, specular, gbuffer)


def within(gbuffer, camera, box: BoundingBox | None):
    """Which pixels are covered by what lies in ``box`` (None: by anything), ``mi.Bool``."""
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
    """(C_d, f_φ(C_s)) times coverage, a lane a pixel. Only covered pixels are computed."""
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


def render(surfels, camera, lighting: Lighting | None, means2d_offset=None, full=False) -> Image:
    """Splat (see `render_gbuffer`) and `shade`; differentiable in the surfels' fields, the environment and the shader."""
    if lighting is not None:
        surfels = lighting.as_splatted(surfels)
    return shade(render_gbuffer(surfels, camera, means2d_offset, full=full), camera, lighting)

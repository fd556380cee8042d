"""From G-buffer to image: C = C_d + f_φ(C_s) per covered pixel (`method.md` §3)."""

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..splat.gbuffer import render_gbuffer
from ..splat.project import opaque
from . import split_sum
from .environment import FilteredEnvironment
from .shader import Shader

COVERED = 4e-3  # pixels with less alpha are left empty


@dataclass
class Lighting:
    """What surfels reflect, and how: the environment, their index of refraction, and f_φ (None: the identity)."""

    filtered: FilteredEnvironment
    eta: float = split_sum.DEFAULT_ETA
    shader: Shader | None = None

    def learned(self) -> list:
        """The arrays that a fit changes: filtered texels, and the weights of the shader where there is one."""
        return [self.filtered.texels, *([self.shader.weights] if self.shader else [])]

    def with_learned(self, arrays) -> "Lighting":
        """The same with other ``arrays`` in place of `learned`."""
        return replace(self, filtered=replace(self.filtered, texels=arrays[0]), shader=self.shader and Shader(arrays[1]))


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
    diffuse = gbuffer.all.diffuse
    if lighting is None:
        return Image(diffuse, diffuse, dr.zeros(mi.Color3f, camera.size[0] * camera.size[1]), gbuffer)
    specular = _specular(gbuffer, camera, lighting)
    return Image(diffuse + specular, diffuse, specular, gbuffer)


def _specular(gbuffer, camera, lighting):
    """f_φ(C_s) times coverage, a lane a pixel. Only covered pixels are computed."""
    specular = dr.zeros(mi.Color3f, camera.size[0] * camera.size[1])
    index = dr.compress(dr.detach(gbuffer.all.alpha) > COVERED)
    if dr.width(index) > 0:
        m = gbuffer.maps(index)
        mean = dr.rcp(m.alpha)
        normal, view = dr.normalize(m.normal), -pixel_directions(camera, index)
        roughness = m.roughness * mean
        C_s = split_sum.specular(normal, view, roughness, m.metallic * mean, m.base_color * mean, lighting.filtered,
                                 lighting.eta)
        if lighting.shader is not None:
            C_s = lighting.shader(C_s, roughness, dr.dot(normal, view))
        dr.scatter(specular, C_s * m.alpha, index)
    return specular


def render(surfels, camera, lighting: Lighting | None, screen_offset=None) -> Image:
    """Splat and `shade`; differentiable in the surfels' fields, the environment and the shader."""
    return shade(render_gbuffer(surfels, camera, screen_offset), camera, lighting)

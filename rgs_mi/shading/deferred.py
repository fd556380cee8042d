"""From G-buffer to image: C = C_d + f_φ(C_s) per covered pixel (`method.md` §3)."""

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..splat.gbuffer import render_gbuffer
from ..splat.project import opaque
from . import split_sum
from .environment import FilteredEnvironment
from .indirect import Indirect
from .shader import Shader

COVERED = 4e-3  # pixels with less alpha are left empty


@dataclass
class Lighting:
    """What surfels reflect, and how: the environment, their index of refraction, f_φ (None: the identity), and each other
    (None: not)."""

    filtered: FilteredEnvironment
    eta: float = split_sum.DEFAULT_ETA
    shader: Shader | None = None
    indirect: Indirect | None = None

    def specular(self, normal, view, roughness, metallic, base_color, point=None):
        """f_φ(C_s), radiance that surfaces reflect towards ``view``, ``mi.Color3f``, by split sum.

        ``normal``, ``view``: unit, world space, ``view`` from the surface to the camera. ``point``: where the surfaces are,
        which `indirect` needs (None: they reflect the environment alone).
        """
        cosine = dr.dot(normal, view)
        reflected = 2 * cosine * normal - view
        incoming = self.filtered.eval(reflected, roughness)
        if point is not None:
            incoming = self.indirect.cover(incoming, point, normal, reflected, self)
        C_s = incoming * split_sum.albedo(cosine, roughness, metallic, base_color, self.eta)
        return C_s if self.shader is None else self.shader(C_s, roughness, cosine)

    def learned(self) -> list:
        """The arrays that a fit changes: filtered texels, and the weights of the shader where there is one."""
        return [self.filtered.texels, *([self.shader.weights] if self.shader else [])]

    def with_learned(self, arrays, surfels) -> "Lighting":
        """The same with other ``arrays`` in place of `learned`, and for other ``surfels``, moved ones."""
        return replace(self, filtered=replace(self.filtered, texels=arrays[0]), shader=self.shader and Shader(arrays[1]),
                       indirect=self.indirect and replace(self.indirect, surfels=surfels))


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
        normal, direction = dr.normalize(m.normal), pixel_directions(camera, index)
        point = None
        if lighting.indirect is not None:
            rotation, origin, *_ = opaque(camera)
            point = origin + direction * (m.depth * mean / (rotation @ direction).z)
        C_s = lighting.specular(normal, -direction, m.roughness * mean, m.metallic * mean, m.base_color * mean, point)
        dr.scatter(specular, C_s * m.alpha, index)
    return specular


def render(surfels, camera, lighting: Lighting | None, screen_offset=None, squares=False) -> Image:
    """Splat (see `render_gbuffer`) and `shade`; differentiable in the surfels' fields, the environment and the shader."""
    return shade(render_gbuffer(surfels, camera, screen_offset, squares=squares), camera, lighting)

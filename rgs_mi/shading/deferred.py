"""From G-buffer to image: C = C_d + f_φ(C_s) per covered pixel (`method.md` §3), f_φ the identity."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..splat.gbuffer import render_gbuffer
from ..splat.project import opaque
from . import split_sum

COVERED = 4e-3  # pixels with less alpha are left empty


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


def shade(gbuffer, camera, filtered, eta=split_sum.DEFAULT_ETA) -> Image:
    """Shade a G-buffer under a `FilteredEnvironment`; None: diffuse radiance only."""
    diffuse = gbuffer.all.diffuse
    if filtered is None:
        return Image(diffuse, diffuse, dr.zeros(mi.Color3f, camera.size[0] * camera.size[1]), gbuffer)
    specular = _specular(gbuffer, camera, filtered, eta)
    return Image(diffuse + specular, diffuse, specular, gbuffer)


def _specular(gbuffer, camera, filtered, eta):
    """C_s times coverage, a lane a pixel. Only covered pixels are computed."""
    specular = dr.zeros(mi.Color3f, camera.size[0] * camera.size[1])
    index = dr.compress(dr.detach(gbuffer.all.alpha) > COVERED)
    if dr.width(index) > 0:
        m = gbuffer.maps(index)
        mean = dr.rcp(m.alpha)
        normal, view = dr.normalize(m.normal), -pixel_directions(camera, index)
        C_s = split_sum.specular(normal, view, m.roughness * mean, m.metallic * mean, m.base_color * mean, filtered, eta)
        dr.scatter(specular, C_s * m.alpha, index)
    return specular


def render(surfels, camera, filtered, screen_offset=None, eta=split_sum.DEFAULT_ETA) -> Image:
    """Splat and `shade`; differentiable in the surfels' fields and the environment."""
    return shade(render_gbuffer(surfels, camera, screen_offset), camera, filtered, eta)

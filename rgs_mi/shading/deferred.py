"""From G-buffer to image: C = C_d + f_φ(C_s) per covered pixel (docs/method.md §3)."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.bounding_box import BoundingBox
from ..core.camera import Camera, opaque, pixel_directions
from ..core.turntable import Turntable
from ..splat.gbuffer import GBuffer, render_gbuffer
from ..splat.tiles import Cutoffs
from ..surfels.surfels import SurfelColumns
from .environment import FilteredEnvironment
from .lighting import Lighting
from .surface import Surface

COVERED = 4e-3  # pixels with less alpha are left empty


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


def behind(camera: Camera, environment: FilteredEnvironment, turntable: Turntable | None) -> "mi.Color3f":
    """Return the radiance of the ``environment`` that each pixel of ``camera`` looks at, of width W · H; with the light that
    goes round a ``turntable`` where there is one."""
    if turntable is not None:
        environment = environment.turned(turntable.to_lamps(camera))
    rays = pixel_directions(camera, dr.arange(mi.UInt32, camera.size[0] * camera.size[1]))
    return environment.eval(rays, point=opaque(camera).origin)


def surface(gbuffer: GBuffer, camera: Camera, index: "mi.UInt32") -> Surface:
    """Return the mean of the surfaces that ``camera`` sees in the pixels ``index``, row-major, their points included."""
    return _surface(gbuffer.maps(index), camera, index, True)


def _surface(m, camera, index, near):
    """`surface` of the maps ``m``, with points where it is ``near``."""
    mean, direction = dr.rcp(m.alpha), pixel_directions(camera, index)
    point = _points(camera, direction, m.depth * mean) if near else None
    normal = dr.normalize(m.normal)
    return Surface(normal, -direction, m.roughness * mean, m.metallic * mean, m.base_color * mean, point)


def _points(camera, direction, depth):
    """World-space points along unit ``direction`` at a ``depth`` (z)."""
    seen = opaque(camera, dr.width(direction))
    return seen.origin + direction * (depth / (seen.rotation @ direction).z)


def _reflected(gbuffer, camera, lighting):
    """(C_d, f_φ(C_s)) times coverage, of width W · H. Only covered pixels are computed."""
    diffuse, specular = gbuffer.all.diffuse, dr.zeros(mi.Color3f, camera.size[0] * camera.size[1])
    shaded = within(gbuffer, camera, lighting.box)
    index = dr.compress(shaded)
    if lighting.lit:
        diffuse = dr.select(shaded, 0, diffuse)
    if dr.width(index) > 0:
        m, lighting = gbuffer.maps(index), lighting.seen_by(camera, dr.width(index))
        seen = _surface(m, camera, index, lighting.near)
        dr.scatter(specular, lighting.specular(seen) * m.alpha, index)
        if lighting.lit:
            lit = lighting.diffuse(seen, lighting.irradiance_visibility(m.diffuse * dr.rcp(m.alpha)))
            dr.scatter(diffuse, lit * m.alpha, index)
    return diffuse, specular


def render(
    surfels: SurfelColumns,
    camera: Camera,
    lighting: Lighting | None,
    means2d_offset: "mi.Vector2f | None" = None,
    cutoffs: Cutoffs = Cutoffs(),
    full: bool = False,
    contribution: "mi.Vector2f | None" = None,
) -> Image:
    """Splat ``surfels`` (see `render_gbuffer`, also for the other arguments) and `shade` them; differentiable in their
    fields, the environment and the shader."""
    if lighting is not None:
        surfels = lighting.as_splatted(surfels)
    return shade(render_gbuffer(surfels, camera, means2d_offset, cutoffs, full, contribution), camera, lighting)

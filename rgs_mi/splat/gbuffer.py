"""The G-buffer: all maps of a view from one walk (`method.md` §2)."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .composite import Layout, composite
from .lists import tile_lists
from .project import project
from .tiles import Cutoffs


@dataclass
class GBuffer:
    """Accumulated maps of one view, a lane a pixel, row-major; each is Σ w · attribute, so divide by ``alpha`` for means.

      size           (width, height)
      diffuse        Σ w c, linear radiance                 ``mi.Color3f``
      normal         Σ w (n + Δn), world space              ``mi.Vector3f``
      delta_normal   Σ w Δn                                 ``mi.Vector3f``
      base_color, roughness, metallic, depth (z), alpha = Σ w
      seen           one flag a surfel: listed in some tile of this view
    """

    size: tuple[int, int]
    diffuse: "mi.Color3f"
    normal: "mi.Vector3f"
    base_color: "mi.Color3f"
    roughness: "mi.Float"
    metallic: "mi.Float"
    delta_normal: "mi.Vector3f"
    depth: "mi.Float"
    alpha: "mi.Float"
    seen: "mi.Bool"


def render_gbuffer(surfels, camera, screen_offset=None, cutoffs=Cutoffs()) -> GBuffer:
    """Splat ``surfels`` into ``camera``; differentiable in all fields. ``screen_offset``: see `project`."""
    projected = project(surfels, camera, screen_offset)
    delta = surfels.column(mi.Vector3f, "delta_normal")
    features = [*surfels.radiance(projected.view), *(projected.normal + delta), *surfels.column(mi.Color3f, "base_color"),
                surfels.column(mi.Float, "roughness"), surfels.column(mi.Float, "metallic"), *delta]
    layout = Layout(camera.size, len(features), cutoffs)
    dr.eval(projected.geometry, features)
    lists = tile_lists(projected, camera.size, cutoffs.alpha_min)
    image = composite(projected, features, lists, layout)

    pixel = dr.arange(mi.UInt32, camera.size[0] * camera.size[1]) * (layout.pixel // 4)
    m = [v for q in range(layout.pixel // 4) for v in dr.gather(mi.Vector4f, image, pixel + q)]
    return GBuffer(camera.size, mi.Color3f(*m[0:3]), mi.Vector3f(*m[3:6]), mi.Color3f(*m[6:9]), m[9], m[10],
                   mi.Vector3f(*m[11:14]), m[14], m[15], lists.seen)

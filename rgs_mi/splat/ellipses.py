"""Surfels as viewers of splats draw them: as ellipses on the screen, whose display colours are blended (3DGS).

A viewer takes a splat of covariance Σ to the Gaussian on the screen that has the covariance

    Σ' = J W Σ Wᵀ Jᵀ + d I                                                                          (26)

with the rotation W from world to camera, the Jacobian J of the projection at the splat's center, and a dilation of d square
pixels (EWA splatting, Zwicker et al. 2002). Σ is that of a surfel, s_u² t_u t_uᵀ + s_v² t_v t_vᵀ. With A Aᵀ + B Bᵀ = Σ'⁻¹ and
N = 0 an ellipse is a projected Gaussian of (1) in `project.py`, whose depth is everywhere its center's. So the lists and the
walk of (2) serve for both: in them ellipses are sorted by their centers' depths, as in viewers.

Far beside the picture J makes giants of small splats, so viewers leave out those whose centers lie beyond its borders: Babylon.js
from `BEYOND` times half of its width or height from its middle on, 3DGS's own clamps J at 1.3 times.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from ..core.camera import Camera, opaque
from .composite import Layout, composite, planes
from .intersect import isect_tiles
from .project import NEAR, NEAR_SCALES, Projected
from .tiles import Cutoffs

if TYPE_CHECKING:
    from ..surfels.surfels import SurfelColumns

#: d of 3DGS, PlayCanvas and others, and of Babylon.js, which adds as much to splats of twice the size.
DILATIONS = 0.3, 0.3 / 4
BEYOND = 1.2
#: Nothing is left for the low-pass to do, nor for blocks to sort.
CUTOFFS = Cutoffs(low_pass=2 / min(DILATIONS), resort_window=0)


@dataclass
class Picture:
    """What a viewer of splats shows in W × H pixels, row-major, with one entry per pixel.

    color         Σ w c, display values premultiplied by coverage
    alpha         Σ w, coverage in [0, 1]
    contribution  Σ w times each of `render_ellipses`'s argument of that name, None without it
    seen          whether any tile lists a surfel; of width N
    """

    color: "mi.Color3f"
    alpha: "mi.Float"
    contribution: "mi.Vector2f | None"
    seen: "mi.Bool"


def project_ellipses(
    surfels: "SurfelColumns",
    camera: Camera,
    dilation: float = DILATIONS[0],
    means2d_offset: "mi.Vector2f | None" = None,
    whole: Camera | None = None,
) -> Projected:
    """Project all N ``surfels`` into ``camera``, a pinhole, by (26) with the ``dilation`` d; differentiable. Normals have no
    derivatives; ``means2d_offset`` is that of `project`. ``whole`` is the camera of the picture of which ``camera`` sees a part
    (None: all)."""
    R, origin, f, principal, _ = opaque(camera, len(surfels))
    offset = surfels.column(mi.Vector3f, "centers") - origin
    p, scales = R @ offset, surfels.column(mi.Vector2f, "scales")
    t_u, t_v, n = surfels.frames()
    visible = p.z > dr.minimum(NEAR, NEAR_SCALES * dr.maximum(scales.x, scales.y))
    z = dr.select(visible, p.z, 1)
    x, y = p.x / z, p.y / z
    picture = whole or camera
    for value, focal, middle, size in zip((x, y), f, opaque(picture).principal, picture.size):
        visible &= dr.abs(value * focal + middle - size / 2) < BEYOND * size / 2
    J = lambda v: mi.Vector2f(f.x * (v.x - x * v.z) / z, f.y * (v.y - y * v.z) / z)
    u, v, d = J(R @ t_u * scales.x), J(R @ t_v * scales.y), dr.opaque(mi.Float, dilation)
    xx, xy, yy = u.x * u.x + v.x * v.x + d, u.x * u.y + v.x * v.y, u.y * u.y + v.y * v.y + d
    B_y = dr.rsqrt(yy)
    A_x = dr.rsqrt(xx - xy * xy / yy)
    A_y = -xy / yy * A_x
    x, y = x * f.x + principal.x, y * f.y + principal.y
    if means2d_offset is not None:
        x, y = x + means2d_offset.x, y + means2d_offset.y
    zero = dr.zeros(mi.Float, len(surfels))
    geometry = [x, y, A_x, A_y, zero, B_y, zero, zero, z, surfels.column(mi.Float, "opacities")]
    return Projected(geometry, offset / dr.norm(offset), n, (mi.Vector3f(0), mi.Vector3f(0)), visible)


def render_ellipses(
    surfels: "SurfelColumns",
    camera: Camera,
    dilation: float = DILATIONS[0],
    means2d_offset: "mi.Vector2f | None" = None,
    cutoffs: Cutoffs = CUTOFFS,
    contribution: "mi.Vector2f | None" = None,
    whole: Camera | None = None,
) -> Picture:
    """Draw ``surfels``, whose radiance is taken for display values and clipped to [0, 1], as a viewer does that knows nothing
    else of them; differentiable. ``dilation`` and ``whole`` are those of `project_ellipses`, the other arguments those of
    `render_gbuffer`."""
    projected = project_ellipses(surfels, camera, dilation, means2d_offset, whole)
    features = [*dr.minimum(surfels.radiance(projected.view), 1), *(() if contribution is None else contribution)]
    dr.eval(projected.geometry, features)
    isects = isect_tiles(projected, camera.size, cutoffs)
    layout = Layout(camera.size, len(features), cutoffs, normals=False)
    image = composite(projected, features, isects, layout)
    *values, _, alpha = planes(image, layout.pixel)[: layout.values]
    return Picture(mi.Color3f(*values[:3]), alpha, None if contribution is None else mi.Vector2f(*values[3:]), isects.seen)

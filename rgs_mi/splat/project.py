"""From surfels to projected Gaussians (docs/method.md §2).

Let p be a surfel's center in camera space, z its depth, n its normal, a = t_u/s_u and b = t_v/s_v, and δ a pixel's
offset from the projected center. The pixel's ray meets the surfel's plane at

    t = z / h,   u = A·δ / h,   v = B·δ / h,   h = 1 + N·δ                                         (1)
    N = z n_xy / (f p·n),   A = z a_xy/f − (p·a) N,   B = z b_xy/f − (p·b) N

where t is the hit's depth and (u, v) its position in standard deviations. So a surfel is ten numbers, exact in
perspective, free of cancellation near its center, and no ray direction is needed in the inner loop.

A lens (`core.lens`) moves the projected center, and its Jacobian J there takes the δ of a pinhole to that of the photograph:
J⁻¹ stands before δ/f in (1). That is exact at the center and linear about it.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from ..core.camera import Camera, opaque

if TYPE_CHECKING:
    from ..surfels.surfels import SurfelColumns

#: Names of the ten geometric numbers of a projected Gaussian.
GEOMETRY = ("x", "y", "A_x", "A_y", "B_x", "B_y", "N_x", "N_y", "z", "opacity")
NEAR, NEAR_SCALES = 1e-2, 0.5  # surfels closer than this in scene units, and in standard deviations, are not drawn
EDGE_ON = 1e-3  # least |cosine| between a surfel's normal and the ray to its center that (1) divides by


@dataclass
class Projected:
    """N projected Gaussians.

    geometry            the ten numbers of (1) in the order of `GEOMETRY`, of width N each; x and y are pixels
    view                unit directions from the camera to the centers, world space
    normal              unit normals turned towards the camera, world space
    normal_derivatives  ∂n/∂u and ∂n/∂v of these; see `Surfels.normal_derivatives`
    visible             whether a surfel lies in front of the camera, and is turned to it where surfels are one-sided
    """

    geometry: "list[mi.Float]"
    view: "mi.Vector3f"
    normal: "mi.Vector3f"
    normal_derivatives: "tuple[mi.Vector3f, mi.Vector3f]"
    visible: "mi.Bool"


def project(surfels: "SurfelColumns", camera: Camera, means2d_offset: "mi.Vector2f | None" = None) -> Projected:
    """Project all N ``surfels`` into ``camera``; differentiable.

    ``means2d_offset`` (pixels, width N) is added to the projected centers: zeros with gradients enabled obtain the gradient
    on the image plane that density control accumulates.
    """
    R, origin, f, principal, lens = opaque(camera, len(surfels))
    offset = surfels.column(mi.Vector3f, "centers") - origin
    p = R @ offset
    t_u, t_v, n_world = surfels.frames()
    scales = surfels.column(mi.Vector2f, "scales")
    n, a, b = R @ n_world, (R @ t_u) / scales.x, (R @ t_v) / scales.y

    visible = p.z > dr.minimum(NEAR, NEAR_SCALES * dr.maximum(scales.x, scales.y))
    z = dr.select(visible, p.z, 1)
    x, y = p.x / z, p.y / z
    per_pixel = _per_pixel(f, lens, x, y)
    if lens is not None:
        x, y = lens.distort(x, y)
    x, y = x * f.x + principal.x, y * f.y + principal.y
    if means2d_offset is not None:
        x, y = x + means2d_offset.x, y + means2d_offset.y

    distance = dr.norm(offset)
    facing = dr.dot(p, n)
    if not surfels.two_sided:
        visible &= facing < 0
    least = EDGE_ON * dr.detach(distance)
    facing_safe = dr.select(dr.abs(facing) < least, dr.copysign(least, facing), facing)
    N = per_pixel(n) * (z / facing_safe)
    A = per_pixel(a) * z - dr.dot(p, a) * N
    B = per_pixel(b) * z - dr.dot(p, b) * N
    opacity = surfels.column(mi.Float, "opacities")
    turned = lambda v: dr.select(facing > 0, -v, v)
    dn_du, dn_dv = surfels.normal_derivatives()
    return Projected(
        [x, y, A.x, A.y, B.x, B.y, N.x, N.y, z, opacity],
        offset / distance,
        turned(n_world),
        (turned(dn_du), turned(dn_dv)),
        visible,
    )


def _per_pixel(f, lens, x, y):
    """The function that takes a vector v to v_xy J⁻¹/f of (1), with J the Jacobian of the ``lens`` at (x, y) (symmetric)."""
    if lens is None:
        return lambda v: mi.Vector2f(v.x / f.x, v.y / f.y)
    xx, xy, yy = lens.jacobian(x, y)
    inverse = dr.rcp(xx * yy - xy * xy)
    return lambda v: mi.Vector2f((yy * v.x - xy * v.y) * inverse / f.x, (xx * v.y - xy * v.x) * inverse / f.y)

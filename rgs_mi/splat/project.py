"""From surfels to projected Gaussians.

Let p be a surfel's centre in camera space, z its depth, n its normal, a = t_u/s_u and b = t_v/s_v, and δ a pixel's
offset from the projected centre. The pixel's ray meets the surfel's plane at

    t = z / h,   u = A·δ / h,   v = B·δ / h,   h = 1 + N·δ                                         (1)
    N = z n_xy / (f p·n),   A = z a_xy/f − (p·a) N,   B = z b_xy/f − (p·b) N

where t is the hit's depth and (u, v) its position in standard deviations. So a surfel is ten numbers, exact in
perspective, free of cancellation near its centre, and no ray direction is needed in the inner loop.
"""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

#: Names of the ten geometric numbers of a projected Gaussian.
GEOMETRY = ("x", "y", "A_x", "A_y", "B_x", "B_y", "N_x", "N_y", "z", "opacity")
NEAR = 1e-2  # surfels closer than this (scene units) are not drawn
EDGE_ON = 1e-3  # least |cosine| between a surfel's normal and the ray to its centre that (1) divides by


@dataclass
class Projected:
    """``geometry``: the ten numbers of (1), ``mi.Float`` of width N each; ``view``: unit directions from the camera to the
    centres, world space; ``normal``: unit normals turned towards the camera, world space, and ``normal_derivatives``:
    how they change with u and v; ``visible``: in front of the camera, and turned to it where surfels are one-sided."""

    geometry: list
    view: "mi.Vector3f"
    normal: "mi.Vector3f"
    normal_derivatives: tuple
    visible: "mi.Bool"


def opaque(camera):
    """The camera's numbers as opaque Dr.Jit values (literals would recompile the kernels at every pose):
    (rotation world-to-camera ``Matrix3f``, origin ``Point3f``, focal ``Vector2f``, principal ``Vector2f``)."""
    scalar = lambda v: dr.opaque(mi.Float, float(v))
    return (
        mi.Matrix3f([[scalar(v) for v in row] for row in camera.rotation]),
        mi.Point3f(*map(scalar, camera.origin)),
        mi.Vector2f(*map(scalar, camera.focal)),
        mi.Vector2f(*map(scalar, camera.principal)),
    )


def project(surfels, camera, means2d_offset=None) -> Projected:
    """Project all surfels into ``camera``; differentiable.

    ``means2d_offset``: optional ``mi.Vector2f`` (pixels, width N) added to the projected centres. Give zeros with gradients
    enabled to obtain the image-plane gradient that density control accumulates.
    """
    R, origin, f, principal = opaque(camera)
    offset = surfels.column(mi.Vector3f, "centers") - origin
    p = R @ offset
    t_u, t_v, n_world = surfels.frames()
    scales = surfels.column(mi.Vector2f, "scales")
    n, a, b = R @ n_world, (R @ t_u) / scales.x, (R @ t_v) / scales.y

    visible = p.z > NEAR
    z = dr.select(visible, p.z, 1)
    x = p.x / z * f.x + principal.x
    y = p.y / z * f.y + principal.y
    if means2d_offset is not None:
        x, y = x + means2d_offset.x, y + means2d_offset.y

    distance = dr.norm(offset)
    facing = dr.dot(p, n)
    if not surfels.two_sided:
        visible &= facing < 0
    least = EDGE_ON * dr.detach(distance)
    facing_safe = dr.select(dr.abs(facing) < least, dr.copysign(least, facing), facing)
    N = mi.Vector2f(n.x / f.x, n.y / f.y) * (z / facing_safe)
    A = mi.Vector2f(a.x / f.x, a.y / f.y) * z - dr.dot(p, a) * N
    B = mi.Vector2f(b.x / f.x, b.y / f.y) * z - dr.dot(p, b) * N
    opacity = surfels.column(mi.Float, "opacities")
    turned = lambda v: dr.select(facing > 0, -v, v)
    return Projected(
        [x, y, A.x, A.y, B.x, B.y, N.x, N.y, z, opacity],
        offset / distance,
        turned(n_world),
        tuple(map(turned, surfels.normal_derivatives())),
        visible,
    )

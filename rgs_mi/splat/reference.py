"""The splatter's slow, readable twin: every surfel against every pixel. The oracle of the tests.

It shares no formula with the tiled one: rays are intersected with planes in world space, nothing is projected but the
center, no lists are formed, and Dr.Jit differentiates it. So it also goes from pixels to rays by itself, not by
`core.camera.pixel_rays`. Of a lens it takes the Jacobian at each center by differences, and turns each pixel's ray to where
the lens, linear about the center, has it. For scenes of some hundred surfels: all pairs are in memory.
"""

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.camera import Camera, opaque
from .ellipses import BEYOND
from .gbuffer import Maps
from .project import NEAR, NEAR_SCALES
from .tiles import BLOCK, Cutoffs

if TYPE_CHECKING:
    from ..surfels.surfels import Surfels

_STEP = 0.005  # x/z units, from point to point of central differences


def _about(lens, x, y, dx, dy):
    """The pinhole's (x, y) for what a ``lens``, linear about (x, y), shows (dx, dy) beside that point's image."""
    if lens is None:
        return x + dx, y + dy
    columns = [
        [(b - a) / (2 * _STEP) for a, b in zip(lens.distort(x - i, y - j), lens.distort(x + i, y + j))]
        for i, j in ((_STEP, 0), (0, _STEP))
    ]
    (xx, yx), (xy, yy) = columns
    inverse = 1 / (xx * yy - xy * yx)
    return x + (yy * dx - xy * dy) * inverse, y + (xx * dy - yx * dx) * inverse


def _front_to_back(surfels, camera, cutoffs) -> np.ndarray:
    """[pixels, N] indices of the surfels in front of the camera, by the depth at which the ray through the middle of the
    pixel's block meets them."""
    (width, height), camera = camera.size, camera.baked()
    fields = {name: value.astype(np.float64) for name, value in surfels.numpy().items()}
    center = (fields["centers"] - camera.origin) @ camera.rotation.T
    front = np.flatnonzero(center[:, 2] > np.minimum(NEAR, NEAR_SCALES * fields["scales"].max(1)))
    center, scales = center[front], fields["scales"][front]
    t_u, t_v, normal = (v.numpy().T[front].astype(np.float64) @ camera.rotation.T for v in surfels.frames())
    projected = camera.project(fields["centers"][front])[0]

    blocks = [np.arange(0, n, block) + block / 2 for n, block in zip(camera.size, BLOCK)]
    middle = np.stack(np.meshgrid(*blocks), -1)[:, :, None]  # [rows, columns, 1, 2]
    plane = np.moveaxis((middle - projected) / camera.focal, -1, 0)
    x, y = _about(camera.lens, *(center[:, :2] / center[:, 2:]).T, *plane)
    ray = np.stack([x, y, np.ones_like(x)], -1)  # [rows, columns, N, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (center * normal).sum(-1) / (ray * normal).sum(-1)  # [rows, columns, N]
        offset = t[..., None] * ray - center
        on_plane = ((offset * t_u).sum(-1) / scales[:, 0]) ** 2 + ((offset * t_v).sum(-1) / scales[:, 1]) ** 2
    on_screen = cutoffs.low_pass * ((middle - projected) ** 2).sum(-1)
    depth = np.where((t > 0) & (on_plane <= on_screen), t, center[:, 2])
    order = front[np.argsort(depth, axis=-1, kind="stable")]
    return order.repeat(BLOCK[1], 0).repeat(BLOCK[0], 1)[:height, :width].reshape(width * height, -1).astype(np.uint32)


def render_gbuffer_reference(surfels: "Surfels", camera: Camera, cutoffs: Cutoffs = Cutoffs()) -> Maps:
    """Return all maps of `render_gbuffer`, in the same frames and units."""
    return _maps(surfels, camera, cutoffs)[0]


def median_depth_reference(
    surfels: "Surfels", camera: Camera, cutoffs: Cutoffs = Cutoffs()
) -> tuple[np.ndarray, np.ndarray]:
    """Return the depths and coverages [W · H] of `composite.median_depth`."""
    _, alpha, z = _maps(surfels, camera, cutoffs)
    left = np.cumprod(1 - alpha.astype(np.float64), axis=1)
    first = (left <= 0.5).argmax(1)[:, None]
    return np.where(left[:, -1] <= 0.5, np.take_along_axis(z, first, 1)[:, 0], 0), 1 - left[:, -1]


def render_ellipses_reference(
    surfels: "Surfels", camera: Camera, dilation: float, cutoffs: Cutoffs, whole: Camera
) -> np.ndarray:
    """Return colour and alpha of `ellipses.render_ellipses`, [H, W, 4]. The Jacobian is that of differences of what the camera
    itself projects."""
    fields = {name: value.astype(np.float64) for name, value in surfels.numpy().items()}
    axes = np.stack([v.numpy().T.astype(np.float64) for v in surfels.frames()[:2]], -1) * fields["scales"][:, None]
    center, depth = camera.project(fields["centers"])
    to = lambda sign: np.stack([camera.project(fields["centers"] + sign * _STEP * e)[0] for e in np.eye(3)], -1)
    axes = (to(1) - to(-1)) / (2 * _STEP) @ axes
    inverse = np.linalg.inv(axes @ axes.swapaxes(1, 2) + dilation * np.eye(2))
    view = fields["centers"] - camera.origin
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    colors = np.minimum(surfels.radiance(mi.Vector3f(np.float32(view.T))).numpy().T, 1)
    x, y = (np.arange(n) + 0.5 for n in camera.size)
    pixels = np.stack(np.meshgrid(x, y), -1)
    image, T = np.zeros((*pixels.shape[:2], 4)), np.ones(pixels.shape[:2])
    beside = np.abs(whole.project(fields["centers"])[0] / whole.size - 0.5).max(1) > 0.5 * BEYOND
    for k in np.argsort(depth, kind="stable"):
        if beside[k] or depth[k] < NEAR:
            continue
        offset = pixels - center[k]
        alpha = fields["opacities"][k] * np.exp(-0.5 * np.einsum("...i,ij,...j", offset, inverse[k], offset))
        w = np.where(
            (alpha > cutoffs.alpha_min) & (T > cutoffs.transmittance_min), T * np.minimum(alpha, cutoffs.alpha_max), 0
        )
        image += w[..., None] * np.append(colors[k], 1)
        T = T - w
    return image


def _maps(surfels, camera, cutoffs):
    """(`Maps`; α and depth of every surfel in every pixel, front to back, [pixels, N] each)."""
    width, height = camera.size
    rotation, origin, focal, principal, lens = opaque(camera)

    centers = surfels.column(mi.Point3f, "centers")
    depth = (rotation @ (centers - origin)).z
    order = _front_to_back(surfels, camera, cutoffs)
    n = order.shape[1]
    surfel = mi.UInt32(order.ravel())  # pixel-major, front to back
    pixel = dr.arange(mi.UInt32, width * height * n) // n
    of = lambda kind, name: dr.gather(kind, getattr(surfels, name).array, surfel)

    t_u, t_v, normal = (dr.gather(mi.Vector3f, v, surfel) for v in surfels.frames())
    center, z = dr.gather(mi.Point3f, centers, surfel) - origin, dr.gather(mi.Float, depth, surfel)
    scales = of(mi.Vector2f, "scales")
    local = rotation @ center
    x, y = local.x / local.z, local.y / local.z
    projected = mi.Vector2f(*((x, y) if lens is None else lens.distort(x, y)))
    offset = mi.Vector2f(mi.Float(pixel % width) + 0.5, mi.Float(pixel // width) + 0.5) - principal - projected * focal
    d = rotation.T @ mi.Vector3f(*_about(lens, x, y, *(offset / focal)), 1)  # its camera-space z is 1
    facing = dr.dot(center, normal)
    t = facing / dr.dot(d, normal)
    u, v = dr.dot(t * d - center, t_u) / scales.x, dr.dot(t * d - center, t_v) / scales.y
    on_plane = dr.select(t > 0, u * u + v * v, dr.largest(mi.Float))
    on_screen = cutoffs.low_pass * dr.squared_norm(offset)
    alpha = of(mi.Float, "opacities") * dr.exp(-0.5 * dr.minimum(on_plane, on_screen))
    alpha = dr.select(alpha > cutoffs.alpha_min, dr.minimum(alpha, cutoffs.alpha_max), 0)
    dr.eval(alpha)

    T, weight = dr.ones(mi.Float, width * height), dr.zeros(mi.Float, width * height * n)
    for i in range(n):
        at = dr.arange(mi.UInt32, width * height) * n + i
        w = dr.select(T > cutoffs.transmittance_min, T * dr.gather(mi.Float, alpha, at), 0)
        dr.scatter(weight, w, at)
        T = T - w

    K, delta = of(mi.Vector3f, "curvature") / dr.sqrt(scales.x * scales.y), of(mi.Vector3f, "delta_normal")
    across, along = dr.select(on_plane <= on_screen, u * scales.x, 0), dr.select(on_plane <= on_screen, v * scales.y, 0)
    normal += (K.x * across + K.y * along) * t_u + (K.y * across + K.z * along) * t_v
    radiance = dr.gather(mi.Color3f, surfels.radiance(dr.normalize(centers - origin)), surfel)
    z = dr.select(on_plane <= on_screen, t, z)
    columns = lambda kind, value: [value] if kind is mi.Float else value
    accumulate = lambda kind, value: kind(*[dr.block_sum(weight * c, n) for c in columns(kind, value)])
    maps = Maps(
        diffuse=accumulate(mi.Color3f, radiance),
        normal=accumulate(mi.Vector3f, dr.select(facing > 0, -normal, normal) + delta),
        base_color=accumulate(mi.Color3f, of(mi.Color3f, "base_color")),
        roughness=accumulate(mi.Float, of(mi.Float, "roughness")),
        metallic=accumulate(mi.Float, of(mi.Float, "metallic")),
        delta_normal=accumulate(mi.Vector3f, delta),
        depth=accumulate(mi.Float, z),
        alpha=accumulate(mi.Float, mi.Float(1)),
        square=accumulate(mi.Float, z * z),
    )
    return maps, *(dr.detach(values).numpy().reshape(width * height, n) for values in (alpha, z))

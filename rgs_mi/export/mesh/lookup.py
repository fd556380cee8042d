"""What the surfels of a fit are like at given points of their surface, as the cameras see them.

The G-buffer of each camera is looked up where it sees the point, and the means weigh views by

    w = (n·ω)² α                                                                                      (17)

with the surface's normal n, the direction ω to the camera and the coverage α. A camera sees a point where its depth map is as
deep as the point is in all four pixels about it, so that nothing is taken from the other side of an edge.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.arrays import as_float
from ...core.camera import Camera, opaque, pixels_of
from ...splat.gbuffer import render_gbuffer
from ...surfels.surfels import SurfelColumns

CHANNELS = {"radiance": 3, "normal": 3, "base_color": 3, "roughness": 1, "metallic": 1}
_GRAZING = 0.15  # least n·ω
_KNOWN = 1e-4  # least sum of weights


@dataclass(frozen=True)
class Seen:
    """Means over views at N points.

    radiance    [N, 3] linear diffuse radiance
    normal      [N, 3] unit vectors, world space
    base_color, roughness, metallic   [N, 3 or 1] parameters of the principled BSDF
    known       [N] whether any camera sees the point; elsewhere all is zero
    """

    radiance: np.ndarray
    normal: np.ndarray
    base_color: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    known: np.ndarray


def look_up(
    surfels: SurfelColumns,
    cameras: Sequence[Camera],
    depths: "Sequence[mi.Float]",
    points: np.ndarray,
    normals: np.ndarray,
    tolerance: float,
    tell: Callable[[float], None] = lambda fraction: None,
) -> Seen:
    """Return what ``cameras`` see of ``surfels`` at ``points`` [N, 3] of unit ``normals`` [N, 3], world space. ``depths`` are the
    cameras' depth maps, and ``tolerance`` how much deeper or less deep the surface may be there; ``tell`` is called with the
    fraction done."""
    with dr.suspend_grad():
        point, normal = (mi.Vector3f(*(as_float(v[:, k]) for k in range(3))) for v in (points, normals))
        total = [dr.zeros(mi.Float, len(points)) for _ in range(12)]
        for k, (camera, depth) in enumerate(zip(cameras, depths)):
            _add(total, render_gbuffer(surfels, camera).image, camera, depth, point, normal, tolerance)
            dr.eval(total)
            tell((k + 1) / len(cameras))
    values = np.stack([v.numpy() for v in total], 1)
    known = values[:, 11] > _KNOWN
    means = values[:, :11] / np.where(known, values[:, 11], 1)[:, None]
    parts = dict(zip(CHANNELS, np.split(means, np.cumsum([*CHANNELS.values()])[:-1], 1)))
    parts["normal"] = parts["normal"] / np.maximum(np.linalg.norm(parts["normal"], axis=1, keepdims=True), 1e-12)
    return Seen(**parts, known=known)


def _add(total, image, camera, depth, point, normal, tolerance):
    """Add what ``camera`` sees in its G-buffer's ``image`` at each ``point`` to ``total``: eleven channels times w, and w."""
    width, height = camera.size
    x, y, z = pixels_of(camera, point)
    cosine = dr.dot(dr.normalize(opaque(camera).origin - point), normal)
    x, y = x - 0.5, y - 0.5
    column, row = mi.Int32(dr.floor(x)), mi.Int32(dr.floor(y))
    seen = (z > 0) & (cosine > _GRAZING) & (column >= 0) & (column < width - 1) & (row >= 0) & (row < height - 1)
    corners = [(mi.UInt32((row + j) * width + column + i), i, j) for j in (0, 1) for i in (0, 1)]
    slack = dr.opaque(mi.Float, tolerance) / dr.maximum(cosine, _GRAZING)
    for index, _, _ in corners:
        seen &= dr.abs(dr.gather(mi.Float, depth, index, seen) - z) < slack
    x, y = x - dr.floor(x), y - dr.floor(y)
    values = [mi.Float(0)] * 16
    for index, i, j in corners:
        weight = dr.select(seen, (x if i else 1 - x) * (y if j else 1 - y) * cosine * cosine, 0)
        for q in range(4):
            packet = dr.gather(mi.Vector4f, image, index * 4 + q, seen)
            for c in range(4):
                values[4 * q + c] = dr.fma(weight, packet[c], values[4 * q + c])
    for k, value in enumerate([*values[:11], values[12]]):
        total[k] += value

"""The splatter's slow, readable twin: every surfel against every pixel. The oracle of the tests.

It shares no formula with the tiled one: rays are intersected with planes in world space, nothing is projected but the
centre, no lists are formed, and Dr.Jit differentiates it. For scenes of some hundred surfels: all pairs are in memory.
"""

import drjit as dr
import mitsuba as mi
import numpy as np

from .gbuffer import Maps
from .lists import SORT_RADIUS
from .project import NEAR
from .tiles import LOW_PASS, TILE, Cutoffs


def _front_to_back(surfels, camera) -> np.ndarray:
    """[pixels, N] numbers of the surfels in front of the camera, by their depth on the ray through the centre of the pixel's
    tile, which counts no farther than SORT_RADIUS standard deviations from their own centres."""
    fields = surfels.numpy()
    width, height = camera.size
    centre = (fields["centers"].astype(np.float64) - camera.origin) @ camera.rotation.T
    t_u, t_v, normal = (v.numpy().T.astype(np.float64) @ camera.rotation.T for v in surfels.frames())
    front = np.flatnonzero(centre[:, 2] > NEAR)
    keys = np.empty((height, width, len(front)))
    for row in range(0, height, TILE[1]):
        for column in range(0, width, TILE[0]):
            middle = np.array([column + TILE[0] / 2, row + TILE[1] / 2])
            for k, i in enumerate(front):
                c, z = centre[i], centre[i, 2]
                offset = middle - (c[:2] / z * camera.focal + camera.principal)
                ray = lambda s: np.append((c[:2] / z + s * offset / camera.focal), 1.0)
                facing = c @ normal[i] / z  # of the ray through the surfel's centre
                # where a small step along the offset leads on the surfel, continued linearly
                step = 1e-6
                hit = (c @ normal[i]) / (ray(step) @ normal[i]) * ray(step) - c
                distance = np.hypot(hit @ t_u[i] / fields["scales"][i, 0], hit @ t_v[i] / fields["scales"][i, 1]) / step
                shrink = min(1.0, SORT_RADIUS / max(distance, 1e-6))
                slope = (ray(1.0) @ normal[i]) / facing - 1
                keys[row:row + TILE[1], column:column + TILE[0], k] = z / np.clip(1 + shrink * slope, 0.5, 2)
    return front[np.argsort(keys.reshape(width * height, -1), axis=1, kind="stable")].astype(np.uint32)


def render_gbuffer_reference(surfels, camera, cutoffs=Cutoffs()) -> Maps:
    """The same maps as `render_gbuffer`, in the same frames and units."""
    width, height = camera.size
    origin = mi.Point3f(camera.origin)
    x_axis, y_axis, z_axis = (mi.Vector3f(row) for row in camera.rotation)

    centers = surfels.column(mi.Point3f, "centers")
    depth = dr.dot(centers - origin, z_axis)
    order = _front_to_back(surfels, camera)
    n = order.shape[1]
    surfel = mi.UInt32(order.ravel())  # pixel-major, front to back
    pixel = dr.arange(mi.UInt32, width * height * n) // n
    of = lambda kind, name: dr.gather(kind, getattr(surfels, name).array, surfel)

    d = mi.Vector3f(np.ascontiguousarray(camera.rays().reshape(-1, 3).T.astype(np.float32)))  # camera-space z is 1
    d = dr.gather(mi.Vector3f, d, pixel)
    t_u, t_v, normal = (dr.gather(mi.Vector3f, v, surfel) for v in surfels.frames())
    centre, z = dr.gather(mi.Point3f, centers, surfel) - origin, dr.gather(mi.Float, depth, surfel)
    scales = of(mi.Vector2f, "scales")
    facing = dr.dot(centre, normal)
    t = facing / dr.dot(d, normal)
    u, v = dr.dot(t * d - centre, t_u) / scales.x, dr.dot(t * d - centre, t_v) / scales.y
    projected = mi.Vector2f(dr.dot(centre, x_axis) * camera.focal[0], dr.dot(centre, y_axis) * camera.focal[1]) / z
    offset = mi.Vector2f(mi.Float(pixel % width) + 0.5, mi.Float(pixel // width) + 0.5) - mi.Vector2f(camera.principal)
    on_plane = dr.select(t > 0, u * u + v * v, dr.largest(mi.Float))
    on_screen = LOW_PASS * dr.squared_norm(offset - projected)
    alpha = of(mi.Float, "opacities") * dr.exp(-0.5 * dr.minimum(on_plane, on_screen))
    alpha = dr.select(alpha > cutoffs.alpha_min, dr.minimum(alpha, cutoffs.alpha_max), 0)
    dr.eval(alpha)

    T, weight = dr.ones(mi.Float, width * height), dr.zeros(mi.Float, width * height * n)
    for i in range(n):
        at = dr.arange(mi.UInt32, width * height) * n + i
        w = dr.select(T > cutoffs.transmittance_min, T * dr.gather(mi.Float, alpha, at), 0)
        dr.scatter(weight, w, at)
        T = T - w

    delta = of(mi.Vector3f, "delta_normal")
    radiance = dr.gather(mi.Color3f, surfels.radiance(dr.normalize(centers - origin)), surfel)
    columns = lambda kind, value: [value] if kind is mi.Float else value
    accumulate = lambda kind, value: kind(*[dr.block_sum(weight * c, n) for c in columns(kind, value)])
    return Maps(
        diffuse=accumulate(mi.Color3f, radiance),
        normal=accumulate(mi.Vector3f, dr.select(facing > 0, -normal, normal) + delta),
        base_color=accumulate(mi.Color3f, of(mi.Color3f, "base_color")),
        roughness=accumulate(mi.Float, of(mi.Float, "roughness")), metallic=accumulate(mi.Float, of(mi.Float, "metallic")),
        delta_normal=accumulate(mi.Vector3f, delta), depth=accumulate(mi.Float, dr.select(on_plane <= on_screen, t, z)),
        alpha=accumulate(mi.Float, mi.Float(1)))

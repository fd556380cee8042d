"""The visual hull of alpha masks: cameras and silhouettes in, a closed surface and depth maps out.

A view's mask becomes a signed distance on the image plane; times depth over focal length it is, to first order, the
distance in the world from the silhouette's cone. The hull's field is the least of these over the views, sampled
bilinearly, so the surface lies between grid nodes and is not stair-stepped. Needs no network, and reflections can't
mislead it; concavities that no silhouette shows stay filled.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage, special

from ..core.camera import Camera, focus_point, opaque, pixel_rays
from ..core.errors import UserError
from ..datasets.types import View

_EDGE_SIGMA = 0.6  # pixels; small enough that lines one pixel wide stay above one half
_PIXEL_VARIANCE = 1 / 12  # of the box that an antialiased mask has been averaged over
_FULL = 0.9  # a mask with more than this in a border pixel goes on beyond the frame
_PAD = 2  # pixels of nothing around a mask that ends in its frame, as wide as the blur reaches
_STEPS = 160, 400  # along the longest side, at least and at most, where a step would be a pixel


@dataclass(frozen=True)
class SignedField:
    """A signed distance on a grid: positive inside, truncated at a few steps.

    Attributes
      values: [X, Y, Z] float32 in world units
      lower:  [3] world position of node (0, 0, 0)
      step:   distance of neighbouring nodes in world units
    """

    values: np.ndarray
    lower: np.ndarray
    step: float

    def at(self, positions: np.ndarray) -> np.ndarray:
        """Return the field [N] at ``positions`` [N, 3], in world units; −∞ beyond the grid."""
        return self._sampled(self.values, positions, -np.inf)

    def depth(self, positions: np.ndarray) -> np.ndarray:
        """Return how deep below the surface ``positions`` [N, 3] are, to a step: [N] world units, not truncated; 0 outside."""
        return self.step * self._sampled(ndimage.distance_transform_edt(self.values > 0), positions, 0.0)

    def _sampled(self, values, positions, beyond):
        node = ((positions - self.lower) / self.step).T
        return ndimage.map_coordinates(values, node, order=1, mode="constant", cval=beyond)


# ---- Silhouettes ----


@dataclass(frozen=True)
class _Silhouette:
    """One view's mask as a signed ``distance`` in pixels ([H, W] float32, positive inside), and its ``camera``.

    ``limits``: (left, top, right, bottom) in pixels; beyond them the view does not decide, since there the mask touches
    the frame's border. A side that it does not touch is infinite: the object ends before it.
    """

    distance: np.ndarray
    camera: Camera
    limits: tuple[float, float, float, float]

    @classmethod
    def of(cls, alpha: np.ndarray, camera) -> "_Silhouette":
        """From a mask [H, W] in [0, 1]."""
        # An antialiased pixel that is not full has the object's end in it.
        open_ = [edge.max() > _FULL for edge in (alpha[:, 0], alpha[0], alpha[:, -1], alpha[-1])]
        left, top, right, bottom = (0 if o else _PAD for o in open_)
        alpha = np.pad(alpha, ((top, bottom), (left, right)))
        height, width = alpha.shape
        within = [
            limit if o else sign * np.inf for o, limit, sign in zip(open_, (0, 0, width - 1, height - 1), (-1, -1, 1, 1))
        ]
        limits = within[0], within[1], within[2], within[3]
        return cls(_signed_distance(alpha), camera.cropped(-left, -top, width, height), limits)

    def sample(self, points: np.ndarray) -> np.ndarray:
        """World-space signed distance [N] from the silhouette's cone at ``points`` [N, 3]; NaN where undecided."""
        camera, (height, width) = self.camera, self.distance.shape
        p = points @ camera.rotation.T.astype(np.float32) - (camera.rotation @ camera.origin).astype(np.float32)
        z = np.maximum(p[:, 2], np.float32(1e-6))
        u = p[:, 0] / z * np.float32(camera.focal[0]) + np.float32(camera.principal[0] - 0.5)
        v = p[:, 1] / z * np.float32(camera.focal[1]) + np.float32(camera.principal[1] - 0.5)
        x, y = np.clip(u, 0, width - 1), np.clip(v, 0, height - 1)
        beside = np.flatnonzero((x != u) | (y != v))
        gap = np.hypot((u - x)[beside], (v - y)[beside])
        i, j = np.minimum(x.astype(np.int32), width - 2), np.minimum(y.astype(np.int32), height - 2)
        x, y, k, d = x - i, y - j, j * width + i, self.distance.ravel()
        upper = d.take(k) * (1 - x) + d.take(k + 1) * x
        lower = d.take(k + width) * (1 - x) + d.take(k + (width + 1)) * x
        value = upper * (1 - y) + lower * y
        value[beside] = -np.hypot(value[beside], gap)
        value *= z * np.float32(1 / np.mean(camera.focal))
        left, top, right, bottom = self.limits
        behind = p[:, 2] <= 1e-6
        value[behind] = -np.linalg.norm(p[behind], axis=1) if np.isinf(self.limits).all() else np.nan
        value[(u < left) | (v < top) | (u > right) | (v > bottom)] = np.nan
        return value


def _signed_distance(alpha: np.ndarray) -> np.ndarray:
    """[H, W] signed distance in pixels to the alpha = 1/2 contour of an antialiased mask with values in [0, 1].

    Far from the contour the Euclidean distance transform; near it the offset of the straight edge that would give the
    blurred mask its value, which is accurate to a small part of a pixel.
    """
    blurred = ndimage.gaussian_filter(alpha, _EDGE_SIGMA, truncate=4)
    inside = blurred > 0.5
    rim = inside & ~np.asarray(ndimage.binary_erosion(inside, border_value=1), bool)
    distance = np.asarray(ndimage.distance_transform_edt(~rim)).astype(np.float32)
    distance = np.where(inside, distance + np.float32(0.5), np.float32(0.5) - distance)
    near = np.abs(distance) < 1.2
    offset = special.erfinv(np.clip(2 * blurred[near] - 1, -0.98, 0.98))
    distance[near] = np.sqrt(2 * (_EDGE_SIGMA**2 + _PIXEL_VARIANCE)) * offset
    return distance


def _silhouettes(views) -> list[_Silhouette]:
    """The silhouettes of all masked views. Raises: UserError when fewer than two have a usable mask."""

    def one(view):
        alpha = view.alpha
        blank = (alpha > 0.5).all() or not (alpha > 0.5).any() or min(alpha.shape) < 2
        return None if blank else _Silhouette.of(alpha, view.camera)

    with ThreadPoolExecutor() as pool:
        found = [s for s in pool.map(one, [v for v in views if v.masked]) if s is not None]
    if len(found) < 2:
        raise UserError(
            "a visual hull needs alpha masks in two views or more, and these photographs have none: "
            "give images with alpha, or a sparse point cloud (COLMAP, PLY), or start from random points"
        )
    return found


def _carve(silhouettes, points: np.ndarray, truncation: float, outvoted: int = 0) -> np.ndarray:
    """The field [N] at ``points`` [N, 3], clipped to ± ``truncation``: the least distance but for so many ``outvoted``.

    Points drop out as soon as more views than these put them further outside than the truncation. Points that fewer
    than a quarter of the views decide are outside, too.
    """

    def chunk(points):
        least = np.full((outvoted + 1, len(points)), truncation, np.float32)
        count = np.zeros(len(points), np.int32)
        alive = np.arange(len(points))
        for silhouette in silhouettes:
            sample = silhouette.sample(points[alive])
            decided = ~np.isnan(sample)
            count[alive] += decided
            sample = np.where(decided, sample, np.inf)
            for row in least:  # ascending
                row[alive], sample = np.minimum(row[alive], sample), np.maximum(row[alive], sample)
            alive = alive[least[-1, alive] > -truncation]
        least[-1, alive[count[alive] < len(silhouettes) / 4]] = -truncation
        return np.maximum(least[-1], -truncation)

    # Neighbouring views are alike: a stride that visits them far apart lets points drop out early.
    order = np.argsort((np.arange(len(silhouettes)) * 0.618034) % 1, kind="stable")
    silhouettes = [silhouettes[i] for i in order]
    with ThreadPoolExecutor() as pool:
        parts = np.array_split(points, max(1, len(points) // 65536))
        return np.concatenate(list(pool.map(chunk, parts)))


# ---- The field ----


def _grid(lower, upper, step) -> tuple[np.ndarray, tuple[int, ...]]:
    """Nodes [N, 3] float32 of the smallest grid from ``lower`` on that covers the box, and its shape."""
    shape = _shape(lower, upper, step)
    return (lower + step * np.stack(np.unravel_index(np.arange(np.prod(shape)), shape), -1)).astype(np.float32), shape


def _shape(lower, upper, step) -> tuple[int, ...]:
    return tuple(int(np.ceil(d / step)) + 1 for d in upper - lower)


def object_box(views: Sequence[View]) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper corner [3] of the masked object, in world space, from cameras and masks alone, with a small
    margin.

    Starts from the cube around the point that the cameras look at which reaches as far as the cameras do, carves it
    coarsely and shrinks it to what is left, until that changes little. Raises: UserError without masks, or when the
    silhouettes have no common volume.
    """
    return _object_box(_silhouettes(views))


def _object_box(silhouettes, outvoted=0):
    center, reach = focus_point([s.camera for s in silhouettes])
    lower, upper = center - reach, center + reach
    for _ in range(8):
        step = (upper - lower).max() / 40
        points, _ = _grid(lower, upper, step)
        # A cell counts while any part of it may be inside: its corners are at most 0.87 steps away.
        left = points[_carve(silhouettes, points, 2 * step, outvoted) > -0.87 * step]
        if not len(left):
            raise UserError(
                "the silhouettes of the views have no common volume: check that the cameras belong to the "
                "images and follow the layout's convention"
            )
        before = (upper - lower).max()
        lower, upper = np.maximum(left.min(0) - step, lower), np.minimum(left.max(0) + step, upper)
        if (upper - lower).max() > 0.9 * before:
            break
    return lower, upper


def carve(views: Sequence[View], box: tuple[np.ndarray, np.ndarray], resolution: int = 160) -> SignedField:
    """Return the visual hull of all masked views on a grid with ``resolution`` steps along the longest side of ``box``.

    ``box`` is (lower [3], upper [3]) as from `object_box`. A view whose mask ends inside its frame carves all that is
    beside it; beyond a border that the mask touches the view does not decide. Raises: UserError without masks, or when
    nothing is left.
    """
    return _field(_silhouettes(views), box, resolution)


def visual_hull(views: Sequence[View], resolution: int | None = None, outvoted: int = 0) -> SignedField:
    """Return `carve` inside `object_box`, measuring the silhouettes once, but for so many views ``outvoted`` at each point:
    masks drawn by hand are wrong here and there. Unless ``resolution`` is given, a step is as long as the typical
    photograph's pixel is there, but for a least and a greatest number of steps."""
    silhouettes = _silhouettes(views)
    box = _object_box(silhouettes, outvoted)
    return _field(silhouettes, box, resolution or _pixels_across(silhouettes, *box), outvoted)


def _pixels_across(silhouettes, lower, upper) -> int:
    """Pixels along the longest side of a box in the typical view, within `_STEPS`."""
    center = (lower + upper) / 2
    pixels = [np.mean(s.camera.focal) / np.linalg.norm(center - s.camera.origin) for s in silhouettes]
    return int(np.clip((upper - lower).max() * np.median(pixels), *_STEPS))


def _field(silhouettes, box, resolution, outvoted=0):
    lower, upper = (np.asarray(corner, np.float64) for corner in box)
    step = float((upper - lower).max() / resolution)
    lower = lower - 2 * step  # the surface closes inside the grid
    coarse, shape = _grid(lower, upper + 2 * step, 4 * step)
    coarse = _carve(silhouettes, coarse, 8 * step, outvoted).reshape(shape)
    shape = _shape(lower, upper + 2 * step, step)
    # A distance changes by no more than the way gone, here at most 3.5 steps to the nearest coarse node: only where the
    # coarse field is smaller than that (and a margin) can the surface be.
    values = ndimage.affine_transform(coarse, np.full(3, 1 / 4), output_shape=shape, order=1, mode="nearest")
    band = np.argwhere(np.abs(values) < 4.5 * step)
    values[tuple(band.T)] = _carve(silhouettes, (lower + step * band).astype(np.float32), 3 * step, outvoted)
    values = ndimage.gaussian_filter(np.clip(values, -3 * step, 3 * step), 0.6)
    for axis in range(3):
        np.moveaxis(values, axis, 0)[[0, -1]] = -step
    if values.max() <= 0:
        raise UserError("the visual hull is empty: check that the cameras belong to the images, or carve it finer")
    return SignedField(values, lower, step)


def largest_piece(field: SignedField) -> SignedField:
    """Return ``field`` with the largest of its connected pieces alone inside."""
    from skimage.measure import label

    pieces = np.asarray(label(field.values > 0, connectivity=1))
    if pieces.max() < 2:
        return field
    largest = 1 + np.argmax(np.bincount(pieces.ravel())[1:])
    return replace(field, values=np.where((pieces > 0) & (pieces != largest), -field.step, field.values))


# ---- The surface ----


def surface(field: SignedField, over: float = 0.6) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the zero level of ``field`` by marching cubes: vertices [V, 3] (world), faces [F, 3] int32 (counter-clockwise
    from outside), outward unit normals [V, 3] of the field as it is smoothed ``over`` so many steps."""
    from skimage.measure import marching_cubes

    nodes, faces, _, _ = marching_cubes(field.values, 0.0, gradient_direction="ascent")
    # Min has creases where cones meet, and marching cubes slivers: a gradient over a few steps is a steadier normal.
    smooth = ndimage.gaussian_filter(field.values, over)
    beside = lambda offset: ndimage.map_coordinates(smooth, nodes.T + offset[:, None], order=1, mode="nearest")
    normals = np.stack([beside(-axis) - beside(axis) for axis in np.eye(3)], -1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    vertices = (field.lower + field.step * nodes).astype(np.float32)
    return vertices, faces.astype(np.int32), normals.astype(np.float32)


def depth_maps(vertices: np.ndarray, faces: np.ndarray, cameras: Sequence[Camera]) -> list[np.ndarray]:
    """Return the mesh of ``vertices`` [V, 3] and ``faces`` [F, 3] as each camera sees it: [H, W] float32 z-depths in world
    units, NaN where it is missed. A JIT variant must be active."""
    import drjit as dr
    import mitsuba as mi

    mesh = mi.Mesh("hull", len(vertices), len(faces))
    params = mi.traverse(mesh)
    params["vertex_positions"] = np.ascontiguousarray(vertices, np.float32).ravel()
    params["faces"] = np.ascontiguousarray(faces, np.uint32).ravel()
    params.update()
    scene = mi.load_dict({"type": "scene", "hull": mesh})
    depths = []
    for camera in cameras:
        width, height = camera.size
        rays = pixel_rays(camera, dr.arange(mi.UInt32, width * height))
        ray = mi.Ray3f(opaque(camera).origin, rays)  # unit z: the ray parameter is the depth
        t = np.array(scene.ray_intersect_preliminary(ray, coherent=True).t).reshape(height, width)
        depths.append(np.where(np.isfinite(t), t, np.float32(np.nan)))
    return depths

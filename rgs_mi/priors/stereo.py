"""What lies below the visual hull, seen by the photographs: a plane sweep, with the hull's own shape as the plane
(docs/method.md §5).

    1. `sweep`   Each view asks, pixel by pixel, how deep below the hull its surroundings look alike in the views next to it:
                 normalized cross-correlation over a window, the mean of the best few (Collins 1996, Goesele et al. 2006).
    2. `_agreed` A mirror image is alike somewhere below the hull, too, but elsewhere for other views. A point counts where
                 most of the views that find something in its direction find it there, and its surroundings do as well: on
                 flat mirrors, views agree by chance here and there.
    3. `carve`   Grid nodes that several views look through are carved off the hull's field.

So a cup gets its inside, and a ball of chrome stays one. Nothing here needs a network.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage
from skimage.transform import downscale_local_mean

from ..core.arrays import as_float
from ..core.camera import Camera, opaque, pixel_rays
from ..core.progress import Progress
from ..datasets.types import View
from . import hull

_WIDTH = 200  # pixels of a photograph's copy at most
_STEPS = 160  # of the grid that is carved, at most; the hull's own may be finer
_LEVELS = 40  # depths below the hull
_REACH = 0.75  # the deepest, over the hull's radius
_NEIGHBOURS, _BEST = 6, 3  # views that each is compared with, and those of them that count
_WINDOW = 2  # pixels on each side
_ALIKE, _GAIN = 0.75, 0.15  # correlation that is enough, and how much above the hull's own it must be
_ABOVE = 2  # levels that count as the hull itself
_SAME = 1.5  # levels between two views' depths that are the same
_AGREED, _VIEWS = 0.4, 3  # part and count of views that must find the same
_AROUND, _SURROUNDINGS = 0.45, 10  # their part in the mean over the surroundings: standard deviation of these, in levels
_CELL = 2  # levels across a cell, of which that mean is made
_SEEN_THROUGH = 3  # views that look through what is carved
_FLAT = 1e-4  # variance of grey levels in a window that shows nothing


def carved_hull(views: Sequence[View], resolution: int | None = None, quiet: bool = True) -> hull.SignedField:
    """Return the `hull.visual_hull` of ``views``, less what they look through; ``quiet`` shows no progress. A JIT variant
    must be active. Raises: UserError as `hull.visual_hull` does."""
    with Progress(quiet=quiet, label="carving the visual hull") as progress:
        field, rough = hull.visual_hulls(views, resolution, min(resolution or _STEPS, _STEPS))
        vertices, faces, _ = hull.surface(rough)
        small = [SmallImage.of(view) for view in views]
        depths = hull.depth_maps(vertices, faces, [s.camera for s in small])
        radius = float(np.linalg.norm(vertices - vertices.mean(0), axis=1).max())
        step = _REACH * radius / _LEVELS
        progress.update(0)
        deeper = []
        for i in range(len(small)):
            deeper.append(sweep(i, small, depths, step))
            progress.update((i + 1) / (len(small) + 1), views=i + 1)
        cut = carve(rough, small, depths, _agreed(small, depths, deeper, step), step)
        progress.update(1)
        return _least(field, cut)


@dataclass(frozen=True)
class SmallImage:
    """A photograph's small copy: its ``camera``, and ``grey`` display values [H, W] float32 over white."""

    camera: Camera
    grey: np.ndarray

    @classmethod
    def of(cls, view: View) -> "SmallImage":
        """Return the copy of a view's photograph, of `_WIDTH` pixels at most."""
        width, height = view.camera.size
        factor = max(1, -(-width // _WIDTH))
        pixels = view.pixels / np.float32(255) if view.pixels.dtype == np.uint8 else view.pixels
        grey = np.clip(pixels[..., :3], 0, 1).mean(-1) * pixels[..., 3] + 1 - pixels[..., 3]
        w, h = width // factor, height // factor
        grey = downscale_local_mean(grey[: h * factor, : w * factor], (factor, factor))
        camera = view.camera.cropped(0, 0, w * factor, h * factor).resized(w, h)
        return cls(camera, np.ascontiguousarray(grey, np.float32))

    def cropped(self, window: tuple[slice, slice]) -> "SmallImage":
        """Return the same image within ``window``, slices of rows and columns."""
        rows, columns = window
        camera = self.camera.cropped(columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start)
        return SmallImage(camera, np.ascontiguousarray(self.grey[window]))


# ---- How alike ----


def sweep(i: int, small: Sequence[SmallImage], depths: Sequence[np.ndarray], step: float) -> np.ndarray:
    """Return how much deeper than the hull the surface of view ``i`` lies, [H, W], world units along the viewing axis; 0
    where it is the hull, or nothing can be told. ``depths`` [H, W] are the hull's in all views, NaN beside it, and ``step``
    lies between two levels."""
    deeper, known = np.zeros_like(depths[i]), np.isfinite(depths[i])
    if not known.any():
        return deeper
    (window,) = ndimage.find_objects(known.astype(np.int8))
    here, depth, known = small[i].cropped(window), depths[i][window], known[window]
    level = (np.arange(_LEVELS) - _ABOVE / 2) * step
    mean = photo_consistency(here, depth, level, [(small[j], depths[j]) for j in _next_to(i, small)], 2 * step)
    mean[:, ~np.asarray(ndimage.binary_erosion(known, iterations=_WINDOW), bool)] = -1
    found, top = mean.argmax(0), mean.max(0)
    sure = (found > _ABOVE) & (found < _LEVELS - 2) & (top > _ALIKE) & (top - mean[: _ABOVE + 1].max(0) > _GAIN)
    deeper[window] = np.where(sure, level[found], 0)
    return deeper


def _next_to(i, small):
    """Indices of the views that look most nearly the same way as view ``i``."""
    forward = np.array([s.camera.rotation[2] for s in small])
    alike = forward @ forward[i]
    alike[i] = -np.inf
    return np.argsort(-alike)[: min(_NEIGHBOURS, len(small) - 1)]


def photo_consistency(
    here: SmallImage,
    depth: np.ndarray,
    level: np.ndarray,
    others: Sequence[tuple[SmallImage, np.ndarray]],
    margin: float,
) -> np.ndarray:
    """Return how much the surroundings of each pixel of ``here`` look like what ``others``, pairs of an image and its hull's
    depth, show if it lies at ``depth`` [H, W] + ``level`` [L]: [L, H, W], the mean of the best few correlations, at least
    −1. That with a view whose frame the point is not in, or whose hull it is more than ``margin`` above, is −1."""
    best = [mi.Float(-1)] * _BEST
    points, own = _points(here.camera, depth, level), _own(here.grey, len(level))
    for other, surface in others:
        score = _correlation(own, *_warp(points, other, surface, margin), depth.shape)
        for k in range(_BEST):  # keep the largest, in order
            best[k], score = dr.maximum(best[k], score), dr.minimum(best[k], score)
        dr.eval(best)
    return np.array(sum(best) / _BEST).reshape(len(level), *depth.shape)


def _points(camera, depth, level):
    """World points below the hull, one entry per level and pixel."""
    filled = np.where(np.isfinite(depth), depth, np.nanmax(depth))
    entry, n = dr.arange(mi.UInt32, filled.size * len(level)), dr.opaque(mi.UInt32, filled.size)
    pixel = entry % n
    z = dr.gather(mi.Float, as_float(filled), pixel) + dr.gather(mi.Float, as_float(level), entry // n)
    point = opaque(camera).origin + pixel_rays(camera, pixel) * z
    dr.eval(point)
    return point


def _warp(points, other, depth, margin):
    """(grey levels of the ``other`` photograph at ``points``, whether these can be its surface: in its frame, not above its
    hull)."""
    constant = lambda x: dr.opaque(mi.Float, float(x))
    seen = opaque(other.camera)
    width, height = other.camera.size
    local = seen.rotation @ mi.Vector3f(points - seen.origin)
    x = local.x / local.z * seen.focal.x + seen.principal.x - 0.5
    y = local.y / local.z * seen.focal.y + seen.principal.y - 0.5
    inside = (local.z > 0) & (x >= 0) & (y >= 0) & (x < constant(width - 1)) & (y < constant(height - 1))
    column, row = dr.floor(x), dr.floor(y)
    at = mi.UInt32(dr.select(inside, row * constant(width) + column, 0))
    grey, right, below = as_float(other.grey), dr.opaque(mi.UInt32, 1), dr.opaque(mi.UInt32, width)
    fetch = lambda k: dr.gather(mi.Float, grey, at + k, inside)
    fx, fy = x - column, y - row
    value = dr.lerp(dr.lerp(fetch(0), fetch(right), fx), dr.lerp(fetch(below), fetch(below + right), fx), fy)
    surface = dr.gather(mi.Float, as_float(np.where(np.isfinite(depth), depth, np.inf)), at, inside)
    inside &= local.z > surface - constant(margin)
    value = dr.select(inside, value, 1)
    dr.eval(value, inside)
    return value, inside


def _own(grey, levels):
    """``grey``, its means and its mean squares over windows, one entry per level and pixel."""
    pixel = dr.arange(mi.UInt32, grey.size * levels) % dr.opaque(mi.UInt32, grey.size)
    means = (ndimage.uniform_filter(grey.astype(np.float64) ** k, 2 * _WINDOW + 1, mode="nearest") for k in (1, 2))
    own = [dr.gather(mi.Float, as_float(image), pixel) for image in (grey, *means)]
    dr.eval(own)
    return own


def _correlation(own, warped, inside, shape):
    """Normalized cross-correlation of the windows around each pixel, whose `_own` these are, and of its ``warped``
    neighbour."""
    here, mean, square = own
    m, mm, cross = _means([warped, warped * warped, warped * here], *shape[::-1])
    spread = dr.sqrt(dr.maximum(square - mean * mean, _FLAT) * dr.maximum(mm - m * m, _FLAT))
    score = dr.select(inside, (cross - m * mean) / spread, -1)
    dr.eval(score)
    return score


def _means(images, width, height):
    """Means over windows of stacks of images, which end at each image's borders."""
    entry = dr.arange(mi.UInt32, dr.width(images[0]))
    columns, rows = dr.opaque(mi.UInt32, width), dr.opaque(mi.UInt32, height)
    for position, extent, stride in ((entry % columns, columns, 1), (entry // columns % rows, rows, columns)):
        dr.eval(images)
        sums = [mi.Float(0)] * len(images)
        for offset in range(-_WINDOW, _WINDOW + 1):
            moved = mi.Int32(position) + offset
            moved = dr.clip(moved, 0, mi.Int32(extent) - 1) - mi.Int32(position)
            at = mi.UInt32(mi.Int32(entry) + moved * mi.Int32(stride))
            sums = [s + dr.gather(mi.Float, image, at) for s, image in zip(sums, images)]
        images = [s / (2 * _WINDOW + 1) for s in sums]
    return images


# ---- What views agree on ----


def _agreed(small, depths, deeper, step):
    """``deeper``, 0 where its points are not what the other views that look for them there have found, most of the time."""
    sure = [below > 0 for below in deeper]
    points = np.concatenate(
        [
            s.camera.origin + s.camera.rays()[where] * (depth + below)[where][:, None]
            for s, depth, below, where in zip(small, depths, deeper, sure)
        ]
    )
    found, agree = np.zeros((2, len(points)), np.int64)
    for s, depth, below in zip(small, depths, deeper):
        z, (at, below_at) = _look(s.camera, points, depth, below)
        found += below_at > 0
        agree += (below_at > 0) & (abs(z - at - below_at) < _SAME * step)
    agreed = agree / np.maximum(found, 1)  # its own view is one of them
    kept = (agree > _VIEWS) & (agreed > _AGREED) & (_mean_around(points, agreed, step) > _AROUND)
    for below, where, part in zip(deeper, sure, np.split(kept, np.cumsum([w.sum() for w in sure])[:-1])):
        below[where] *= part
    return deeper


def _mean_around(points, values, step):
    """[N] mean of ``values`` [N] over the surroundings of ``points`` [N, 3]."""
    if not len(points):
        return values
    cell = np.floor((points - points.min(0)) / (_CELL * step)).astype(np.intp)
    shape = cell.max(0) + 1
    total, count = np.zeros(shape), np.zeros(shape)
    np.add.at(total, tuple(cell.T), values)
    np.add.at(count, tuple(cell.T), 1)
    blurred = lambda sums: ndimage.gaussian_filter(sums, _SURROUNDINGS / _CELL, mode="constant")[tuple(cell.T)]
    return blurred(total) / blurred(count)


def _look(camera, points, *maps):
    """(z-depths of ``points``, the entries of ``maps`` where they are seen, NaN beyond the frame)."""
    pixel, z = camera.project(points)
    column, row = np.floor(pixel).astype(np.int64).T
    inside = (z > 0) & (column >= 0) & (row >= 0) & (column < camera.size[0]) & (row < camera.size[1])
    values = [np.full(len(points), np.nan, np.float32) for _ in maps]
    for value, image in zip(values, maps):
        value[inside] = image[row[inside], column[inside]]
    return z, values


def carve(
    field: hull.SignedField,
    small: Sequence[SmallImage],
    depths: Sequence[np.ndarray],
    deeper: Sequence[np.ndarray],
    step: float,
) -> hull.SignedField:
    """Return the field of what is left of ``field`` without the nodes through which several views look at something deeper,
    close to these; elsewhere three steps inside. ``depths`` are the hull's, ``deeper`` what `sweep` adds to them."""
    inside = np.argwhere(field.values > 0)
    points = field.lower + field.step * inside
    through = np.zeros(len(points), np.int64)
    for s, depth, below in zip(small, depths, deeper):
        z, (at, below_at) = _look(s.camera, points, depth, below)
        through += (below_at > 0) & (z < at + below_at - step)
    gone = np.zeros(field.values.shape, bool)
    gone[tuple(inside[through >= _SEEN_THROUGH].T)] = True
    values = ndimage.gaussian_filter(np.where(gone, -field.step, field.values), 1.0)
    values[~np.asarray(ndimage.binary_dilation(gone, iterations=2), bool)] = 3 * field.step
    return hull.SignedField(values, field.lower, field.step)


def _least(field, other):
    """The lesser of two fields, on the grid of the first."""
    scale, offset = field.step / other.step, (field.lower - other.lower) / other.step
    values = ndimage.affine_transform(other.values, np.full(3, scale), offset, field.values.shape, order=1, mode="nearest")
    return hull.SignedField(np.minimum(field.values, values), field.lower, field.step)

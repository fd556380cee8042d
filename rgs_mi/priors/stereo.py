"""What photographs say of depth, without a network: a plane sweep, and what its depth maps agree on (docs/method.md §5).

    1. `sweep`        Each view asks, pixel by pixel, at which of many depths its surroundings look alike in the views next to it:
                      normalized cross-correlation over a window, the mean of the best few (Collins 1996, Goesele et al. 2006).
                      With masks the depths lie below the visual hull, in its own shape; without, at equal steps of inverse
                      depth through all that the cameras see.
    2. `agreement`    A mirror image is alike at some depth, too, but elsewhere for other views; and what repeats is alike at
                      many. A point counts where most of the views that could see it have it at its depth, and few look
                      through it.

So a cup gets its inside, a ball of chrome stays one, and a scene without masks gets a surface.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage
from skimage.transform import downscale_local_mean

from ..core.arrays import as_float
from ..core.camera import Camera, focus_point, opaque, pixel_rays
from ..core.progress import Progress
from ..datasets.types import View
from . import hull

PIXELS = 400**2  # of a photograph's copy, about
_LEVELS, _ABOVE = 44, 4  # depths below the hull; those of them that lie above it
_REACH = 0.75  # the deepest, over the hull's radius
_INVERSE_LEVELS, _FINER = 128, 4  # depths where there is no hull, and steps between two of them in the end
_NEAREST = 0.25  # of these, over the least distance of a camera from what all look at
_NEIGHBOURS, _BEST = 6, 3  # views that each is compared with, and those of them that count
_BASELINE, _WIDEST = 10.0, 35.0  # degrees between the directions to two neighbours: wished, and at most
_WINDOW = 2  # pixels on each side, at least
_WIDE = 1 / 64  # of the picture's size, where there is no hull, and much that is faint
_FLAT = 1e-4  # variance of grey levels in a window that shows nothing
SAME = 1.5  # levels between two depths that are the same
WITNESSES = 16  # views that are asked whether they agree
VIEWS, _AGREED = 2, 0.5  # of them, at least, and their part of those that look there


@dataclass(frozen=True)
class SmallImage:
    """A photograph's small copy: its ``camera``, and ``grey`` display values [H, W] float32 over white."""

    camera: Camera
    grey: np.ndarray

    @classmethod
    def of(cls, view: View, pixels: int = PIXELS) -> "SmallImage":
        """Return the copy of a view's photograph, of ``pixels`` pixels at most, or nearly so."""
        width, height = view.camera.size
        factor = max(1, int(np.ceil(np.sqrt(width * height / pixels) - 0.1)))
        rgba = view.pixels / np.float32(255) if view.pixels.dtype == np.uint8 else view.pixels
        grey = np.clip(rgba[..., :3], 0, 1).mean(-1) * rgba[..., 3] + 1 - rgba[..., 3]
        w, h = width // factor, height // factor
        grey = downscale_local_mean(grey[: h * factor, : w * factor], (factor, factor))
        camera = view.camera.cropped(0, 0, w * factor, h * factor).resized(w, h)
        return cls(camera, np.ascontiguousarray(grey, np.float32))

    def normalized(self, window: int = _WINDOW) -> np.ndarray:
        """Return the grey levels less their mean over the ``window`` around each pixel, over its standard deviation, [H, W]."""
        mean, square = (ndimage.uniform_filter(self.grey.astype(np.float64) ** k, 2 * window + 1) for k in (1, 2))
        return ((self.grey - mean) / np.sqrt(np.maximum(square - mean**2, _FLAT))).astype(np.float32)


@dataclass(frozen=True)
class DepthMap:
    """What a sweep found in one view.

    camera     of the small copy
    depth      [H, W] z-depth in world units, NaN where nothing was looked for
    likeness   [H, W] how alike the views are there: the mean of the best correlations, in [−1, 1]
    tolerance  [H, W] how far apart two depths may be, there, that are the same, in world units
    hull       [H, W] z-depth of the visual hull, NaN beside it; None without masks
    gain       [H, W] how much more alike they are than on the hull; None without masks
    window     pixels on each side of those that were compared
    """

    camera: Camera
    depth: np.ndarray
    likeness: np.ndarray
    tolerance: np.ndarray
    hull: np.ndarray | None = None
    gain: np.ndarray | None = None
    window: int = _WINDOW


def depth_maps(views: Sequence[View], mesh: tuple | None = None, quiet: bool = True, pixels: int = PIXELS) -> list[DepthMap]:
    """Sweep all ``views`` in copies of ``pixels``; ``mesh`` are the vertices and faces of their `hull.surface`, None where they
    have no masks. ``quiet`` shows no progress. A JIT variant must be active."""
    with Progress(quiet=quiet, label="comparing the photographs") as progress:
        small = [SmallImage.of(view, pixels) for view in views]
        size = np.sqrt(np.prod(small[0].camera.size))
        window = max(_WINDOW, int(_WIDE * size)) if mesh is None else _WINDOW
        cameras, images = [s.camera for s in small], [s.normalized(window) for s in small]
        surfaces = [None] * len(small) if mesh is None else hull.depth_maps(mesh[0], mesh[1], cameras)
        levels, step = _levels(cameras, mesh)
        target = focus_point(cameras)[0] if mesh is None else mesh[0].mean(0)
        maps = []
        for i in range(len(small)):
            maps.append(_depth_map(i, cameras, images, surfaces, levels, step, neighbours(i, cameras, target), window))
            progress.update((i + 1) / len(small), views=i + 1)
        return maps


def _levels(cameras, mesh):
    """The depths of a sweep and the distance of two of them: depths below the hull, or, without one, inverse depths."""
    if mesh is not None:
        step = _REACH * float(np.linalg.norm(mesh[0] - mesh[0].mean(0), axis=1).max()) / (_LEVELS - _ABOVE)
        return (np.arange(_LEVELS) - _ABOVE) * step, step
    center = focus_point(cameras)[0]
    nearest = _NEAREST * min(np.linalg.norm(c.origin - center) for c in cameras)
    levels = np.linspace(1 / nearest, 0, _INVERSE_LEVELS, endpoint=False)
    return levels, levels[0] - levels[1]


def neighbours(i: int, cameras: Sequence[Camera], target: np.ndarray, count: int = _NEIGHBOURS) -> list[int]:
    """Return the indices of the ``count`` cameras to compare camera ``i`` with: those that see ``target`` [3] from some ten
    degrees beside it, and look the same way."""
    away = np.array([c.origin for c in cameras]) - target
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    forward = np.array([c.rotation[2] for c in cameras])
    angle, turn = (np.degrees(np.arccos(np.clip(v @ v[i], -1, 1))) for v in (away, forward))
    cost = np.abs(np.log(np.maximum(angle, 0.1) / _BASELINE)) + turn / 60
    cost[(angle > _WIDEST) | (np.arange(len(cameras)) == i)] = np.inf
    return [int(j) for j in np.argsort(cost)[:count] if np.isfinite(cost[j])]


def _depth_map(i, cameras, images, surfaces, levels, step, others, window):
    """The `DepthMap` of view ``i``."""
    (width, height), surface = cameras[i].size, surfaces[i]
    known = np.ones((height, width), bool) if surface is None else np.isfinite(surface)
    depth = np.full((height, width), np.nan, np.float32)
    likeness, gain = np.zeros((2, height, width), np.float32)
    tolerance = np.full((height, width), SAME * step, np.float32)
    if len(others) < 2 or not known.any():
        return DepthMap(cameras[i], depth, likeness, tolerance, surface, gain, window)
    (part,) = ndimage.find_objects(known.astype(np.int8))
    rows, columns = part
    camera = cameras[i].cropped(columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start)
    base = np.zeros(known.shape) if surface is None else np.where(known, surface, np.nanmax(surface))
    at = lambda level: 1 / level if surface is None else base[part] + level
    shown = [(cameras[j], images[j], surfaces[j]) for j in others]
    swept = lambda levels: sweep(
        camera, images[i][part], [at(level) for level in levels], shown, (SAME + 0.5) * step, window
    )
    score = swept(levels)
    place, likeness[part] = _peak(score)
    level = levels[0] + place * (levels[1] - levels[0])
    if surface is None:  # there a level is some pixels of the neighbours
        beside = lambda place: np.maximum(level + (place / _FINER - 1) * step, levels[-1])
        place, likeness[part] = _peak(swept([beside(k) for k in range(2 * _FINER + 1)]))
        level = beside(place)
    found = at(level)
    depth[part] = np.where(known[part], found, np.nan)
    if surface is None:
        tolerance[part] = SAME * step * found**2
        return DepthMap(cameras[i], depth, likeness, tolerance, window=window)
    gain[part] = likeness[part] - score[: _ABOVE + 2].max(0)
    return DepthMap(cameras[i], depth, np.where(known, likeness, 0), tolerance, surface, gain, window)


def _peak(score):
    """Where the greatest of ``score`` [L, H, W] is in each pixel, between levels by a parabola, and its value."""
    best = score.argmax(0)
    middle = np.clip(best, 1, len(score) - 2)
    before, here, after = (np.take_along_axis(score, (middle + k)[None], 0)[0] for k in (-1, 0, 1))
    bend = before - 2 * here + after
    offset = np.where((middle == best) & (bend < -1e-6), 0.5 * (before - after) / np.minimum(bend, -1e-6), 0)
    return best + np.clip(offset, -0.5, 0.5), score.max(0)


# ---- How alike ----


def sweep(
    camera: Camera,
    image: np.ndarray,
    depths: Sequence[np.ndarray | float],
    others: Sequence[tuple[Camera, np.ndarray, np.ndarray | None]],
    margin: float = 0.0,
    window: int = _WINDOW,
) -> np.ndarray:
    """Return how much the surroundings of each pixel of ``image`` look like what ``others`` show if it lies at each of
    ``depths``: [L, H, W], the mean of the best few correlations, at least −1.

    Args:
      camera, image: of the view, [H, W], as `SmallImage.normalized` has it with this ``window``
      depths: L times z-depths [H, W], or one of all pixels, in world units
      others: the same of other views, and of each its hull's depth, NaN beside it, or None. A view counts where the point is in
        its frame and not more than ``margin`` above its hull
    """
    height, width = image.shape
    index = dr.arange(mi.UInt32, height * width)
    rays, own, origin = pixel_rays(camera, index), as_float(image), opaque(camera).origin
    scores = []
    placed = [
        (other, as_float(shown), None if hull is None else as_float(np.nan_to_num(hull, nan=np.inf)))
        for other, shown, hull in others
    ]
    dr.eval(rays, own)
    for depth in depths:
        z = as_float(depth) if isinstance(depth, np.ndarray) else dr.opaque(mi.Float, float(depth))
        point = origin + rays * z
        found = [_warp(point, *other, margin) for other in placed]
        means = _means([dr.select(inside, value * own, -1) for value, inside in found], width, height, window)
        best = [mi.Float(-1)] * min(_BEST, len(placed))
        for mean, (_, inside) in zip(means, found):
            mean = dr.select(inside, mean, -1)
            for k in range(len(best)):  # keep the largest, in order
                best[k], mean = dr.maximum(best[k], mean), dr.minimum(best[k], mean)
        scores.append(sum(best) / len(best))
        dr.eval(scores[-1])
    return np.stack([score.numpy().reshape(height, width) for score in scores])


def _warp(point, other, image, surface, margin):
    """(values of the ``other`` view's ``image`` at ``point``, whether that can be its surface: in its frame, not above its
    hull)."""
    constant = lambda x: dr.opaque(mi.Float, float(x))
    seen = opaque(other)
    width, height = other.size
    local = seen.rotation @ mi.Vector3f(point - seen.origin)
    x = local.x / local.z * seen.focal.x + seen.principal.x - 0.5
    y = local.y / local.z * seen.focal.y + seen.principal.y - 0.5
    inside = (local.z > 0) & (x >= 0) & (y >= 0) & (x < constant(width - 1)) & (y < constant(height - 1))
    column, row = dr.floor(x), dr.floor(y)
    at = mi.UInt32(dr.select(inside, row * constant(width) + column, 0))
    right, below = dr.opaque(mi.UInt32, 1), dr.opaque(mi.UInt32, width)
    fetch = lambda k: dr.gather(mi.Float, image, at + k, inside)
    fx, fy = x - column, y - row
    value = dr.lerp(dr.lerp(fetch(0), fetch(right), fx), dr.lerp(fetch(below), fetch(below + right), fx), fy)
    if surface is not None:
        inside &= local.z > dr.gather(mi.Float, surface, at, inside) - constant(margin)
    return value, inside


def _means(images, width, height, window):
    """Means of ``images`` over windows, which end at the border."""
    index = dr.arange(mi.UInt32, width * height)
    columns, rows = dr.opaque(mi.UInt32, width), dr.opaque(mi.UInt32, height)
    for position, extent, stride in ((index % columns, columns, 1), (index // columns, rows, columns)):
        dr.eval(images)
        sums = [mi.Float(0)] * len(images)
        for offset in range(-window, window + 1):
            moved = dr.clip(mi.Int32(position) + offset, 0, mi.Int32(extent) - 1) - mi.Int32(position)
            at = mi.UInt32(mi.Int32(index) + moved * mi.Int32(stride))
            sums = [s + dr.gather(mi.Float, image, at) for s, image in zip(sums, images)]
        images = [s / (2 * window + 1) for s in sums]
    return images


# ---- What views agree on ----


def verified(maps: Sequence[DepthMap]) -> list[DepthMap]:
    """Return ``maps`` with no likeness left where most of the neighbouring views that look there find another depth, and in
    places where that holds for most pixels around."""
    cameras = [m.camera for m in maps]
    center = focus_point(cameras)[0]
    kept = []
    for i, m in enumerate(maps):
        index = dr.arange(mi.UInt32, m.depth.size)
        depth = as_float(np.nan_to_num(m.depth))
        points = opaque(m.camera).origin + pixel_rays(m.camera, index) * depth
        dr.eval(points)
        count, same, through = _agreement(points, [maps[j] for j in neighbours(i, cameras, center, WITNESSES)])
        alike = (count >= VIEWS) & (same > _AGREED * (same + through)) & (depth > 0)
        alike = alike.numpy().reshape(m.depth.shape).astype(np.float32)
        alike *= ndimage.uniform_filter(alike, 2 * m.window + 1) > _AGREED
        kept.append(replace(m, likeness=m.likeness * alike))
    return kept


def agreement(points: np.ndarray, maps: Sequence[DepthMap]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return how many of ``maps`` have a surface at each of ``points`` [N, 3], and the sums of the likeness of these, and of
    those that look through it at something farther, [N] each."""
    if not len(points):
        return np.zeros(0), np.zeros(0), np.zeros(0)
    p = mi.Point3f(*(as_float(np.ascontiguousarray(x)) for x in np.asarray(points, np.float32).T))
    dr.eval(p)
    return tuple(v.numpy() for v in _agreement(p, maps))


def _agreement(points, maps):
    """`agreement` of Dr.Jit's ``points``."""
    count, same, through = (dr.zeros(mi.Float, dr.width(points)) for _ in range(3))
    for m in maps:
        seen = opaque(m.camera)
        local = seen.rotation @ mi.Vector3f(points - seen.origin)
        x = local.x / local.z * seen.focal.x + seen.principal.x
        y = local.y / local.z * seen.focal.y + seen.principal.y
        width, height = (dr.opaque(mi.Float, float(n)) for n in m.camera.size)
        inside = (local.z > 0) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
        at = mi.UInt32(dr.select(inside, dr.floor(y) * width + dr.floor(x), 0))
        depth, likeness, tolerance = (
            dr.gather(mi.Float, as_float(v), at, inside) for v in (np.nan_to_num(m.depth), m.likeness, m.tolerance)
        )
        weight = dr.select(inside & (depth > 0), dr.maximum(likeness, 0), 0)
        farther = depth - local.z
        meets = dr.abs(farther) <= tolerance
        count += dr.select(meets & (weight > 0), mi.Float(1), 0)
        same += dr.select(meets, weight, 0)
        through += dr.select(farther > tolerance, weight, 0)
        dr.eval(count, same, through)
    return count, same, through

"""Where photographs look through the visual hull: the inside of a cup, the neck of a cape (docs/method.md §5).

Depths below the hull are believed where they explain the photographs better than the hull itself does, where most views find
the same, and where the surroundings do so, too: views agree by chance here and there on a mirror, but not all around.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage

from ..core.camera import focus_point
from .stereo import SAME, VIEWS, WITNESSES, DepthMap, agreement, neighbours

COPIES = 200**2  # pixels of the copies that are compared: they show less noise, and more of the surroundings
_GAIN = 0.1  # how much more alike than on the hull
_BELOW = 2.5  # tolerances below the hull, over `SAME`
_AGREED, _AROUND = 0.5, 0.6  # part of the views that find a point where one does, and its mean over the surroundings
_SURROUNDINGS, _CELL = 10, 2  # these, as a standard deviation in levels, and the cells in which it is taken
_LOOK_THROUGH = 3  # views that look through what is not there


def openings(maps: Sequence[DepthMap]) -> list[DepthMap]:
    """Return ``maps``, which have a hull, with likeness 1 where there is an opening, 0 elsewhere."""
    below = [replace(m, likeness=_deeper(m)) for m in maps]
    center = focus_point([m.camera for m in maps])[0]
    found = [_support(i, below, center) for i in range(len(below))]
    points = np.concatenate([points for points, _, _ in found])
    count = np.concatenate([count for _, count, _ in found])
    part = np.concatenate([part for _, _, part in found])
    around = _mean_around(points, part, _level(maps))
    kept = (count >= VIEWS) & (part > _AGREED) & (around > _AROUND)
    for m, here in zip(below, np.split(kept, np.cumsum([len(points) for points, _, _ in found])[:-1])):
        m.likeness[m.likeness > 0] = here
    return below


def seen_through(points: np.ndarray, opened: Sequence[DepthMap], verified: Sequence[DepthMap]) -> np.ndarray:
    """Return [N] which of ``points`` [N, 3] several views look through, as `openings` says, unless more of the ``verified``
    maps have a surface there than look through it."""
    _, _, through = agreement(points, opened)
    _, same, farther = agreement(points, verified)
    return (through >= _LOOK_THROUGH) & (farther >= same)


def _level(maps):
    """World units between two depths of the sweep that ``maps`` come from."""
    return max(float(m.tolerance.max()) for m in maps) / SAME


def _deeper(m):
    """[H, W] 1 where the depth of ``m`` is below its hull, and more alike than that, else 0."""
    depth, surface = np.nan_to_num(m.depth), np.nan_to_num(m.hull, nan=np.inf)
    return ((depth - surface > _BELOW / SAME * m.tolerance) & (m.gain > _GAIN)).astype(np.float32)


def _support(i, maps, center):
    """Points of ``maps[i]`` with likeness, how many of its neighbours find them, and these among those that look there."""
    m = maps[i]
    where = m.likeness > 0
    points = (m.camera.origin + m.camera.rays()[where] * m.depth[where][:, None]).astype(np.float32)
    count, same, through = agreement(points, [maps[j] for j in neighbours(i, [m.camera for m in maps], center, WITNESSES)])
    return points, count, same / np.maximum(same + through, 1e-6)


def _mean_around(points, values, level):
    """[N] mean of ``values`` [N] over the surroundings of ``points`` [N, 3]."""
    if not len(points):
        return values
    cell = np.floor((points - points.min(0)) / (_CELL * level)).astype(np.intp)
    shape = cell.max(0) + 1
    total, count = np.zeros(shape), np.zeros(shape)
    np.add.at(total, tuple(cell.T), values)
    np.add.at(count, tuple(cell.T), 1)
    blurred = lambda sums: ndimage.gaussian_filter(sums, _SURROUNDINGS / _CELL, mode="constant")[tuple(cell.T)]
    return blurred(total) / blurred(count)

"""Points with normals on what depth maps agree on (`stereo.py`; docs/method.md §5)."""

from collections.abc import Callable, Sequence

import numpy as np
from scipy import ndimage, spatial

from .sampling import thinned
from .stereo import DepthMap

_ALIKE = 0.3  # likeness that is worth a candidate
_CANDIDATES, _MOST = 3, 1_000_000  # for each point that is wanted; in all
_NEIGHBOURS, _TURN = 16, 0.5  # points that each is smoothed with, and the least cosine of their normals
_BLUR = 1.5  # pixels of a depth map, for normals
_DISK = 1.6  # radius of the disk that a point has to itself, over the spacing of the candidates

Oriented = tuple[np.ndarray, np.ndarray]  #: positions [N, 3] and unit normals [N, 3], float32, world space


def oriented_points(
    maps: Sequence[DepthMap], count: int, rng: np.random.Generator, opened: Callable[[np.ndarray], np.ndarray] | None = None
) -> Oriented:
    """Return about ``count`` points that ``maps`` agree on, denser where photographs show more of a surface; normals are
    turned to the view that saw them. Fewer, or none, where there is less to agree on. ``opened`` is a callback that says of
    points [N, 3] on the hull whether something below them is asked for; None: of all."""
    parts = [_candidates(m) for m in maps]
    positions, normals, above = (np.concatenate(arrays) for arrays in zip(*parts))
    chosen = rng.permutation(len(positions))[:_MOST]
    if opened is not None:
        chosen = chosen[opened(above[chosen])]
    chosen = chosen[: _CANDIDATES * count]
    if len(chosen) <= _NEIGHBOURS:
        return positions[:0], normals[:0]
    positions, normals = smoothed(positions[chosen], normals[chosen])
    distance, _ = spatial.KDTree(positions).query(positions, 4, workers=-1)
    kept = thinned(positions, _DISK * distance[:, 1:].mean(1))
    return positions[kept], normals[kept]


def smoothed(positions: np.ndarray, normals: np.ndarray) -> Oriented:
    """Return oriented points [N, 3] whose normals are means over their neighbours', and which lie in the plane through them
    (moving least squares of degree 0; Alexa et al. 2001)."""
    _, near = spatial.KDTree(positions).query(positions, min(_NEIGHBOURS + 1, len(positions)), workers=-1)
    alike = (normals[near] * normals[:, None]).sum(-1) > _TURN
    mean = (normals[near] * alike[..., None]).sum(1)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    height = ((positions[near] - positions[:, None]) * mean[:, None]).sum(-1)
    moved = positions + mean * ((height * alike).sum(1) / alike.sum(1))[:, None]
    return moved.astype(np.float32), mean.astype(np.float32)


def _candidates(m):
    """Points and normals of a depth map's pixels, but for its borders, steep places and what nothing is like, and the points of
    the hull above them."""
    known = np.isfinite(m.depth)
    weight = ndimage.gaussian_filter((known & (m.likeness > _ALIKE)).astype(np.float32), _BLUR)
    filled = np.where(known & (m.likeness > _ALIKE), m.depth, 0)
    depth = ndimage.gaussian_filter(filled, _BLUR) / np.maximum(weight, 1e-6)
    rays = m.camera.rays()
    points = rays * depth[..., None]
    normals = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    length = np.linalg.norm(normals, axis=-1)
    normals = normals / np.maximum(length, 1e-20)[..., None]
    normals *= -np.sign((normals * rays).sum(-1, keepdims=True))
    kept = known & (m.likeness > _ALIKE) & (weight > 0.5) & (np.abs(depth - m.depth) < m.tolerance) & (length > 0)
    at = lambda depth: (m.camera.origin + rays[kept] * depth[kept][:, None]).astype(np.float32)
    return at(m.depth), normals[kept].astype(np.float32), at(m.depth if m.hull is None else m.hull)

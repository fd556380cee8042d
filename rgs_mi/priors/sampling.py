"""Points spread evenly over a surface."""

import numpy as np
from scipy import spatial

_BEND, _DENSER = 0.3, 4  # difference of unit normals from sample to sample that is too much; how much denser samples may be
_CHUNK = 100_000  # points that are asked for their neighbours at a time: memory


def sample_surface(
    vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return ``count`` points on a mesh as of `surface`: positions [count, 3] and unit normals [count, 3], float32. They are
    spread evenly, but up to four times as densely where the mesh bends.

    Six times as many weighted samples are `thinned`. Too many are cut and too few topped up at random.
    """
    corners = vertices[faces].astype(np.float64)
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    bend = np.sqrt(area.sum() / count) * _bend(faces, normals, area)
    density = np.clip((bend / _BEND) ** 2, 1, _DENSER)
    face = rng.choice(len(faces), 6 * count, p=area * density / (area * density).sum())
    u, v = np.sqrt(rng.random(6 * count)), rng.random(6 * count)
    weights = np.stack([1 - u, u * (1 - v), u * v], -1)[:, :, None]
    positions = (weights * corners[face]).sum(1)

    radius = 0.69 * np.sqrt((area * density).sum() / (count * density[face]))
    kept = thinned(positions, radius)
    rest = np.setdiff1d(np.arange(len(positions)), kept)
    chosen = np.concatenate([rng.permutation(kept), rng.permutation(rest)])[:count]

    normal = (weights[chosen] * normals[faces[face[chosen]]]).sum(1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(normal.dtype).tiny)
    return positions[chosen].astype(np.float32), normal.astype(np.float32)


def _bend(faces, normals, area):
    """[F] how much the normals of a mesh change over a unit of length, averaged over neighbouring faces."""
    corners = normals[faces].astype(np.float64)
    change = np.linalg.norm(corners - corners.mean(1, keepdims=True), axis=2).max(1)
    total = np.bincount(faces.ravel(), np.repeat(change * np.sqrt(area / 2), 3))  # of change over √(2 area), times the area
    return (total / np.maximum(np.bincount(faces.ravel(), np.repeat(area, 3)), np.finfo(float).tiny))[faces].mean(1)


def thinned(positions: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Return the indices of a Poisson-disk subset of ``positions`` [N, 3], no two of which are nearer than the smaller of
    their ``radius`` [N]. It is made in rounds: a point stays when no remaining neighbour comes before it."""
    tree, indices = spatial.KDTree(positions), np.arange(len(positions), dtype=np.int32)
    chunks = np.array_split(indices, -(-len(indices) // _CHUNK))
    a, b = np.concatenate([_close(tree, positions, radius, chunk) for chunk in chunks], 1)
    state = np.zeros(len(positions), np.int8)  # 0 open, 1 kept, -1 removed
    while (state == 0).any():
        held = np.zeros(len(positions), bool)
        held[b] = True
        state[(state == 0) & ~held] = 1
        state[b[state[a] == 1]] = -1
        open_ = (state[a] == 0) & (state[b] == 0)
        a, b = a[open_], b[open_]
    return np.flatnonzero(state == 1)


def _close(tree, positions, radius, chunk):
    """[2, P] the indices of all pairs of ``positions``, the first of which is in the ``chunk`` and comes before the other, that
    are too near to each other."""
    near = tree.query_ball_point(positions[chunk], radius[chunk], workers=-1)
    a, b = np.repeat(chunk, [len(n) for n in near]), np.concatenate(near).astype(np.int32)
    pairs = np.stack([a, b])[:, a < b]  # the index is the order
    a, b = pairs
    return pairs[:, np.linalg.norm(positions[a] - positions[b], axis=1) < radius[b]]

"""Solids as signed fields f(p), negative inside: rounded combinations of simple solids, and their surface as a mesh.

Points p are [N, 3], fields [N]. A field grows about as fast as distance does (its gradient is not much longer than 1).
Lengths are in the model's units.
"""

import itertools

import numpy as np
import numpy.typing as npt

from .meshes import Field, Mesh, unit

BLOCK = 8  # grid points along a block that is skipped as a whole where the surface is far
CHUNK = 1 << 17  # points that are evaluated together
FAR = 0.3  # beyond it only a bound of the distance from a curve is needed
EPSILON = 1e-4  # step of the differences that give a gradient


# ---- Combining solids ----


def union(a: np.ndarray, b: np.ndarray, radius: float) -> np.ndarray:
    """Return both solids, the crease between them filled with a fillet of about ``radius``."""
    h = np.maximum(1 - np.abs(a - b) / radius, 0)
    return np.minimum(a, b) - radius * h**3 / 6


def intersection(a: np.ndarray, b: np.ndarray, radius: float) -> np.ndarray:
    """Return what both solids share, its edges rounded off."""
    return -union(-a, -b, radius)


def difference(a: np.ndarray, b: np.ndarray, radius: float) -> np.ndarray:
    """Return the first solid without the second, the edges rounded off."""
    return -union(-a, b, radius)


# ---- Solids ----


def box(p: np.ndarray, half: npt.ArrayLike, radius: float) -> np.ndarray:
    """Return a box of half extents ``half`` [3] with edges and corners of ``radius``."""
    q = np.abs(p) - (np.asarray(half) - radius)
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0) - radius


def capsule(p: np.ndarray, a: npt.ArrayLike, b: npt.ArrayLike, radius: float) -> np.ndarray:
    """Return all points within ``radius`` of the segment from a to b [3]."""
    start = np.asarray(a, float)
    ab = np.asarray(b, float) - start
    t = np.clip((p - start) @ ab / (ab @ ab), 0, 1)
    return np.linalg.norm(p - start - t[:, None] * ab, axis=-1) - radius


def ellipsoid(p: np.ndarray, half: npt.ArrayLike) -> np.ndarray:
    """Return an ellipsoid of half axes ``half`` [3]; a distance to first order."""
    half = np.asarray(half)
    q = p / half
    length = np.linalg.norm(q, axis=-1)
    return length * (length - 1) / np.maximum(np.linalg.norm(q / half, axis=-1), 1e-9)


def swept(p: np.ndarray, control: npt.ArrayLike, radii: npt.ArrayLike) -> np.ndarray:
    """Return a tube with round ends around a cubic Bézier curve of control points ``control`` [4, 3]; ``radii`` [K] are the
    coefficients of its radius, a polynomial in t from 0 to 1.

    The nearest point of the curve comes from samples, then Newton's method, so that the field is smooth. Points that
    are `FAR` from the control points' box have the distance from that box instead, which is less.
    """
    radii = np.asarray(radii)
    control = np.asarray(control, float)
    gap = np.linalg.norm(np.maximum(np.maximum(control.min(0) - p, p - control.max(0)), 0), axis=-1)
    value, near = gap.copy(), gap < FAR
    p = p[near]
    basis = np.array([[1, 0, 0, 0], [-3, 3, 0, 0], [3, -6, 3, 0], [-1, 3, -3, 1.0]]) @ control
    at = lambda t, c: np.stack([np.polynomial.polynomial.polyval(t, x) for x in c.T], -1)
    first, second = basis[1:] * np.array([1, 2, 3])[:, None], basis[2:] * np.array([2, 6])[:, None]
    samples = np.linspace(0, 1, 33)
    curve = at(samples, basis)
    t = samples[((curve**2).sum(-1) - 2 * p @ curve.T).argmin(1)]
    for _ in range(3):
        offset, d = at(t, basis) - p, at(t, first)
        slope, bend = (offset * d).sum(-1), (d**2).sum(-1) + (offset * at(t, second)).sum(-1)
        t = np.clip(t - np.clip(slope / np.where(bend > 1e-6, bend, np.inf), -0.05, 0.05), 0, 1)
    value[near] = np.linalg.norm(p - at(t, basis), axis=-1) - np.polynomial.polynomial.polyval(t, radii)
    return value


# ---- Surface ----


def gradient(f: Field, p: np.ndarray) -> np.ndarray:
    """Return the derivative [N, 3] of a field at ``p`` [N, 3], from the corners of a small tetrahedron."""
    corners = EPSILON * np.array([[1, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1.0]])
    return np.asarray(sum(f(p + e)[:, None] * e for e in corners)) / (4 * EPSILON**2)


def surface(f: Field, low: npt.ArrayLike, high: npt.ArrayLike, step: float) -> Mesh:
    """Return the surface f = 0 within a box, closed where it does not leave the box, with f's own normals.

    Args:
      f:    field; details and gaps thinner than two steps are lost
      low, high: [3] corners of the box
      step: distance of the grid's points, about the length of an edge of the mesh

    Surface nets (Gibson 1998): every cell of a grid that the surface crosses gives one vertex, every edge that it crosses a
    quadrilateral between the four cells around it. Newton's method then puts the vertices onto the surface.
    """
    low, high = np.asarray(low, float), np.asarray(high, float)
    values = _sample(f, low, np.ceil((high - low) / step / BLOCK).astype(int), step)
    inside = _untangle(values) < 0
    count = np.asarray(sum(inside[_shift(c, inside.shape)].astype(np.uint8) for c in itertools.product((0, 1), repeat=3)))
    mixed = (count > 0) & (count < 8)
    index = np.cumsum(mixed).reshape(mixed.shape) - 1
    cells = np.argwhere(mixed)
    p = low + step * _cell_points(values, cells)
    for _ in range(3):
        g = gradient(f, p)
        p -= (f(p) / np.maximum((g**2).sum(-1), 1e-12))[:, None] * g
        # In its cell, no vertex meets another.
        p = np.clip(p, low + step * (cells + 0.005), low + step * (cells + 0.995))
    a, b, c, d = p[quads := _quads(inside, index)].transpose(1, 0, 2)
    # The shorter diagonal gives the better triangles.
    flip = np.linalg.norm(a - c, axis=-1) > np.linalg.norm(b - d, axis=-1)
    quads[flip] = np.roll(quads[flip], 1, axis=1)
    faces = quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    return Mesh(p.astype(np.float32), faces.astype(np.uint32), unit(gradient(f, p)).astype(np.float32))


def _sample(f, low, blocks, step):
    """[X, Y, Z] values at the points of a grid; blocks that the surface can't reach have the value of their middle."""
    corner = np.stack(np.meshgrid(*[np.arange(n) for n in blocks], indexing="ij"), -1) * BLOCK
    middle = f((low + step * (corner + (BLOCK - 1) / 2)).reshape(-1, 3)).reshape(blocks)
    near = np.abs(middle) < 1.5 * step * BLOCK * np.sqrt(3) / 2
    offset = np.stack(np.meshgrid(*[np.arange(BLOCK)] * 3, indexing="ij"), -1).reshape(-1, 3)
    points = low + step * (corner[near][:, None] + offset).reshape(-1, 3)
    fine = np.concatenate([f(chunk) for chunk in np.array_split(points, len(points) // CHUNK + 1)])
    values = middle
    for axis in range(3):
        values = values.repeat(BLOCK, axis)
    view = values.reshape(np.stack([blocks, [BLOCK] * 3], -1).ravel()).transpose(0, 2, 4, 1, 3, 5)
    view[near] = fine.reshape(-1, BLOCK, BLOCK, BLOCK)
    return values


def _untangle(values):
    """Values in which no square of the grid has both diagonals inside or outside: there the surface would touch itself."""
    while True:
        tangled = []
        for axis in range(3):
            corners = [
                _shift(np.insert(c, axis, 0), np.add(values.shape, np.eye(3, dtype=int)[axis]))
                for c in ((0, 0), (0, 1), (1, 1), (1, 0))
            ]
            a, b, c, d = (values[corner] < 0 for corner in corners)
            where = np.argwhere((a == c) & (b == d) & (a != b))
            four = np.stack([where + [s.start for s in corner] for corner in corners])  # [4, S, 3] grid points
            least = np.abs(values[tuple(four.transpose(2, 0, 1))]).argmin(0)
            tangled.append(four[least, np.arange(len(where))])
        points = np.unique(np.concatenate(tangled), axis=0)
        if not len(points):
            return values
        at = tuple(points.T)
        values[at] = np.where(values[at] < 0, 1e-9, -1e-9)


def _shift(corner, shape):
    """Slices that pick one corner of every cell."""
    return tuple(slice(c, n - 1 + c) for c, n in zip(corner, shape))


def _cell_points(values, cells):
    """[M, 3] mean, in grid units, of the points where the surface crosses the edges of cells [M, 3]."""
    total, count = np.zeros(cells.shape), np.zeros(len(cells))
    for axis, corner in itertools.product(range(3), itertools.product((0, 1), repeat=3)):
        if corner[axis]:
            continue
        start, end = cells + corner, cells + corner + np.eye(3, dtype=int)[axis]
        a, b = values[tuple(start.T)], values[tuple(end.T)]
        crosses = (a < 0) != (b < 0)
        t = np.where(crosses, a / np.where(crosses, a - b, 1), 0)
        total += crosses[:, None] * (start + t[:, None] * np.eye(3)[axis])
        count += crosses
    return total / count[:, None]


def _quads(inside, index):
    """[Q, 4] cells around each edge of the grid that the surface crosses, counter-clockwise seen from outside."""
    quads = []
    for axis in range(3):
        e, u, v = np.roll(np.eye(3, dtype=int), -axis, axis=0)
        start, end = _shift((0, 0, 0), inside.shape), _shift(e, inside.shape)
        edge = np.argwhere(inside[start] != inside[end])
        edge = edge[(edge @ u > 0) & (edge @ v > 0)]
        around = np.stack([index[tuple((edge - o).T)] for o in (u + v, v, 0 * u, u)], -1)
        outward = inside[tuple(edge.T)]
        quads.append(np.where(outward[:, None], around, around[:, ::-1]))
    return np.concatenate(quads)

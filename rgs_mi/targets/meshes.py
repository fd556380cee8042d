"""Triangle meshes from smooth surfaces: grids, tubes, lathes. Faces are counter-clockwise seen from outside."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

#: A function from points [N, 3] to numbers [N].
Field = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh: ``vertices`` [V, 3] float32, ``faces`` [F, 3] uint32, ``normals`` [V, 3] float32 (unit, outward,
    smooth)."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray

    def select(self, keep: np.ndarray) -> "Mesh":
        """Return the faces where ``keep`` [F] is true, with the normals of the whole surface."""
        used, faces = np.unique(self.faces[keep], return_inverse=True)
        return Mesh(self.vertices[used], faces.reshape(-1, 3).astype(np.uint32), self.normals[used])

    def cut(self, value: np.ndarray) -> "Mesh":
        """Return the same surface with edges along the curve where ``value`` [V] is zero; what is closed stays closed.

        Where the curve passes close to a vertex it goes through the vertex, so that no sliver loses its area to rounding.
        """
        side, faces = np.sign(value), self.faces.astype(np.int64)
        straddling = _straddling(side[faces])
        ends = np.sort(faces[straddling][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2))
        keys = np.unique(ends[:, 0] * len(value) + ends[:, 1])
        low, high = keys // len(value), keys % len(value)
        length = np.linalg.norm(self.vertices[low] - self.vertices[high], axis=1)
        near = 0.04 * np.median(length) * np.abs(value[high] - value[low]) / length if len(keys) else 0
        crossed = side[low] * side[high] < 0
        for end in (low, high):
            side[end[crossed & (np.abs(value[end]) < near)]] = 0

        crossed = side[low] * side[high] < 0
        keys, low, high = keys[crossed], low[crossed], high[crossed]
        t = (value[low] / (value[low] - value[high]))[:, None]
        mix = lambda x: x[low] + t * (x[high].astype(float) - x[low])
        count = len(value)
        at = lambda a, b: count + np.searchsorted(keys, np.minimum(a, b) * count + np.maximum(a, b))

        sides = side[faces]
        straddling = _straddling(sides)
        through = straddling & (sides == 0).any(1)
        pieces = [faces[~straddling]]
        # The corner a is on the curve, which leaves through bc.
        a, b, c = _rotated(faces[through], (sides[through] == 0).argmax(1))
        pieces += [np.stack([a, b, at(b, c)], -1), np.stack([a, at(b, c), c], -1)]
        # The corner a is alone on its side.
        whole = straddling & ~through
        a, b, c = _rotated(faces[whole], (sides[whole] == -np.sign(sides[whole].sum(1, keepdims=True))).argmax(1))
        p, q = at(a, b), at(a, c)
        pieces += [np.stack(triple, -1) for triple in ((a, p, q), (p, b, c), (p, c, q))]
        return Mesh(
            np.concatenate([self.vertices, mix(self.vertices).astype(np.float32)]),
            np.concatenate(pieces).astype(np.uint32),
            np.concatenate([self.normals, unit(mix(self.normals)).astype(np.float32)]),
        )

    def moved(self, offset: npt.ArrayLike) -> "Mesh":
        """Return the mesh shifted by ``offset`` [3]."""
        return Mesh(self.vertices + np.asarray(offset, np.float32), self.faces, self.normals)


def _straddling(sides: np.ndarray) -> np.ndarray:
    """[F] which faces have corners on both sides; sides [F, 3] are -1, 0 or 1."""
    return (sides.min(1) < 0) & (sides.max(1) > 0)


def _rotated(faces: np.ndarray, first: np.ndarray) -> np.ndarray:
    """[3, F] corners of faces [F, 3], each from the corner ``first`` [F] on."""
    return faces[np.arange(len(faces))[:, None], (first[:, None] + np.arange(3)) % 3].T


def divide(mesh: Mesh, regions: Sequence[tuple[str, Sequence[Field]]], rest: str) -> dict[str, Mesh]:
    """Cut a surface into named parts with crisp borders.

    Args:
      regions: (name, fields) pairs; a region is where all its fields are negative. Where regions overlap, the first has it;
               a name may occur several times
      rest:    name of what no region has
    """
    for field in dict.fromkeys(field for _, fields in regions for field in fields):
        mesh = mesh.cut(field(mesh.vertices.astype(float)))
    center = mesh.vertices[mesh.faces].mean(1, dtype=float)
    names = list(dict.fromkeys([*(name for name, _ in regions), rest]))
    owner = np.full(len(center), names.index(rest))
    for name, fields in reversed(regions):
        owner[np.logical_and.reduce([field(center) < 0 for field in fields])] = names.index(name)
    return {name: mesh.select(owner == k) for k, name in enumerate(names)}


def between(coordinate: Field, low: float, high: float) -> tuple[Field, Field]:
    """Return two fields for `divide`: where a coordinate is between two values."""
    return (lambda p: low - coordinate(p)), (lambda p: coordinate(p) - high)


def unit(v: np.ndarray) -> np.ndarray:
    """Scale vectors [..., 3] to length 1; 0 stays 0."""
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-20)


def weld(points: np.ndarray, faces: np.ndarray) -> Mesh:
    """Return a mesh of ``points`` [N, 3] and ``faces`` [F, 3] in which equal points are one vertex and flat faces are gone.

    A vertex normal is the sum of its faces' area vectors, normalized.
    """
    keys, index, inverse = np.unique(np.round(points, 6), axis=0, return_index=True, return_inverse=True)
    vertices, faces = points[index], inverse.reshape(-1)[faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(1)]
    a, b, c = vertices[faces].transpose(1, 0, 2)
    area = np.cross(b - a, c - a)
    normals = np.stack([np.bincount(faces.ravel(), np.repeat(area[:, k], 3), len(vertices)) for k in range(3)], -1)
    return Mesh(vertices.astype(np.float32), faces.astype(np.uint32), unit(normals).astype(np.float32))


def grid_faces(rows: int, columns: int) -> np.ndarray:
    """Return the faces between the points of a grid, row by row: [2 (rows − 1) (columns − 1), 3].

    Outside is where (along a row) × (down a column) points.
    """
    i = np.arange((rows - 1) * columns).reshape(rows - 1, columns)[:, :-1].ravel()
    a, b, c, d = i, i + 1, i + columns, i + columns + 1
    return np.stack([a, b, d, a, d, c], -1).reshape(-1, 3)


def grid(points: np.ndarray) -> Mesh:
    """Return the surface through ``points`` [R, C, 3]. Seams and poles close because their points coincide."""
    return weld(points.reshape(-1, 3), grid_faces(*points.shape[:2]))


def tube(curve: np.ndarray, up: np.ndarray, width: npt.ArrayLike, height: npt.ArrayLike, sides: int = 32) -> Mesh:
    """Return a tube around a curve, with elliptical cross-sections; closed where the curve or its sizes close it.

    Args:
      curve: [N, 3] centers; a loop repeats its first point at the end
      up:    [N, 3] or [3] direction of the height, made perpendicular to the curve
      width, height: [N] or one number, half axes of the ellipse
      sides: points around it
    """
    first, last = curve[0], curve[-1]
    if np.allclose(first, last):
        padded = np.vstack([curve[-2], curve[:-1], first, curve[1]])
    else:
        padded = np.vstack([2 * first - curve[1], curve, 2 * last - curve[-2]])
    tangent = unit(padded[2:] - padded[:-2])
    side = unit(np.cross(tangent, np.broadcast_to(up, curve.shape)))
    up = np.cross(side, tangent)
    half_width, half_height = (np.broadcast_to(x, len(curve))[:, None, None] for x in (width, height))
    c, s = _circle(sides)
    return grid((padded[1:-1, None] + half_width * c * side[:, None] + half_height * s * up[:, None])[:, ::-1])


def _circle(sides: int) -> np.ndarray:
    """[2, sides + 1, 1] cosines and sines around a circle, the last exactly the first."""
    a = 2 * np.pi * (np.arange(sides + 1) % sides) / sides
    return np.stack([np.cos(a), np.sin(a)])[..., None]


def lathe(profile: np.ndarray, origin: np.ndarray, axis: npt.ArrayLike, sides: int = 96) -> Mesh:
    """Return a solid of revolution about the ``axis`` [3] through ``origin`` [3]: ``profile`` [N, 2] is (radius, height along
    the axis), from the top down."""
    axis = unit(np.asarray(axis, float))
    x = unit(np.cross(axis, [0.0, 0, 1] if abs(axis[2]) < 0.9 else [1.0, 0, 0]))
    y = np.cross(axis, x)
    c, s = _circle(sides)
    r, h = profile.T[:, :, None, None]
    return grid((origin + r * (c * x + s * y) + h * axis)[:, ::-1])


def rounded(corners: npt.ArrayLike, cuts: npt.ArrayLike, steps: int = 8) -> np.ndarray:
    """Return a profile [N, 2] for `lathe`: the polyline through ``corners`` [C, 2] with each corner rounded off in ``steps``.

    ``cuts`` (one number or [C]) say how far from the corner its arc begins; at most half a side.
    """
    corners = np.asarray(corners, float)
    sides = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    cut = np.minimum(np.broadcast_to(cuts, len(corners))[1:-1], 0.5 * np.minimum(sides[1:], sides[:-1]))[:, None, None]
    before, corner, after = (x[:, None] for x in (corners[:-2], corners[1:-1], corners[2:]))
    t = np.linspace(0, 1, steps)[:, None]
    start, end = cut * unit(before - corner), cut * unit(after - corner)
    arcs = corner + (1 - t) ** 2 * start + t**2 * end
    return np.vstack([corners[:1], arcs.reshape(-1, 2), corners[-1:]])


def join(*meshes: Mesh) -> Mesh:
    """Return several meshes as one."""
    offsets = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.faces + o for m, o in zip(meshes, offsets)]).astype(np.uint32),
        np.concatenate([m.normals for m in meshes]),
    )


def mirrored(mesh: Mesh) -> Mesh:
    """Return the mirror image through the plane y = 0."""
    flip = np.array([1, -1, 1], np.float32)
    return Mesh(mesh.vertices * flip, mesh.faces[:, ::-1].copy(), mesh.normals * flip)

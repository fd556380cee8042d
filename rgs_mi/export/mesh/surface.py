"""From the zero of a signed distance to a mesh that others take: its largest parts, smooth where its normals say so, of few
triangles, on a plane."""

import importlib
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import sparse

from ...core.arrays import as_float
from ...core.camera import Camera, opaque, pixel_directions
from ...core.errors import UserError
from ...targets.meshes import Mesh, weld

PACKAGES = ("fast_simplification", "xatlas")
_LEAST_AREA = 0.01  # of a part that is kept, over that of the largest
_ROUNDS = 20  # of `smoothed`
_MOST_TEXELS = 2500  # root of the texels that charts may have in all
_PADDING = 2  # texels around each chart


def largest_parts(mesh: Mesh) -> Mesh:
    """Return the connected parts of a ``mesh`` whose area is at least a hundredth of the largest one's."""
    count = len(mesh.vertices)
    ends = mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    graph = sparse.coo_array((np.ones(len(ends), bool), ends.T), (count, count))
    _, part = sparse.csgraph.connected_components(graph, directed=False)
    area = np.bincount(part[mesh.faces[:, 0]], _areas(mesh))
    return mesh.select((area >= _LEAST_AREA * area.max())[part[mesh.faces[:, 0]]])


def _areas(mesh):
    a, b, c = mesh.vertices.astype(float)[mesh.faces].transpose(1, 0, 2)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def smoothed(mesh: Mesh, normals: np.ndarray) -> Mesh:
    """Return the ``mesh`` with vertices moved until edges lie more nearly in the planes that the ``normals`` [V, 3] at their
    ends say, which are truer than the surface's own: with neighbours j of i, again and again

        x_i ← x_i + ½ mean_j n_j (n_j · (x_j − x_i))                                              (18)

    so that what normals know of detail stays (after Sun et al. 2007, and Nehab et al. 2005)."""
    count = len(mesh.vertices)
    ends = np.concatenate([mesh.faces[:, [k, (k + j) % 3]] for k in range(3) for j in (1, 2)])
    neighbors = sparse.csr_array((np.ones(len(ends)), ends.T), (count, count))
    neighbors.data[:] = 1  # an edge that two faces share counts once
    points, n = mesh.vertices.astype(float), normals.astype(float)
    step = 0.5 / np.maximum(neighbors.sum(1), 1)[:, None]
    planes = (neighbors @ (n[:, :, None] * n[:, None]).reshape(count, 9)).reshape(count, 3, 3)
    for _ in range(_ROUNDS):
        heights = neighbors @ (n * (n * points).sum(1, keepdims=True))
        points = points + step * (heights - np.einsum("vij,vj->vi", planes, points))
    return Mesh(points.astype(np.float32), mesh.faces, normals.astype(np.float32))


def simplified(mesh: Mesh, faces: int) -> Mesh:
    """Return the ``mesh`` in at most about so many ``faces``, by quadric errors (Garland and Heckbert 1997), with normals of its
    own. Raises: UserError where the package is missing."""
    if len(mesh.faces) <= faces:
        return mesh
    (fast_simplification,) = packages("fast_simplification")
    points, triangles = fast_simplification.simplify(
        mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32), target_count=faces
    )
    _, first, count = np.unique(np.sort(triangles, axis=1), axis=0, return_index=True, return_counts=True)
    return weld(points.astype(float), triangles[first[count == 1]].astype(int))  # two of the same corners are a fin


def packages(*names: str) -> list[Any]:
    """Import what meshes are made with. Raises: UserError where it is missing."""
    try:
        return [importlib.import_module(name) for name in names]
    except ImportError as error:
        raise UserError("--to mesh: packages are missing: pip install 'rgs-mi[mesh]'") from error


def as_mitsuba(mesh: "Mesh | UVMesh") -> "mi.Mesh":
    """Return a ``mesh`` as Mitsuba's, with normals and, where it has them, texture coordinates."""
    uv = mesh.uv if isinstance(mesh, UVMesh) else None
    own = mi.Mesh("mesh", len(mesh.vertices), len(mesh.faces), has_vertex_normals=True, has_vertex_texcoords=uv is not None)
    params = mi.traverse(own)
    params["vertex_positions"], params["vertex_normals"] = as_float(mesh.vertices), as_float(mesh.normals)
    if uv is not None:
        params["vertex_texcoords"] = as_float(uv)
    params["faces"] = mi.UInt32(mesh.faces.ravel())
    params.update()
    return own


def coverage(scene: "mi.Scene", camera: Camera, side: int) -> np.ndarray:
    """Return how much of each pixel of ``camera`` the shapes of a ``scene`` fill, [H, W] float32, by ``side`` × ``side`` rays."""
    (width, height), (fine, _) = camera.size, camera.subdivided(side**2)
    index = dr.arange(mi.UInt32, width * height * side**2)
    hit = scene.ray_test(mi.Ray3f(opaque(camera).origin, pixel_directions(fine, index)))
    return hit.numpy().reshape(height, side, width, side).mean((1, 3), dtype=np.float32)


# ---- On a plane ----


@dataclass(frozen=True)
class UVMesh:
    """A triangle mesh with texture coordinates, cut at the seams of its charts.

    vertices  [V, 3] float32, world space
    faces     [F, 3] uint32, counter-clockwise seen from outside
    normals   [V, 3] float32, unit
    uv        [V, 2] float32 in [0, 1]: u to the right and v downwards, as glTF has them
    size      (columns, rows) of the textures that it wants
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    size: tuple[int, int]

    def tangents(self) -> np.ndarray:
        """Return [F, 2, 3] ∂x/∂u and ∂x/∂v of each face, world space; 0 where a face has no area on the plane."""
        (a, b, c), (s, t, r) = (v.astype(float)[self.faces].transpose(1, 0, 2) for v in (self.vertices, self.uv))
        (s, t), edges = ((t - s).T, (r - s).T), (b - a, c - a)
        (s_u, s_v), (t_u, t_v) = s, t
        area = s_u * t_v - s_v * t_u
        inverse = np.where(area != 0, 1 / np.where(area != 0, area, 1), 0)[:, None]
        du = (t_v[:, None] * edges[0] - s_v[:, None] * edges[1]) * inverse
        dv = (s_u[:, None] * edges[1] - t_u[:, None] * edges[0]) * inverse
        return np.stack([du, dv], 1)


def unwrapped(mesh: Mesh, texel: float) -> UVMesh:
    """Return the ``mesh`` cut into charts on a plane, on which a texel has about the size ``texel`` (world units), or more where
    textures would be too large. Raises: UserError where the package is missing."""
    (xatlas,) = packages("xatlas")
    texel = max(texel, np.sqrt(_areas(mesh).sum()) / _MOST_TEXELS)
    atlas, packing = xatlas.Atlas(), xatlas.PackOptions()
    atlas.add_mesh(mesh.vertices, mesh.faces)
    packing.texels_per_unit, packing.padding, packing.bilinear = 1 / texel, _PADDING, True
    atlas.generate(xatlas.ChartOptions(), packing)
    origin, faces, uv = atlas[0]
    return UVMesh(mesh.vertices[origin], faces, mesh.normals[origin], uv, (atlas.width, atlas.height))

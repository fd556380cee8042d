"""The outlines of a mesh brought to those of the surfels that it is made of.

Splats reach beyond the surface that their median depths say, so that a fit whose outlines are right has its depths inside, by a
part of a pixel; voxels and smoothing take another. Along the normal, in the image, of an outline that both have, the coverages α
of the surfels and β of the mesh are apart by

    d = ∫ (α − β) ds                                                                                  (23)

pixels, or d z / f in the world at the depth z, f pixels being the focal length. So much the vertices there should move along
their normals; what all of them move by, h, follows from the least Σ (h_i − d z / f)² + λ Σ (h_i − h_j)² + ε Σ h_i² over what
cameras say of vertices i and over edges ij.
"""

from collections.abc import Sequence

import mitsuba as mi
import numpy as np
from scipy import ndimage, sparse

from ...core.camera import Camera
from ...targets.meshes import Mesh, unit
from .surface import as_mitsuba, coverage

_REACH, _STEP = 3.0, 0.5  # pixels on either side of an outline that (23) is an integral over, and between its samples
_CLEAR = 0.1  # coverage up to which a pixel is empty, and short of which it is full
_STIFF, _STILL = 10.0, 1e-3  # λ and ε of (23)
_ROUNDS = 2
_SIDE = 2  # rays along a pixel's side that say how much of it the mesh fills


def aligned(mesh: Mesh, cameras: Sequence[Camera], coverages: Sequence[np.ndarray]) -> Mesh:
    """Return the ``mesh`` with vertices moved along their normals until its outlines are those of the ``coverages`` ([H, W] each,
    in [0, 1]) that ``cameras`` see; vertices that are on none move as near ones do."""
    for _ in range(_ROUNDS):
        mesh = Mesh(mesh.vertices + _offsets(mesh, cameras, coverages)[:, None] * mesh.normals, mesh.faces, mesh.normals)
    return mesh


def _offsets(mesh, cameras, coverages):
    """[V] world units by which vertices should move along their normals."""
    count = len(mesh.vertices)
    ends, faces = _edges(mesh.faces)
    weight, total = np.zeros(count), np.zeros(count)
    scene = mi.load_dict({"type": "scene", "mesh": as_mitsuba(mesh)})
    a, b, c = mesh.vertices.astype(float)[mesh.faces].transpose(1, 0, 2)
    outward = np.cross(b - a, c - a)
    for camera, covered in zip(cameras, coverages):
        facing = (outward * (a - camera.origin)).sum(1) < 0
        outline = np.flatnonzero(facing[faces[:, 0]] != facing[faces[:, 1]])
        clear, offset = _measured(mesh, ends[outline], scene, camera, covered)
        edges = outline[clear]
        for side in (0, 1):
            weight += np.bincount(ends[edges, side], minlength=count)
            total += np.bincount(ends[edges, side], offset, count)
    graph = sparse.coo_array((np.ones(len(ends)), ends.T), (count, count))
    laplacian = sparse.csgraph.laplacian(graph + graph.T)
    system = sparse.diags_array(weight + _STILL) + _STIFF * laplacian
    return sparse.linalg.spsolve(system.tocsc(), total).astype(np.float32)


def _edges(faces):
    """([E, 2] ends, [E, 2] faces) of the edges that two faces share."""
    ends = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64), 1)
    order = np.lexsort(ends.T)
    same = np.flatnonzero((ends[order[1:]] == ends[order[:-1]]).all(1))
    one, other = order[same], order[same + 1]
    return ends[one], np.stack([one, other], 1) // 3


def _measured(mesh, ends, scene, camera, covered):
    """(whether an outline shows at the middle of each edge of these ``ends`` [E, 2], which lie between front and back; where it
    does, d z / f of (23))."""
    point = mesh.vertices[ends].astype(float).mean(1)
    normal = unit(mesh.normals[ends].astype(float).mean(1))
    step = 1e-4 * np.linalg.norm(point - camera.origin, axis=1, keepdims=True)
    (pixel, z), (beside, _) = camera.project(point), camera.project(point + step * normal)
    across = unit(beside - pixel)
    own = coverage(scene, camera, _SIDE)
    along = np.arange(-_REACH, _REACH + _STEP / 2, _STEP)
    at = pixel[:, None] + along[:, None] * across[:, None] - 0.5
    sample = lambda image: ndimage.map_coordinates(image, [at[..., 1], at[..., 0]], order=1, mode="nearest")
    alpha, beta = sample(covered), sample(own)
    clear = ((at > 0) & (at < np.array(camera.size) - 1)).all((1, 2))
    for profile in (alpha, beta):
        clear &= (profile[:, 0] > 1 - _CLEAR) & (profile[:, -1] < _CLEAR)
    offset = _STEP * (alpha - beta).sum(1) * z / max(camera.focal)
    return clear, offset[clear]

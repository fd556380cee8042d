"""Depth maps as one surface: a truncated signed distance, the mean over the views (Curless and Levoy 1996).

A voxel at x, of depth z(x) to a camera whose map has the depth d where it sees x, is told s with the weight w,

    s = max(min((d − z) / τ, 1), −1),   w = min(1 + s, 1)                                              (16)

and s = w = 1 where the map has no depth: the camera looks past the surface there. The truncation τ is five voxels (2DGS). Behind
the surface a camera is believed less and less, or else thin parts, seen from both sides, would come out too thick. The surface is
where the mean of s is zero, between voxels that some view has told of.

Voxels have about the size of a pixel on the surface. Only those near what some view sees are there, in blocks of 8³: of the
helmet at 400 × 400 pixels these are 13 000 blocks, 6.7 million voxels of a box of 43 million. Which blocks there are, a mask of
the whole box says, one in 512 of its voxels, so that no hash of blocks is needed; marching cubes fill some layers of blocks at a
time. Photographs of more pixels have more voxels, up to as many as a mesh of 60 000 triangles can show.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from skimage import measure

from ...core.bounding_box import BoundingBox
from ...core.camera import Camera, opaque, pixel_rays, pixels_of
from ...targets.meshes import Mesh, weld

BLOCK = 8  # voxels along a block's edge
TRUNCATION = 5.0  # τ, voxels
_MOST_BLOCKS, _MOST_VOXELS = 2**25, 2**23  # in the whole box; in those that are there: more than its mesh can show
_COARSER = 1.25  # voxels grow by that until both hold
_SLAB = 8  # blocks whose surface is extracted at a time


@dataclass(frozen=True)
class Volume:
    """A signed distance in blocks of voxels.

    origin  [3] world-space position of voxel (0, 0, 0)
    voxel   distance between voxels, world units
    pixel   median size of a pixel on the surface, world units
    shape   [3] blocks of the whole box
    blocks  [B, 3] which of these are there
    distance, weight  [B, 8, 8, 8] float32: the mean of s of (16), 1 where nothing is known; the sum of w
    """

    origin: np.ndarray
    voxel: float
    pixel: float
    shape: np.ndarray
    blocks: np.ndarray
    distance: np.ndarray
    weight: np.ndarray


def fuse(
    cameras: Sequence[Camera], depths: "Sequence[mi.Float]", box: BoundingBox | None = None, voxel: float | None = None
) -> Volume | None:
    """Return the `Volume` of what ``cameras`` see at ``depths`` (of width W · H each, row-major, camera-space z; 0 where they
    see nothing), within the ``box`` (None: all of it). None where no camera sees anything.

    ``voxel``: world units (None: the median size of a pixel on the surface). Where there is more surface than `_MOST_VOXELS`
    show voxels are larger.
    """
    with dr.suspend_grad():
        lower, upper, pixel = _extent(cameras, depths, box)
        if not np.isfinite(pixel):
            return None
        voxel = voxel or pixel
        while True:
            origin = lower - 2 * TRUNCATION * voxel
            shape = np.ceil((upper - lower + 4 * TRUNCATION * voxel) / (BLOCK * voxel)).astype(int)
            if shape.prod() <= _MOST_BLOCKS:
                blocks = _seen_blocks(cameras, depths, box, origin, voxel, shape)
                if len(blocks) * BLOCK**3 <= _MOST_VOXELS:
                    break
            voxel *= _COARSER
        return Volume(origin, voxel, pixel, shape, blocks, *_integrated(cameras, depths, origin, voxel, blocks))


def _extent(cameras, depths, box):
    """(lower corner [3], upper corner [3], median size of a pixel) of all that is seen."""
    lower, upper, sizes = np.full(3, np.inf), np.full(3, -np.inf), []
    for camera, point, z in _seen(cameras, depths, box):
        lower = np.minimum(lower, dr.ravel(dr.min(point, axis=1)).numpy())
        upper = np.maximum(upper, dr.ravel(dr.max(point, axis=1)).numpy())
        sizes.append(np.median(z.numpy()) / max(camera.focal))
    return lower, upper, float(np.median(sizes)) if sizes else np.nan


def _seen(cameras, depths, box):
    """(camera, positions, depths) of the pixels of each camera that see something in the ``box``, where any do."""
    for camera, depth in zip(cameras, depths):
        index = dr.compress(depth > 0)
        if dr.width(index) and box is not None:
            index = dr.gather(mi.UInt32, index, dr.compress(box.contains(_points(camera, depth, index)[0])))
        if dr.width(index):
            yield camera, *_points(camera, depth, index)


def _points(camera, depth, index):
    """(positions, depths) of the pixels ``index``."""
    z = dr.gather(mi.Float, depth, index)
    point = opaque(camera).origin + z * pixel_rays(camera, index)
    dr.eval(point, z)
    return point, z


def _seen_blocks(cameras, depths, box, origin, voxel, shape):
    """[B, 3] the blocks that rays cross within τ of what they see."""
    seen = dr.zeros(mi.UInt32, int(shape.prod()))
    lower, size = mi.Point3f(*map(_opaque, origin)), _opaque(BLOCK * voxel)
    count = [dr.opaque(mi.UInt32, int(n)) for n in shape]
    for camera, point, _ in _seen(cameras, depths, box):
        away = dr.normalize(point - opaque(camera).origin)
        for step in np.linspace(-TRUNCATION, TRUNCATION, 5):
            at = mi.Vector3i(dr.floor((point + _opaque(step * voxel) * away - lower) / size))
            cell = (mi.UInt32(at.x) * count[1] + mi.UInt32(at.y)) * count[2] + mi.UInt32(at.z)
            dr.scatter(seen, mi.UInt32(1), cell)
    return np.argwhere(seen.numpy().reshape(shape))


def _integrated(cameras, depths, origin, voxel, blocks):
    """(distance, weight) of `Volume`: (16)."""
    corner = mi.Vector3u(np.ascontiguousarray(blocks.T, np.uint32))
    lane = dr.arange(mi.UInt32, len(blocks) * BLOCK**3)
    within = mi.Vector3u(lane // BLOCK**2 % BLOCK, lane // BLOCK % BLOCK, lane % BLOCK)
    index = dr.gather(mi.Vector3u, corner, lane // BLOCK**3) * BLOCK + within
    point = mi.Point3f(*map(_opaque, origin)) + _opaque(voxel) * mi.Point3f(index)
    total, weight = dr.zeros(mi.Float, dr.width(lane)), dr.zeros(mi.Float, dr.width(lane))
    for camera, depth in zip(cameras, depths):
        signed, told = _signed(camera, depth, point, _opaque(TRUNCATION * voxel))
        total += told * signed
        weight += told
        dr.eval(total, weight)
    mean = dr.select(weight > 0, total / dr.select(weight > 0, weight, 1), 1)
    return (values.numpy().reshape(-1, BLOCK, BLOCK, BLOCK) for values in (mean, weight))


def _signed(camera, depth, point, truncation):
    """s and w of (16) for each ``point``."""
    x, y, z = pixels_of(camera, point)
    column, row = mi.Int32(dr.floor(x)), mi.Int32(dr.floor(y))
    inside = (z > 0) & (column >= 0) & (column < camera.size[0]) & (row >= 0) & (row < camera.size[1])
    d = dr.gather(mi.Float, depth, mi.UInt32(row * camera.size[0] + column), inside)
    signed = dr.select(d > 0, dr.clip((d - z) / truncation, -1, 1), 1)
    return signed, dr.select(inside, dr.minimum(1 + signed, 1), 0)


def _opaque(value):
    return dr.opaque(mi.Float, float(value))


# ---- From the volume to its surface ----


def surface(volume: Volume) -> Mesh:
    """Return the zero of a ``volume`` as a triangle mesh in world space, faces counter-clockwise seen from outside, by marching
    cubes (Lorensen and Cline 1987), some layers of blocks at a time; empty where there is none."""
    points, faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), int)], 0
    for first in range(0, volume.shape[0], _SLAB):
        vertices, triangles = _extracted(volume, first)
        points.append(vertices)
        faces.append(triangles + count)
        count += len(vertices)
    points, faces = np.concatenate(points), np.concatenate(faces)
    return weld(volume.origin + volume.voxel * points, faces)  # layers meet in equal points


def _extracted(volume, first):
    """(vertices [V, 3] in voxels, faces [F, 3]) between the layers of blocks ``first`` and ``first`` + `_SLAB`."""
    part = (volume.blocks[:, 0] >= first) & (volume.blocks[:, 0] <= first + _SLAB)
    x, y, z = (volume.blocks[part] - [first, 0, 0]).T
    distance, known = (np.zeros((_SLAB + 1, BLOCK, volume.shape[1], BLOCK, volume.shape[2], BLOCK), t) for t in "fb")
    distance += 1
    distance[x, :, y, :, z, :], known[x, :, y, :, z, :] = volume.distance[part], volume.weight[part] > 0
    layers = _SLAB * BLOCK + 1  # the first layer of the next blocks as well
    distance, known = (v.reshape((_SLAB + 1) * BLOCK, *(BLOCK * volume.shape[1:]))[:layers] for v in (distance, known))
    known[1:, 1:, 1:] = _corners(known)  # scikit-image asks the far corner of a cube whether it counts
    if not (known[1:, 1:, 1:] & (distance[1:, 1:, 1:] < 0)).any():
        return np.zeros((0, 3)), np.zeros((0, 3), int)
    points, faces, _, _ = measure.marching_cubes(distance, 0.0, gradient_direction="descent", mask=known)
    return points + [first * BLOCK, 0, 0], faces


def _corners(known):
    """Whether all eight corners of each cube between voxels are ``known``."""
    for axis in range(3):
        known = np.logical_and(*(np.take(known, range(k, known.shape[axis] - 1 + k), axis) for k in (0, 1)))
    return known

"""Surfels as a textured mesh, from depth maps to textures."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ...core.bounding_box import BoundingBox
from ...core.camera import Camera
from ...core.errors import UserError
from ...core.progress import Progress
from ...surfels.surfels import SurfelColumns
from . import tsdf
from .depth_maps import depth_map
from .lookup import look_up
from .outlines import aligned
from .surface import UVMesh, largest_parts, simplified, smoothed, unwrapped
from .textures import Texels, Textures, textures

_FACES, _MOST_FACES = 1 / 16, 60_000  # of the mesh, over those of the surface voxel by voxel; of any
_TEXEL = 0.7  # pixels
_TOLERANCE = 2.0  # voxels between a camera's depth map and what it sees


@dataclass(frozen=True)
class TexturedMesh:
    """A mesh and its textures, which are known at its ``texels``; ``radiance`` [H, W, 3] is the texture of the surfels' own."""

    mesh: UVMesh
    texels: Texels
    textures: Textures
    radiance: np.ndarray


def build(
    surfels: SurfelColumns,
    cameras: Sequence[Camera],
    path: str | Path,
    *,
    lit: bool,
    eta: float,
    box: BoundingBox | None = None,
    quiet: bool = False,
) -> TexturedMesh:
    """Return the ``surfels`` of the scene file ``path`` as a mesh, made of what ``cameras`` see of them in the ``box`` (None:
    anywhere). ``lit`` and ``eta`` are those of `textures`.

    Raises: UserError where cameras see nothing, or a package is missing.
    """
    with Progress(None, quiet, "meshing") as progress:
        depths, coverages = [], []
        for k, camera in enumerate(cameras):
            depth, coverage = depth_map(surfels, camera)
            depths.append(depth)
            coverages.append(coverage.numpy().reshape(camera.size[::-1]))
            progress.update(0.2 * (k + 1) / len(cameras))
        volume = tsdf.fuse(cameras, depths, box)
        progress.update(0.3)
        dense = None if volume is None else tsdf.surface(volume)
        if volume is None or dense is None or not len(dense.faces):
            raise UserError(f"{path}: its cameras see no surface of its surfels: there is nothing to export")
        dense = largest_parts(dense)
        tolerance = _TOLERANCE * volume.voxel
        look = lambda points, normals, first, last: look_up(
            surfels, cameras, depths, points, normals, tolerance, lambda f: progress.update(first + (last - first) * f)
        )
        dense = smoothed(dense, _normals(dense, look, 0.4, 0.6))
        mesh = simplified(dense, min(_MOST_FACES, int(_FACES * len(dense.faces))))
        progress.update(0.62)
        mesh = aligned(mesh, cameras, coverages)
        progress.update(0.65)
        mesh = replace(mesh, normals=_normals(mesh, look, 0.65, 0.7))
        uv = unwrapped(mesh, _TEXEL * volume.pixel)
        progress.update(0.8)
        texels = Texels.of(uv)
        seen = look(texels.points, texels.normals, 0.8, 1.0)
    near = texels.nearest(seen.known)
    return TexturedMesh(uv, texels, textures(texels, seen, near, lit, eta), texels.image(seen.radiance, near))


def _normals(mesh, look, first, last):
    """[V, 3] normals of the surfels at the vertices of a ``mesh``; its own where no camera sees them."""
    seen = look(mesh.vertices, mesh.normals, first, last)
    return np.where(seen.known[:, None], seen.normal, mesh.normals).astype(np.float32)

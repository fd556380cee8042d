"""A finished run as files that others open. What `rgs-mi export` calls."""

import difflib
import math
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..core.camera import Camera
from ..core.errors import UserError
from ..core.files import make_folder
from ..core.scene_files import load_scene
from ..export import gltf_splat, splat_ply, usd_splat
from ..export.bake import bake
from ..export.mesh.surface import PACKAGES, packages
from ..export.mitsuba_scene import SCENE
from ..report.results import finished, origin_of
from ..shading.environment import Environment
from . import export_splats
from .export_mesh import export_mesh, training_photographs

FORMATS = ("splat", "gltf-splat", "usd", "mesh")
_RIGID = 1e-4  # how far an environment's ``to_world`` may be from a rotation


def export(
    run: str | Path,
    to: str,
    *,
    out: str | Path | None = None,
    kernel: str | None = None,
    refine: float | None = None,
    data: str | Path | None = None,
    quiet: bool = False,
) -> list[Path]:
    """Write the finished fit in the folder ``run`` in the format ``to``, one of `FORMATS`, into the folder ``out`` (None:
    ``export/FORMAT`` in ``run``), and return the paths of its files. ``kernel`` is that of `usd_splat.write` (None: its default).
    With ``refine`` (minutes; None: not at all) a mesh's textures are fitted that long to the training photographs
    (`export_mesh`), and splats to renderings from between their cameras (`export_splats`); they are in the folder ``data``
    (None: where metrics.json says).

    Raises: UserError for an unknown format, a folder that holds no finished run, a run without surfels, and where a package
    is missing or a file can't be written.
    """
    if to not in FORMATS:
        raise UserError(f"--to {to}: unknown format{_nearest(to)}: choose one of {', '.join(FORMATS)}")
    if kernel is not None and to != "usd":
        raise UserError(f"--kernel {kernel}: only the format 'usd' has kernels: leave it out, or say --to usd")
    if kernel is not None and kernel not in usd_splat.KERNELS:
        raise UserError(f"--kernel {kernel}: unknown kernel: choose one of {', '.join(usd_splat.KERNELS)}")
    if to != "mesh" and data is not None and refine is None:
        raise UserError(
            "--data: splats are made of a run alone, unless they are refined: leave it out, or add --refine MINUTES"
        )
    if refine is not None and not 0 < refine < math.inf:
        raise UserError(f"--refine {refine:g}: needs a number of minutes above 0")
    if to == "usd":
        usd_splat.check()
    if to == "mesh":
        packages(*PACKAGES)
    run = Path(run)
    path = _scene_of(run)
    folder = run / "export" / to if out is None else Path(out)
    make_folder(folder)
    scene = load_scene(path, {})
    origin, y_up = origin_of(run), to_y_up(scene, path)
    if to == "mesh":
        return export_mesh(run, path, scene, y_up, origin, folder, refine, data, quiet)
    splats = replace(bake(scene, path, quiet), origin=origin)
    if refine:
        seen = [p.camera for p in training_photographs(run, data)] or [Camera.from_sensor(s) for s in scene.sensors()]
        if not seen:
            raise UserError(f"{path}: has no sensors, and its photographs are gone: nothing says where to look from")
        splats = export_splats.refine(splats, scene, path, seen, refine, quiet)
    if to == "splat":
        return splat_ply.write(folder, splats)
    splats = splats.rotated(y_up)
    if to == "gltf-splat":
        return gltf_splat.write(folder, splats)
    return usd_splat.write(folder, splats, _texels(scene), kernel or usd_splat.KERNELS[0])


def to_y_up(scene: "mi.Scene", path: str | Path) -> np.ndarray:
    """Return the rotation [3, 3] from the world of the ``scene`` that was loaded from ``path`` to one whose y axis points up:
    the frame of its environment map, or z to y where there is none. Raises: UserError for a map that is scaled or mirrored."""
    emitter = scene.environment()
    if emitter is None or emitter.class_name() != "EnvironmentMapEmitter":
        return np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    rotation = Environment.from_emitter(emitter).rotation
    if abs(rotation @ rotation.T - np.eye(3)).max() > _RIGID or np.linalg.det(rotation) < 0:
        raise UserError(f"{path}: 'to_world' of its envmap is no rotation: use rotations alone")
    return rotation.T


def _texels(scene):
    """[rows, columns, 3] of the environment; None where there is none."""
    return None if scene.environment() is None else Environment.from_emitter(scene.environment()).texels.numpy()


def _scene_of(run):
    """The scene file of a finished run. Raises: UserError where there is none."""
    if not run.is_dir():
        raise UserError(f"no run at {run}: give the folder that 'rgs-mi optimize' wrote")
    if finished(run) and (run / SCENE).is_file():
        return run / SCENE
    if (run / "checkpoints").is_dir():
        raise UserError(f"{run}: holds an unfinished run: go on with 'rgs-mi optimize … --resume'")
    raise UserError(f"{run}: holds no run: give the folder that 'rgs-mi optimize' wrote")


def _nearest(name):
    """Which format may have been meant, in words."""
    near = difflib.get_close_matches(name, FORMATS, 1, 0.3)
    return f", nearest to '{near[0]}'" if near else ""

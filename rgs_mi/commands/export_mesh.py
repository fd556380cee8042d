"""A finished run as a textured mesh: a GLB, and a scene of stock Mitsuba. What `rgs-mi export --to mesh` calls."""

import sys
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..core.camera import Camera
from ..core.errors import UserError
from ..datasets import load_dataset
from ..export.mesh import gltf, stock_scene
from ..export.mesh.build import build
from ..export.mesh.fit import fitted
from ..export.mesh.photographs import Photograph
from ..export.mesh.refine import refine
from ..export.relight import light_diffuse
from ..plugins import lit_surfels, surfels_of
from ..report import cameras, results
from ..shading.environment import Environment


def export_mesh(
    run: Path,
    path: Path,
    scene: "mi.Scene",
    rotation: np.ndarray,
    origin: tuple[float, float, float],
    folder: Path,
    minutes: float | None = None,
    data: str | Path | None = None,
    quiet: bool = False,
) -> list[Path]:
    """Write the surfels of the ``scene``, which is that of the file ``path`` in the folder ``run``, as a mesh into ``folder``:
    as a GLB, turned by ``rotation`` [3, 3] and put where the capture has the world's ``origin`` [3], and as a scene of stock
    Mitsuba in the run's own world; return the paths of all files.

    The mesh is what the run's training cameras see, and where it is lit, base color and metallic are fitted to the photographs;
    where these are gone, it is what the scene's sensors see. With ``minutes`` textures and environment are refined that long
    against the training photographs, in the folder ``data`` (None: where metrics.json says that they were).

    Raises: UserError for a run without surfels or, with ``minutes``, without photographs or environment, and where a package is
    missing or a file can't be written.
    """
    light_diffuse(scene)
    surfels, lighting = lit_surfels(scene, path)
    if not len(surfels):
        raise UserError(f"{path}: its shape of surfels is empty: there is nothing to export")
    emitter = scene.environment()
    mapped = emitter is not None and emitter.class_name() == "EnvironmentMapEmitter"
    if minutes and (not mapped or lighting is None or lighting.turntable is not None):
        raise UserError(f"{path}: has no environment map that stands still, which --refine needs: leave it out")
    _tell_what_is_lost(path, scene, lighting)
    photographs = training_photographs(run, data, needed=bool(minutes))
    seen = [p.camera for p in photographs] or [Camera.from_sensor(sensor) for sensor in scene.sensors()]
    lit = lighting is not None and lighting.lit
    eta = surfels_of(scene, path).eta
    splatted = surfels if lighting is None else lighting.as_splatted(surfels)
    result = build(splatted, seen, path, lit=lit, eta=eta, box=lighting and lighting.box, quiet=quiet)
    if lighting is not None and lit and photographs:
        own = fitted(result.textures, result.mesh, result.texels, result.radiance, photographs, lighting, quiet)
        result = replace(result, textures=own)
    environment = Environment.from_emitter(emitter).texels.numpy() if mapped else None
    write = lambda: stock_scene.write(folder, result.mesh, result.texels, result.textures, eta, environment, path)
    paths = write()
    if minutes:
        names = ("base_color", "roughness", *(("metallic",) if lit else ("radiance",)))  # unlit ones are metals throughout
        scene_file = folder / stock_scene.SCENE
        found = refine(scene_file, result.mesh, result.texels, photographs, names, 60 * minutes, quiet)
        environment = found.pop("environment")
        result = replace(result, textures=replace(result.textures, **found))
        write()
    return [*gltf.write(folder, result.mesh, result.texels, result.textures, rotation, (rotation @ origin).tolist()), *paths]


def _tell_what_is_lost(path, scene, lighting):
    """A line on stderr for what a mesh does not have."""
    lost = {
        "the light goes round with the camera, which no other program does: it is that of azimuth 0": "turntable",
        "the light is painted on a room, which no other program knows: it is at infinity": "room",
        "what its shader makes of reflections is left out": "shader",
    }
    for words, name in lost.items():
        if lighting is not None and getattr(scene.integrator(), name):
            print(f"{path}: {words}", file=sys.stderr)


def training_photographs(run: Path, data: str | Path | None, needed: bool = False) -> list[Photograph]:
    """Return the training photographs of a ``run``, in the folder ``data`` (None: where metrics.json says), with their cameras,
    as learned where they were; none where they are gone and not ``needed``. Raises: UserError where they are needed, or
    were asked for."""
    try:
        folder, longest = results.photographs_of(run)
        folder = data or folder
        if folder is None:
            raise UserError(f"{run / results.METRICS} does not say where the photographs are: give their folder with --data")
        views = load_dataset(folder, longest).train
    except UserError:
        if needed or data is not None:
            raise
        print(f"{run}: its photographs are gone: what is exported is what the scene's sensors see", file=sys.stderr)
        return []
    learned = cameras.read_training(run, views)
    if learned is None:
        return [Photograph(view.camera, view.pixels) for view in views]
    return [Photograph(learned[view.name].camera, view.pixels, learned[view.name].gain) for view in views]

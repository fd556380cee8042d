"""A run evaluated again on the photographs that it held out: when LPIPS's weights were installed later, or on another
machine. What `rgs-mi evaluate` calls.

What is evaluated is the scene that the run exported, not a checkpoint of the fit: it is what people use and pass on, says by
itself how it is shaded, and is there when checkpoints are deleted. Both give the same figures, to rounding.
"""

import json
from pathlib import Path

import numpy as np

from ..core.camera import Camera
from ..core.errors import UserError
from ..core.inputs import JSON, read_file
from ..core.ownership import owned
from ..core.scene_files import film_of, load_scene
from ..datasets import load_dataset
from ..evaluation import lpips
from ..evaluation.evaluate import SCORES
from ..export.mitsuba_scene import SCENE, ids_of, sensor_ids
from ..fit.curves import Curves
from ..plugins import lit_surfels
from ..report import cameras, results
from ..shading.environment import Environment

_FACTS = {
    "finished": bool,
    "train_seconds": (int, float),
    "iterations": int,
    "surfels": int,
    "parameters": int,
    "peak_rss_mb": (int, float, type(None)),
    "train_views": int,
    "test_views": int,
    "settings": dict,
    "versions": dict,
    "machine": dict,
    "command": str,
    "views": dict,
}  # what metrics.json must say of the fit


def reevaluate(run: str | Path, data: str | Path | None = None, quiet: bool = False) -> dict:
    """Measure the run in the folder ``run`` again, and write its metrics.json, pictures of test views, contact sheet and
    report anew. What metrics.json says of the fit stays, and LPIPS where its weights are not installed here; ``evaluated``
    says where and by what this was measured. Where the fit learned cameras or exposures, the test views keep those that were
    found for them.

    Args:
      data: the folder of its photographs (None: where metrics.json says that they were)

    Returns: what metrics.json holds now.
    Raises: UserError for a folder that holds no run, for photographs of something else, and where a file can't be written.
    """
    run = Path(run)
    saved, curves, path = _saved(run / results.METRICS), Curves.read(run), run / SCENE
    scene = load_scene(path, {})
    surfels, lighting = lit_surfels(scene, path)
    background, longest = _setting(saved, "background", (0, 1), run), _setting(saved, "resolution", (1, 1 << 16), run)
    folder = data or saved.get("photographs")
    dataset, registration = _photographs(folder, scene, run, int(longest), quiet)
    with owned(run):
        mean, scores, rows, _ = results.measure(
            surfels, lighting, dataset, background, film_of(scene), run, quiet, registration
        )
        if not lpips.installed():
            _keep_lpips(saved, mean, scores)
        now = {"photographs": str(dataset.root.resolve()), "evaluated": results.circumstances()}
        figures = {k: v for k, v in saved.items() if k != "views"} | mean | now | {"views": scores}
        results.publish(run, figures, curves, rows, Environment.from_emitter(scene.environment()))
    return figures


def _saved(path) -> dict:
    """What metrics.json holds. Raises: UserError where it is missing, damaged, or of something else."""
    try:
        saved = json.loads(read_file(path, JSON))
        wrong = [name for name, kind in _FACTS.items() if not isinstance(saved[name], kind)]
        wrong += [name for name, scores in saved["views"].items() if not isinstance(scores, dict)]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise UserError(f"{path}: missing, damaged, or not of a run ({error}): give the folder that a fit wrote") from error
    if wrong:
        raise UserError(f"{path}: '{wrong[0]}' is not what a fit writes there: give the folder that a fit wrote")
    return saved


def _keep_lpips(saved, mean, scores):
    """Put what was ``saved`` of LPIPS into the figures that were measured."""
    names = [name for name in SCORES if "lpips" in name]
    if saved.get("lpips") is not None:
        mean |= {name: saved.get(name) for name in (*names, "lpips_reason")}
        for view, figures in scores.items():
            figures |= {name: saved["views"].get(view, {}).get(name) for name in names}


def _setting(saved, name, limits, run) -> float:
    """The number ``name`` of the settings that were ``saved``."""
    try:
        value = float(saved["settings"][name])
    except (KeyError, TypeError, ValueError):
        value = np.nan
    if not limits[0] <= value <= limits[1]:
        raise UserError(
            f"{run / results.METRICS}: its settings have no {name} from {limits[0]} to {limits[1]}: it is damaged"
        )
    return value


def _photographs(folder, scene, run, longest, quiet):
    """The `Dataset`, and how its views find their place. Raises: UserError where they are not those of the scene's sensors."""
    if not isinstance(folder, str | Path):
        raise UserError(f"{run / results.METRICS} does not say where the photographs are: give their folder with --data")
    dataset = load_dataset(folder, longest, quiet)
    views, sensors = results.evaluation_views(dataset), scene.sensors()
    same = sensor_ids([view.name for view in views], ids_of(run / SCENE)) == [sensor.id() for sensor in sensors]
    registration = cameras.read(run, views) if same else None
    given = [view.camera for view in views]
    if registration is not None:  # then sensors stand where these views were found to be, not where they were given
        same = all(_sees_the_same(registration.cameras[view.name], view.camera) for view in views)
        given = [registration.found[view.name].camera for view in views]
    if not same or not all(_sees_the_same(Camera.from_sensor(s), camera) for s, camera in zip(sensors, given)):
        raise UserError(f"{folder}: its test views are not those of {run}: give the folder of its photographs with --data")
    return dataset, registration


def _sees_the_same(camera, own):
    """Whether a ``camera`` stands where another of its own does, and has its size."""
    scale = max(1.0, np.linalg.norm(own.origin))
    return tuple(camera.size) == tuple(own.size) and np.allclose(camera.to_world, own.to_world, atol=1e-4 * scale)

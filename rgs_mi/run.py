"""A fit from beginning to end: photographs and scene in, a run's folder out. What `scripts/optimize.py` calls."""

import shutil
import sys
import time
import warnings
from pathlib import Path

import numpy as np

from . import checkpoint, results
from .config import completed, to_dict
from .errors import UserError
from .fit import Fit
from .initial import initial_points
from .interrupt import GracefulInterrupt
from .model import Model
from .priors import depth_priors
from .progress import Progress
from .scene import FitScene
from .settings import Settings

_PRIORS = Path("data") / "priors"  # what is known of depths is kept here, below the current folder
_SMOOTHING = 0.95  # of the PSNR that the progress line shows


def optimize(path, *, data=None, variables=None, config=None, overrides=(), minutes=None, seed=None, out=None,
             resume=False, quiet=False) -> Path:
    """Fit the scene at ``path`` and write the run's folder, which is returned.

    Args:
      data, variables: see `FitScene.load`
      config, overrides, minutes, seed: the settings, each over the former (see `FitScene.settings`)
      out:     the run's folder (default: runs/NAME)
      resume:  go on from the newest checkpoint in ``out``

    Raises: UserError for bad input, a folder that can't be written, and a fit that diverges.
    """
    scene = FitScene.load(path, data, variables)
    overrides = [*overrides, *([f"minutes={minutes}", "iterations=null"] if minutes is not None else []),
                 *([f"seed={seed}"] if seed is not None else [])]
    settings = scene.settings(config, overrides)
    folder = Path(out) if out else Path("runs") / scene.name
    saved = _saved(folder, resume)
    dataset = scene.dataset(quiet)
    fit = _resume(saved, scene, dataset, settings) if saved else start(scene, dataset, settings)
    stopped = _loop(fit, folder, quiet)
    results.write(fit, scene, folder, quiet)
    if stopped:
        print(f"stopped at {100 * fit.progress:.0f}%; go on with the same command and --resume")
    return folder


# ---- Start ----

def _saved(folder, resume):
    """The checkpoint to go on from, or None. Raises: UserError where a fresh start would lose an unfinished run."""
    if resume:
        saved = checkpoint.load_latest(folder)
        if saved is None:
            print(f"{folder} holds no checkpoint: starting from the beginning", file=sys.stderr)
        return saved
    if any((folder / "checkpoints").glob("step_*.npz")):
        if not results.finished(folder):
            raise UserError(f"{folder} holds an unfinished run: go on with --resume, or choose another --out")
        shutil.rmtree(folder / "checkpoints")
    return None


def start(scene, dataset, settings) -> Fit:
    """A fit at its beginning."""
    positions, normals, colors, spacing = initial_points(dataset, settings.start.surfels, settings.seed,
                                                         settings.start.hull)
    extent = float(np.linalg.norm(positions - positions.mean(0), axis=1).max())
    light = scene.environment
    model = Model.start(positions, normals, colors, spacing, light.texels.numpy(), light.rotation, settings.sh_order,
                        settings.seed, settings.start.scale, settings.start.roughness, settings.shader)
    return Fit(dataset, model, settings, extent, scene.shading, _priors(dataset, settings))


def _priors(dataset, settings):
    """The depth prior of each training view, or None."""
    if settings.weights.depth == 0:
        return None
    return depth_priors(settings.prior.name, dataset.train, cache=_PRIORS, **settings.prior.options)


def _resume(saved, scene, dataset, settings) -> Fit:
    """The fit of a checkpoint, under ``settings``; tells which differ from those that it was saved with."""
    arrays, meta = saved
    if meta["photographs"] != _photographs(dataset):
        raise UserError(f"{dataset.root}: not the photographs of the checkpoint: give its --data, or another --out")
    old, new = _flat(completed(Settings, meta["settings"])), _flat(to_dict(settings))
    changed = [key for key in new if old.get(key) != new[key]]
    if fixed := [key for key in ("sh_order", "shader") if key in changed]:
        raise UserError(f"{fixed[0]} is {old[fixed[0]]} in the checkpoint and can't change: choose another --out")
    if changed:
        listing = ", ".join(f"{key} {old.get(key)} -> {new[key]}" for key in changed)
        print(f"settings differ from the checkpoint's, the new ones hold: {listing}", file=sys.stderr)
    return Fit.resume(dataset, settings, arrays, meta, shading=scene.shading, priors=_priors(dataset, settings))


def _photographs(dataset) -> list:
    """What tells one data set from another: names and sizes of its training views."""
    return [[view.name, *map(int, view.camera.size)] for view in dataset.train]


def _flat(tree, prefix="") -> dict:
    """{"a": {"b": 1}} as {"a.b": 1}."""
    flat = {}
    for key, value in tree.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return flat


# ---- Loop ----

def _loop(fit, folder, quiet) -> bool:
    """Step until the budget is spent or someone interrupts; returns whether someone did. Begins and ends with a
    checkpoint: a folder that can't be written is known before the work, not after it."""
    settings, psnr = fit.settings, None
    checkpoint.save(folder, *_state(fit, folder))
    (folder / results.METRICS).unlink(missing_ok=True)  # from here on the run is unfinished
    saved = time.monotonic()
    planned = None if settings.iterations else max(0.0, 60 * settings.minutes - fit.elapsed)
    with GracefulInterrupt() as interrupt, Progress(planned, quiet) as progress:
        while fit.progress < 1 and not interrupt.requested:
            before = fit.elapsed
            fit.step()
            if not np.isfinite(fit.psnr):
                raise _diverged(fit, folder)
            psnr = fit.psnr if psnr is None else _SMOOTHING * psnr + (1 - _SMOOTHING) * fit.psnr
            progress.update(fit.progress, psnr=psnr, surfels=len(fit.model), ms=1e3 * (fit.elapsed - before),
                            pixels=fit.dataset.train[0].camera.size[0] // fit.stage.downscale)
            if time.monotonic() - saved > settings.checkpoint_seconds:
                state = _state(fit, folder)
                try:
                    checkpoint.save(folder, *state)
                except UserError as error:
                    warnings.warn(f"no checkpoint this time, the fit goes on: {error}", stacklevel=2)
                saved = time.monotonic()
        checkpoint.save(folder, *_state(fit, folder))
    return interrupt.requested


def _state(fit, folder):
    """What a checkpoint holds. Raises: UserError for numbers that are not finite, which must not replace good ones."""
    arrays, meta = fit.state()
    if not all(np.isfinite(a).all() for a in arrays.values()):
        raise _diverged(fit, folder)
    return arrays, meta | {"settings": to_dict(fit.settings), "photographs": _photographs(fit.dataset)}


def _diverged(fit, folder):
    return UserError(f"the fit diverged at step {fit.step_number} (not a finite number): {folder / 'checkpoints'} has "
                     "the last good state: go on with --resume and lower rates, e.g. --set rates.centers=[1e-4,1e-5]")

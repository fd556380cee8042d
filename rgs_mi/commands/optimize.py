"""A fit from beginning to end: photographs and scene in, a run's folder out. What `rgs-mi optimize` calls."""

import os
import signal
import sys
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np

from .. import report
from ..core.bounding_box import BoundingBox
from ..core.camera import Camera
from ..core.errors import Stopped, UserError
from ..core.interrupt import GracefulInterrupt
from ..core.ownership import Owned, owned
from ..core.progress import Progress
from ..core.runtime import cache_folder
from ..datasets.rims import without_rim
from ..datasets.types import Dataset
from ..export.mitsuba_scene import SCENE
from ..fit import checkpoint, events, foreground, light, walls
from ..fit.model import Model
from ..fit.plan import planned, told
from ..fit.ranks import Ranks
from ..fit.scene import FitScene
from ..fit.trainer import Fit
from ..priors import depth_priors
from ..priors.initialization import Points, initial_points, surroundings
from ..priors.silhouettes import agreement
from ..report import results
from ..settings.config import to_dict
from ..settings.settings import Settings
from ..shading.tables import specular_of
from ..viewer import server
from ..viewer.live import Watch
from .fit_line import FitLine

_ON_SURFACE, _ANYWHERE = 0.7, 0.1  # opacities to start with; where surfels fill space, more would hide what is within
_HIDING = 0.97  # on the hull of an object without masks, through which surroundings would be seen


def optimize(
    path: str | Path,
    *,
    data: str | Path | None = None,
    variables: Mapping[str, str] | None = None,
    config: str | Path | None = None,
    overrides: Sequence[str] = (),
    minutes: float | None = None,
    seed: int | None = None,
    out: str | Path | None = None,
    resume: bool = False,
    quiet: bool = False,
    tensorboard: bool = False,
    window: tuple[str, int] | None = None,
    ranks: Ranks = Ranks(),
) -> Path:
    """Fit the scene at ``path`` and write the run's folder, which is returned.

    Args:
      data, variables: see `FitScene.load`
      config, overrides, minutes, seed: the settings, each over the former (see `FitScene.settings`)
      out:     the run's folder (default: runs/NAME), which no other process can have at the same time. A run that is there is
               moved aside, to NAME.1 and so on, when the fit begins; an unfinished one is refused
      resume:  go on from the newest checkpoint in ``out``
      tensorboard: write event files into the folder's ``tensorboard``
      window:  host and port of a page that shows the fit while it goes on (`viewer.live`)
      ranks:   the processes that make the fit together, of which this is the first; the others call `join`

    Raises: UserError for bad input, a package that is missing, a folder that can't be written, and a fit that diverges;
    Stopped where someone has stopped it, by a signal or in the window, after everything is saved, and evaluated as well after
    Ctrl-C, but not after SIGTERM.
    """
    if window:
        server.check(*window)
    if tensorboard:
        events.check()
    scene = FitScene.load(path, data, variables)
    overrides = [*overrides, *budget(minutes), *([f"seed={seed}"] if seed is not None else [])]
    settings = scene.settings(config, overrides)
    folder = Path(out) if out else Path("runs") / scene.name
    if os.path.realpath(folder / SCENE) == os.path.realpath(scene.path):
        raise UserError(f"{folder} holds the scene that is fitted, which its results would replace: choose another --out")
    with owned(folder) as mine:
        saved = _saved(folder, resume)
        dataset = scene.dataset(settings.resolution, quiet)
        fit = _resume(saved, scene, dataset, settings, folder) if saved else start(scene, dataset, settings, quiet)
        if not saved:
            _make_room(mine, scene)
        if not quiet:
            print(told(fit.settings, dataset))
        log = events.Events(folder / "tensorboard", fit.step_number) if tensorboard else None
        watch = _watched(fit, folder, window)
        try:
            fit.ranks = ranks
            with ranks.sharing_cores():
                stopped = _loop(fit, folder, quiet, log, watch)
        finally:
            for opened in filter(None, (log, watch)):
                opened.close()
        if stopped in (None, signal.SIGINT):  # what sends other signals does not wait for results
            results.write(fit, scene, folder, quiet)
    if stopped:
        raise Stopped(stopped, f"stopped at {100 * fit.progress:.0f}%; go on with the same command and --resume")
    return folder


def join(ranks: Ranks, path: str | Path, data: str | Path | None = None, variables: Mapping[str, str] | None = None) -> None:
    """Make the steps of the fit that the first of ``ranks`` has begun with the same scene, until that ends it.

    Raises: UserError for photographs that are not the same here, and where another process has ended too soon.
    """
    settings, arrays, meta = cast(tuple[Settings, dict, dict], ranks.same(None))
    scene = FitScene.load(path, data, variables)
    dataset = scene.dataset(settings.resolution, quiet=True)
    if meta["digests"]["photographs"] != dataset.digest:
        raise UserError(f"{dataset.root}: not the photographs of the first process: give all of them the same --data")
    shading, priors = _shading(scene, settings, dataset), _priors(dataset, settings)
    fit = Fit.resume(dataset, settings, arrays, meta, shading=shading, priors=priors, ranks=ranks)
    with ranks.sharing_cores(), GracefulInterrupt(patient=True):  # a signal to all of them is the first one's to hear
        while ranks.same(None):
            fit.step()


def _watched(fit, folder, window):
    """The window on the fit, where someone asked for one. Raises: UserError where it can't be opened."""
    if window is None:
        return None
    watch = Watch(fit, str(folder), *window)
    print(watch.address, flush=True)
    return watch


def budget(minutes: float | None) -> list[str]:
    """Return the overrides that plan a fit to end within ``minutes``; none for None."""
    return [f"minutes={minutes}", "iterations=null"] if minutes is not None else []


# ---- Start ----


def _saved(folder, resume):
    """The checkpoint to go on from, or None. Raises: UserError where a fresh start would lose an unfinished run."""
    if resume:
        saved = checkpoint.load_latest(folder)
        if saved is None:
            print(f"{folder} holds no checkpoint: starting from the beginning", file=sys.stderr)
        return saved
    if any((folder / "checkpoints").glob("step_*.npz")) and not results.finished(folder):
        raise UserError(f"{folder} holds an unfinished run: go on with --resume, or choose another --out")
    return None


def _make_room(mine: Owned, scene):
    """Move a run that is in the folder aside, and say so. Raises: UserError where that can't be."""
    if not any((mine.folder / name).exists() for name in (results.METRICS, report.REPORT)):
        return
    if any(Path(os.path.realpath(p)).is_relative_to(os.path.realpath(mine.folder)) for p in (scene.path, scene.photographs)):
        raise UserError(f"{mine.folder} holds a run, and what it was fitted to: choose another --out")
    print(f"{mine.folder} holds a run: it is {mine.move_aside()} now", file=sys.stderr)


def start(scene: FitScene, dataset: Dataset, settings: Settings, quiet: bool = True) -> Fit:
    """Return the fit of a ``scene`` to the photographs of ``dataset``, at its beginning."""
    settings, seen = light.decided(planned(settings, dataset), dataset)
    if seen and not quiet:
        print(seen)
    begin = settings.initialization
    assert begin.surfels, "`planned` gives them"
    trimmed = [without_rim(view, settings.mask_rim) for view in dataset.train]
    cameras = _begun_cameras(trimmed, settings, quiet)
    placed = replace(dataset, train=[replace(view, camera=cameras[view.name]) for view in trimmed])
    points = initial_points(placed, begin.surfels, settings.seed, begin.hull, begin.compare, quiet)
    random = points.normals is None and not (dataset.points is not None and len(dataset.points))
    opacity = begin.opacity or (_ANYWHERE if random else _ON_SURFACE)

    def fit_from(points: Points, shown: Dataset, settings: Settings) -> Fit:
        shading, box = _shading(scene, settings, dataset), _box(settings, dataset)
        specular = specular_of(shading.eta)  # what it can't say, η from 1.79 on, stays as the scene has it
        learns_specular = shading.specular == "split_sum" and any(settings.learning_rates.specular) and specular < 1
        middle = points.positions.mean(0) if box is None else box.center
        extent = float(np.linalg.norm(points.positions - middle, axis=1).max()) if box is None else box.radius
        center = shading.turntable.point if shading.turntable else middle  # a room turns about its center
        model = Model.start(
            points.positions,
            points.normals,
            points.appearance.diffuse,
            points.spacing,
            scene.environment.texels.numpy(),
            scene.environment.rotation,
            settings.sh_order,
            settings.seed,
            begin.scale,
            opacity,
            begin.roughness,
            points.appearance.metallic,
            settings.shader,
            two_sided=True if begin.two_sided or box is not None else None,
            center=center,
            room=None if settings.room is None else np.multiply(settings.room, extent),
            specular=specular if learns_specular else None,
        )
        fit = Fit(shown, model, settings, extent, shading, _priors(shown, settings))
        if fit.cameras:
            fit.cameras.begin([cameras[view.name] for view in shown.train])
        return fit

    box = given = _box(settings, dataset)
    if not any(view.masked for view in dataset.train):
        box = given or BoundingBox.seen_by([view.camera for view in dataset.train], None if random else points.positions)
        if begin.foreground and points.normals is not None and settings.specular_start < 1:
            begun = lambda points, settings: fit_from(
                _with_surroundings(points, dataset, settings).in_places(), placed, settings
            )
            if found := foreground.found(begun, placed, points, _in_box(settings, box, dataset), box, quiet):
                points, box, opacity = found[0], given or found[1], begin.opacity or _HIDING
        if given is None:
            settings = _in_box(settings, box, dataset)
    eyes = np.array([camera.origin for camera in cameras.values()])
    beside = partial(_walls_seen, points.positions, eyes, box, scene.environment.rotation)
    if box is not None:
        points = _with_surroundings(points, dataset, settings)
    fit_of = partial(fit_from, points.in_places())
    if settings.light == "auto":
        settings = light.tried(fit_of, dataset, settings, quiet)
    settings = light.ring_turns(fit_of, dataset, settings, quiet)
    settings = walls.near_room(fit_of, dataset, settings, quiet, None if box is None or random else beside)
    return fit_of(dataset, settings)


def _walls_seen(positions, eyes, box, rotation) -> np.ndarray:
    """Distances of the walls around what is in the ``box`` that points tell, and cameras at ``eyes``, in radii of it, in a frame
    of this ``rotation``."""
    points, eyes = ((of - box.center) @ np.linalg.inv(rotation).T for of in (positions, eyes))
    return walls.surrounding(points, box.radius, eyes) / box.radius


def _in_box(settings, box, dataset):
    """The ``settings`` with a ``box``, which they have in the world of the files."""
    return replace(settings, box=box.moved(dataset.origin).corners)


def _begun_cameras(views, settings, quiet) -> dict[str, Camera]:
    """{name: camera} of training ``views`` as a fit begins with them: as given, or where silhouettes agree."""
    cameras = {view.name: view.camera for view in views}
    if settings.cameras != "learned" or not settings.initialization.silhouettes:
        return cameras
    found = agreement(views)
    if found is None or not found.better:
        return cameras
    if not quiet:
        moved = "poses begin where silhouettes agree"
        print(f"{moved}: of two photographs, to {found.now:.2f} pixels, not {found.given:.1f} as cameras are given")
    return dict(zip(cameras, found.cameras))


def _with_surroundings(points, dataset, settings):
    """`initial_points` of the object and whatever else photographs show, and those of what lies farther away."""
    normals = points.normals
    if normals is None:
        normals = np.random.default_rng((settings.seed, 2)).normal(size=points.positions.shape)
        normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    far = surroundings(dataset, settings.initialization.surroundings, settings.seed)
    return points._replace(normals=normals.astype(np.float32)).joined_with(far)


def _shading(scene, settings, dataset):
    """How the scene is shaded: in the box around the object where there is one, on a turntable where it is on one.

    Raises: UserError for a box that is none, and for cameras that see no turntable.
    """
    return replace(scene.shading, box=_box(settings, dataset), turntable=light.turntable_of(settings, dataset))


def _box(settings, dataset):
    """The box around the object, or None. Settings have it in the world of the files, whose origin may be elsewhere. Raises:
    UserError for one that is none."""
    try:
        return settings.box and BoundingBox.of(settings.box).moved(-np.array(dataset.origin))
    except ValueError as error:
        raise UserError(f"settings: box {settings.box}: {error}") from error


def _priors(dataset, settings):
    """The depth prior of each training view, or None."""
    if settings.weights.depth == 0:
        return None
    return depth_priors(settings.prior.name, dataset.train, cache=cache_folder("priors"), **settings.prior.options)


def _resume(saved, scene, dataset, settings, folder) -> Fit:
    """The fit of a checkpoint, under ``settings``; tells which differ from those that it was saved with.

    Raises: UserError for a checkpoint of something else, and for settings that can't change.
    """
    arrays, meta = saved
    try:
        return _gone_on_with(arrays, meta, scene, dataset, settings)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise UserError(
            f"{folder / 'checkpoints'}: its newest is not one of a fit ({type(error).__name__}: {error}): start again in "
            "another --out"
        ) from error


def _gone_on_with(arrays, meta, scene, dataset, settings):
    for name in ("box", "light", "turns", "mask_rim", "room"):  # what was decided at the start
        asked, found = getattr(settings, name), meta["settings"].get(name)
        if asked == "auto" or (asked is None and name != "room"):  # whose None is light at infinity
            settings = replace(settings, **{name: tuple(found) if isinstance(found, list) else found})
    settings = planned(settings, dataset)
    if meta["digests"]["photographs"] != dataset.digest:
        raise UserError(f"{dataset.root}: not the photographs of the checkpoint: give its --data, or another --out")
    old, new = _flat(meta["settings"]), _flat(to_dict(settings))
    changed = [key for key in new if old.get(key) != new[key]]
    if fixed := [key for key in ("sh_order", "shader", "room") if key in changed]:
        raise UserError(f"{fixed[0]} is {old.get(fixed[0])} in the checkpoint and can't change: choose another --out")
    if changed:
        listing = ", ".join(f"{key} {old.get(key)} -> {new[key]}" for key in changed)
        print(f"settings differ from the checkpoint's, the new ones hold: {listing}", file=sys.stderr)
    shading, priors = _shading(scene, settings, dataset), _priors(dataset, settings)
    return Fit.resume(dataset, settings, arrays, meta, shading=shading, priors=priors)


def _flat(tree, prefix="") -> dict:
    """{"a": {"b": 1}} as {"a.b": 1}."""
    flat = {}
    for key, value in tree.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return flat


# ---- Loop ----


def _loop(fit, folder, quiet, events=None, watch=None) -> int | None:
    """Step until the budget is spent or someone stops it, also in a window (``watch``); returns None, or by which signal. Begins
    and ends with a checkpoint: a folder that can't be written is known before the work, not after it."""
    settings, ranks = fit.settings, fit.ranks
    state = _state(fit, folder)
    checkpoint.save(folder, *state)
    ranks.same((settings, *state))  # for `join`
    if fit.progress < 1:
        (folder / results.METRICS).unlink(missing_ok=True)  # from here on the run is unfinished
    saved, paused = time.monotonic(), False
    planned = None if settings.iterations else max(0.0, 60 * settings.minutes - fit.elapsed)
    # torchrun passes Ctrl-C on, to processes that the terminal has told already
    with GracefulInterrupt(patient=ranks.size > 1) as interrupt, Progress(planned, quiet) as progress:
        line = FitLine(fit, progress)
        while ranks.same(fit.progress < 1 and interrupt.signal is None):
            recorded = fit.step()
            if not np.isfinite(fit.psnr):
                raise _diverged(fit, folder)
            line.update()
            if events and recorded:
                events.add(fit.curves.rows[-1])
            if time.monotonic() - saved > settings.checkpoint_seconds:
                paused, saved = _paused(fit, folder, paused), time.monotonic()
            if watch:
                watch.between(lambda: interrupt.signal is not None)
                if watch.stopped:
                    interrupt.signal = interrupt.signal or signal.SIGINT
        _paused(fit, folder, paused)
    return interrupt.signal


def _paused(fit, folder, before) -> bool:
    """Save a checkpoint; returns whether the disk takes none, which is told once: ``before`` says what was returned last."""
    state = _state(fit, folder)
    try:
        checkpoint.save(folder, *state)
    except UserError as error:
        if not before:
            warnings.warn(
                f"no checkpoints while it lasts, the last good one stays and the fit goes on: {error}", stacklevel=2
            )
        return True
    if before:
        print("checkpoints are written again", file=sys.stderr)
    return False


def _state(fit, folder):
    """What a checkpoint holds. Raises: UserError for numbers that are not finite, which must not replace good ones."""
    arrays, meta = fit.state()
    if not all(np.isfinite(a).all() for a in arrays.values()):
        raise _diverged(fit, folder)
    return arrays, meta | {"settings": to_dict(fit.settings), "digests": results.digests(fit.dataset, fit.settings)}


def _diverged(fit, folder):
    return UserError(
        f"the fit diverged at step {fit.step_number} (not a finite number): {folder / 'checkpoints'} has "
        "the last good state: go on with --resume and lower rates, e.g. --set learning_rates.centers=[1e-4,1e-5]"
    )

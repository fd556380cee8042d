"""What a run leaves behind: metrics.json, the scene, pictures of the test views, a contact sheet, a report, a summary."""

import hashlib
import json
import platform
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import __version__, report
from ..core.errors import UserError
from ..core.files import write_json, write_png
from ..core.film import Film
from ..core.inputs import JSON, read_file
from ..core.progress import Progress
from ..core.runtime import cores, peak_rss_mb, release_memory
from ..datasets.resolution import LONGEST
from ..datasets.types import Dataset, View
from ..evaluation import evaluate, lpips, metrics, pictures
from ..evaluation.registration import Registered, Registration, register
from ..export.mitsuba_scene import export
from ..fit import checkpoint
from ..fit.curves import Curves
from ..settings.config import to_dict
from ..settings.settings import Settings
from ..shading.environment import Environment
from ..shading.lighting import Lighting
from ..shading.room import SIDES
from ..surfels.surfels import Surfels
from . import cameras
from .figures import label, text

if TYPE_CHECKING:
    from ..fit.scene import FitScene
    from ..fit.trainer import Fit

UNALIGNED = "psnr_unaligned"  # PSNR with poses and exposures as they were given
METRICS, SHEET, GUIDED = "metrics.json", "contact_sheet.png", "guided.png"
PREVIEWS = 4  # test views on the sheet and in the report, and with their G-buffers written
_SUMMARY = ("psnr", "ssim", "lpips", "normal_mae_deg", "surfels", "iterations", "train_seconds", "render_fps")
_TOO_SMALL = "not measured: no test views that are large enough"  # for LPIPS
_NO_LPIPS = f"not measured, for want of weights: {lpips.INSTALL}"


def write(fit: "Fit", scene: "FitScene", folder: Path, quiet: bool) -> None:
    """Evaluate and export a ``fit`` to ``scene`` into ``folder``, and print what came out and where it is.

    Where nothing was held out, pictures show training views and the figures of quality are null.
    Raises: UserError where the disk is full or the folder can't be written.
    """
    facts = _facts(fit)  # the peak of memory is the fit's, not that of its evaluation
    fit.photographs = None  # no step comes any more
    release_memory()
    with dr.suspend_grad():
        surfels, environment = fit.model.surfels(fit.sh_order), fit.model.environment()
        lighting = fit.lighting(surfels)
    views = evaluation_views(fit.dataset)
    registration = cameras.registration(fit.cameras, views)
    settings = fit.settings
    film = Film.gaussian(settings.rfilter, settings.spp)
    mean, scores, rows, found = measure(
        surfels, lighting, fit.dataset, settings.background, film, folder, quiet, registration
    )
    exported = export(
        folder,
        scene,
        surfels,
        environment,
        fit.shading,
        fit.model.shader(),
        [replace(view, camera=found[view.name].camera) for view in views],
        settings.spp,
        settings.rfilter,
    )
    if fit.cameras:
        exported.append(cameras.write(folder, fit.cameras, fit.dataset, views, found))
        facts["cameras"] = cameras.summary(fit.cameras)
    if (guided := fit.guided_picture()) is not None:
        write_png(folder / GUIDED, guided / 255)
    fit.curves.write(folder)
    publish(folder, mean | facts | {"views": scores}, fit.curves, rows, environment, exported)


def measure(
    surfels: Surfels,
    lighting: Lighting | None,
    dataset: Dataset,
    background: float,
    film: Film,
    folder: Path,
    quiet: bool,
    registration: Registration | None = None,
) -> tuple[dict, dict, dict, dict[str, Registered]]:
    """Render the evaluation views of ``dataset``, and write their pictures below ``folder``.

    Args: see `evaluate.render_view`. ``registration``: which of their poses and exposures are fitted first; None: none.
    Returns: the figures of quality and speed, means as metrics.json has them; its ``views``, {name: scores};
    {name: `pictures.panels`} of the preview views; and {name: how each was seen}.
    Raises: UserError where the disk is full or the folder can't be written.
    """
    views, scores, rows, found = evaluation_views(dataset), {}, {}, {}
    on_sheet = {view.name for view in preview_views(views)}
    with Progress(None, quiet, "evaluating") as progress:
        for k, view in enumerate(views):
            seen, unaligned = Registered(view.camera), {}
            if registration is not None:
                start = registration.cameras.get(view.name, view.camera)
                image = evaluate.render_view(surfels, lighting, start, background, film).image
                unaligned = {UNALIGNED: metrics.psnr(image, evaluate.ground_truth(view, background))}
                seen = register(registration, surfels, lighting, view, background)
            found[view.name] = seen
            rendering = evaluate.render_view(surfels, lighting, seen.camera, background, film, seen.gain)
            pictures.write_view(folder / "test", view, rendering, background, gbuffer=view.name in on_sheet)
            release_memory()  # LPIPS needs as much
            scores[view.name] = evaluate.score(view, rendering, background) | unaligned
            if view.name in on_sheet:
                rows[view.name] = pictures.panels(view, rendering, background)
            progress.update((k + 1) / len(views))
    if not dataset.test:
        scores = {}
    mean = evaluate.mean_scores(list(scores.values()))
    reason = None
    if mean["lpips"] is None:
        reason = _TOO_SMALL if lpips.installed() else _NO_LPIPS
    fps = evaluate.frames_per_second(surfels, lighting, [view.camera for view in views], film)
    mean |= {"lpips_reason": reason, "render_fps": fps}
    if registration is not None:
        mean |= {"test_cameras": registration.words}
        mean |= {UNALIGNED: float(np.mean([s[UNALIGNED] for s in scores.values()])) if scores else None}
    return mean, scores, rows, found


def publish(
    folder: Path,
    figures: dict,
    curves: Curves,
    rows: Mapping[str, Mapping[str, np.ndarray]],
    environment: Environment,
    others: Sequence[Path] = (),
) -> None:
    """Write contact sheet, report and metrics.json into ``folder``, and print what came out and where it is, the paths
    ``others`` among it. ``figures`` are what metrics.json holds; `report.write` explains ``curves`` and ``rows``.

    Raises: UserError where the disk is full or the folder can't be written.
    """
    lines, texels = _summary(figures), environment.texels.numpy()
    pictures.contact_sheet(folder / SHEET, list(rows.values()), texels, folder.resolve().name, lines)
    report.write(folder, figures, curves, rows, texels)
    write_json(folder / METRICS, figures)  # last: it says that the run is finished
    print(
        "\n".join(
            [*lines, "", *map(str, (folder / report.REPORT, folder / SHEET, folder / METRICS, *others, folder / "test"))]
        )
    )


def evaluation_views(dataset: Dataset) -> list[View]:
    """Return the views that results are of: the held-out ones, or a few of those that are fitted."""
    return dataset.test or dataset.train[:PREVIEWS]


def preview_views(views: Sequence[View]) -> list[View]:
    """Return those of ``views`` that pictures show: `PREVIEWS` of them, evenly spread."""
    return [views[k] for k in sorted({int(k) for k in np.linspace(0, len(views) - 1, PREVIEWS + 2)[1:-1].round()})]


def saved_figures(folder: Path) -> dict | None:
    """Return what metrics.json in ``folder`` holds; None where it is missing, damaged, or of no run."""
    try:
        saved = json.loads(read_file(folder / METRICS, JSON))
        return saved if isinstance(saved["settings"], dict) and isinstance(saved["finished"], bool) else None
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None


def finished(folder: Path) -> bool:
    """Return whether the run in ``folder`` came to its end."""
    saved = saved_figures(folder)
    return saved is not None and saved["finished"]


def photographs_of(run: Path) -> tuple[str | None, int]:
    """Return the folder in which the photographs of the ``run`` were, None where its metrics.json does not say, and the most
    pixels along a side that they were read with."""
    saved = saved_figures(run) or {"settings": {}}
    folder, longest = saved.get("photographs"), saved["settings"].get("resolution", LONGEST)
    return (folder if isinstance(folder, str) else None), (longest if isinstance(longest, int) else LONGEST)


def origin_of(run: Path) -> tuple[float, float, float]:
    """Return where the origin of the ``run``'s world lies in that of its photographs' files (`Dataset.origin`); 0 where
    metrics.json does not say, as in runs from before it did. Raises: UserError where what it says is no point."""
    origin = (saved_figures(run) or {}).get("origin", (0, 0, 0))
    try:
        x, y, z = map(float, origin)
        if np.isfinite((x, y, z)).all():
            return x, y, z
    except (TypeError, ValueError):
        pass
    raise UserError(f"{run / METRICS}: its origin is no point: it is damaged")


def digests(dataset: Dataset, settings: Settings) -> dict[str, str]:
    """Return what tells a fit from all others, as checkpoints and metrics.json have it: hashes of its photographs and of its
    settings."""
    written = json.dumps(to_dict(settings), sort_keys=True)
    return {"photographs": dataset.digest, "settings": hashlib.sha256(written.encode()).hexdigest()}


def _facts(fit) -> dict:
    """What metrics.json says of the run as a whole, beside `measure`."""
    table, room = fit.shading.turntable, fit.model.environment().room
    return {
        "format": checkpoint.FORMAT,
        "finished": fit.progress >= 1,
        "train_seconds": fit.elapsed,
        "iterations": fit.step_number,
        "surfels": len(fit.model),
        "parameters": sum(fit.model.numpy(name).size for name in fit.model.names()),
        "peak_rss_mb": peak_rss_mb(),
        "train_views": len(fit.dataset.train),
        "test_views": len(fit.dataset.test),
        "turntable": table and asdict(table),
        "eta": fit.shading.eta,
        "room": room and {"center": room.center, "distances": dict(zip(SIDES, room.distances))},
        "origin": fit.dataset.origin,
        "photographs": str(fit.dataset.root.resolve()),
        "settings": to_dict(fit.settings),
        "digests": digests(fit.dataset, fit.settings),
        **circumstances(),
    }


def circumstances() -> dict:
    """Return with what, where and by which command this process runs, as metrics.json has it."""
    return {
        "versions": {
            "rgs_mi": __version__,
            "mitsuba": mi.__version__,
            "drjit": dr.__version__,
            "python": platform.python_version(),
        },
        "machine": {
            "cpus": cores(),
            "threads": dr.thread_count(),
            "processor": platform.machine(),
            "system": platform.system(),
            "variant": mi.variant(),
        },
        "command": shlex.join(sys.argv),
    }


def _summary(figures) -> list[str]:
    """The figures in words, a line each."""
    lines = [f"{label(name)} {text(name, figures[name], unit=True)}" for name in _SUMMARY if figures[name] is not None]
    return lines if figures["psnr"] is not None else ["no test views: nothing is held out to measure on", *lines]

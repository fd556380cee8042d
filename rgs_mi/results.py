"""What a run leaves behind: metrics.json, the scene, pictures of the test views, a contact sheet, a summary."""

import json
import os
import platform
import resource
import shlex
import sys

import drjit as dr
import mitsuba as mi
import numpy as np

from . import __version__, checkpoint, evaluate, lpips, pictures
from .config import to_dict
from .export import export
from .progress import Progress

METRICS, SHEET, GUIDED = "metrics.json", "contact_sheet.png", "guided.png"
SHOWN = 4  # test views on the sheet, and with their G-buffers written
_NO_LPIPS = f"not measured, for want of weights: {lpips.INSTALL}"


def write(fit, scene, folder, quiet):
    """Evaluate and export a `Fit` of a `FitScene` into ``folder``, and print what came out and where it is.

    Where nothing was held out, pictures show training views and the figures of quality are null.
    Raises: UserError where the disk is full or the folder can't be written.
    """
    held_out = bool(fit.dataset.test)
    views = judged(fit.dataset)
    background = fit.settings.background
    with dr.suspend_grad():
        surfels, environment = fit.model.surfels(fit.sh_order), fit.model.environment()
        exported = export(folder, scene, surfels, environment, fit.shading, fit.settings.indirect,
                          fit.model.shader(), views)
        lighting = fit.lighting(surfels)
    scores, rows = {}, []
    on_sheet = {view.name for view in shown(views)}
    with Progress(None, quiet, "evaluating") as progress:
        for k, view in enumerate(views):
            rendering = evaluate.render_view(surfels, lighting, view.camera, background)
            pictures.write_view(folder / "test", view, rendering, background, gbuffer=view.name in on_sheet)
            scores[view.name] = evaluate.score(view, rendering, background)
            if view.name in on_sheet:
                rows.append((view, rendering))
            progress.update((k + 1) / len(views))
    if (guided := fit.guided_picture()) is not None:
        pictures.write_png(folder / GUIDED, guided / 255)
    fps = evaluate.frames_per_second(surfels, lighting, [view.camera for view in views])
    mean = evaluate.mean_scores(list(scores.values()) if held_out else [])
    figures = _figures(fit, mean, fps) | {"views": scores if held_out else {}}
    with checkpoint.atomic_file(folder / METRICS) as stream:
        stream.write((json.dumps(figures, indent=1, default=str) + "\n").encode())
    lines = _summary(figures)
    pictures.contact_sheet(folder / SHEET, rows, environment.texels.numpy(), background, folder.resolve().name, lines)
    print("\n".join([*lines, "", *map(str, (folder / SHEET, folder / METRICS, *exported, folder / "test"))]))


def judged(dataset) -> list:
    """The views that results are of: the held-out ones, or a few of those that are fitted."""
    return dataset.test or dataset.train[:SHOWN]


def shown(views) -> list:
    """The views of a list that pictures show: `SHOWN` of them, evenly spread."""
    return [views[k] for k in sorted({int(k) for k in np.linspace(0, len(views) - 1, SHOWN + 2)[1:-1].round()})]


def finished(folder) -> bool:
    """Whether the run in ``folder`` came to its end."""
    try:
        return bool(json.loads((folder / METRICS).read_text())["finished"])
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _figures(fit, mean, fps) -> dict:
    """What metrics.json says of the run as a whole."""
    parameters = sum(fit.model.numpy(name).size for name in fit.model.optimizer.keys())
    return mean | {
        "lpips_reason": None if mean["lpips"] is not None
        else "not measured: no test views that are large enough" if lpips.installed() else _NO_LPIPS,
        "finished": fit.progress >= 1, "render_fps": fps, "train_seconds": fit.elapsed, "iterations": fit.step_number,
        "surfels": len(fit.model), "parameters": parameters,
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "train_views": len(fit.dataset.train), "test_views": len(fit.dataset.test),
        "settings": to_dict(fit.settings),
        "versions": {"rgs_mi": __version__, "mitsuba": mi.__version__, "drjit": dr.__version__,
                     "python": platform.python_version()},
        "machine": {"cpus": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
                    "processor": platform.machine(), "system": platform.system(), "variant": mi.variant()},
        "command": shlex.join(sys.argv),
    }


def _summary(figures) -> list[str]:
    """The figures in words, a line each."""
    minutes, seconds = divmod(round(figures["train_seconds"]), 60)
    quality = []
    if figures["psnr"] is None:
        quality.append("no test views: nothing is held out to measure on")
    else:
        quality += [f"PSNR {figures['psnr']:.2f} dB", f"SSIM {figures['ssim']:.4f}"]
    if figures["lpips"] is not None:
        quality.append(f"LPIPS {figures['lpips']:.4f}")
    if figures["normal_mae_deg"] is not None:
        quality.append(f"normal error {figures['normal_mae_deg']:.2f}°")
    return [*quality, f"{figures['surfels']:,} surfels".replace(",", " "),
            f"{figures['iterations']} steps in {minutes}:{seconds:02} min",
            f"{figures['render_fps']:.1f} views per second"]

"""The page of one run."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import yaml
from skimage.transform import downscale_local_mean

from ..core.files import atomic_file
from ..evaluation.evaluate import SCORES
from ..evaluation.pictures import ERROR_RANGE, NORMAL_RANGE
from ..fit.curves import Curves
from ..settings.config import to_dict
from ..settings.settings import Settings
from . import cameras, html
from .plots import curves as plot

REPORT = "report.html"
_TILES = ("psnr", "ssim", "lpips", "normal_mae_deg", "surfels", "render_fps", "train_seconds", "iterations", "peak_rss_mb")
_OF_VIEW = ("psnr", "ssim", "lpips", "normal_mae_deg")  # figures above a view's pictures
_SIDES = ("photograph", "rendering")  # under the slider
_SCALES = {"error": ("0", f"{ERROR_RANGE:g}"), "normal error": ("0°", f"{NORMAL_RANGE}°")}  # of panels in `pictures.RAMP`
_SLIDER, _PANEL, _ENVIRONMENT = 640, 300, 1024  # most pixels of a picture's width
_ENVIRONMENT_WORDS = (
    "The light that was recovered, latitude by longitude: radiance at an exposure, through sRGB's curve; "
    "what is brighter than white is clipped."
)
_FILES = ("metrics.json", "curves.csv", "contact_sheet.png", "scene.xml")


def write(
    folder: Path,
    figures: dict,
    curves: Curves,
    rows: Mapping[str, Mapping[str, np.ndarray]],
    environment: np.ndarray,
) -> None:
    """Write ``FOLDER/report.html``.

    Args:
      figures:     what metrics.json holds
      curves:      those of the fit
      rows:        view's name -> its `pictures.panels`
      environment: [rows, columns, 3], linear radiance

    Raises: UserError where the disk is full or the folder can't be written.
    """
    page = html.render(
        "run.html",
        title=folder.resolve().name,
        figures=figures,
        tiles=_TILES,
        plots=_plots(curves),
        views=[_view(name, panels, figures["views"].get(name, {})) for name, panels in rows.items()],
        scales=_SCALES,
        environment=html.hdr(_shrunk(environment), _ENVIRONMENT_WORDS),
        cameras=cameras.rows(figures.get("cameras", {})),
        scores=[name for name in SCORES if figures[name] is not None],
        settings=list(_lines(figures["settings"], to_dict(Settings()))),
        files=_FILES,
    )
    with atomic_file(folder / REPORT) as stream:
        stream.write(page)


# ---- Curves ----


def _plots(curves) -> list[str]:
    """Curves over the time that was spent, with a mark where the photographs' width changes."""
    if not curves.rows:
        return []
    seconds = np.array(curves.column("seconds"))
    time, unit = (seconds / 60, "minutes") if seconds[-1] >= 120 else (seconds, "seconds")
    pixels = curves.column("pixels")
    stages = {f"{pixels[0]} px": 0} | {
        f"{pixels[k]} px": time[k - 1] for k in range(1, len(pixels)) if pixels[k] != pixels[k - 1]
    }
    over_time = lambda series, words, **options: plot(
        {name: (time, y) for name, y in series.items()}, unit, words, marks=stages, **options
    )
    psnr = curves.column("psnr")
    losses = {name.removeprefix("loss.").replace("_", " "): curves.column(name) for name in curves.losses()}
    return [
        over_time({"of a stretch": psnr, "running mean": _running_mean(psnr)}, "PSNR of training views, dB", low=None),
        over_time(losses, "parts of the loss, weighted", log=True),
        over_time({"surfels": curves.column("surfels")}, "surfels"),
        over_time({"ms": curves.column("ms")}, "milliseconds a step", log=True),
    ]


def _running_mean(values, reach=10):
    """Of each value and its neighbours, ``reach`` to either side, that are known."""
    windows = (np.array(values[max(k - reach, 0) : k + reach + 1]) for k in range(len(values)))
    return [float(np.mean(known)) if len(known := window[np.isfinite(window)]) else np.nan for window in windows]


# ---- Pictures ----


def _view(name, panels, scores) -> dict:
    """What the page shows of a view."""
    sides = {side: html.jpeg(panels[side], f"view {name}: {side}", _SLIDER) for side in _SIDES}
    others = {kind: html.jpeg(p, f"{kind} of view {name}", _PANEL) for kind, p in panels.items() if kind not in _SIDES}
    known = {k: scores[k] for k in _OF_VIEW if scores.get(k) is not None}
    return {"name": name, "scores": known, "panels": others} | sides


def _shrunk(environment):
    """At most `_ENVIRONMENT` texels wide: means over blocks, in linear light."""
    k = -(-environment.shape[1] // _ENVIRONMENT)
    height, width = (n - n % k for n in environment.shape[:2])
    return downscale_local_mean(environment[:height, :width], (k, k, 1))


# ---- Settings ----


def _lines(tree: dict, defaults: dict, indent=""):
    """Settings as YAML, a dictionary a line: its ``text`` after the ``indent``, whether it is ``changed`` from the defaults,
    and at the first line of what is changed the ``default``."""
    for key, value in tree.items():
        default = defaults.get(key)
        if isinstance(value, dict) and value:
            yield {"indent": indent, "text": f"{key}:", "changed": False, "default": None}
            yield from _lines(value, default or {}, indent + "  ")
            continue
        several = isinstance(value, list) and any(isinstance(item, dict) for item in value)
        texts = [f"{key}:", *(f"  - {_inline(item)}" for item in value)] if several else [f"{key}: {_inline(value)}"]
        for k, text in enumerate(texts):
            changed = value != default
            first = _inline(default) if changed and k == 0 else None
            yield {"indent": indent, "text": text, "changed": changed, "default": first}


def _inline(value):
    text = yaml.safe_dump(value, default_flow_style=True, width=float("inf"), allow_unicode=True, sort_keys=False)
    return text.removesuffix("...\n").strip()

"""The page of a suite of runs: a row a scene, with links to the runs' own pages."""

import json
import math
import os
from html import escape
from pathlib import Path

import numpy as np

from ..core.errors import UserError
from ..core.files import atomic_file
from ..datasets.images import read_image
from . import html
from .comparison import FIGURES
from .figures import cell, label
from .run import REPORT

_STORED, _SHOWN = 224, 112  # pixels of a thumbnail's width


def write_suite(path, runs, title: str):
    """Write the page ``path``: a table of ``runs``, [(scene's name, the run's folder or None, what went wrong or None)].

    A run whose files are missing or damaged is shown with what is wrong with it. Means are over runs that came to an end.
    Raises: UserError where the disk is full or the folder can't be written.
    """
    path = Path(path)
    found = [(name, folder and Path(folder), *_figures(folder and Path(folder), error)) for name, folder, error in runs]
    names = [name for name in FIGURES if any(figures.get(name) is not None for _, _, figures, _ in found)]
    rows, bad, done = [], [], []
    for k, (scene, folder, figures, error) in enumerate(found):
        rows.append(
            [
                _scene(path, scene, folder, error),
                html.Html("".join(_thumbnails(folder, scene))),
                *(cell(name, figures.get(name), f"{scene}/{name}") for name in names),
            ]
        )
        (bad.append(k) if error else done.append(figures))
    mean = ["mean", f"{len(done)} of {len(found)}", *(_mean(name, done) for name in names)]
    words = f"{len(done)} of {len(found)} scenes came to an end; figures of quality are of views that were held out."
    with atomic_file(path) as stream:
        stream.write(
            html.page(
                title,
                html.paragraph(words, "soft"),
                html.table(["scene", "photograph, rendering", *map(label, names)], rows, bad, mean),
            ).encode()
        )


def _figures(folder, error):
    """(the numbers of metrics.json, what is wrong or None)."""
    if folder is None:
        return {}, error or "no run"
    try:
        figures = json.loads((folder / "metrics.json").read_text("utf-8"))
        unfinished = None if figures["finished"] else "the fit was stopped before its end"
    except (OSError, ValueError, KeyError, TypeError):
        return {}, error or f"{folder / 'metrics.json'} is missing or damaged: fit the scene again"
    numbers = {name: v for name in FIGURES if isinstance(v := figures.get(name), int | float) and math.isfinite(v)}
    return numbers, error or unfinished


def _scene(path, scene, folder, error):
    """The name, a link where the run has a page, and below it what went wrong."""
    report = folder and folder / REPORT
    words = (
        html.link(scene, Path(os.path.relpath(report, path.parent)).as_posix())
        if report and report.exists()
        else escape(scene)
    )
    return html.Html(words + (f"<small>{escape(error)}</small>" if error else ""))


def _mean(name, done):
    values = [figures[name] for figures in done if figures.get(name) is not None]
    return cell(name, float(np.mean(values)) if values else None, f"mean/{name}")


def _thumbnails(folder, scene):
    """Photograph and rendering of the first view that the run's own page shows."""
    for picture in sorted(folder.glob("test/*_gbuffer.exr"))[:1] if folder else ():
        picture = picture.with_name(picture.name.replace("_gbuffer.exr", "_compare.png"))
        try:
            pixels, _ = read_image(picture, scene)
        except UserError:
            continue  # what is missing in a row is seen
        width = max(pixels.shape[1] // 3, 1)
        for k, kind in enumerate(("photograph", "rendering")):
            yield html.thumbnail(pixels[:, k * width : (k + 1) * width, :3], f"{kind} of {scene}", _STORED, _SHOWN)

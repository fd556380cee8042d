"""The page of a suite of runs: a row a scene, with links to the runs' own pages."""

import json
import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..core.errors import UserError
from ..core.files import atomic_file
from ..core.inputs import JSON, read_file
from ..datasets.images import read_image
from . import html
from .run import REPORT
from .tables import FIGURES

_STORED, _WIDTH = 224, 112  # pixels of a thumbnail's width, in the file and on the page


def write_suite(path: str | Path, runs: Sequence[tuple[str, str | Path | None, str | None]], title: str) -> None:
    """Write the page ``path``: a table of ``runs``, [(scene's name, the run's folder or None, what went wrong or None)].

    A run whose files are missing or damaged is listed with what is wrong with it. Means are over runs that came to an end.
    Raises: UserError where the disk is full or the folder can't be written.
    """
    path = Path(path)
    rows = [_row(path, scene, folder and Path(folder), error) for scene, folder, error in runs]
    names = [name for name in FIGURES if any(name in row["figures"] for row in rows)]
    done = [row["figures"] for row in rows if not row["error"]]
    means = {name: _mean([figures[name] for figures in done if name in figures]) for name in names}
    page = html.render("suite.html", title=title, runs=rows, names=names, means=means, finished=len(done))
    with atomic_file(path) as stream:
        stream.write(page)


def _row(path, scene, folder, error) -> dict:
    """What the page ``path`` shows of a run: its scene, its page where it has one, figures, pictures, and what is wrong."""
    figures, error = _figures(folder, error)
    page = folder / REPORT if folder and (folder / REPORT).exists() else None
    return {
        "scene": scene,
        "page": page and Path(os.path.relpath(page, path.parent)).as_posix(),
        "figures": figures,
        "pictures": list(_thumbnails(folder, scene)),
        "error": error,
    }


def _figures(folder, error):
    """(the numbers of metrics.json, what is wrong or None)."""
    if folder is None:
        return {}, error or "no run"
    try:
        figures = json.loads(read_file(folder / "metrics.json", JSON))
        unfinished = None if figures["finished"] else "the fit was stopped before its end"
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return {}, error or f"{folder / 'metrics.json'} is missing or damaged: fit the scene again"
    numbers = {name: v for name in FIGURES if isinstance(v := figures.get(name), int | float) and math.isfinite(v)}
    return numbers, error or unfinished


def _mean(values):
    return float(np.mean(values)) if values else None


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
            yield html.jpeg(pixels[:, k * width : (k + 1) * width, :3], f"{kind} of {scene}", _STORED, _WIDTH)

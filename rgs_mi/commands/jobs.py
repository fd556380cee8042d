"""Fits of a suite of scenes, each done once and gone on with where it was interrupted, on this machine or on a cluster: what
`ablate` and `suite` share."""

import contextlib
import io
import json
import warnings
from collections.abc import Collection, Generator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..core.cluster import each_on
from ..core.errors import Stopped, UserError
from ..core.files import atomic_file
from ..core.ownership import owned
from ..core.subprocesses import each_apart
from ..datasets import is_capture, looked_for
from ..datasets.types import View
from ..fit import checkpoint
from ..fit.plan import agree
from ..fit.scene import FitScene
from ..report import results
from ..report.tables import DETAILS, FIGURES, csv_text
from .optimize import optimize

# ---- What there is to do ----


@dataclass(frozen=True)
class Job:
    """One fit to the photographs ``data`` of ``scene``, into ``folder``: ``overrides`` over ``config`` (a preset, a file or
    None), which make ``settings`` (nested dicts); ``variant`` and ``seed`` are what tables call it by. ``asked`` says
    whether it is to be done now; of other jobs, tables have what is there."""

    scene: str
    data: Path
    variant: str
    seed: int
    config: str | Path | None
    overrides: Sequence[str]
    settings: dict
    folder: Path
    asked: bool

    def has(self, saved: dict) -> bool:
        """Return whether the settings ``saved`` with a fit are this job's."""
        return agree(self.settings, saved)

    def figures(self) -> dict | None:
        """Return what metrics.json of the finished fit holds; None where there is none, or one with other settings."""
        figures = results.saved_figures(self.folder)
        return figures if figures and figures["finished"] and self.has(figures["settings"]) else None


def find_scenes(suite: str | Path) -> dict[str, Path]:
    """Return name -> scene file or capture: the ``*.xml`` in the folder ``suite``, and its subfolders that are captures
    (`is_capture`).

    Raises: UserError where there are none.
    """
    suite = Path(suite)
    captures = {path.name: path for path in suite.glob("*") if is_capture(path)}
    found = {path.stem: path for path in suite.glob("*.xml")} | captures
    if not found:
        raise UserError(
            f"{suite} holds neither scenes (*.xml) nor captures (folders with {looked_for()}): give a folder of some"
        )
    return dict(sorted(found.items()))


def check_names(kind: str, names: Sequence[str] | None, there: Collection[str]) -> None:
    """Check that all ``names`` (None: none) are ``there``; ``kind`` is what they are, in a word. Raises: UserError
    otherwise."""
    for name in names or ():
        if name not in there:
            raise UserError(f"no {kind} '{name}': choose from {', '.join(there)}")


def effort(settings: dict) -> str:
    """Return the budget of a fit with these ``settings``, in words."""
    return f"{settings['iterations']} steps a fit" if settings["iterations"] else f"{settings['minutes']:g} minutes a fit"


# ---- Doing it ----


def photographs(xml: str | Path, data: str | Path, longest: int, quiet: bool) -> tuple[str, list[View]]:
    """Return a digest of all photographs of a scene, which are path-traced first where need be, and scaled where they have
    more than ``longest`` pixels along a side, and a few of its preview views.

    Raises: UserError for photographs that can't be read.
    """
    dataset = FitScene.load(xml, data).dataset(longest, quiet)
    return dataset.digest, results.preview_views(results.evaluation_views(dataset))[::2]


def each_fitted(
    xml: str | Path, jobs: Sequence[Job], *, workers: int = 1, scheduler: str | None = None, quiet: bool = False
) -> Generator[tuple[Job, UserError | None], None, None]:
    """Do each of ``jobs``, fits of the scene file ``xml``, unless that is done, in processes of their own: up to ``workers`` at a
    time on this machine, or on those of the Dask cluster at the address ``scheduler``. To be closed.

    Yields: (job, what went wrong or None), as they end.
    Raises: UserError where nothing can be done at all; KeyboardInterrupt after Ctrl-C, when all have saved.
    """
    if workers < 1:
        raise UserError(f"--workers {workers}: needs at least 1")
    calls = [(xml, job, quiet or workers > 1 or scheduler is not None) for job in jobs]
    return _told(each_on(scheduler, _done, calls) if scheduler else each_apart(_done, calls, workers))


def _told(ended):
    with contextlib.closing(ended):
        for (_, job, _), _, error in ended:
            yield job, error


def _done(xml, job, quiet):
    """Do a job, unless that is done. Raises: UserError where it fails, or is stopped, and where the run that is there is of other
    photographs."""
    digest, _ = photographs(xml, job.data, job.settings["resolution"], quiet)
    # another call may be at it, or a worker that has died and still saves
    with owned(job.folder, wait=True):
        saved = results.saved_figures(job.folder)
        if saved and dict(saved.get("digests") or ()).get("photographs") != digest:
            raise UserError(f"{job.folder} holds a fit to other photographs: delete it, or choose another --out")
    if job.figures() is None:
        if not quiet:
            print(job.folder, flush=True)
        fit(xml, job, quiet)


def fit(xml: str | Path, job: Job, quiet: bool) -> None:
    """Do a job, or go on with it; a fit with other settings is moved aside. Raises: UserError where it fails, or is stopped."""
    saved = None if results.finished(job.folder) else checkpoint.load_latest(job.folder)
    resume = saved is not None and job.has(saved[1]["settings"])
    if saved and not resume:
        with owned(job.folder) as mine:
            warnings.warn(f"{job.folder} had other settings: it is {mine.move_aside()} now", stacklevel=2)
    options = {"data": job.data, "config": job.config, "overrides": job.overrides, "out": job.folder}
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            optimize(xml, **options, resume=resume, quiet=quiet)
    except Stopped as stop:
        raise UserError("stopped before its end: the same command goes on") from stop


# ---- What comes out ----


def rows_of(jobs: Sequence[Job], errors: Mapping[Path, str]) -> list[dict]:
    """Return a row (see `tables`) for each fit that is there or was asked for; ``errors`` is {folder: what went wrong}."""
    rows = []
    for job in jobs:
        error = errors.get(job.folder)
        figures = None if error else job.figures()
        if figures or job.asked:
            status = "failed" if error else "finished" if figures else "missing"
            rows.append(
                {"scene": job.scene, "variant": job.variant, "seed": job.seed, "status": status}
                | {name: figures and figures.get(name) for name in (*FIGURES, *DETAILS)}
                | {"error": error}
            )
    return rows


def write_tables(
    out: str | Path, name: str, sections: Sequence[str], rows: Sequence[dict], told: dict[str, object]
) -> list[Path]:
    """Write ``OUT/NAME.md`` (``sections`` of text), ``.csv`` (the ``rows``) and ``.json`` (the rows as ``runs``, and what
    else is ``told``), and return their paths. Raises: UserError where one can't be written."""
    columns = ("scene", "variant", "seed", "status", *FIGURES, *DETAILS, "error")
    paths = []
    for suffix, text in {
        "md": "\n\n".join(sections) + "\n",
        "csv": csv_text(rows, columns),
        "json": json.dumps({"runs": rows} | told, indent=1) + "\n",
    }.items():
        paths.append(Path(out) / f"{name}.{suffix}")
        with atomic_file(paths[-1]) as stream:
            stream.write(text.encode())
    return paths

"""Fits of a suite of scenes, each done once and gone on with where it was interrupted: what `ablate` and `suite` share."""

import contextlib
import hashlib
import io
import json
import shutil
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..core.errors import UserError
from ..core.files import atomic_file
from ..datasets import is_capture, looked_for
from ..datasets.types import View
from ..fit import checkpoint
from ..fit.plan import agree
from ..fit.scene import FitScene
from ..report import results
from ..report.tables import DETAILS, FIGURES, csv_text
from .optimize import optimize

_DIGEST = "photographs.sha256"  # beside or above the fits: what they are of


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
        if not results.finished(self.folder):
            return None
        figures = json.loads((self.folder / results.METRICS).read_text())
        return figures if self.has(figures["settings"]) else None


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
    digest = hashlib.sha256()
    for view in [*dataset.train, *dataset.test]:
        for part in (view.name.encode(), view.camera.to_world.tobytes(), view.pixels.tobytes()):
            digest.update(part)
    return digest.hexdigest(), results.preview_views(results.evaluation_views(dataset))[::2]


def check_photographs(folder: Path, digest: str) -> None:
    """Note the ``digest`` of what the fits below ``folder`` are of. Raises: UserError where those that are there are of
    other photographs."""
    path = folder / _DIGEST
    if path.is_file() and path.read_text().strip() != digest:
        raise UserError(f"{folder} holds fits to other photographs: delete it, or choose another --out")
    with atomic_file(path) as stream:
        stream.write(f"{digest}\n".encode())


def fit(xml: str | Path, job: Job, quiet: bool) -> None:
    """Do a job, or go on with it. Raises: UserError where it fails, or is stopped."""
    saved = checkpoint.load_latest(job.folder)
    resume = saved is not None and not results.finished(job.folder) and job.has(saved[1]["settings"])
    if saved and not resume:
        warnings.warn(f"{job.folder} had other settings: starting again", stacklevel=2)
        shutil.rmtree(job.folder / "checkpoints")
    with contextlib.redirect_stdout(io.StringIO()):
        optimize(xml, data=job.data, config=job.config, overrides=job.overrides, out=job.folder, resume=resume, quiet=quiet)
    if job.figures() is None:
        raise UserError("stopped before its end: the same command goes on")


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

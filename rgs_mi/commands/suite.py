"""A suite of captures, each fitted once and evaluated on its held-out views: tables beside the paper's, and a page. What
`rgs-mi benchmark suite` calls.

    OUT/suite.md, .csv, .json     the paper's tables with ours beside them, every scene's figures; written after each fit
    OUT/suite.html                the same with pictures (`report`)
    OUT/SCENE/                    the runs, as `rgs-mi optimize` makes them
"""

import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from ..fit.scene import FitScene
from ..report import paper_results, write_suite
from ..report.tables import DETAILS, FIGURES, mean, scene_table
from ..settings.config import to_dict
from .jobs import Job, check_names, each_fitted, effort, find_scenes, rows_of, write_tables
from .optimize import budget

NAME = "suite"
_REMARK = (
    "Figures of held-out views, means over views, then scenes. Data sets are told by the names of scenes: those in "
    "scenes/targets have the names of Shiny Blender's, and are not them. The paper's times are of an RTX 3090 Ti."
)


def plan(
    root: str | Path,
    xml: str | Path,
    *,
    scenes: Sequence[str] | None = None,
    config: str | Path | None = None,
    minutes: float | None = None,
    overrides: Sequence[str] = (),
    out: str | Path,
) -> list[Job]:
    """Return the fits of all scenes (arguments: see `fit_suite`).

    Raises: UserError for a scene or setting that does not exist.
    """
    found = find_scenes(root)
    check_names("scene", scenes, found)
    overrides = (*overrides, *budget(minutes))
    settings = {scene: to_dict(FitScene.load(xml, data).settings(config, overrides)) for scene, data in found.items()}
    return [
        Job(
            scene,
            data,
            Path(config).stem if config else "default",
            settings[scene]["seed"],
            config,
            overrides,
            settings[scene],
            Path(out) / scene,
            asked=not scenes or scene in scenes,
        )
        for scene, data in found.items()
    ]


def fit_suite(
    root: str | Path,
    xml: str | Path,
    *,
    scenes: Sequence[str] | None = None,
    config: str | Path | None = None,
    minutes: float | None = None,
    overrides: Sequence[str] = (),
    workers: int = 1,
    scheduler: str | None = None,
    out: str | Path = "runs/suite",
    quiet: bool = False,
) -> int:
    """Fit the scenes that are not yet fitted; write the tables and the page (see the module). Ctrl-C saves; the same call
    then goes on.

    Args:
      root:    a folder of captures, in any layout, and of scenes to path-trace (see `find_scenes`)
      xml:     the scene that is fitted to each of them, scenes/object.xml
      scenes:  names, those to fit (None: all). The tables also show what other calls with the same settings have left in
               ``out``: jobs of a cluster may fit a scene each, and a last call, with nothing left to fit, write the tables
      config, minutes, overrides: preset or file, budget, settings ('a.b=value') of every fit
      workers, scheduler: see `each_fitted`

    Returns: how many scenes failed. Each has its error in the tables, in one line, and does not keep others from being done.
    Raises: UserError where nothing can be done at all; KeyboardInterrupt after Ctrl-C.
    """
    out, errors = Path(out), {}
    jobs = plan(root, xml, scenes=scenes, config=config, minutes=minutes, overrides=overrides, out=out)
    asked = [job for job in jobs if job.asked]
    fits = each_fitted(xml, asked, workers=workers, scheduler=scheduler, quiet=quiet)
    try:
        with closing(fits):
            for job, error in fits:
                if error:
                    errors[job.folder] = str(error)
                    print(f"{job.scene}: {error}", file=sys.stderr)
                elif not quiet:
                    print(f"{job.scene}: finished", flush=True)
                _write(jobs, errors, out)
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here", file=sys.stderr)
        raise
    finally:
        text, paths = _write(jobs, errors, out)
        page = out / f"{NAME}.html"
        write_suite(
            page,
            [
                (job.scene, job.folder if job.figures() else None, errors.get(job.folder))
                for job in jobs
                if job.asked or job.figures()
            ],
            f"Suite {Path(root).resolve().name}",
        )
    print("\n".join([text, "", *map(str, (*paths, page))]))
    return len(errors)


def _write(jobs, errors, out):
    """Write the tables: their text and paths."""
    rows = rows_of(jobs, errors)
    ours = paper_results.means(rows, [job.scene for job in jobs])
    finished = {(row["scene"], row["seed"]): row for row in rows if row["status"] == "finished"}
    listed = [(row["scene"], row) for row in rows]
    if finished:
        listed.append(("mean", {"seed": "", "status": "finished"} | mean(finished, (*FIGURES, *DETAILS))))
    introduction = f"{effort(jobs[0].settings)}; settings: {' '.join([jobs[0].variant, *jobs[0].overrides])}. {_REMARK}"
    sections = ["# Suite", introduction, *paper_results.tables(ours), "## Scenes", scene_table(listed)]
    paths = write_tables(out, NAME, sections, rows, {"means": ours, "paper": paper_results.PAPER})
    return "\n\n".join(sections[1:]), paths

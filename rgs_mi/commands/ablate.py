"""What each part of RGS brings: variants of the settings fitted to a suite of scenes, as tables beside the paper's and as
pictures. What `rgs-mi ablate` calls.

    OUT/ablation.md, .csv, .json     every fit's figures, and means; written again after each fit
    OUT/SCENE.png                    a few test views: ground truth and all variants, normals below
    OUT/SCENE/VARIANT[-SEED]/        the runs, as `rgs-mi optimize` makes them
"""

import itertools
import sys
import warnings
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from ..core.subprocesses import apart
from ..fit.scene import FitScene
from ..report import pictures
from ..report.tables import mean_tables, means, scene_table
from ..settings.config import presets, to_dict
from .jobs import Job, check_names, each_fitted, effort, find_scenes, photographs, rows_of, write_tables
from .optimize import budget


@dataclass(frozen=True)
class Variant:
    """A variant of the settings: a ``preset`` and ``overrides``. ``label`` is its name in tables; ``against`` is the variant
    that it is compared with; it is fitted to the first ``scenes`` of a suite (None: to all), unless it is asked for by
    name."""

    label: str
    preset: str
    overrides: tuple[str, ...] = ()
    against: str = "baseline"
    scenes: int | None = None


#: What surfels at random lack: the shape that masks agree on, and rates for normals that are nearly right.
HULL = ("initialization.hull=true", "initialization.compare=false", "learning_rates.rotations=[2e-3,2e-4]")
#: The shape that photographs agree on, too.
STEREO = (*HULL, "initialization.compare=true")
#: Cross-view shape consistency regularisation; in the paper's loss it stands in the place of 2DGS's own consistency.
CSCR = (
    *STEREO,
    "weights.depth=1e-3",
    "weights.normal=1e-2",
    "weights.crease=0",
    "weights.delta_normal=1e-3",
    "weights.consistency=[0,0]",
    "learning_rates.delta_normal=[1e-3,1e-4]",
    "prior.name=stereo",
)
#: Reflection-guided densification.
RD = ("density.guided=true",)

VARIANTS = {
    "sh2dgs": Variant("2DGS, not deferred", "sh2dgs"),
    "baseline": Variant("deferred 2DGS", "deferred2dgs"),
    "hull": Variant("+ start on the hull", "deferred2dgs", HULL),
    "stereo": Variant("+ start on the carved hull", "deferred2dgs", STEREO),
    "cscr": Variant("+ CSCR", "deferred2dgs", CSCR),
    "rd": Variant("+ RD", "deferred2dgs", RD),
    "full": Variant("full: + CSCR + RD", "deferred2dgs", CSCR + RD),
    "fast": Variant("fast: the defaults", "fast"),
    "lean": Variant(
        "full, at most 11 000 surfels",
        "deferred2dgs",
        (*CSCR, *RD, "initialization.surfels=8000", "density.max_surfels=11000"),
        "baseline",
        2,
    ),
    "paper": Variant("full, multi-view steps (MVGS)", "paper", (), "full", 2),
    "no-indirect": Variant("fast, reflections of the light alone", "fast", ("indirect=none",), "fast", 2),
    "no-depth": Variant("full, no depth prior", "deferred2dgs", (*CSCR, *RD, "weights.depth=0"), "full", 2),
    "no-normal": Variant("full, no L_normal", "deferred2dgs", (*CSCR, *RD, "weights.normal=0"), "full", 2),
    "no-delta-normal": Variant(
        "full, no Δn", "deferred2dgs", (*CSCR, *RD, "weights.delta_normal=0", "learning_rates.delta_normal=[0,0]"), "full", 2
    ),
}

#: The paper's ablation, means over Shiny Blender.
PAPER = {
    "baseline": {"psnr": 33.29, "ssim": 0.967, "surfels": 1.4e6, "render_fps": 132},
    "cscr": {"psnr": 34.54, "ssim": 0.974, "surfels": 0.4e6, "render_fps": 137},
    "rd": {"psnr": 34.63, "ssim": 0.975, "surfels": 0.2e6, "render_fps": 143},
    "full": {"psnr": 35.38, "ssim": 0.976, "surfels": 0.1e6, "render_fps": 146, "normal_mae_deg": 2.04},
}

# ---- What there is to do ----


def known_variants() -> dict[str, Variant]:
    """Return `VARIANTS`, and every preset by its name."""
    return {name: Variant(f"preset {name}", name) for name in presets()} | VARIANTS


def plan(
    suite: str | Path,
    xml: str | Path,
    *,
    scenes: Sequence[str] | None = None,
    variants: Sequence[str] | None = None,
    minutes: float | None = None,
    overrides: Sequence[str] = (),
    seeds: Sequence[int] = (0,),
    out: str | Path,
) -> list[Job]:
    """Return all fits of an ablation, seed by seed and scene by scene (arguments: see `ablate`).

    Raises: UserError for a scene, variant or setting that does not exist.
    """
    found, known = find_scenes(suite), known_variants()
    check_names("scene", scenes, found)
    check_names("variant", variants, known)
    scenes_to_fit = {scene: FitScene.load(xml, data) for scene, data in found.items()}
    jobs = []
    listed = dict.fromkeys([*VARIANTS, *(variants or ())])
    for seed, (k, scene), name in itertools.product(dict.fromkeys(seeds), enumerate(found), listed):
        variant = known[name]
        wanted = name in variants if variants else variant.scenes is None or k < variant.scenes
        changes = (*variant.overrides, *overrides, *budget(minutes), f"seed={seed}")
        jobs.append(
            Job(
                scene,
                found[scene],
                name,
                seed,
                variant.preset,
                changes,
                to_dict(scenes_to_fit[scene].settings(variant.preset, changes)),
                Path(out) / scene / (f"{name}-{seed}" if seed else name),
                asked=wanted and (not scenes or scene in scenes),
            )
        )
    return jobs


# ---- Doing it ----


def ablate(
    suite: str | Path,
    xml: str | Path,
    *,
    scenes: Sequence[str] | None = None,
    variants: Sequence[str] | None = None,
    minutes: float | None = None,
    overrides: Sequence[str] = (),
    seeds: Sequence[int] = (0,),
    workers: int = 1,
    scheduler: str | None = None,
    out: str | Path = "runs/ablation",
    quiet: bool = False,
) -> int:
    """Fit what is not yet fitted; write tables and pictures (see the module). Ctrl-C saves; the same call then goes on.

    Args:
      suite:    a folder of scenes to path-trace, or of captures (see `find_scenes`)
      xml:      the scene that is fitted to each of them, scenes/object.xml
      scenes, variants: names, those to fit (None: all; of `VARIANTS` those for few scenes on these only). The tables also
                show what earlier calls with the same settings have left in ``out``
      minutes, overrides: budget and settings ('a.b=value') of every fit, over what the variants say
      seeds:    each fit is done with each of these
      workers, scheduler: see `each_fitted`

    Returns: how many fits failed. Each has its error in the tables, in one line, and does not keep others from being done.
    Raises: UserError where nothing can be done at all; KeyboardInterrupt after Ctrl-C.
    """
    out, errors = Path(out), {}
    jobs = plan(suite, xml, scenes=scenes, variants=variants, minutes=minutes, overrides=overrides, seeds=seeds, out=out)
    asked = [job for job in jobs if job.asked]
    left = Counter(job.scene for job in asked)
    fits = each_fitted(xml, asked, workers=workers, scheduler=scheduler, quiet=quiet)
    try:
        with closing(fits):
            for job, error in fits:
                if error:
                    errors[job.folder] = str(error)
                    print(f"{job.folder}: {error}", file=sys.stderr)
                left[job.scene] -= 1
                if not left[job.scene]:
                    _picture(job.scene, jobs, errors, xml, out)
                _write(jobs, errors, out)
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here", file=sys.stderr)
        raise
    finally:
        summary, paths = _write(jobs, errors, out)
    print("\n".join([summary, "", *map(str, paths)]))
    return len(errors)


# ---- What comes out ----


def _picture(scene, jobs, errors, xml, out):
    """The picture of the fits of a ``scene`` that are there, with the first seed."""
    there = [j for j in jobs if (j.scene, j.seed) == (scene, jobs[0].seed) and j.folder not in errors and j.figures()]
    if not there:
        return
    try:
        _, views = apart(photographs, xml, there[0].data, there[0].settings["resolution"], True)
        columns = [(known_variants()[job.variant].label, job.figures(), job.folder) for job in there]
        pictures.write(out / f"{scene}.png", views, columns, there[0].settings["background"])
    except Exception as error:  # of a damaged run
        warnings.warn(f"{out / scene}: no picture ({type(error).__name__}: {error})", stacklevel=2)


def _write(jobs, errors, out):
    """Write the tables: the summary of them, and their paths."""
    rows, variants = rows_of(jobs, errors), known_variants()
    table = means(rows, variants)
    summary = f"{_introduction(jobs)}\n\n{mean_tables(table, variants, PAPER)}"
    sections = ["# Ablation", summary]
    for scene in dict.fromkeys(row["scene"] for row in rows):
        sections += [f"## {scene}", scene_table([(variants[r["variant"]].label, r) for r in rows if r["scene"] == scene])]
        sections += [f"![{scene}]({scene}.png)"] * (out / f"{scene}.png").is_file()
    return summary, write_tables(out, "ablation", sections, rows, {"means": table, "paper": PAPER})


def _introduction(jobs):
    seeds = list(dict.fromkeys(job.seed for job in jobs))
    return (
        f"{effort(jobs[0].settings)}; seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))}. Figures of held-out "
        "views: means over views, seeds, scenes. Δ: the difference on the scenes and seeds that both have; in brackets "
        "that of each seed. The paper's are of Shiny Blender."
    )

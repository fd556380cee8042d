"""What each part of RGS brings: variants of the settings fitted to a suite of scenes, as tables beside the paper's and as
pictures. What `scripts/ablate.py` calls.

    OUT/ablation.md, .csv, .json     every fit's figures, and means; written again after each fit
    OUT/SCENE.png                    a few test views: the truth and all variants, normals below
    OUT/SCENE/VARIANT[-SEED]/        the runs, as `scripts/optimize.py` makes them
"""

import contextlib
import csv
import hashlib
import io
import itertools
import json
import shutil
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path

from . import checkpoint, results
from .apart import apart
from .comparison import DETAILS, FIGURES, mean_tables, means, picture, scene_table
from .config import completed, presets, to_dict
from .errors import UserError
from .run import optimize
from .scene import FitScene
from .settings import Settings
from .views import blender


@dataclass(frozen=True)
class Variant:
    """A ``preset`` and ``overrides``. ``against``: the variant that it is compared with; ``scenes``: fitted to so many of
    a suite, the first (None: to all), unless someone asks for it by name."""

    label: str
    preset: str
    overrides: tuple[str, ...] = ()
    against: str = "baseline"
    scenes: int | None = None


#: What surfels at random lack: the shape that views agree on, and rates for normals that are nearly right.
HULL = ("start.hull=true", "rates.rotations=[2e-3,2e-4]")
#: Cross-view shape consistency regularisation; in the paper's loss it stands in the place of 2DGS's own consistency.
CSCR = (*HULL, "weights.depth=1e-3", "weights.normal=1e-2", "weights.crease=0", "weights.delta_normal=1e-3",
        "weights.consistency=[0,0]", "rates.delta_normal=[1e-3,1e-4]", "prior.name=hull")
#: Reflection-guided densification.
RD = ("density.guided=true",)

VARIANTS = {
    "sh2dgs": Variant("2DGS, not deferred", "sh2dgs"),
    "baseline": Variant("deferred 2DGS", "deferred2dgs"),
    "hull": Variant("+ start on the hull", "deferred2dgs", HULL),
    "cscr": Variant("+ CSCR", "deferred2dgs", CSCR),
    "rd": Variant("+ RD", "deferred2dgs", RD),
    "full": Variant("full: + CSCR + RD", "deferred2dgs", CSCR + RD),
    "fast": Variant("fast: the defaults", "fast"),
    "paper": Variant("full, multi-view steps (MVGS)", "paper", (), "full", 2),
    "no-indirect": Variant("fast, reflections of the light alone", "fast", ("indirect=none",), "fast", 2),
    "no-depth": Variant("full, no depth prior", "deferred2dgs", (*CSCR, *RD, "weights.depth=0"), "full", 2),
    "no-normal": Variant("full, no L_normal", "deferred2dgs", (*CSCR, *RD, "weights.normal=0"), "full", 2),
    "no-delta-normal": Variant("full, no Δn", "deferred2dgs",
                               (*CSCR, *RD, "weights.delta_normal=0", "rates.delta_normal=[0,0]"), "full", 2),
}

#: The paper's ablation, means over Shiny Blender.
PAPER = {
    "baseline": {"psnr": 33.29, "ssim": 0.967, "surfels": 1.4e6, "render_fps": 132},
    "cscr": {"psnr": 34.54, "ssim": 0.974, "surfels": 0.4e6, "render_fps": 137},
    "rd": {"psnr": 34.63, "ssim": 0.975, "surfels": 0.2e6, "render_fps": 143},
    "full": {"psnr": 35.38, "ssim": 0.976, "surfels": 0.1e6, "render_fps": 146, "normal_mae_deg": 2.04},
}

_DIGEST = "photographs.sha256"  # in a scene's folder: what its fits are of


# ---- What there is to do ----

@dataclass(frozen=True)
class Job:
    """One fit to the photographs ``data`` of ``scene``, into ``folder``: ``overrides`` over the preset, which make
    ``settings`` (nested dicts). ``asked``: it is to be done now; of the others, what is there is shown."""

    scene: str
    data: Path
    variant: str
    seed: int
    overrides: tuple[str, ...]
    settings: dict
    folder: Path
    asked: bool

    def has(self, saved: dict) -> bool:
        """Whether the settings ``saved`` with a fit are this job's."""
        return completed(Settings, saved) == self.settings

    def figures(self) -> dict | None:
        """metrics.json of the finished fit; None where there is none, or one with other settings."""
        if not results.finished(self.folder):
            return None
        figures = json.loads((self.folder / results.METRICS).read_text())
        return figures if self.has(figures["settings"]) else None


def find_scenes(suite) -> dict[str, Path]:
    """name -> scene file or capture: the ``*.xml`` in the folder ``suite``, and its subfolders in the Blender layout.

    Raises: UserError where there are none.
    """
    suite = Path(suite)
    captures = {path.parent.name: path.parent for path in suite.glob(f"*/{blender.TRAIN}")}
    found = {path.stem: path for path in suite.glob("*.xml")} | captures
    if not found:
        raise UserError(f"{suite} holds neither scenes (*.xml) nor captures (folders with {blender.TRAIN}): "
                        "give a folder of some")
    return dict(sorted(found.items()))


def known_variants() -> dict[str, Variant]:
    """`VARIANTS`, and every preset by its name."""
    return {name: Variant(f"preset {name}", name) for name in presets()} | VARIANTS


def plan(suite, xml, *, scenes=None, variants=None, minutes=None, overrides=(), seeds=(0,), out) -> list[Job]:
    """All fits of an ablation, seed by seed and scene by scene (arguments: see `ablate`).

    Raises: UserError for a scene, variant or setting that does not exist.
    """
    found, known = find_scenes(suite), known_variants()
    for kind, names, there in (("scene", scenes, found), ("variant", variants, known)):
        for name in names or ():
            if name not in there:
                raise UserError(f"no {kind} '{name}': choose from {', '.join(there)}")
    template = FitScene.load(xml, next(iter(found.values())))
    budget = [f"minutes={minutes}", "iterations=null"] if minutes is not None else []
    jobs = []
    shown = dict.fromkeys([*VARIANTS, *(variants or ())])
    for seed, (k, scene), name in itertools.product(dict.fromkeys(seeds), enumerate(found), shown):
        variant = known[name]
        wanted = name in variants if variants else variant.scenes is None or k < variant.scenes
        changes = (*variant.overrides, *overrides, *budget, f"seed={seed}")
        jobs.append(Job(scene, found[scene], name, seed, changes, to_dict(template.settings(variant.preset, changes)),
                        Path(out) / scene / (f"{name}-{seed}" if seed else name),
                        asked=wanted and (not scenes or scene in scenes)))
    return jobs


# ---- Doing it ----

def ablate(suite, xml, *, scenes=None, variants=None, minutes=None, overrides=(), seeds=(0,), out="runs/ablation",
           quiet=False) -> int:
    """Fit what is not yet fitted; write tables and pictures (see the module). Ctrl-C saves; the same call then goes on.

    Args:
      suite:    a folder of scenes to path-trace, or of captures (see `find_scenes`)
      xml:      the scene that is fitted to each of them, scenes/object.xml
      scenes, variants: names, those to fit (None: all; of `VARIANTS` those for few scenes on these only). The tables also
                show what earlier calls with the same settings have left in ``out``
      minutes, overrides: budget and settings ('a.b=value') of every fit, over what the variants say
      seeds:    each fit is done with each of these

    Returns: how many fits failed. Each has its error in the tables, in one line, and does not keep others from being done.
    Raises: UserError where nothing can be done at all; KeyboardInterrupt after Ctrl-C.
    """
    out, errors = Path(out), {}
    jobs = plan(suite, xml, scenes=scenes, variants=variants, minutes=minutes, overrides=overrides, seeds=seeds, out=out)
    asked = [job for job in jobs if job.asked]
    try:
        for _, group in itertools.groupby(asked, lambda job: (job.seed, job.scene)):
            _fit_scene(list(group), jobs, errors, xml, out, quiet)
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here", file=sys.stderr)
        raise
    finally:
        summary = _write(jobs, errors, out)
    print("\n".join([summary, "", *(str(out / f"ablation.{suffix}") for suffix in ("md", "csv", "json"))]))
    return len(errors)


def _fit_scene(group, jobs, errors, xml, out, quiet):
    """The fits of one scene with one seed, and its picture."""
    def failed(job, error):
        errors[job.folder] = str(error)
        print(f"{job.folder}: {error}", file=sys.stderr)

    scene = group[0].scene
    try:
        digest, views = apart(_photographs, xml, group[0].data, quiet)
        _check_photographs(out / scene, digest)
    except UserError as error:
        for job in group:
            failed(job, error)
        _write(jobs, errors, out)
        return
    try:
        for job in group:
            if job.figures() is None:
                if not quiet:
                    print(job.folder, flush=True)
                try:
                    apart(_fit, xml, job, quiet)
                    if job.figures() is None:
                        raise UserError("stopped before its end: the same command goes on")
                except UserError as error:
                    failed(job, error)
                _write(jobs, errors, out)
    finally:
        shown = [(known_variants()[job.variant].label, job.figures(), job.folder) for job in jobs
                 if (job.scene, job.seed) == (scene, jobs[0].seed) and job.folder not in errors and job.figures()]
        try:
            if shown:
                picture(out / f"{scene}.png", views, shown, group[0].settings["background"])
        except Exception as error:  # of a damaged run
            warnings.warn(f"{out / scene}: no picture ({type(error).__name__}: {error})", stacklevel=2)


def _photographs(xml, data, quiet):
    """The scene's photographs, path-traced first where need be: a digest of all, and the test views for the picture."""
    dataset = FitScene.load(xml, data).dataset(quiet)
    digest = hashlib.sha256()
    for view in [*dataset.train, *dataset.test]:
        for part in (view.name.encode(), view.camera.to_world.tobytes(), view.pixels.tobytes()):
            digest.update(part)
    return digest.hexdigest(), results.shown(results.judged(dataset))[::2]


def _check_photographs(folder, digest):
    """Note what the fits below ``folder`` are of. Raises: UserError where those that are there are of other photographs."""
    path = folder / _DIGEST
    if path.is_file() and path.read_text().strip() != digest:
        raise UserError(f"{folder} holds fits to other photographs: delete it, or choose another --out")
    with checkpoint.atomic_file(path) as stream:
        stream.write(f"{digest}\n".encode())


def _fit(xml, job, quiet):
    """Do a job, or go on with it."""
    saved = checkpoint.load_latest(job.folder)
    resume = saved is not None and not results.finished(job.folder) and job.has(saved[1]["settings"])
    if saved and not resume:
        warnings.warn(f"{job.folder} had other settings: starting again", stacklevel=2)
        shutil.rmtree(job.folder / "checkpoints")
    with contextlib.redirect_stdout(io.StringIO()):
        optimize(xml, data=job.data, config=known_variants()[job.variant].preset, overrides=job.overrides, out=job.folder,
                 resume=resume, quiet=quiet)


# ---- What comes out ----

def rows_of(jobs, errors) -> list[dict]:
    """A row (see `comparison`) for each fit that is there or was asked for."""
    rows = []
    for job in jobs:
        error = errors.get(job.folder)
        figures = None if error else job.figures()
        if figures or job.asked:
            status = "failed" if error else "finished" if figures else "missing"
            rows.append({"scene": job.scene, "variant": job.variant, "seed": job.seed, "status": status}
                        | {name: figures and figures[name] for name in (*FIGURES, *DETAILS)} | {"error": error})
    return rows


def _write(jobs, errors, out) -> str:
    """Write the tables; returns the summary."""
    rows, variants = rows_of(jobs, errors), known_variants()
    table = means(rows, variants)
    summary = f"{_introduction(jobs)}\n\n{mean_tables(table, variants, PAPER)}"
    sections = ["# Ablation", summary]
    for scene in dict.fromkeys(row["scene"] for row in rows):
        sections += [f"## {scene}", scene_table([row for row in rows if row["scene"] == scene], variants)]
        sections += [f"![{scene}]({scene}.png)"] * (out / f"{scene}.png").is_file()
    lines = io.StringIO()
    writer = csv.DictWriter(lines, ("scene", "variant", "seed", "status", *FIGURES, *DETAILS, "error"))
    writer.writeheader()
    writer.writerows(rows)
    for suffix, text in {"md": "\n\n".join(sections) + "\n", "csv": lines.getvalue(),
                         "json": json.dumps({"runs": rows, "means": table, "paper": PAPER}, indent=1) + "\n"}.items():
        with checkpoint.atomic_file(out / f"ablation.{suffix}") as stream:
            stream.write(text.encode())
    return summary


def _introduction(jobs):
    settings, seeds = jobs[0].settings, list(dict.fromkeys(job.seed for job in jobs))
    budget = f"{settings['iterations']} steps" if settings["iterations"] else f"{settings['minutes']:g} minutes"
    return (f"{budget} a fit; seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))}. Figures of held-out views: means "
            "over views, seeds, scenes. Δ: the difference on the scenes and seeds that both have; in brackets that of each "
            "seed. The paper's are of Shiny Blender.")

"""How a fit grows with surfels, pixels and photographs: what its start, a step and its memory come to. What
`rgs-mi benchmark growth` calls.

    OUT/growth.csv    a row a measurement; written after each
    OUT/growth.png    the same as curves
"""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from operator import attrgetter
from pathlib import Path

import numpy as np
from skimage.transform import resize

from ..core.files import atomic_file
from ..core.runtime import peak_rss_mb
from ..core.subprocesses import each_apart
from ..datasets.types import Dataset, View
from ..fit.scene import FitScene
from ..report.plots import growth_figure
from ..report.tables import csv_text
from .benchmark import milliseconds, steady_settings
from .optimize import start

_STEPS = 12  # that are timed


@dataclass(frozen=True)
class Load:
    """How large a fit is: its ``surfels``, the pixels of a photograph's longer ``side``, and its training ``views``."""

    surfels: int
    side: int
    views: int


SMALL, LARGE = Load(100_000, 400, 50), Load(1_000_000, 1600, 400)
_MORE = {
    "surfels": (10_000, 30_000, 300_000, LARGE.surfels),
    "side": (200, 800, LARGE.side),
    "views": (100, 200, LARGE.views),
}


@dataclass(frozen=True)
class Cost:
    """What a fit takes: seconds until its first step can be made, ms of a warm step on one view, and the most memory that its
    process held in MiB, all photographs included (None where the system does not say)."""

    start_s: float
    step_ms: float
    memory_mb: float | None


def growth(path: str | Path, data: str | Path, out: str | Path, loads: Sequence[Load] | None = None) -> None:
    """Measure fits of the scene at ``path`` to the photographs in ``data``, enlarged to each of ``loads`` (None: `SMALL`, others
    with less or more of one thing, and `LARGE`), each in a process of its own; print and write them into the folder ``out``.
    The plot shows those that differ from the first in one thing.

    Raises: UserError where a fit fails, one that the system has killed for its memory included, and where nothing can be
    written; what was measured before is there by then.
    """
    out, loads, costs = Path(out), loads or _all_loads(), {}
    print(f"{'surfels':>9}{'side':>7}{'views':>7}{'start':>10}{'step':>11}{'memory':>11}")
    for (*_, load), cost, error in each_apart(measured, [(path, data, load) for load in loads]):
        if error:
            raise error
        costs[load] = cost
        memory = "" if cost.memory_mb is None else f"{cost.memory_mb:8.0f} MB"
        print(f"{load.surfels:9}{load.side:7}{load.views:7}{cost.start_s:8.1f} s{cost.step_ms:8.0f} ms{memory}", flush=True)
        with atomic_file(out / "growth.csv") as stream:
            stream.write(csv_text([asdict(load) | asdict(cost) for load, cost in costs.items()]).encode())
    with atomic_file(out / "growth.png") as stream:
        growth_figure({field.name: _row(costs, field.name, loads[0]) for field in fields(Load)}).savefig(
            stream, format="png", dpi=110
        )


def measured(path: str | Path, data: str | Path, load: Load) -> Cost:
    """Return what a fit of this ``load`` takes here and now (arguments: see `growth`)."""
    scene = FitScene.load(path, data)
    # The light stands still: where the same cameras come again and again, trials would have to tell
    settings = replace(steady_settings(scene, load.surfels), light="world")
    dataset = enlarged(scene.dataset(settings.resolution), load.side, load.views)
    begin = time.perf_counter()
    fit = start(scene, dataset, settings)
    start_s = time.perf_counter() - begin
    fit.step()
    assert fit.photographs, "a step has made them"
    for k in range(load.views):
        fit.photographs.tile(k)
    return Cost(start_s, milliseconds(fit.step, _STEPS + 1), peak_rss_mb())


def enlarged(dataset: Dataset, side: int, views: int) -> Dataset:
    """Return ``dataset`` with so many training ``views``, the same ones again and again, of which the longer ``side`` has so
    many pixels, each in memory of its own; without test views."""
    train = [_of_side(view, side) for view in dataset.train[:views]]
    turns = [divmod(k, len(train)) for k in range(views)]
    copies = [replace(train[k], name=f"{train[k].name}.{turn}", pixels=train[k].pixels.copy()) for turn, k in turns]
    return replace(dataset, train=copies, test=[])


def _of_side(view: View, side: int) -> View:
    width, height = (round(n * side / max(view.camera.size)) for n in view.camera.size)
    pixels = np.asarray(resize(view.pixels, (height, width), order=1, preserve_range=True), view.pixels.dtype)
    return replace(view, camera=view.camera.resized(width, height), pixels=pixels, normal=None)


def _all_loads() -> list[Load]:
    others = [replace(SMALL, **{name: n}) for name, values in _MORE.items() for n in values]
    return [*dict.fromkeys([SMALL, *others, LARGE])]


def _row(costs: dict[Load, Cost], name: str, base: Load) -> dict[str, np.ndarray]:
    """What grows with the part ``name`` of a load alone, from ``base``: {name: its values, field of a cost: [N]}."""
    along = [load for load in costs if replace(load, **{name: getattr(base, name)}) == base]
    along.sort(key=attrgetter(name))
    column = lambda field: np.array([getattr(costs[load], field.name) for load in along], float)
    return {name: np.array([getattr(load, name) for load in along])} | {f.name: column(f) for f in fields(Cost)}

"""Where a step of a fit spends its time: what the kernels of each stage take, and what they would at best.

A stage is a call of some functions; kernels that are launched in it, and time that no kernel takes, are the innermost stage's.
Dr.Jit evaluates late: what feeds a stage and was not evaluated before counts as that stage's.
"""

import functools
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from unittest import mock

import drjit as dr
import drjit.opt
import mitsuba as mi
import numpy as np

from ..datasets.photographs import Photographs
from ..fit import losses, rows
from ..fit.cameras import Cameras
from ..fit.density import DensityControl, Statistics
from ..fit.model import Model
from ..fit.objective import Objective
from ..shading import deferred, prefilter
from ..shading.indirect import Indirect
from ..splat import composite, gbuffer
from ..splat.intersect import TileIntersections
from ..surfels import surfels

#: Stage -> its functions: (where they are looked up, name).
STAGES = {
    "photograph": ((Photographs, "tile"),),
    "environment's filters": ((prefilter, "apply"), (prefilter._Apply, "backward")),
    "projection": ((Model, "in_view"), (Model, "take"), (deferred, "render_gbuffer")),
    "lists": ((gbuffer, "isect_tiles"),),
    "forward": ((gbuffer, "composite"),),
    "shading": ((deferred, "shade"),),
    "reflected rays": ((Indirect, "incident_radiance"),),
    "losses": (
        (Objective, "__call__"),
        (Objective, "environment"),
        (losses._Blur, "backward"),
        (losses._Shifted, "backward"),
        (surfels._Split, "backward"),
    ),
    "shading, back": ((composite.Planes, "backward"), (composite, "_gather_image")),
    "backward": ((composite.Composite, "backward"),),
    "projection, back": ((Statistics, "add"), (rows._Columns, "backward"), (Model, "gradients")),
    "density control": ((DensityControl, "note_reflective"), (DensityControl, "refine")),
    "optimizer": ((rows.Rows, "step"), (drjit.opt.Optimizer, "step")),
    "cameras": ((Cameras, "see"), (Cameras, "step")),
}
REST = "the rest"
_LANES = 1 << 22  # of the kernels that measure the machine
_CHAIN = 256  # operations in a row, of each of four chains


@dataclass
class Stage:
    """What a stage took in one step: ``kernels`` that it launched, their time and the time ``cpu`` of all threads, sorting,
    sums, NumPy and waiting included, in ms; ``at_best``: what the kernels would take if they did nothing but compute, or
    nothing but stream their arrays once."""

    kernels: float = 0.0
    kernel: float = 0.0
    cpu: float = 0.0
    at_best: float = 0.0


def machine() -> tuple[float, float]:
    """Return how many operations (multiplications with additions, of one lane) this machine does in a ms with the threads that
    Dr.Jit has, and how many bytes it moves."""
    x = dr.opaque(mi.Float, 1.0, _LANES)
    y = [x * (k + 1) for k in range(4)]

    def compute():
        values = y
        for _ in range(_CHAIN):
            values = [dr.fma(v, 0.999, 0.001) for v in values]
        dr.eval(sum(values))

    def stream():
        dr.eval(x + 1)

    def fastest(call):
        seconds = []
        for _ in range(5):
            dr.sync_thread()
            begin = time.process_time()
            call()
            dr.sync_thread()
            seconds.append(time.process_time() - begin)
        return 1e3 * min(seconds[1:])

    return 4 * _CHAIN * _LANES / fastest(compute), 8 * _LANES / fastest(stream)


@contextmanager
def _one_thread() -> Iterator[None]:
    """A pool of one thread: CPU time then is work, where others that wait for work would count as well."""
    threads = dr.thread_count()
    dr.set_thread_count(1)
    try:
        yield
    finally:
        dr.set_thread_count(threads)


class _Watch:
    """Attributes to the innermost stage what happens between entering and leaving stages."""

    def __init__(self, rates):
        self.stages = {name: Stage() for name in (*STAGES, REST)}
        self._rates, self._inside = rates, [REST]
        self._blocks, self._listed = 0, 1.0  # blocks of pixels, and surfels that each lists in the mean: a loop's rounds
        self._cpu = time.process_time()

    def account(self):
        """Book what has happened since the last call."""
        dr.sync_thread()
        stage, cpu = self.stages[self._inside[-1]], time.process_time()
        history = dr.kernel_history()
        stage.cpu += 1e3 * (cpu - self._cpu)
        stage.kernel += sum(k["execution_time"] for k in history)
        jit = [k for k in history if k["type"] == dr.KernelType.JIT]
        stage.kernels += len(jit)
        for k in jit:
            rounds = self._listed if k["size"] == self._blocks else 1
            compute = rounds * k["operation_count"] * k["size"] / self._rates[0]
            stream = 4 * (k["input_count"] + k["output_count"]) * k["size"] / self._rates[1]
            stage.at_best += max(compute, stream)
        self._cpu = time.process_time()

    def watched(self, function: Callable, name: str) -> Callable:
        """``function``, as the stage ``name``."""

        @functools.wraps(function)
        def call(*args, **kwargs):
            self.account()
            self._inside.append(name)
            try:
                result = function(*args, **kwargs)
                if isinstance(result, TileIntersections):
                    self._blocks = dr.width(result.count)
                    self._listed = float(np.mean(result.count.numpy()))
                return result
            finally:
                self.account()
                self._inside.pop()

        return call


def profile(step: Callable[[], object], steps: int) -> dict[str, Stage]:
    """Return what each stage takes in the mean of so many calls of ``step``, on one thread."""
    with _one_thread(), ExitStack() as stack:
        rates = machine()
        for _ in range(2):
            step()
        stack.enter_context(dr.scoped_set_flag(dr.JitFlag.KernelHistory, True))
        dr.sync_thread()
        dr.kernel_history_clear()
        watch = _Watch(rates)
        for name, functions in STAGES.items():
            for owner, attribute in functions:
                watched = watch.watched(getattr(owner, attribute), name)
                stack.enter_context(mock.patch.object(owner, attribute, watched))
        for _ in range(steps):
            step()
        watch.account()
    for stage in watch.stages.values():
        for field in ("kernels", "kernel", "cpu", "at_best"):
            setattr(stage, field, getattr(stage, field) / steps)
    return watch.stages


def table(stages: dict[str, Stage]) -> str:
    """Return the ``stages`` as lines, the longest first, and their sum."""
    rows = sorted(stages.items(), key=lambda item: -item[1].cpu)
    total = Stage(*(np.sum([[s.kernels, s.kernel, s.cpu, s.at_best] for s in stages.values()], 0)))
    lines = [f"{'ms, one thread':24}{'CPU':>9}{'kernels':>10}{'at best':>10}{'launched':>10}"]
    lines += [
        f"{name:24}{s.cpu:9.1f}{s.kernel:10.1f}{s.at_best:10.1f}{s.kernels:10.1f}" for name, s in [*rows, ("sum", total)]
    ]
    return "\n".join(lines)

"""How long things take: the splatter against another implementation, and a step of a fit. What `rgs-mi benchmark`
calls; all times are medians of warm calls, in milliseconds."""

import re
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.camera import Camera
from ..core.errors import UserError
from ..fit.scene import FitScene
from ..fit.trainer import Fit
from ..settings.settings import Settings
from ..splat.composite import Layout, composite
from ..splat.intersect import isect_tiles
from ..splat.project import project
from ..surfels.surfels import Surfels, rotation_from_normal
from . import step_profile
from .optimize import start

STAGES = ("lists", "forward", "backward")
FEATURES = 9
_FOV = 39.598  # degrees: 0.6911112 rad, Blender's default camera
_REPEAT = 5


def milliseconds(call: Callable[[], object], repeat: int = _REPEAT) -> float:
    """Return the median time of so many calls, but for the first one."""
    times = []
    for _ in range(repeat):
        dr.sync_thread()
        begin = time.perf_counter()
        call()
        dr.sync_thread()
        times.append(time.perf_counter() - begin)
    return 1e3 * float(np.median(times[1:]))


# ---- Splatter ----


def sphere(count: int, seed: int = 0) -> Surfels:
    """Return ``count`` random surfels on the unit sphere, which cover it about four times."""
    rng = np.random.default_rng(seed)
    unit = lambda v: v / np.linalg.norm(v, axis=1, keepdims=True)
    centers = unit(rng.normal(size=(count, 3)))
    normals = unit(centers + 0.05 * rng.normal(size=(count, 3)))
    scales = 0.6 * np.sqrt(4 * np.pi / count) * np.exp(0.3 * rng.normal(size=(count, 2)))
    opacities = 1 / (1 + np.exp(-1.5 * rng.normal(size=(count, 1)) - 1))
    grey, zero = np.full((count, 3), 0.5), np.zeros((count, 3))
    return Surfels.from_numpy(
        {
            "centers": centers,
            "rotations": rotation_from_normal(normals),
            "scales": scales,
            "opacities": opacities,
            "sh": zero,
            "base_color": grey,
            "roughness": grey[:, :1],
            "metallic": zero[:, :1],
            "delta_normal": zero,
        }
    )


def splat_times(surfels: Surfels, size: int) -> dict[str, float]:
    """Return the times of `STAGES` in ms for an image of ``size`` x ``size`` pixels: the intersections of tiles,
    compositing, and its derivative by geometry and features."""
    camera = Camera.look_at((0, 0, 4), (0, 0, 0), (0, 1, 0), _FOV, (size, size))
    rng = np.random.default_rng(1)
    projected = project(surfels, camera)
    features = [mi.Float(rng.uniform(size=len(surfels)).astype(np.float32)) for _ in range(FEATURES)]
    dr.eval(projected.geometry, projected.visible, features)
    layout = Layout(camera.size, FEATURES)
    adjoint = mi.Float(rng.normal(size=size * size * layout.pixel).astype(np.float32))
    times = {"lists": milliseconds(lambda: isect_tiles(projected, camera.size, layout.cutoffs))}
    lists = isect_tiles(projected, camera.size, layout.cutoffs)
    times["forward"] = milliseconds(lambda: dr.eval(composite(projected, features, lists, layout)))

    inputs = [*projected.geometry, *features]
    seconds = []
    for _ in range(_REPEAT):
        dr.enable_grad(inputs)
        dr.clear_grad(inputs)
        image = composite(projected, features, lists, layout)
        dr.sync_thread()
        begin = time.perf_counter()
        dr.backward_from(image * adjoint)
        dr.eval([dr.grad(v) for v in inputs])
        dr.sync_thread()
        seconds.append(time.perf_counter() - begin)
        dr.disable_grad(inputs)
    return times | {"backward": 1e3 * float(np.median(seconds[1:]))}


def other_times(script: str | Path, count: int, size: int) -> dict[str, float]:
    """Return the times of `STAGES` in ms that ``script --surfels N --res R`` prints, as 'forward   12.3 ms'.

    Raises: UserError where it does not print one of them.
    """
    command = [sys.executable, str(script), "--surfels", str(count), "--res", str(size)]
    done = subprocess.run(command, capture_output=True, text=True)
    found = {name: float(value) for name, value in re.findall(r"^(\w+)\s+([\d.]+) ms", done.stdout, re.MULTILINE)}
    if missing := [name for name in STAGES if name not in found]:
        reason = (done.stderr.strip().splitlines() or ["no such line"])[-1]
        raise UserError(f"{script}: prints no time of '{missing[0]}' ({reason}): expected lines 'forward   12.3 ms'")
    return {name: found[name] for name in STAGES}


def splat(count: int = 50_000, size: int = 800, against: str | Path | None = None, rounds: int = 3) -> None:
    """Print the times of the splatter, and of the script ``against`` measured in turns with it."""
    surfels = sphere(count)
    ours, others = [], []
    for _ in range(rounds):
        ours.append(splat_times(surfels, size))
        if against:
            others.append(other_times(against, count, size))
    print(f"{count} surfels, {size} x {size} pixels, {FEATURES} channels and depth, medians of {rounds} rounds, ms")
    rows = {name: [np.median([t[name] for t in table]) for table in (ours, others) if table] for name in STAGES}
    rows["total"] = np.sum(list(rows.values()), 0)
    print(f"{'':10}{'rgs_mi':>10}" + (f"{'other':>10}{'ratio':>10}" if against else ""))
    for name, row in rows.items():
        ratio = f"{row[1] / row[0]:9.2f}x" if against else ""
        print(f"{name:10}" + "".join(f"{value:10.1f}" for value in row) + ratio)


# ---- Step ----


def steady_settings(scene: FitScene, count: int, overrides: Sequence[str] = ()) -> Settings:
    """Return the settings of a fit of ``scene`` with ``count`` surfels, of which all steps are alike: one view at full
    resolution, all harmonics, as many surfels as at first; ``overrides`` come over them."""
    return scene.settings(
        None,
        [
            f"initialization.surfels={count}",
            "iterations=10000000",
            "density.start=1",
            "sh_start=0",
            "stages=[{until: 1, downscale: 1, views: 1}]",
            *overrides,
        ],
    )


def step(
    path: str | Path, data: str | Path | None, count: int = 15_000, steps: int = 20, overrides: Sequence[str] = ()
) -> None:
    """Print the time of a fit's step on one view at full resolution with ``count`` surfels, and the kernels that were
    compiled after warm-up (which a fit of constant size should not need); and of each of its stages what it takes."""
    scene = FitScene.load(path, data)
    settings = steady_settings(scene, count, overrides)
    fit: Fit = start(scene, scene.dataset(settings.resolution), settings)
    for _ in range(len(fit.dataset.train)):  # loads each photograph once
        fit.step()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        time_of_step = milliseconds(fit.step, steps + 1)
        kernels = dr.kernel_history((dr.KernelType.JIT,))
    compiled = sum(not k["cache_hit"] or k["cache_disk"] for k in kernels)
    width, height = fit.dataset.train[0].camera.size
    print(
        f"{len(fit.model)} surfels, {width} x {height} pixels: {time_of_step:.1f} ms a step, "
        f"{len(kernels) / (steps + 1):.0f} kernels a step, {compiled} compiled after warm-up"
    )
    print(step_profile.table(step_profile.profile(fit.step, steps)))

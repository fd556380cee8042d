"""A fit by several processes: the same as one with as many views a step, and going on when one of them is killed."""

import json
import os
import signal
from dataclasses import fields, replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rgs_mi.fit.ranks import Ranks
from rgs_mi.settings.settings import LearningRates, Stage

from ranks_steps import LEARNED, stepped
from runs import PATIENCE, ROOT, SMALL, start, wait_for

pytest.importorskip("torch", reason="needs PyTorch: pip install torch")


def torchrun(*words, **options):
    """Two processes, started as a user does."""
    environment = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tests'}"}
    return start("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", 2, *words, env=environment, **options)


def test_alone_everything_is_its_own():
    ranks, array = Ranks(), mi.Float(1, 2)
    assert ranks.mean([array])[0] is array and ranks.gather(5) == [5] and ranks.same("x") == "x"
    with ranks.sharing_cores():
        assert dr.thread_count() > 0


def test_two_processes_are_one_with_twice_the_views(tmp_path):
    """Cameras, exposures and density control included; each has the same model at the end. Adam makes steps as long as its
    rate of the least gradient, which rounds in another way: most numbers are the same, and none is far."""
    process = torchrun(ROOT / "tests" / "ranks_steps.py", tmp_path / "two.npz")
    assert process.wait(PATIENCE) == 0
    with np.load(tmp_path / "two.npz") as two:
        found = dict(two)
    assert found["same"] and found["apart"] < 1e-5
    rates = LEARNED.learning_rates
    scaled = {f.name: tuple(np.sqrt(2) * np.array(getattr(rates, f.name))) for f in fields(LearningRates)}
    own = {name: getattr(rates, name) for name in ("poses", "intrinsics", "exposure")}  # of a row, which no more views have
    one = stepped(replace(LEARNED, learning_rates=LearningRates(**scaled | own), stages=(Stage(1.0, 1, 2),)), Ranks())
    arrays, _ = one.state()
    assert found["psnr"] == pytest.approx(one.psnr, abs=0.01) and len(one.model) > 300
    for name, expected in arrays.items():
        apart, size = np.abs(found[name].astype(float) - expected.astype(float)), np.abs(expected).mean()
        limit = 5e-3 if "intrinsics" in name else 1e-3  # of eight numbers nearly the largest
        assert np.quantile(apart, 0.95) <= limit * size + 1e-7, name
    other, _ = stepped(LEARNED, Ranks()).state()
    assert other["centers"].shape != arrays["centers"].shape or np.abs(other["centers"] - arrays["centers"]).max() > 1e-3


def test_goes_on_after_one_was_killed(inputs, tmp_path):
    scene, data = inputs
    words = [word for setting in [*SMALL, "iterations=150"] for word in ("--set", setting)]
    command = [
        "--max-restarts",
        1,
        ROOT / "scripts" / "optimize.py",
        scene,
        "--data",
        data,
        "--out",
        tmp_path / "run",
        *words,
    ]
    with open(tmp_path / "said", "w") as said:
        process = torchrun(*command, stdout=said, stderr=said)
        wait_for(lambda: len(list((tmp_path / "run" / "checkpoints").glob("step_*.npz"))) > 1, process)
        os.kill(second_of(process), signal.SIGKILL)
        code = process.wait(PATIENCE)
    words = (tmp_path / "said").read_text()
    assert code == 0, words
    figures = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert figures["finished"] and figures["iterations"] == 150 and figures["psnr"] > 15
    assert "another one of this fit has ended" in words


def second_of(process):
    """The number of the process of rank 1 that ``process``, a torchrun, has started."""
    for path in Path("/proc").glob("[0-9]*"):
        try:
            words = dict(w.partition("=")[::2] for w in (path / "environ").read_text().split("\0"))
            parent = int((path / "stat").read_text().rpartition(")")[2].split()[1])
        except (OSError, ValueError):
            continue
        if words.get("RANK") == "1" and parent == process.pid:
            return int(path.name)
    raise AssertionError("no second process")

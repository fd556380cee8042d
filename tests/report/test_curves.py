"""Curves of a run: their file, their plots, and the event files of TensorBoard."""

import json
import re
import sys

import numpy as np
import pytest

from rgs_mi.core.errors import UserError
from rgs_mi.fit.curves import STRETCHES, Curves
from rgs_mi.report import plots

from pages import SMALL, metrics


def test_curves_of_a_run(run):
    lines = (run / "curves.csv").read_text().splitlines()
    rows = [dict(zip(lines[0].split(","), line.split(","))) for line in lines[1:]]
    assert [int(row["step"]) for row in rows] == list(range(1, 13))
    assert [row["pixels"] for row in rows] == ["16"] * 6 + ["32"] * 6
    assert {"loss.photometric", "loss.mask", "loss.consistency", "loss.normal", "loss.minimum_variation"} <= set(rows[0])
    assert all(float(row["ms"]) > 0 and float(row["psnr"]) > 0 and int(row["surfels"]) > 0 for row in rows)
    assert float(rows[-1]["seconds"]) == pytest.approx(metrics(run)["train_seconds"])


def test_curves_average_stretches():
    curves, steps = Curves(), 10 * STRETCHES
    complete = [
        curves.add(k / steps, {"step": k}, {"psnr": float(k), "ms": float("nan") if k % 2 else 1.0}) for k in range(steps)
    ]
    assert len(curves.rows) == sum(complete) == STRETCHES and curves.rows[-1]["step"] == steps - 10
    assert curves.rows[2] == {"step": 20, "psnr": np.mean(range(11, 21)), "ms": 1.0}


def test_curves_survive_a_checkpoint(inputs):
    """And with a longer budget, which makes the progress go back, more rows follow."""
    from rgs_mi.commands.optimize import start
    from rgs_mi.fit.scene import FitScene
    from rgs_mi.fit.trainer import Fit

    scene = FitScene.load(*inputs)
    settings = scene.settings(None, SMALL)
    dataset = scene.dataset(quiet=True)
    fit = start(scene, dataset, settings)
    fit.step()
    arrays, meta = fit.state()
    again = Fit.resume(dataset, scene.settings(None, [*SMALL, "iterations=600"]), arrays, json.loads(json.dumps(meta)))
    assert again.step() and [row["step"] for row in again.curves.rows] == [1, 2]
    assert [row["step"] for row in fit.curves.rows] == [1]


# ---- Plots ----


def test_plots():
    """Decades from below, what has no logarithm left out; the same SVG each time, without names of its own."""
    series = {"a": ([0, 1, 2], [1, 10, float("nan")]), "b <": ([0, 2], [0.1, 0.0])}
    (axes,) = plots.draw(series, "x", "y", {"bound": 5}, {"mark": 1}, 0.0, True).axes
    assert [line.get_xydata().tolist() for line in axes.lines[:2]] == [[[0, 1], [1, 10]], [[0, 0.1]]]
    assert axes.get_yscale() == "log" and axes.get_xlim()[0] == 0 and axes.get_ylim()[0] <= 0.1
    text = plots.curves(series, "x", "y <", {"bound": 5}, {"mark": 1}, log=True)
    assert text == plots.curves(series, "x", "y <", {"bound": 5}, {"mark": 1}, log=True)
    assert "b &lt;" in text and 'aria-label="y &lt; over x"' in text and "nan" not in text
    assert all(word in text for word in ("bound", "mark", ">0.1<", ">10<")) and not re.search(r' id="[\w.]+_\d', text)


@pytest.mark.parametrize("series", [{"constant": ([1, 2], [0, 0])}, {"nothing": ([], [])}, {}])
@pytest.mark.parametrize("log", [False, True])
def test_plots_of_little(series, log):
    assert plots.curves(series, "x", "y", log=log).startswith("<svg")


# ---- TensorBoard ----


def test_event_files(run):
    from tensorboardX.proto.event_pb2 import Event

    (path,) = (run / "tensorboard").glob("events.out.tfevents.*")
    data, events = path.read_bytes(), []
    while data:
        length = int.from_bytes(data[:8], "little")
        events.append(Event.FromString(data[12 : 12 + length]))
        data = data[16 + length :]
    scalars = {(event.step, value.tag): value.simple_value for event in events for value in event.summary.value}
    lines = (run / "curves.csv").read_text().splitlines()
    names = lines[0].split(",")
    for line in lines[1:]:
        row = {name: float(cell) for name, cell in zip(names, line.split(",")) if cell}  # some begin later
        assert all(
            scalars.pop((row["step"], name.replace(".", "/"))) == pytest.approx(value)
            for name, value in row.items()
            if name != "step"
        )
    assert not scalars


def test_tensorboard_is_missing(inputs, tmp_path, monkeypatch):
    from rgs_mi.commands.optimize import optimize

    monkeypatch.setitem(sys.modules, "tensorboardX.event_file_writer", None)
    with pytest.raises(UserError, match="pip install tensorboardX"):
        optimize(inputs[0], data=inputs[1], out=tmp_path / "run", overrides=SMALL, quiet=True, tensorboard=True)
    assert not (tmp_path / "run").exists()

"""Ablations: what is fitted, going on, failures, and the tables."""

import csv
import json
import os
import shutil
import signal
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from rgs_mi.commands import ablate, jobs
from rgs_mi.core import subprocesses
from rgs_mi.core.errors import UserError
from rgs_mi.fit import checkpoint
from rgs_mi.fit.scene import FitScene
from rgs_mi.report import results, tables

from runs import PATIENCE, ROOT, TARGET, make_suite, start, start_script, wait_for

SMALL = ["iterations=6", "initialization.surfels=200", "stages=[{views: 2}]", "density.refine_every=3", "density.start=0"]


@pytest.fixture(scope="module")
def suite(inputs, tmp_path_factory):
    """(scene to fit, folder of the captures 'one' and 'two')."""
    return make_suite(*inputs, tmp_path_factory.mktemp("suite"), "one", "two")


def call(suite, out, **options):
    scene, captures = suite
    return ablate.ablate(captures, scene, out=out, **{"overrides": SMALL, "quiet": True} | options)


def read(out):
    return json.loads((out / "ablation.json").read_text())


# ---- Plan ----


def settings(suite, variant):
    scene, captures = suite
    v = ablate.VARIANTS[variant]
    return FitScene.load(scene, captures / "one").settings(v.preset, v.overrides)


def test_paper_is_baseline_both_parts_and_multi_view_steps(suite):
    scene = FitScene.load(suite[0], suite[1] / "one")
    paper, full = settings(suite, "paper"), settings(suite, "full")
    assert [s.views for s in paper.stages] == [48, 24, 12, 4] and [s.downscale for s in paper.stages] == [8, 4, 2, 1]
    assert replace(paper, stages=full.stages) == full != settings(suite, "cscr") != settings(suite, "baseline")
    assert all(v.against in ablate.VARIANTS for v in ablate.VARIANTS.values())
    assert all(scene.settings(v.preset, v.overrides) for v in ablate.known_variants().values())


def test_plan(suite, tmp_path):
    scene, captures = suite
    whole = ablate.plan(captures, scene, seeds=[0, 2], out=tmp_path, minutes=3)
    assert len(whole) == 2 * 2 * len(ablate.VARIANTS) and all(job.asked for job in whole)
    assert len({job.folder for job in whole}) == len(whole)
    assert whole[0].folder == tmp_path / "one" / "sh2dgs" and whole[-1].folder == tmp_path / "two" / "no-delta-normal-2"
    assert {job.settings["minutes"] for job in whole} == {3} and whole[-1].settings["seed"] == 2
    some = ablate.plan(captures, scene, scenes=["two"], variants=["full", "preview"], out=tmp_path)
    assert [job.folder.relative_to(tmp_path).parts for job in some if job.asked] == [("two", "full"), ("two", "preview")]


def test_leave_one_out_on_two_scenes(suite, tmp_path):
    scene, captures = suite
    for name in ("one", "two", "three"):
        (tmp_path / name).symlink_to(captures / "one")
    plan = ablate.plan(tmp_path, scene, out=tmp_path)
    assert [job.scene for job in plan if job.asked and job.variant == "no-depth"] == ["one", "three"]  # by name
    plan = ablate.plan(tmp_path, scene, variants=["no-depth"], out=tmp_path)
    assert [job.scene for job in plan if job.asked] == ["one", "three", "two"]


def test_scenes_are_found(tmp_path):
    (tmp_path / "ball.xml").write_text(TARGET)
    (tmp_path / "include").mkdir()
    (tmp_path / "include" / "setup.xml").write_text("<scene version='3.0.0'/>")
    assert jobs.find_scenes(tmp_path) == {"ball": tmp_path / "ball.xml"}
    assert list(jobs.find_scenes(ROOT / "scenes" / "targets")) == ["ball", "car", "coffee", "helmet", "teapot", "toaster"]


@pytest.mark.parametrize(
    "options, message",
    [
        ({"scenes": ["tree"]}, "no scene 'tree': choose from one, two"),
        ({"variants": ["ful"]}, "no variant 'ful'"),
        ({"overrides": ["densty.start=0.1"]}, "did you mean"),
    ],
)
def test_mistakes(suite, tmp_path, options, message):
    with pytest.raises(UserError, match=message):
        call(suite, tmp_path, **options)
    assert not list(tmp_path.iterdir())


# ---- Fits ----


def test_goes_on(suite, tmp_path, inside, capsys):
    options = {"scenes": ["one"], "variants": ["baseline", "full"]}
    assert call(suite, tmp_path, **options) == 0
    assert inside == ["one/baseline", "one/full"]
    assert "full: + CSCR + RD" in capsys.readouterr().out
    first = read(tmp_path)
    assert [r["status"] for r in first["runs"]] == ["finished"] * 2
    metrics = json.loads((tmp_path / "one" / "full" / "metrics.json").read_text())
    assert all(first["runs"][1][name] == metrics[name] for name in (*tables.FIGURES, *tables.DETAILS))

    (tmp_path / "one.png").unlink()
    assert call(suite, tmp_path, **options) == 0 and len(inside) == 2
    assert read(tmp_path) == first
    sheet = np.asarray(Image.open(tmp_path / "one.png"))[..., :3]  # 3 columns; 2 test views, images and normals
    assert sheet.shape[1] == 3 * 268 + 40 and sheet.shape[0] > 4 * 260
    assert sheet.std(axis=(0, 1)).min() > 10

    shutil.copytree(tmp_path / "one" / "baseline", tmp_path / "two" / "baseline")
    assert call(suite, tmp_path, scenes=["two"], variants=["baseline"]) == 0 and len(inside) == 2
    assert [r["scene"] for r in read(tmp_path)["runs"]] == ["one", "one", "two"]  # the tables tell of all that is there
    call(suite, tmp_path, scenes=["one"], variants=["full"], overrides=[*SMALL, "iterations=2"])
    assert json.loads((tmp_path / "one" / "full.1" / "metrics.json").read_text()) == metrics
    assert inside[2:] == ["one/full"] and [r["iterations"] for r in read(tmp_path)["runs"]] == [2]

    file = tmp_path / "one" / "full" / "metrics.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"digests": {"photographs": "others"}}))
    assert call(suite, tmp_path, **options) == 1 and len(inside) == 3
    assert ["other photographs" in (r["error"] or "") for r in read(tmp_path)["runs"] if r["scene"] == "one"] == [
        False,
        True,
    ]


def test_failures_are_told(suite, tmp_path, inside, monkeypatch, capsys):
    scene, captures = suite
    (tmp_path / "suite" / "bad").mkdir(parents=True)
    (tmp_path / "suite" / "bad" / "transforms_train.json").write_text("{")
    (tmp_path / "suite" / "good").symlink_to(captures / "one")
    optimize = jobs.optimize

    def explode(xml, **options):
        if "weights.depth=0" in options["overrides"]:
            raise UserError("out | of luck")
        return optimize(xml, **options)

    monkeypatch.setattr(jobs, "optimize", explode)
    assert call((scene, tmp_path / "suite"), tmp_path / "out", variants=["no-depth", "full"]) == 3
    rows = {(r["scene"], r["variant"]): r for r in read(tmp_path / "out")["runs"]}
    assert [r["status"] for r in rows.values()] == ["failed", "failed", "finished", "failed"]
    assert "malformed JSON" in rows["bad", "full"]["error"] and rows["good", "no-depth"]["error"] == "out | of luck"
    assert rows["good", "no-depth"]["psnr"] is None and rows["good", "full"]["psnr"] > 5
    assert "out \\| of luck" in (tmp_path / "out" / "ablation.md").read_text()
    assert "out | of luck" in capsys.readouterr().err


def test_stopped_and_gone_on(suite, tmp_path, monkeypatch):
    """In processes of their own: Ctrl-C, one that is killed, and the same command again."""
    scene, captures = suite
    command = [
        captures,
        "--scenes",
        "one",
        "--variants",
        "baseline",
        "--out",
        tmp_path / "out",
        "--quiet",
        "--set",
        "initialization.surfels=200",
        "--set",
        "stages=[{views: 2}]",
        "--set",
        "checkpoint_seconds=0",
    ]
    monkeypatch.chdir(tmp_path)
    process = start_script("ablate.py", *command, "--set", "iterations=1000000")
    run = tmp_path / "out" / "one" / "baseline"
    wait_for(lambda: any((run / "checkpoints").glob("step_*[1-9].npz")), process)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130 and "same command goes on" in error and "Traceback" not in error, error
    reached = checkpoint.load_latest(run)[1]["step"]
    assert reached > 0 and read(tmp_path / "out")["runs"][0]["status"] == "missing"

    # as if the plan had been to end soon after that
    retold(max(run.glob("checkpoints/*.npz")), iterations=reached + 2)
    process = start_script("ablate.py", *command, "--set", f"iterations={reached + 2}")
    out, error = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0 and "starting again" not in error and "deferred 2DGS" in out, error
    assert read(tmp_path / "out")["runs"][0]["iterations"] == reached + 2


def retold(path, **changes):
    """Change the settings in a checkpoint."""
    arrays, meta = checkpoint._load(path)
    meta["settings"] |= changes
    checkpoint.save(path.parents[1], arrays, meta)


def kill_myself():
    os.kill(os.getpid(), signal.SIGKILL)


def crash():
    return 1 / 0


def no_luck():
    raise UserError("no luck")


def test_apart(capfd):
    assert subprocesses.apart(divmod, 7, 2) == (3, 1)
    for function, message in (
        (kill_myself, "SIGKILL, perhaps for want of memory"),
        (no_luck, "^no luck$"),
        (crash, "ZeroDivisionError: division by zero"),
    ):
        with pytest.raises(UserError, match=message):
            subprocesses.apart(function)
    assert "in crash" in capfd.readouterr().err  # a bug shows where it is


PARENT = """
import sys, time
from pathlib import Path
import rgs_mi
from rgs_mi.core.subprocesses import apart
from rgs_mi.core.interrupt import GracefulInterrupt

def wait(path):
    with GracefulInterrupt() as interrupt:
        path.write_text("waiting")
        while interrupt.signal is None:
            time.sleep(0.02)
    path.write_text("saved")

if __name__ == "__main__":
    rgs_mi.set_variant()
    apart(wait, Path(sys.argv[1]))
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_saves_when_its_parent_ends(tmp_path, number):
    script, file = tmp_path / "parent.py", tmp_path / "file"
    script.write_text(PARENT)
    process = start(script, file, stderr=subprocess.DEVNULL)
    wait_for(lambda: file.is_file() and file.read_text() == "waiting", process)
    process.send_signal(number)
    wait_for(lambda: file.read_text() == "saved")
    process.wait(10)


# ---- Tables ----


def row(scene, variant, seed=0, status="finished", **figures):
    return {
        "scene": scene,
        "variant": variant,
        "seed": seed,
        "status": status,
        "error": None,
        **dict.fromkeys((*tables.FIGURES, *tables.DETAILS)),
        **figures,
    }


def test_means():
    """Scenes weigh alike however many seeds they have; differences are of what both variants have."""
    rows = [
        row("a", "baseline", 0, psnr=20.0, normal_mae_deg=8.0),
        row("a", "baseline", 1, psnr=22.0, normal_mae_deg=6.0),
        row("b", "baseline", 0, psnr=30.0),
        row("c", "baseline", 0, psnr=40.0, normal_mae_deg=2.0),
        row("a", "full", 0, psnr=23.0, normal_mae_deg=5.0),
        row("a", "full", 1, psnr=26.0, normal_mae_deg=4.0),
        row("b", "full", 0, psnr=31.0, normal_mae_deg=1.0),
        row("c", "full", 0, "failed"),
        row("a", "no-depth", 0, psnr=22.0, normal_mae_deg=7.0),
    ]
    table = tables.means(rows, ablate.VARIANTS)
    assert list(table) == ["baseline", "full", "no-depth"]
    assert table["baseline"]["scenes"] == 3 and table["baseline"]["psnr"] == pytest.approx((21 + 30 + 40) / 3)
    assert table["baseline"]["normal_mae_deg"] == pytest.approx((7 + 2) / 2)
    assert table["baseline"]["difference"]["psnr"] is None
    full = table["full"]
    assert full["scenes"] == 2 and full["psnr"] == pytest.approx((24.5 + 31) / 2)
    assert full["difference"]["psnr"] == pytest.approx(((3 + 4) / 2 + 1) / 2)
    assert full["difference"]["normal_mae_deg"] == pytest.approx(-2.5) and full["ssim"] is None
    assert full["difference_by_seed"][0]["psnr"] == pytest.approx(2) and full["difference_by_seed"][1]["psnr"] == 4
    assert table["no-depth"]["against"] == "full" and table["no-depth"]["difference"]["psnr"] == -1

    text = tables.mean_tables(table, ablate.VARIANTS, ablate.PAPER)
    cells = [[cell.strip() for cell in line.split("|")] for line in text.splitlines() if line]
    lines = {line[1]: line[2:-1] for line in cells}
    assert lines["full: + CSCR + RD"] == [
        "2",
        "27.75",
        "",
        "",
        "2.75°",
        "",
        "",
        "",
        "+2.25 (+2.00, +4.00)",
        "",
        "",
        "-2.50° (-3.00°, -2.00°)",
        "35.38",
        "+2.09",
        "0.976",
        "2.04°",
        "100 000",
    ]
    header = cells[0][1:-1]
    assert header[:5] == ["Δ: to deferred 2DGS", "scenes", "PSNR, dB", "SSIM", "LPIPS"] and "time, min" in header
    assert lines["deferred 2DGS"][-5:] == ["33.29", "", "0.967", "", "1 400 000"]
    assert lines["full, no depth prior"] == ["1", "22.00", "", "", "7.00°", "", "", "", "-1.00", "", "", "+2.00°"]
    assert len({len(line) for line in text.split("\n\n")[0].splitlines()}) == 1  # aligned


def test_table_files(suite, tmp_path):
    """The files say what the runs say."""
    scene, captures = suite
    plan = ablate.plan(captures, scene, variants=["baseline", "rd"], out=tmp_path)
    for k, job in enumerate(job for job in plan if job.asked):
        job.folder.mkdir(parents=True)
        figures = dict.fromkeys((*tables.FIGURES, *tables.DETAILS), k + 1.5)
        (job.folder / results.METRICS).write_text(json.dumps(figures | {"finished": True, "settings": job.settings}))
    ablate._write(plan, {plan[1].folder: "=an, error"}, tmp_path)
    with open(tmp_path / "ablation.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [tuple(r[name] for name in ("scene", "variant", "psnr", "error")) for r in rows] == [
        ("one", "baseline", "", "'=an, error"),  # no formula
        ("one", "rd", "2.5", ""),
        ("two", "baseline", "3.5", ""),
        ("two", "rd", "4.5", ""),
    ]
    told = read(tmp_path)
    assert told["means"]["rd"]["psnr"] == 3.5 and told["means"]["rd"]["difference"]["psnr"] == 1
    text = (tmp_path / "ablation.md").read_text()
    assert "## one" in text and "an, error" in text and "34.63" in text and "8 minutes a fit; seed 0" in text

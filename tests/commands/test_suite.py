"""Suites: which scenes there are, what is fitted, workers, failures, and the paper's tables."""

import csv
import gc
import json
import os
import signal
import struct
import time
from multiprocessing.connection import Connection

import drjit as dr
import pytest

from rgs_mi.commands import jobs, suite
from rgs_mi.core import subprocesses
from rgs_mi.core.errors import UserError
from rgs_mi.fit import checkpoint
from rgs_mi.report import paper_results, results, tables

from captures import photographs, write_colmap, write_nerfstudio, write_nero
from runs import PATIENCE, make_suite, start_script, wait_for

SMALL = ["iterations=6", "initialization.surfels=200", "stages=[{views: 2}]", "density.stop=0"]


@pytest.fixture(scope="module")
def captures(inputs, tmp_path_factory):
    """(scene to fit, folder of the captures 'car' and 'helmet')."""
    return make_suite(*inputs, tmp_path_factory.mktemp("suite"), "car", "helmet")


def call(captures, out, **options):
    scene, root = captures
    return suite.fit_suite(root, scene, out=out, **{"overrides": SMALL, "quiet": True} | options)


def read(out):
    return json.loads((out / "suite.json").read_text())


# ---- Scenes ----


def test_captures_of_all_layouts_are_found(captures, tmp_path):
    for name, write in (("a", write_colmap), ("b", write_nerfstudio), ("c", write_nero)):
        (tmp_path / name).mkdir()
        write(tmp_path / name, photographs(3))
    (tmp_path / "d").symlink_to(captures[1] / "car")
    (tmp_path / "e.xml").write_text("<scene version='3.0.0'/>")
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "readme.txt").write_text("none")
    assert list(jobs.find_scenes(tmp_path)) == ["a", "b", "c", "d", "e"]


@pytest.mark.parametrize("root", ["empty", "missing"])
def test_no_scenes(tmp_path, root):
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=rf"{root} holds neither scenes .* nor captures .*transforms_train.json.*COLMAP"):
        jobs.find_scenes(tmp_path / root)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"scenes": ["tree"]}, "no scene 'tree': choose from car, helmet"),
        ({"config": "quick"}, "no preset 'quick'"),
        ({"overrides": ["densty.start=0.1"]}, "did you mean"),
        ({"workers": 0}, "at least 1"),
        ({"minutes": -1}, "between"),
    ],
)
def test_mistakes(captures, tmp_path, options, message):
    with pytest.raises(UserError, match=message):
        call(captures, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


# ---- Fits ----


def test_goes_on(captures, tmp_path, inside, capsys):
    out = tmp_path / "out"
    assert call(captures, out, scenes=["helmet"]) == 0 and inside == ["helmet/default"]
    assert [(r["scene"], r["status"]) for r in read(out)["runs"]] == [("helmet", "finished")]
    assert read(out)["means"]["Shiny Blender"]["scenes"] == 1
    assert call(captures, out) == 0 and inside == ["helmet/default", "car/default"]  # as another job of a cluster would
    first = read(out)
    metrics = json.loads((out / "car" / "metrics.json").read_text())
    assert first["runs"][0]["scene"] == "car"
    assert all(first["runs"][0][name] == metrics[name] for name in (*tables.FIGURES, *tables.DETAILS))
    assert (
        first["means"]["Shiny Blender"]["psnr"] == pytest.approx(sum(r["psnr"] for r in first["runs"]) / 2)
        and first["means"]["Shiny Blender"]["of"] == 6
    )

    text = capsys.readouterr().out
    (out / "suite.md").unlink()
    assert call(captures, out) == 0 and len(inside) == 2 and read(out) == first  # all is done: tables alone
    text = capsys.readouterr().out
    assert "this run, scenes 2 of 6" in text and "35.38" in text and "iterations=6" in text
    assert text.split("## Scenes")[0].strip() in (out / "suite.md").read_text()
    page = (out / "suite.html").read_text()
    assert "helmet" in page and "car" in page
    with open(out / "suite.csv", newline="") as stream:
        assert [float(r["psnr"]) for r in csv.DictReader(stream)] == [r["psnr"] for r in first["runs"]]

    call(captures, out, scenes=["car"], overrides=[*SMALL, "iterations=2"])
    assert inside[2:] == ["car/default"] and [(r["scene"], r["iterations"]) for r in read(out)["runs"]] == [("car", 2)]
    assert json.loads((out / "car.1" / "metrics.json").read_text()) == metrics  # what was finished is not lost
    (out / "car" / "metrics.json").unlink()  # nor is what was begun
    with pytest.warns(UserWarning, match=r"car had other settings: it is .*car\.2 now"):
        call(captures, out, scenes=["car"], overrides=[*SMALL, "iterations=3"])
    assert checkpoint.load_latest(out / "car.2")[1]["step"] == 2


DAMAGES = ["{", "[1]", '{"finished": true}', '{"finished": true, "settings": 3}', "\xff", "[" * 100000]


def test_a_damaged_run_ends_no_suite(captures, tmp_path, inside):
    """Its checkpoints are gone on with."""
    out = tmp_path / "out"
    call(captures, out, scenes=["helmet"])
    for content in DAMAGES:
        (out / "helmet" / "metrics.json").write_text(content)
        assert results.saved_figures(out / "helmet") is None
    assert call(captures, out, scenes=["helmet"]) == 0 and [r["status"] for r in read(out)["runs"]] == ["finished"]
    assert inside == ["helmet/default"] * 2


def test_failures_are_told(captures, tmp_path, inside, capsys):
    root = tmp_path / "root"
    (root / "bad").mkdir(parents=True)
    (root / "bad" / "transforms_train.json").write_text("{")
    (root / "car").symlink_to(captures[1] / "car")
    out = tmp_path / "out"
    (out / "car").mkdir(parents=True)
    others = {"finished": True, "settings": {}, "digests": {"photographs": "others"}}
    (out / "car" / "metrics.json").write_text(json.dumps(others))
    assert call((captures[0], root), out) == 2 and inside == []
    rows = read(out)["runs"]
    assert [r["status"] for r in rows] == ["failed"] * 2
    assert "malformed JSON" in rows[0]["error"] and "other photographs" in rows[1]["error"]
    assert "malformed JSON" in (out / "suite.md").read_text() and "malformed JSON" in (out / "suite.html").read_text()
    assert "bad: " in capsys.readouterr().err

    (out / "car" / "metrics.json").unlink()
    assert call((captures[0], root), out) == 1 and inside == ["car/default"]
    assert [r["status"] for r in read(out)["runs"]] == ["failed", "finished"]


def test_stopped_and_gone_on(captures, tmp_path, monkeypatch):
    """Two at a time in processes of their own: Ctrl-C saves both, and the same command goes on."""
    command = [
        "suite",
        captures[1],
        "--out",
        tmp_path / "out",
        "--quiet",
        "--workers",
        "2",
        "--set",
        "initialization.surfels=200",
        "--set",
        "stages=[{views: 2}]",
        "--set",
        "checkpoint_seconds=0",
        "--set",
        "density.stop=0",
    ]
    monkeypatch.chdir(tmp_path)
    process = start_script("benchmark.py", *command, "--set", "iterations=1000000")
    runs = [tmp_path / "out" / name for name in ("car", "helmet")]
    wait_for(lambda: all(any((run / "checkpoints").glob("step_*[1-9].npz")) for run in runs), process)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130 and "same command goes on" in error and "Traceback" not in error, error
    for run in runs:
        assert checkpoint.load_latest(run)[1]["step"] > 0 and not (run / results.METRICS).exists()
    assert [r["status"] for r in read(tmp_path / "out")["runs"]] == ["missing"] * 2


def work(name, seconds):
    start = time.monotonic()
    time.sleep(seconds)
    if name == "bad":
        raise UserError("no luck")
    return start, time.monotonic(), dr.thread_count(), os.getpid()


def test_workers(monkeypatch):
    monkeypatch.setattr(subprocesses, "cores", lambda: 8)
    calls = [("a", 4), ("bad", 0.1), ("c", 0.1)]
    ended = list(subprocesses.each_apart(work, calls, 2))
    assert sorted(arguments for arguments, _, _ in ended) == sorted(calls)
    told = {arguments[0]: (value, error) for arguments, value, error in ended}
    assert told["bad"][0] is None and str(told["bad"][1]) == "no luck" and told["a"][1] is told["c"][1] is None
    (a, _), (c, _) = told["a"], told["c"]
    assert a[2] == c[2] == 4 and len({a[3], c[3], os.getpid()}) == 3


# ---- Tables ----


def half_a_word():
    """Die in the middle of sending what came out."""
    for found in gc.get_objects():
        if isinstance(found, Connection) and not found.closed and found.writable:
            os.write(found.fileno(), struct.pack("!i", 1000) + b"half")
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_worker_that_dies_in_the_middle_of_a_word():
    with pytest.raises(UserError, match="killed by SIGKILL, perhaps for want of memory"):
        subprocesses.apart(half_a_word)


def test_data_sets_by_name():
    assert paper_results.by_data_set(["ball", "teapot", "helmet"]) == {"Shiny Blender": ["ball", "helmet", "teapot"]}
    assert paper_results.by_data_set(["cat_blender", "luyu", "teapot"])["Glossy Synthetic"] == [
        "cat_blender",
        "luyu",
        "teapot",
    ]
    assert paper_results.by_data_set(["lego", "sedan", "bottle"]) == {"NeRF Synthetic": ["lego"], "Ref-NeRF Real": ["sedan"]}
    assert paper_results.by_data_set([]) == {}


def test_every_row_of_the_paper_fits_its_table():
    for title, (data_sets, figures) in paper_results.TABLES.items():
        assert all(
            len(rows) == len(data_sets) and all(len(row) == len(figures) for row in rows)
            for rows in paper_results.PAPER[title].values()
        )


def row(scene, status="finished", **figures):
    return {
        "scene": scene,
        "variant": "fast",
        "seed": 0,
        "status": status,
        "error": None,
        **dict.fromkeys((*tables.FIGURES, *tables.DETAILS)),
        **figures,
    }


def test_tables():
    ours = paper_results.means(
        [
            row(
                "ball",
                psnr=30.0,
                ssim=0.9,
                surfels=40_000,
                train_seconds=600.0,
                render_fps=20.0,
                peak_rss_mb=900.0,
                normal_mae_deg=3.0,
            ),
            row("car", psnr=32.0, ssim=0.92, normal_mae_deg=4.0),
            row("toaster", "failed"),
            row("lego", psnr=27.0),
            row("bottle", psnr=1.0),
        ],
        ["ball", "car", "toaster", "lego", "bottle", "sedan"],
    )
    assert list(ours) == ["Shiny Blender", "NeRF Synthetic"] and ours["Shiny Blender"]["psnr"] == 31
    sections = paper_results.tables(ours)
    assert [s for s in sections if s.startswith("## ")] == [
        "## Reflective objects",
        "## NeRF Synthetic",
        "## Normals, Shiny Blender",
        "## Budget, Shiny Blender",
    ]
    lines = [[c.strip() for c in line.split("|")[1:-1]] for line in "\n".join(sections).splitlines() if "|" in line]
    assert lines[0] == ["", "Shiny Blender: PSNR, dB", "Shiny Blender: SSIM", "Shiny Blender: LPIPS"]
    of = [line[1:] for line in lines if line[0] == "RGS, the paper"]
    assert of == [
        ["35.38", "0.976", "0.050"],
        ["33.51", "0.968", "0.028"],
        ["2.04°", "0.954", "0.051"],
        ["100 000", "180", "146", "", "35.38"],
    ]
    mine = [line for line in lines if line[0].startswith("this run")]
    assert mine == [
        ["this run, scenes 2 of 6", "31.00", "0.910", ""],
        ["this run, scenes 1 of 8", "27.00", "", ""],
        ["this run, scenes 2 of 6", "3.50°", "", ""],
        ["this run, scenes 2 of 6", "40 000", "10", "20", "900", "31.00"],
    ]
    assert paper_results.tables(paper_results.means([row("bottle", psnr=1.0)], ["bottle"])) == []
    lone = [row("teapot", psnr=30.0)]  # of the data set that the others of the suite are of
    assert list(paper_results.means(lone, ["teapot", "ball"])) == ["Shiny Blender"]
    assert list(paper_results.means(lone, ["teapot", "angel"])) == ["Glossy Synthetic"]

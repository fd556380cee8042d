"""A run that is judged again: the same figures as the fit's, what stays, and bad input."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from rgs_mi.commands import evaluate
from rgs_mi.core.errors import UserError
from rgs_mi.evaluation import lpips
from rgs_mi.evaluation.evaluate import SCORES

SMALL = ["iterations=20", "initialization.surfels=300", "stages=[{views: 2}]", "indirect_start=0"]
QUALITY = ("psnr", "ssim", "normal_mae_deg", "normal_ssim")


@pytest.fixture(scope="module")
def run(inputs, tmp_path_factory):
    return fit(inputs, tmp_path_factory.mktemp("runs") / "ball")


@pytest.fixture
def copy(run, tmp_path):
    """A run to do harm to."""
    return shutil.copytree(run, tmp_path / "run")


def fit(inputs, out, *overrides, **options):
    from rgs_mi.commands.optimize import optimize

    scene, data = inputs
    return optimize(scene, data=data, out=out, overrides=[*SMALL, *overrides], quiet=True, **options)


def metrics(folder):
    return json.loads((folder / "metrics.json").read_text())


def change(folder, **figures):
    (folder / "metrics.json").write_text(json.dumps(metrics(folder) | figures))


def assert_same(again, before, rel=1e-4):
    for name in QUALITY:
        assert again[name] == pytest.approx(before[name], rel=rel), name
    for name in ("train_seconds", "iterations", "settings", "command", "versions", "machine", "surfels", "finished"):
        assert again[name] == before[name], name
    assert list(again["views"]) == list(before["views"])


def test_same_figures(inputs, copy):
    before = metrics(copy)
    change(copy, psnr=1.0, views={name: v | {"psnr": 1.0} for name, v in before["views"].items()})
    for name in ("contact_sheet.png", "test/r_1.png", "report.html"):
        (copy / name).unlink()
    returned = evaluate.reevaluate(copy, quiet=True)
    again = metrics(copy)
    assert_same(again, before)
    assert returned["psnr"] == again["psnr"] and before["psnr"] > 10
    assert again["views"]["r_1"]["psnr"] == pytest.approx(before["views"]["r_1"]["psnr"], rel=1e-4)
    assert again["render_fps"] > 0 and again["evaluated"]["machine"] == before["machine"]
    assert all((copy / name).is_file() for name in ("contact_sheet.png", "test/r_1.png", "report.html"))
    assert_same(evaluate.reevaluate(copy, inputs[1], quiet=True), before)  # again, and with the folder given


def test_cameras_that_were_learned(inputs, tmp_path):
    """Held-out views keep the place that was found for them; the figures without it are beside."""
    settings = ["cameras=learned", "exposure=learned", "cameras_start=0", "iterations=40"]
    folder = fit(inputs, tmp_path / "run", *settings)
    before, rows = metrics(folder), json.loads((folder / "cameras.json").read_text())
    assert before["test_cameras"] == "pose and exposure fitted to every other of 4 x 4 parts"
    assert len(rows["train"]) == 12 and len(rows["evaluated"]) == 3
    assert all(row["to_world"] != row["given"] for split in ("train", "evaluated") for row in rows[split].values())
    assert before["cameras"]["rotation_deg"]["max"] > 0 and before["cameras"]["exposure_ev"]["max"] > 0
    again = evaluate.reevaluate(folder, quiet=True)
    assert_same(again, before)
    assert again["psnr_unaligned"] == pytest.approx(before["psnr_unaligned"], rel=1e-4)
    assert before["psnr"] > before["psnr_unaligned"]
    assert (
        before["views"]["r_1"].keys() >= {"psnr", "psnr_unaligned"} and "turned by" in (folder / "report.html").read_text()
    )
    (folder / "cameras.json").write_text('{"views": {}}')
    with pytest.raises(UserError, match="cameras.json: damaged"):
        evaluate.reevaluate(folder, quiet=True)


@pytest.mark.parametrize(
    "overrides, options",
    [
        (["monte_carlo_start=0"], {"xml": 'type="rgs_deferred"><string name="specular" value="monte_carlo"/>'}),
        (["shader=mlp"], {"variables": {"diffuse": "lit"}}),
        (["background=0.25", "sh_start=0", "indirect=none"], {}),
        (["specular_start=1"], {}),
    ],
)
def test_whatever_the_shading(inputs, tmp_path, overrides, options):
    scene, data = inputs
    other = tmp_path / "other.xml"
    other.write_text(scene.read_text().replace('type="rgs_deferred">', options.pop("xml", 'type="rgs_deferred">')))
    folder = fit((other, data), tmp_path / "run", *overrides, **options)
    before = metrics(folder)
    assert_same(evaluate.reevaluate(folder, quiet=True), before)


def test_samples_per_pixel_are_those_of_the_scene(copy):
    before, scene = metrics(copy), copy / "scene.xml"
    assert before["settings"]["spp"] == 4
    assert scene.read_text().count('name="sample_count" value="4"') == before["test_views"]
    scene.write_text(scene.read_text().replace('name="sample_count" value="4"', 'name="sample_count" value="1"'))
    again = evaluate.reevaluate(copy, quiet=True)
    assert again["psnr"] != pytest.approx(before["psnr"], abs=1e-3)
    assert again["psnr"] == pytest.approx(before["psnr"], abs=1)


def test_the_scene_is_what_is_judged(copy):
    """Not the checkpoints, which may be gone: another environment shows."""
    before = metrics(copy)
    shutil.rmtree(copy / "checkpoints")
    shutil.copy(dark_environment(copy), copy / "environment.exr")
    assert evaluate.reevaluate(copy, quiet=True)["psnr"] < before["psnr"] - 0.3


def dark_environment(folder):
    import mitsuba as mi

    path = folder / "dark.exr"
    mi.Bitmap(np.array(mi.Bitmap(str(folder / "environment.exr"))) * np.float32(0.3)).write(str(path))
    return path


def test_weights_that_came_later(copy, monkeypatch):
    """And those that went."""
    monkeypatch.setattr(lpips, "installed", lambda: True)
    monkeypatch.setattr(lpips, "distance", lambda *_: 0.25)
    figures = evaluate.reevaluate(copy, quiet=True)
    assert figures["lpips"] == figures["normal_lpips"] == figures["views"]["r_2"]["lpips_alex"] == 0.25
    assert figures["lpips_reason"] is None
    monkeypatch.setattr(lpips, "installed", lambda: False)
    figures = evaluate.reevaluate(copy, quiet=True)
    assert figures["lpips"] == figures["views"]["r_2"]["lpips"] == 0.25 and figures["lpips_reason"] is None
    assert metrics(copy) == figures


def test_nothing_held_out(inputs, tmp_path):
    scene, data = inputs
    capture = shutil.copytree(data, tmp_path / "capture")
    (capture / "transforms_test.json").unlink()
    folder = fit((scene, capture), tmp_path / "run")
    figures = evaluate.reevaluate(folder, quiet=True)
    assert all(figures[name] is None for name in SCORES) and figures["views"] == {}
    assert figures["train_seconds"] == metrics(folder)["train_seconds"] > 0


def test_stopped_fit(copy):
    change(copy, finished=False)
    assert evaluate.reevaluate(copy, quiet=True)["finished"] is False


def other_size(capture):
    for path in capture.glob("test/r_0*.png"):
        Image.open(path).resize((16, 16)).save(path)


def moved(capture):
    path = capture / "transforms_test.json"
    meta = json.loads(path.read_text())
    meta["frames"][1]["transform_matrix"][0][3] += 0.2
    path.write_text(json.dumps(meta))


def fewer(capture):
    path = capture / "transforms_test.json"
    meta = json.loads(path.read_text())
    path.write_text(json.dumps(meta | {"frames": meta["frames"][1:]}))


@pytest.mark.parametrize("harm", [other_size, moved, fewer])
def test_other_photographs(inputs, copy, tmp_path, harm):
    capture = shutil.copytree(inputs[1], tmp_path / "capture")
    harm(capture)
    before = (copy / "metrics.json").read_bytes()
    with pytest.raises(UserError, match="capture: its test views are not those of"):
        evaluate.reevaluate(copy, capture, quiet=True)
    assert (copy / "metrics.json").read_bytes() == before


@pytest.mark.parametrize(
    "damage, message",
    [
        (lambda run: (run / "metrics.json").unlink(), "metrics.json: missing, damaged"),
        (lambda run: (run / "metrics.json").write_text("[1, 2]"), "not of a run"),
        (lambda run: (run / "metrics.json").write_text("{"), "damaged"),
        (lambda run: change(run, train_seconds="long"), "'train_seconds' is not what a fit writes"),
        (lambda run: change(run, settings={"background": "sky"}), "no background"),
        (lambda run: change(run, settings={"background": 7}), "no background"),
        (lambda run: change(run, photographs=None), "does not say where the photographs are: give their folder with --data"),
        (lambda run: change(run, photographs="/nowhere"), "'/nowhere' does not exist: give a capture's folder with --data"),
        (lambda run: (run / "scene.xml").unlink(), "no scene at"),
        (lambda run: (run / "object.ply").write_bytes(b"ply"), "object.ply: "),
        (lambda run: (run / "curves.csv").write_text("a,b\nc,d\n"), "curves.csv: damaged"),
    ],
)
def test_damaged_runs(copy, damage, message):
    damage(copy)
    with pytest.raises(UserError, match=message) as caught:
        evaluate.reevaluate(copy, quiet=True)
    assert "\n" not in str(caught.value)

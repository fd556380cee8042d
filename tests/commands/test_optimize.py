"""The command line: what a run leaves behind, going on after a crash, and mistakes that cost one line each."""

import json
import re
import shutil
import signal
import subprocess
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from rgs_mi import report
from rgs_mi.commands.evaluate import reevaluate
from rgs_mi.commands.export import export
from rgs_mi.core.alignment import Similarity
from rgs_mi.core.errors import UserError
from rgs_mi.fit import checkpoint, walls
from rgs_mi.fit.scene import FitScene
from rgs_mi.fit.trainer import Fit
from rgs_mi.surfels.ply import read_ply

from readers import glb_splats
from runs import PATIENCE, ROOT, SMALL, assert_renders_as_written, start, start_script, wait_for

SHOWN = ("psnr", "ssim", "lpips", "normal_mae_deg", "surfels", "iterations", "train_seconds", "render_fps", "peak_rss_mb")


@pytest.fixture(scope="module")
def run(inputs, tmp_path_factory):
    """The folder of a finished run."""
    scene, data = inputs
    return fit(scene, data, tmp_path_factory.mktemp("runs") / "ball")


def fit(scene, data, out, overrides=SMALL, **options):
    from rgs_mi.commands.optimize import optimize

    return optimize(scene, data=data, out=out, overrides=overrides, quiet=True, **options)


def metrics(folder):
    return json.loads((folder / "metrics.json").read_text())


def test_metrics(run):
    figures = metrics(run)
    assert figures["finished"] and figures["iterations"] == 20 and figures["surfels"] > 0
    assert all(name in figures for name in SHOWN)
    assert (figures["lpips"] is None) == bool(figures["lpips_reason"])
    assert figures["psnr"] > 10 and figures["normal_mae_deg"] < 30
    assert figures["settings"]["initialization"]["surfels"] == 300
    assert list(figures["views"]) == ["r_0", "r_1", "r_2"]
    assert figures["psnr"] == pytest.approx(np.mean([v["psnr"] for v in figures["views"].values()]))


def test_files(run):
    for name in ("object.ply", "environment.exr", "scene.xml", "contact_sheet.png", "test/r_0_compare.png"):
        assert (run / name).stat().st_size > 0
    maps = mi.Bitmap(str(run / "test" / "r_0_gbuffer.exr"))
    names = [field.name for field in maps.struct_()]
    normal, alpha = (
        np.array(maps)[..., [names.index(n) for n in pick]]
        for pick in (["sh_normal.X", "sh_normal.Y", "sh_normal.Z"], ["alpha.Y"])
    )
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), alpha[..., 0], atol=1e-4)
    assert not [p for p in run.rglob("*.tmp")]


def test_exported_scene_renders_the_same(run):
    scene = mi.load_file(str(run / "scene.xml"), parallel=False)
    np.testing.assert_array_equal(
        np.array(mi.traverse(scene)["environment.data"])[:, 1:-1], np.array(mi.Bitmap(str(run / "environment.exr")))
    )
    assert len(scene.sensors()) == 3
    assert_renders_as_written(scene, run)


@pytest.mark.parametrize("preset", ["paper", "deferred2dgs", "sh2dgs", "mirror"])
def test_presets(inputs, tmp_path, preset):
    folder = fit(*inputs, tmp_path / "run", config=preset, overrides=[*SMALL, "iterations=3"])
    assert (folder / "guided.png").exists() == (preset == "paper")
    assert_renders_as_written(mi.load_file(str(folder / "scene.xml"), parallel=False), folder)


def test_indirect_light_is_exported(inputs, tmp_path):
    folder = fit(*inputs, tmp_path / "run", overrides=[*SMALL, "indirect=one_bounce", "indirect_start=0"])
    scene = mi.load_file(str(folder / "scene.xml"), parallel=False)
    assert scene.integrator().indirect == "one_bounce"
    assert_renders_as_written(scene, folder)


@pytest.mark.parametrize(
    "old, new",
    [
        ('type="rgs_deferred">', 'type="rgs_deferred"><string name="specular" value="none"/>'),
        ('type="rgs_deferred">', 'type="rgs_deferred"><string name="specular" value="monte_carlo"/>'),
        ('<default name="diffuse" value="relightable"/>', '<default name="diffuse" value="lit"/>'),
        ('<default name="diffuse" value="relightable"/>', '<default name="diffuse" value="radiance"/>'),
        ('<bsdf type="principled" id="material"/>', '<bsdf type="principled"><float name="eta" value="2.5"/></bsdf>'),
    ],
)
def test_shading_is_the_scenes(inputs, tmp_path, old, new):
    scene, data = inputs
    other = tmp_path / "other.xml"
    other.write_text(scene.read_text().replace(old, new))
    folder = fit(other, data, tmp_path / "run", overrides=[*SMALL, "iterations=3"])
    assert_renders_as_written(mi.load_file(str(folder / "scene.xml"), parallel=False), folder)


def test_photographs_without_masks(inputs, tmp_path):
    """RGB files: the fit starts from random points, and from surroundings; what is in a box reflects."""
    scene, data = inputs
    for path in data.glob("transforms_*.json"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    for path in data.glob("*/r_*[0-9].png"):
        (tmp_path / path.parent.name).mkdir(exist_ok=True)
        white = Image.new("RGBA", Image.open(path).size, "white")
        white.alpha_composite(Image.open(path))
        white.convert("RGB").save(tmp_path / path.parent.name / path.name)
    process = start_script(
        "optimize.py",
        scene,
        "--data",
        tmp_path,
        "--out",
        tmp_path / "run",
        "--quiet",
        *(
            word
            for setting in [
                *SMALL,
                "iterations=30",
                "density.refine_every=10",
                "density.start=0",
                "sh_start=0.2",
                "initialization.surroundings=100",
            ]
            for word in ("--set", setting)
        ),
    )
    _, error = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0 and error == "", error
    figures = metrics(tmp_path / "run")
    assert figures["finished"] and figures["psnr"] > 8 and figures["normal_mae_deg"] is None
    scene = mi.load_file(str(tmp_path / "run" / "scene.xml"), parallel=False)
    assert 1 < scene.integrator().box.radius < 6
    assert np.linalg.norm(mi.traverse(scene)["object.centers"].numpy(), axis=1).max() > 10
    assert_renders_as_written(scene, tmp_path / "run")


def test_a_world_that_is_far_from_its_origin(inputs, tmp_path):
    """The run is in a world near by, and says where that is; boxes are given, and formats written, in the capture's."""
    scene, data = inputs
    shift = np.array([1e5, -2e5, 300.0])
    shutil.copytree(data, tmp_path / "data")
    for path in (tmp_path / "data").glob("transforms_*.json"):
        meta = json.loads(path.read_text())
        for frame in meta["frames"]:
            frame["transform_matrix"] = Similarity(1.0, np.eye(3), shift).pose(np.array(frame["transform_matrix"])).tolist()
        path.write_text(json.dumps(meta))
    box = [*(shift - 2).tolist(), *(shift + 3).tolist()]
    out = fit(scene, tmp_path / "data", tmp_path / "far", [*SMALL, f"box={box}"])
    figures = metrics(out)
    assert figures["origin"] == pytest.approx(shift, abs=3) and figures["settings"]["box"] == box
    near = fit(scene, data, tmp_path / "near", [*SMALL, "box=[-2,-2,-2,3,3,3]"])
    assert figures["psnr"] == pytest.approx(metrics(near)["psnr"], abs=0.3)
    mean = lambda folder: read_ply(folder / "object.ply")["centers"].mean(0)
    assert mean(out) + figures["origin"] - shift == pytest.approx(mean(near), abs=0.05)
    reevaluate(out, quiet=True)
    assert metrics(out)["psnr"] == pytest.approx(figures["psnr"], abs=1e-3)
    (splats,) = export(out, "splat", quiet=True)
    (origin,) = re.findall(rb"comment origin (.*)", splats.read_bytes())
    assert [float(x) for x in origin.split()] == figures["origin"]
    (glb,) = export(out, "gltf-splat", quiet=True)
    x, y, z = figures["origin"]
    assert glb_splats(glb)[1]["nodes"][0]["translation"] == pytest.approx([x, z, -y])
    (out / "metrics.json").write_text((out / "metrics.json").read_text().replace('"origin": [', '"origin": ["a", '))
    with pytest.raises(UserError, match="origin is no point"):
        export(out, "splat", quiet=True)


def test_render(run, tmp_path):
    from rgs_mi.export.render import AOVS, render_scene

    (file,) = render_scene(run, view="r_1", size=20, spp=4, aovs=True, out=tmp_path / "one.png")
    assert Image.open(file).size == (20, 20) and Image.open(file).mode == "RGBA"
    channels = [field.name for field in mi.Bitmap(str(file.with_suffix(".exr"))).struct_()]
    assert {name.split(".")[0] for name in channels} == {*AOVS, "R", "G", "B", "A"}
    frames = render_scene(run, turntable=3, size=16, out=tmp_path / "turn", quiet=True)
    alpha = [np.asarray(Image.open(frame))[..., 3] for frame in frames]
    assert len(frames) == 3 and all(a.max() > 200 and a.min() == 0 for a in alpha)
    with pytest.raises(UserError, match="no view 'r_9'"):
        render_scene(run, view="r_9", out=tmp_path)


def test_resume_after_a_crash(inputs, tmp_path, monkeypatch, capsys):
    step = Fit.step

    def crash(self):
        if self.step_number == 12:
            raise RuntimeError("lights out")
        step(self)

    monkeypatch.setattr(Fit, "step", crash)
    with pytest.raises(RuntimeError):
        fit(*inputs, tmp_path)
    monkeypatch.undo()
    with pytest.raises(UserError, match="--resume"):
        fit(*inputs, tmp_path)
    assert checkpoint.load_latest(tmp_path)[1]["step"] == 12 and not (tmp_path / "metrics.json").exists()
    fit(*inputs, tmp_path, overrides=[*SMALL, "weights.mask=0.2"], resume=True)
    assert metrics(tmp_path)["iterations"] == 20
    assert "weights.mask 0.1 -> 0.2" in capsys.readouterr().err
    with pytest.raises(UserError, match="sh_order"):
        fit(*inputs, tmp_path, overrides=[*SMALL, "sh_order=0"], resume=True)
    with pytest.raises(UserError, match="room is None in the checkpoint and can't change"):
        fit(*inputs, tmp_path, overrides=[*SMALL, "room=4"], resume=True)


def test_walls_that_were_found_stay(inputs, tmp_path, monkeypatch):
    found, step = (3.0, 3.0, 1.0, 4.0, 3.0, 3.5), Fit.step

    def crash(self):
        if self.step_number == 12:
            raise RuntimeError("lights out")
        step(self)

    monkeypatch.setattr(walls, "near_room", lambda fit_of, dataset, settings, *others: replace(settings, room=found))
    monkeypatch.setattr(Fit, "step", crash)
    auto = [*SMALL, "room=auto", "learning_rates.room=[0,0]"]
    with pytest.raises(RuntimeError):
        fit(*inputs, tmp_path, overrides=auto)
    monkeypatch.undo()  # nothing is looked for again
    with pytest.raises(UserError, match="room is .* can't change"):
        fit(*inputs, tmp_path, overrides=SMALL, resume=True)
    fit(*inputs, tmp_path, overrides=auto, resume=True)
    stored = metrics(tmp_path)
    assert tuple(stored["settings"]["room"]) == found
    distances = np.array(list(stored["room"]["distances"].values()))
    assert np.allclose(distances / distances[0], np.array(found) / found[0], rtol=1e-4)


def test_a_finished_run_is_moved_aside(inputs, tmp_path, capsys):
    out = tmp_path / "run"
    fit(*inputs, out, overrides=[*SMALL, "iterations=3"])
    before = {path.relative_to(out): path.read_bytes() for path in out.rglob("*") if path.is_file()}
    with pytest.raises(UserError, match="nowhere"):
        fit(inputs[0], tmp_path / "nowhere", out)
    assert metrics(out)["iterations"] == 3
    fit(*inputs, out, overrides=[*SMALL, "iterations=2"])
    assert metrics(out)["iterations"] == 2
    assert f"{out} holds a run: it is {tmp_path / 'run.1'} now" in capsys.readouterr().err
    aside = {p.relative_to(tmp_path / "run.1"): p.read_bytes() for p in (tmp_path / "run.1").rglob("*") if p.is_file()}
    assert aside == before

    (out / "metrics.json").write_text("{")  # damaged: with its checkpoints it could still be gone on with
    with pytest.raises(UserError, match="unfinished run"):
        fit(*inputs, out, overrides=[*SMALL, "iterations=1"])


def test_what_is_fitted_is_not_overwritten(inputs, tmp_path):
    scene, data = inputs
    (tmp_path / "scene.xml").write_text(scene.read_text())
    with pytest.raises(UserError, match="holds the scene that is fitted"):
        fit(tmp_path / "scene.xml", data, tmp_path)
    (tmp_path / "object.xml").write_text(scene.read_text())
    (tmp_path / "report.html").touch()
    with pytest.raises(UserError, match="holds a run, and what it was fitted to"):
        fit(tmp_path / "object.xml", data, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["object.xml", "report.html", "scene.xml"]


def test_only_to_the_same_photographs_and_by_the_same_format(inputs, tmp_path):
    """NeRF Synthetic's scenes have the same names and sizes: what they show tells them apart."""
    scene, data = inputs
    other = tmp_path / "data"
    shutil.copytree(data, other)
    shutil.copy(other / "train" / "r_0.png", other / "train" / "r_1.png")
    run = fit(scene, data, tmp_path / "run", overrides=[*SMALL, "iterations=3"])
    _, meta = checkpoint.load_latest(run)
    assert meta["digests"] == metrics(run)["digests"] and metrics(run)["format"] == checkpoint.FORMAT
    with pytest.raises(UserError, match="data: not the photographs of the checkpoint"):
        fit(scene, other, run, resume=True)
    arrays, meta = checkpoint.load_latest(run)
    for wrong, message in (
        ({"format": checkpoint.FORMAT + 1}, "format 2 of a newer version"),
        ({"format": None}, "format None of another version"),
        ({"format": "x" * 99 + "\n"}, "of another version"),
        ({"digests": None}, "not one of a fit"),
        ({"settings": 3}, "not one of a fit"),
        ({"extent": "wide"}, "not one of a fit"),
    ):
        checkpoint.save(run, arrays, meta | wrong)
        with pytest.raises(UserError, match=message):
            fit(scene, data, run, resume=True)
    checkpoint.save(run, {}, meta)
    with pytest.raises(UserError, match="not one of a fit"):
        fit(scene, data, run, resume=True)


def test_two_at_once(inputs, tmp_path):
    """The second is told whose the folder is, and the first goes on."""
    command = ["optimize.py", inputs[0], "--data", inputs[1], "--out", tmp_path / "run"]
    first = start_script(*command, "--set", "initialization.surfels=300", "--set", "iterations=1000000")
    wait_for(lambda: any((tmp_path / "run" / "checkpoints").glob("step_*.npz")), first)
    second = start_script(*command, "--resume")
    out, error = second.communicate(timeout=PATIENCE)
    assert second.returncode == 2 and error.count("\n") == 1, error
    assert f"run is in use by process {first.pid} on " in error
    assert first.poll() is None and any((tmp_path / "run" / "checkpoints").glob("step_*.npz"))
    first.kill()
    first.communicate()


def test_a_run_is_called_by_the_name_of_its_photographs(inputs, monkeypatch):
    scene, data = inputs
    for given in (data, data / "train" / "..", f"{data}/"):
        assert FitScene.load(scene, given).name == "ball"
    monkeypatch.chdir(data / "train")
    assert FitScene.load(scene, "..").name == "ball" and FitScene.load(scene, "/").name == "object"


def test_nothing_to_resume(inputs, tmp_path, capsys):
    fit(*inputs, tmp_path, overrides=[*SMALL, "iterations=1"], resume=True)
    assert "from the beginning" in capsys.readouterr().err


def test_full_disk_does_not_end_the_fit(inputs, tmp_path, monkeypatch, capsys):
    """Neither in its middle nor at its end, and it is told once; the last good checkpoint stays."""
    save, calls, full = checkpoint.save, [], []

    def full_for_a_while(*arguments):
        calls.append(arguments[2]["step"])
        if calls[-1] in full:
            raise UserError("no space")
        return save(*arguments)

    monkeypatch.setattr(checkpoint, "save", full_for_a_while)
    full += range(3, 8)
    with pytest.warns(UserWarning, match="no space") as told:
        fit(*inputs, tmp_path / "middle")
    assert len(told) == 1 and capsys.readouterr().err == "checkpoints are written again\n"
    assert calls[3:9] == [3, 4, 5, 6, 7, 8] and checkpoint.load_latest(tmp_path / "middle")[1]["step"] == 20
    full += range(8, 100)
    with pytest.warns(UserWarning, match="no space") as told:
        fit(*inputs, tmp_path / "end")
    assert len(told) == 1 and checkpoint.load_latest(tmp_path / "end")[1]["step"] == 2
    assert [metrics(tmp_path / name)["iterations"] for name in ("middle", "end")] == [20, 20]


@pytest.mark.parametrize("failures", [1, 9, 10])
def test_divergence_keeps_the_last_checkpoint(inputs, tmp_path, monkeypatch, failures):
    """Ten steps in a row without a finite error; nine are forgiven, and no other numbers reach a checkpoint."""
    view = Fit._view

    def overflow(self, *arguments):
        broken = 5 <= self.step_number < 5 + failures
        return view(self, *arguments) | ({"error": mi.Float(np.nan)} if broken else {})

    monkeypatch.setattr(Fit, "_view", overflow)
    if failures < 10:
        fit(*inputs, tmp_path)
        assert metrics(tmp_path)["iterations"] == 20
        return
    with pytest.raises(UserError, match="diverged at step 15 .* go on with --resume and lower rates"):
        fit(*inputs, tmp_path)
    arrays, meta = checkpoint.load_latest(tmp_path)
    assert meta["step"] == 14 and all(np.isfinite(array).all() for array in arrays.values())
    assert not (tmp_path / "metrics.json").exists()


def test_numbers_that_are_not_finite_do_not_replace_a_checkpoint(inputs, tmp_path, monkeypatch):
    step = Fit.step

    def break_model(self):
        step(self)
        if self.step_number == 5:
            self.model.set("centers", np.full_like(self.model.numpy("centers"), np.nan))

    monkeypatch.setattr(Fit, "step", break_model)
    with pytest.raises(UserError, match="diverged at step 5"):
        fit(*inputs, tmp_path)
    assert checkpoint.load_latest(tmp_path)[1]["step"] == 4


def test_a_run_has_not_ended_before_its_page_is_there(inputs, tmp_path, monkeypatch):
    def full(*_):
        raise UserError("no space")

    monkeypatch.setattr(report, "write", full)
    with pytest.raises(UserError, match="no space"):
        fit(*inputs, tmp_path, overrides=[*SMALL, "iterations=1"])
    assert not (tmp_path / "metrics.json").exists()


def test_no_test_views(inputs, tmp_path):
    scene, data = inputs
    copy = tmp_path / "data"
    copy.mkdir()
    (copy / "train").symlink_to(data / "train")
    (copy / "transforms_train.json").write_bytes((data / "transforms_train.json").read_bytes())
    figures = metrics(fit(scene, copy, tmp_path / "run", overrides=[*SMALL, "iterations=2"]))
    assert figures["psnr"] is None and figures["ssim"] is None and figures["views"] == {}
    assert (tmp_path / "run" / "contact_sheet.png").is_file()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_stopped(inputs, tmp_path, number):
    """Ctrl-C saves and evaluates; what sends SIGTERM kills soon after, so that there is no more than saving. Each has its code,
    and the same command goes on."""
    command = ["optimize.py", inputs[0], "--data", inputs[1], "--out", tmp_path / "run"]
    process = start_script(
        *command, "--set", "iterations=1000000", "--set", "initialization.surfels=300", "--set", "checkpoint_seconds=0"
    )
    wait_for(lambda: any((tmp_path / "run" / "checkpoints").glob("step_*[1-9].npz")), process)
    process.send_signal(number)
    out, error = process.communicate(timeout=PATIENCE)
    assert process.returncode == 128 + number and "Traceback" not in error, error
    assert error.splitlines()[-1] == "stopped at 0%; go on with the same command and --resume"
    assert (tmp_path / "run" / "metrics.json").exists() == (number == signal.SIGINT)
    assert not (tmp_path / "run" / ".lock").exists()
    step = checkpoint.load_latest(tmp_path / "run")[1]["step"]
    assert step > 0
    if number == signal.SIGINT:
        figures = metrics(tmp_path / "run")
        assert not figures["finished"] and figures["iterations"] == step


def test_telling_does_not_end_it(inputs, tmp_path):
    """A full disk below 2> run.log and > run.txt, and a reader that is gone: the fit goes on, and ends well."""
    command = [ROOT / "scripts" / "optimize.py", inputs[0], "--data", inputs[1], "--set", "iterations=3"]
    command += ["--set", "initialization.surfels=300", "--set", "learning_rates.room=[0,0]"]
    with open("/dev/full", "w") as full:
        process = start(*command, "--out", tmp_path / "full", stdout=full, stderr=full)
    gone = start(*command, "--out", tmp_path / "gone", stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    for stream in (gone.stdout, gone.stderr):
        stream.close()
    for name, ended in (("full", process), ("gone", gone)):
        assert ended.wait(timeout=PATIENCE) == 0 and metrics(tmp_path / name)["finished"]
    with open("/dev/full", "w") as full:
        process = start(*command, "--set", "iterations=none", stdout=full, stderr=full)
    assert process.wait(timeout=PATIENCE) == 2


def test_mistakes(inputs, tmp_path):
    """Each ends with code 2 and one line that names the trouble."""
    scene, data = inputs
    write = lambda name, text: (tmp_path / name).write_text(text) and tmp_path / name
    sensor = scene.read_text().replace("</scene>", '<sensor type="orthographic" id="flat"/></scene>')
    cases = {
        "nowhere": [scene, "--data", tmp_path / "nowhere"],
        "--data": [scene],
        "Parsing of XML": [write("bad.xml", "<scene version='3.0.0'><shape")],
        "no scene at": [tmp_path / "none.xml"],
        "malformed YAML": [scene, "--data", data, "--config", write("bad.yaml", "density: [1, ")],
        "did you mean": [scene, "--data", data, "--set", "densty.start=0.1"],
        "both null": [scene, "--data", data, "--set", "minutes=null"],
        "'flat' is a OrthographicCamera": [write("flat.xml", sensor), "--data", data],
        "integrator is a": [
            write(
                "path.xml",
                scene.read_text().replace("rgs_deferred", "path").replace('<string name="diffuse" value="$diffuse"/>', ""),
            ),
            "--data",
            data,
        ],
        "write name=value": [scene, "--data", data, "-D", "width"],
        "can't be written": [scene, "--data", data, "--out", scene / "run"],
    }
    processes = {text: start_script("optimize.py", *arguments) for text, arguments in cases.items()}
    for text, process in processes.items():
        out, error = process.communicate(timeout=PATIENCE)
        assert process.returncode == 2, (text, out, error)
        assert error.startswith("error: ") and len(error.splitlines()) == 1 and text in error, (text, error)


def test_benchmark(tmp_path, capsys):
    from rgs_mi.commands import benchmark

    other = tmp_path / "other.py"
    other.write_text("for name in ('lists', 'forward', 'backward'): print(f'{name:10s} 1000.0 ms  (first call 1 ms)')")
    benchmark.splat(500, 64, other, rounds=1)
    rows = {line.split()[0]: line.split()[1:] for line in capsys.readouterr().out.splitlines()[2:]}
    assert list(rows) == ["lists", "forward", "backward", "total"]
    assert float(rows["total"][1]) == 3000 and all(float(r[0]) > 0 for r in rows.values())
    other.write_text("print('forward 1.0 ms')")
    with pytest.raises(UserError, match="no time of 'lists'"):
        benchmark.splat(500, 64, other, rounds=1)

"""Cameras that move, and their frames as a video."""

import builtins

import numpy as np
import pytest
from PIL import Image

from rgs_mi.core.camera import Camera
from rgs_mi.core.errors import UserError
from rgs_mi.core.scene_files import load_scene
from rgs_mi.export import render, video

from readers import decoded
from runs import PATIENCE, start_script

SIZE = (31, 20)


@pytest.fixture
def frames(tmp_path):
    """Fourteen PNGs of odd width: a red square of half coverage moves over nothing."""
    paths = []
    for k in range(14):
        pixels = np.zeros((SIZE[1], SIZE[0], 4), np.uint8)
        pixels[6:14, k : k + 12] = [255, 0, 0, 128]
        paths.append(tmp_path / f"{k:03}.png")
        Image.fromarray(pixels).save(paths[-1])
    return paths


def test_video(frames, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    paths = video.write(tmp_path / "out", frames)
    assert paths == [tmp_path / "out" / "video.mp4", tmp_path / "out" / "sheet.png"]
    shown, meta = decoded(paths[0])
    assert shown.shape == (14, 20, 32, 3) and meta["codec"] == "h264" and meta["pix_fmt"].startswith("yuv420p")
    assert meta["fps"] == 4
    assert abs(shown[:, 1, 1].astype(int) - 255).max() <= 4 and abs(shown[:, :, 31].astype(int) - 255).max() <= 12  # white
    for k in (0, 7, 13):  # in their order, each with its colours
        assert abs(shown[k, 10, k + 6].astype(int) - [255, 127, 127]).max() <= 12
        assert abs(shown[k, 10, k + 16].astype(int) - 255).max() <= 12
    sheet = np.asarray(Image.open(paths[1]))
    assert sheet.shape[1] == 4 * 320 + 5 * 8 and (sheet[5] == 255).all() and sheet.std() > 10
    assert not list(tmp_path.rglob("*.tmp"))


@pytest.mark.parametrize("count, rate", [(1, 4), (90, 15), (400, 30)])
def test_rate(frames, tmp_path, count, rate):
    """About six seconds, in a sane number of frames a second."""
    pytest.importorskip("imageio_ffmpeg")
    path, _ = video.write(tmp_path / "out", [frames[k % 14] for k in range(count)])
    shown, meta = decoded(path)
    assert len(shown) == count and meta["fps"] == rate


def test_transparent_is_white(frames):
    assert (video.over_white(frames[0])[0, 0] == 255).all() and (video.over_white(frames[0])[8, 5] == [255, 127, 127]).all()


def test_sheet_of_a_few(tmp_path):
    """As wide as the frames want it, which lie where they belong to the pixel."""
    frames = [np.full((10, 20, 3), 40 * k, np.uint8) for k in range(3)]
    video.sheet(frames).write(tmp_path / "sheet.png")
    sheet = np.asarray(Image.open(tmp_path / "sheet.png"))[..., :3]
    assert sheet.shape == (160 + 16, 3 * 328 + 8, 3)
    for k in range(3):
        assert (sheet[8:-8, 8 + 328 * k : 328 * (k + 1)] == 40 * k).all()
    assert (sheet[:8] == 255).all() and (sheet[:, 328:336] == 255).all()


def test_no_encoder(frames, tmp_path, monkeypatch):
    """Is told before anything is rendered."""
    real = builtins.__import__

    def without(name, *arguments, **options):
        if name == "imageio_ffmpeg":
            raise ImportError(name)
        return real(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", without)
    for call in (
        lambda: video.write(tmp_path / "out", frames),
        lambda: render.render_scene(tmp_path / "missing.xml", turntable=3, as_video=True),
    ):
        with pytest.raises(UserError, match="pip install imageio-ffmpeg"):
            call()


@pytest.mark.parametrize(
    "options, message",
    [
        ({"turntable": 0}, "--turntable 0: needs 1 to"),
        ({"turntable": -3}, "needs 1"),
        ({"along": -1}, "--path -1: needs"),
        ({"along": 10**9}, "to 10000 frames"),
        ({"as_video": True}, "add --turntable N or --path"),
    ],
)
def test_mistakes(tmp_path, options, message):
    with pytest.raises(UserError, match=message):
        render.render_scene(tmp_path / "scene.xml", **options)


# ---- Paths ----

SENSOR = """<sensor type="perspective" id="{name}"><float name="fov" value="{fov}"/>
<transform name="to_world"><lookat origin="{origin}" target="0.2, 0.1, 0" up="0, 0, 1"/></transform>
<film type="hdrfilm"><integer name="width" value="{width}"/><integer name="height" value="8"/></film></sensor>"""


def scene_of(folder, *sensors):
    path = folder / "scene.xml"
    path.write_text(
        "<scene version='3.0.0'><integrator type='path'/><emitter type='constant'/><shape type='sphere'/>"
        f"{''.join(SENSOR.format(**sensor) for sensor in sensors)}</scene>"
    )
    return path


def sensor(name, degrees, fov=40, width=8, radius=4):
    x, y = radius * np.cos(np.radians(degrees)), radius * np.sin(np.radians(degrees))
    return {"name": name, "origin": f"{x + 0.2}, {y + 0.1}, 1", "fov": fov, "width": width}


def test_path_passes_the_views(tmp_path):
    """About what they look at, at their distance and not across; 130 degrees apart as in our captures."""
    path = scene_of(tmp_path, sensor("r_0", 0), sensor("r_1", 130), sensor("r_2", 260, fov=60))
    scene = load_scene(path, {})
    views = [Camera.from_sensor(s) for s in scene.sensors()]
    cameras = list(render._along(scene, path, 21).values())
    assert len(cameras) == 21
    for k, view in zip((0, 10, 20), views):
        np.testing.assert_allclose(cameras[k].to_world, view.to_world, atol=1e-5)
        np.testing.assert_allclose(cameras[k].focal, view.focal, rtol=1e-5)
    away = np.array([np.linalg.norm(c.origin - [0.2, 0.1, 0]) for c in cameras])
    np.testing.assert_allclose(away, np.sqrt(17), rtol=0.01)
    steps = np.linalg.norm(np.diff([c.origin for c in cameras], axis=0), axis=1)
    assert steps.max() < 1.5 * np.median(steps)


def test_path_of_the_views_themselves(tmp_path):
    path = scene_of(tmp_path, sensor("first", 0), sensor("second", 20, width=16))
    cameras = render._along(load_scene(path, {}), path, 0)
    assert list(cameras) == ["first", "second"] and all(c.size == (8, 8) for c in cameras.values())
    one = scene_of(tmp_path, sensor("only", 0))
    with pytest.raises(UserError, match="has one sensor, which is no path"):
        render._along(load_scene(one, {}), one, 5)


def test_from_the_command_line(tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    path = scene_of(tmp_path, sensor("a", 0), sensor("b", 20), sensor("c", 40))
    process = start_script("render.py", path, "--path", "--video", "--quiet", "--spp", "4")
    out, error = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, error
    assert [line.rpartition("/")[2] for line in out.split()] == ["a.png", "b.png", "c.png", "video.mp4", "sheet.png"]
    shown, _ = decoded(tmp_path / "path" / "video.mp4")
    assert shown.shape == (3, 8, 8, 3)

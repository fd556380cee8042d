"""Photographs that are larger than asked for: what is scaled when read, in every layout, and what follows it."""

import json
import pickle
import threading

import numpy as np
import pytest
from PIL import Image

from rgs_mi.datasets import frames as frames_module
from rgs_mi.datasets import load_dataset
from rgs_mi.datasets.images import limited, read_image

from captures import (
    FOCAL,
    POINTS,
    PRINCIPAL,
    SIZE,
    intrinsics,
    photographs,
    poses,
    save,
    write_blender,
    write_colmap,
    write_exr,
    write_llff,
    write_nerfstudio,
    write_nero,
)

SCALE = 2.5  # no power of two
LARGE = tuple(round(SCALE * n) for n in SIZE)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Undistorted photographs are kept below the current folder."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def large():
    return photographs(3, scale=SCALE)


def views(data):
    return sorted(data.train + data.test, key=lambda view: view.name)


def of_large(root):
    """Make a folder's transforms those of photographs that are `SCALE` times larger."""
    for file in root.glob("transforms*.json"):
        meta = json.loads(file.read_text())
        file.write_text(json.dumps(meta | {key: SCALE * value for key, value in intrinsics().items()}))
    return root


def write_large_nero(root, images):
    write_nero(root, images, np.full(LARGE[::-1], 4.0))
    matrix = SCALE * np.array([[FOCAL[0], 0, PRINCIPAL[0]], [0, FOCAL[1], PRINCIPAL[1]], [0, 0, 1 / SCALE]])
    for i, pose in enumerate(poses(len(images))):
        (root / f"{i}-camera.pkl").write_bytes(pickle.dumps([np.linalg.inv(pose)[:3], matrix]))
    return root


LAYOUTS = {
    "blender": lambda root, images: of_large(write_blender(root, images)),
    "nerfstudio": lambda root, images: of_large(write_nerfstudio(root, images)),
    "colmap": lambda root, images: write_colmap(
        root, images, parameters=tuple(SCALE * n for n in (*FOCAL, *PRINCIPAL)), size=LARGE
    ),
    "nero": write_large_nero,
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_photographs_and_cameras(tmp_path, large, capsys, layout):
    LAYOUTS[layout](tmp_path, large)
    whole, scaled = views(load_dataset(tmp_path)), views(load_dataset(tmp_path, 120, quiet=False))
    assert f"{tmp_path}: 3 of 3 photographs are scaled to 120 pixels along their longer side (the first from 300 x 240)" in (
        capsys.readouterr().err
    )
    for a, b in zip(whole, scaled):
        assert a.camera.size == LARGE and a.scaled_from is None
        assert b.camera.size == SIZE == b.pixels.shape[1::-1] and b.scaled_from == LARGE
        np.testing.assert_allclose(b.camera.focal, FOCAL, rtol=1e-9)
        np.testing.assert_allclose(b.camera.principal, PRINCIPAL, rtol=1e-9)
        np.testing.assert_allclose(a.camera.to_world, b.camera.to_world)
        pixel, _ = b.camera.project(np.zeros((1, 3)))
        np.testing.assert_allclose(pixel * SCALE, a.camera.project(np.zeros((1, 3)))[0])
    load_dataset(tmp_path, 300, quiet=False)
    assert not capsys.readouterr().err  # nothing to scale, nothing to say


def test_dots_stay_where_they_are(tmp_path):
    """Through a lens with distortion, at a size that is no whole fraction."""
    lens = {"k1": -0.2, "k2": 0.05, "p1": 0.01}
    images = photographs(3, scale=SCALE, **lens)
    of_large(write_nerfstudio(tmp_path, images, **lens))
    for view in views(load_dataset(tmp_path, 270)):
        assert max(view.camera.size) == 270 or view.scaled_from == LARGE
        check_places(view)


def check_places(view):
    """The brightest place near each dot is the dot."""
    pixel, _ = view.camera.project(POINTS)
    light = view.pixels[..., :3].astype(float).sum(-1)
    light = np.abs(light - np.median(light))
    found = 0
    for u, v in pixel[(pixel > 6).all(1) & (pixel < np.array(view.camera.size) - 6).all(1)]:
        window = light[int(v) - 4 : int(v) + 5, int(u) - 4 : int(u) + 5]
        y, x = np.mgrid[int(v) - 4 : int(v) + 5, int(u) - 4 : int(u) + 5] + 0.5
        np.testing.assert_allclose([np.average(x, weights=window), np.average(y, weights=window)], [u, v], atol=0.35)
        found += 1
    assert found > 4


def test_masks_and_normals(tmp_path):
    """A mask of another size, and normals, which are sampled: at an edge none is the mean of two."""
    rgb, mask = np.full((240, 300, 3), 90, np.uint8), np.zeros((480, 600), np.uint8)
    mask[:, 200:] = 255
    normals = np.full((240, 300, 3), 128, np.uint8)
    normals[:, :, 2], normals[:, 200:] = 255, [255, 128, 128]
    for name in ("a", "b"):
        save(tmp_path / f"images/{name}.png", rgb)
        save(tmp_path / f"images/{name}_alpha.png", mask)
        save(tmp_path / f"images/{name}_normal.png", normals)
    write_blender(tmp_path, {"a": rgb, "b": rgb})
    view = load_dataset(tmp_path, 110).test[0]
    assert view.masked and view.pixels.shape == (88, 110, 4) and view.normal.shape == (88, 110, 3)
    assert not view.alpha[:, :36].any() and view.alpha[:, 38:].all() and not view.normal[:, :36].any()
    length = np.linalg.norm(view.normal, axis=-1)
    np.testing.assert_allclose(length[view.alpha > 0], 1, atol=1e-5)
    np.testing.assert_allclose(view.normal[:, 40:70], np.broadcast_to([0, 0, 1], (88, 30, 3)), atol=0.01)
    np.testing.assert_allclose(view.normal[:, 78:], np.broadcast_to([1, 0, 0], (88, 32, 3)), atol=0.01)


@pytest.mark.parametrize("suffix", [".png", ".exr"])
def test_colours_behind_a_mask_do_not_bleed(tmp_path, suffix):
    path, alpha = tmp_path / f"a{suffix}", np.zeros((60, 80, 1), np.float32)
    alpha[:, 33:] = 1
    if suffix == ".exr":
        write_exr(path, np.float32([7.0, 0.5, 0.25]) * alpha, alpha)
    else:
        save(path, np.uint8(255 * np.concatenate([np.where(alpha, [0.8, 0.4, 0.2], 1.0), alpha], -1)))
    pixels, masked = read_image(path, "here", (32, 24))
    opaque = 255 if suffix == ".png" else 1
    assert masked and pixels.shape == (24, 32, 4) and 0 < pixels[5, 13, 3] < opaque and pixels[5, 20, 3] == opaque
    expected = [7.0, 0.5, 0.25] if suffix == ".exr" else [204, 102, 51]
    np.testing.assert_allclose(
        pixels[5, 13:, :3], np.broadcast_to(expected, (19, 3)), rtol=1e-2, atol=1 if suffix == ".png" else 1e-3
    )


def test_large_jpegs_are_decoded_small(tmp_path, monkeypatch):
    """What Pillow decodes is at most twice as large as what is asked for."""
    save(tmp_path / "a.jpg", np.full((1500, 2000, 3), 90, np.uint8))
    decoded, convert = [], Image.Image.convert
    monkeypatch.setattr(Image.Image, "convert", lambda self, *a, **k: (decoded.append(self.size), convert(self, *a, **k))[1])
    pixels, _ = read_image(tmp_path / "a.jpg", "here", (260, 195))
    assert pixels.shape == (195, 260, 4) and abs(pixels[..., :3].astype(int) - 90).max() <= 1
    assert decoded[0] == (500, 375)


def test_few_are_held_at_full_size(tmp_path, monkeypatch):
    """However many threads load photographs."""
    images = photographs(24)
    write_llff(tmp_path, images)
    height, width = next(iter(images.values())).shape[:2]
    monkeypatch.setattr(frames_module, "_DECODED", 3 * frames_module._work_of((width, height), False))
    there, most, lock, read = 0, 0, threading.Lock(), frames_module.read_image

    def counted(*arguments):
        nonlocal there, most
        with lock:
            there += 1
            most = max(most, there)
        try:
            return read(*arguments)
        finally:
            with lock:
                there -= 1

    monkeypatch.setattr(frames_module, "read_image", counted)
    monkeypatch.setattr("os.cpu_count", lambda: 32)
    load_dataset(tmp_path)
    assert 1 <= most <= 3


def test_proportions_are_kept():
    assert limited((4032, 3024), 1600) == (1600, 1200) and limited((1080, 1920), 1600) == (900, 1600)
    assert limited((1600, 900), 1600) == (1600, 900) and limited((100_000, 1), 1600) == (1600, 1)

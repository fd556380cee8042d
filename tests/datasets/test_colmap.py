"""The layout of COLMAP: poses and lenses proved by dots at known places, and every way in which a model can be bad."""

import shutil
import struct

import numpy as np
import pytest

from rgs_mi.core.color import srgb_decode
from rgs_mi.core.errors import UserError
from rgs_mi.datasets import distortion, load_dataset
from rgs_mi.datasets.resolution import chosen

from captures import (
    COLORS,
    FOCAL,
    POINTS,
    PRINCIPAL,
    SIZE,
    check_dots,
    photograph,
    photographs,
    poses,
    save,
    write_colmap,
    write_exr,
)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Undistorted photographs are kept below the current folder."""
    monkeypatch.chdir(tmp_path)


def views(data):
    return sorted(data.train + data.test, key=lambda view: view.name)


# ---- What comes out ----


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
@pytest.mark.parametrize("folder", ["sparse/0", "sparse", ".", "colmap/sparse/0"])
def test_every_place(tmp_path, folder, suffix):
    data = load_dataset(write_colmap(tmp_path, photographs(), suffix=suffix, folder=folder))
    assert [v.name for v in data.test] == ["v00", "v08"] and [v.name for v in data.train] == [f"v0{i}" for i in range(1, 8)]
    for view, pose in zip(views(data), poses()):
        np.testing.assert_allclose(view.camera.to_world, pose, atol=1e-9)
        assert view.camera.focal == FOCAL and view.camera.principal == PRINCIPAL and not view.masked
        check_dots(view)
    np.testing.assert_allclose(data.points, POINTS, atol=1e-6)
    np.testing.assert_allclose(data.point_colors, srgb_decode(COLORS / 255), atol=1e-6)


LENSES = {
    "SIMPLE_PINHOLE": ((95, *PRINCIPAL), {}),
    "SIMPLE_RADIAL": ((95, *PRINCIPAL, -0.2), {"k1": -0.2}),
    "RADIAL": ((95, *PRINCIPAL, 0.12, 0.05), {"k1": 0.12, "k2": 0.05}),
    "OPENCV": ((*FOCAL, *PRINCIPAL, -0.15, 0.04, 0.02, -0.03), {"k1": -0.15, "k2": 0.04, "p1": 0.02, "p2": -0.03}),
    "FULL_OPENCV": (
        (*FOCAL, *PRINCIPAL, 0.1, 0.02, 0.01, -0.01, 0.9, 0.2, 0.4, -0.8),
        {"k1": 0.1, "k2": 0.02, "p1": 0.01, "p2": -0.01, "k3": 0.9, "k4": 0.2, "k5": 0.4, "k6": -0.8},
    ),
}


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
@pytest.mark.parametrize("model", LENSES)
def test_every_lens(tmp_path, monkeypatch, model, suffix):
    parameters, lens = LENSES[model]
    if len(parameters) < 6 and parameters[0] == 95:
        monkeypatch.setattr("captures.FOCAL", (95, 95))
    data = load_dataset(write_colmap(tmp_path, photographs(**lens), model, parameters, suffix))
    for view in views(data):
        check_dots(view)
        assert not view.masked and view.pixels.dtype == np.uint8


def test_the_check_of_dots_sees_distortion(tmp_path):
    """What proves the lenses right fails where distortion is left in."""
    view = load_dataset(write_colmap(tmp_path, photographs(k1=-0.2))).train[0]
    with pytest.raises(AssertionError):
        check_dots(view)


def test_photographs_in_linear_light(tmp_path):
    """EXR stays linear, and an edge is blended in linear light whatever the file."""
    write_colmap(tmp_path, photographs(), "OPENCV", LENSES["OPENCV"][0], type=".exr")
    lens = LENSES["OPENCV"][1]
    for i, pose in enumerate(poses()):
        write_exr(tmp_path / f"images/v0{i}.exr", photograph(pose, **lens))
    for view in views(load_dataset(tmp_path)):
        assert view.pixels.dtype == np.float32
        check_dots(view, tolerance=0.06)

    stripes = np.zeros((96, 120, 3), np.uint8)
    stripes[:, ::2] = 255  # no pixel's mean over its neighbours is but 1/2, in linear light
    write_colmap(tmp_path, {f"v{i}": stripes for i in range(2)}, "SIMPLE_RADIAL", (95, *PRINCIPAL, -0.001))
    light = srgb_decode(load_dataset(tmp_path).train[0].pixels[..., 0] / 255)
    assert abs(light[20:40, 30:60].mean() - 0.5) < 0.02


def test_smaller_copies(tmp_path):
    """images_4 for photographs of more than 1600 pixels, the camera with them; another file type counts."""
    write_colmap(
        tmp_path,
        photographs(),
        "PINHOLE",
        (*(40 * f for f in FOCAL), *(40 * p for p in PRINCIPAL)),
        size=tuple(40 * n for n in SIZE),
        type=".JPG",
    )
    for name, pixels in photographs(scale=2).items():
        save(tmp_path / "images_4" / f"{name}.png", pixels)
        save(tmp_path / "images_2" / f"{name}.png", pixels[:4, :6])
        save(tmp_path / "images_8" / f"{name}.png", pixels[:4, :6])
    for view in views(load_dataset(tmp_path)):
        assert view.path.parent.name == "images_4" and view.camera.size == (240, 192)
        np.testing.assert_allclose(view.camera.focal, 2 * np.array(FOCAL))
        check_dots(view)


def test_smaller_copies_of_other_names(tmp_path):
    """LLFF's, in the order of the photographs."""
    write_colmap(
        tmp_path,
        photographs(),
        "PINHOLE",
        (*(40 * f for f in FOCAL), *(40 * p for p in PRINCIPAL)),
        size=tuple(40 * n for n in SIZE),
        type=".JPG",
    )
    for i, pixels in enumerate(photographs().values()):
        save(tmp_path / f"images_8/image{i:03d}.png", pixels)
    for i, view in enumerate(views(load_dataset(tmp_path))):
        assert view.name == f"v0{i}" and view.path.name == f"image{i:03d}.png"
        check_dots(view)
    (tmp_path / "images_8/image003.png").unlink()
    refused(tmp_path, "none of its 9 frames has an image file")  # which is missing is not known


def test_which_copy(tmp_path):
    images = tmp_path / "images"
    assert chosen(images, 5000) == images
    for name in ("images", "images_2", "images_4", "images_8", "images_x", "images_0"):
        (tmp_path / name).mkdir()
    names = {size: chosen(images, size).name for size in (800, 1600, 1601, 3115, 4946, 6401, 99999)}
    assert names == {
        800: "images",
        1600: "images",
        1601: "images_2",
        3115: "images_2",
        4946: "images_4",
        6401: "images_8",
        99999: "images_8",
    }
    images.rmdir()
    assert chosen(images, 800).name == "images_2"


@pytest.mark.parametrize("name", ["v{}.png", "v{}.jpg.png"])
def test_masks(tmp_path, name):
    write_colmap(tmp_path, photographs(), type=".jpg")
    mask = np.zeros((48, 60), np.uint8)  # half the size
    mask[8:40, 12:48] = 255
    for i in range(9):
        save(tmp_path / "masks" / name.format(f"0{i}"), mask)
    for view in views(load_dataset(tmp_path)):
        assert view.masked and view.alpha[16:80, 24:96].all() and view.alpha.sum() == 64 * 72
        check_dots(view)
    (tmp_path / "masks" / name.format("03")).unlink()
    with pytest.warns(UserWarning, match=r"masks: 1 of 9 photographs have no mask \(first: v03\)"):
        data = load_dataset(tmp_path)
    assert [view.masked for view in views(data)] == [i != 3 for i in range(9)]
    save(tmp_path / "masks" / name.format("03"), mask[:20])
    with pytest.raises(UserError, match="its mask is 60 x 20, the photograph 120 x 96: both must have the same proportions"):
        load_dataset(tmp_path)


def test_masks_are_undistorted_with_their_photographs(tmp_path):
    """Barrel distortion moves everything inwards: a disc's area grows again by what the formula says. Colours beside the
    mask, which are white, do not bleed in."""
    k1 = -0.2
    x, y = (np.arange(120) + 0.5 - PRINCIPAL[0]) / 95, (np.arange(96) + 0.5 - PRINCIPAL[1]) / 95
    radius = np.hypot(*np.meshgrid(x, y))
    inner = 0.3 * (1 + k1 * 0.3**2)
    alpha = np.clip((inner - radius) * 95 + 0.5, 0, 1)
    rgba = np.where((alpha > 0)[..., None], [120, 60, 30, 0], [255, 255, 255, 0]).astype(np.uint8)
    rgba[..., 3] = np.rint(255 * alpha)
    view = load_dataset(write_colmap(tmp_path, {"a": rgba, "b": rgba}, "SIMPLE_RADIAL", (95, *PRINCIPAL, k1))).train[0]
    assert view.masked
    np.testing.assert_allclose(np.sqrt(view.alpha.sum() / np.pi) / 95, 0.3, rtol=2e-3)
    assert np.abs(view.pixels[view.alpha > 0.02][:, :3].astype(int) - [120, 60, 30]).max() <= 1


def test_pixels_that_no_photograph_shows(tmp_path):
    """Pincushion distortion: the undistorted corners lie outside, and a polynomial that runs back shows nothing twice. What
    has no mask is cut to what is shown."""
    for k1, whole in ((0.3, False), (-0.2, True), (-2.5, False)):
        write_colmap(tmp_path, photographs(k1=k1), "SIMPLE_RADIAL", (95, *PRINCIPAL, k1))
        for view in load_dataset(tmp_path).train:
            assert not view.masked and view.alpha.all() and min(view.camera.size) > 25
            assert (view.camera.size == SIZE) == whole and view.pixels.shape[1::-1] == view.camera.size
            center = view.camera.rays()[int(view.camera.principal[1] - 0.5), int(view.camera.principal[0] - 0.5)]
            np.testing.assert_allclose(center, view.camera.to_world[:3, 2], atol=0.02)
        for name, pixels in photographs(k1=k1).items():
            save(tmp_path / f"masks/{name}.png", np.full(pixels.shape[:2], 255, np.uint8))
        save(tmp_path / "masks/v00.png", np.pad(np.zeros((2, 2), np.uint8), ((0, 94), (0, 118)), constant_values=255))
        view = next(v for v in views(load_dataset(tmp_path)) if v.name == "v00")
        assert view.masked and view.camera.size == SIZE and not view.pixels[view.alpha == 0].any()
        assert whole or not view.alpha[[0, 0, -1, -1], [0, -1, 0, -1]].any()
        shutil.rmtree(tmp_path / "masks")


def test_undistorted_photographs_are_kept(tmp_path, monkeypatch):
    write_colmap(tmp_path, photographs(k1=-0.2), "SIMPLE_RADIAL", (95, *PRINCIPAL, -0.2))
    first = views(load_dataset(tmp_path))
    kept = sorted((tmp_path / "data/undistorted").iterdir())
    assert len(kept) == 9 and all(path.suffix == ".npz" for path in kept)
    with monkeypatch.context() as patch:
        patch.setattr(distortion, "_resample", None)  # must not be called
        for a, b in zip(first, views(load_dataset(tmp_path))):
            np.testing.assert_array_equal(a.pixels, b.pixels)
    kept[0].write_bytes(b"damaged")
    with pytest.warns(UserWarning, match="is damaged .*computing it again"):
        for a, b in zip(first, views(load_dataset(tmp_path))):
            np.testing.assert_array_equal(a.pixels, b.pixels)
    write_colmap(tmp_path, photographs(k1=-0.2), "SIMPLE_RADIAL", (95, *PRINCIPAL, -0.19))
    load_dataset(tmp_path)
    assert len(list((tmp_path / "data/undistorted").iterdir())) == 18
    (tmp_path / "plain").mkdir()
    load_dataset(write_colmap(tmp_path / "plain", photographs()))
    assert len(list((tmp_path / "data/undistorted").iterdir())) == 18


def test_names_in_folders(tmp_path):
    names = {"left/0": 0, "left/1": 1, "right/0": 2, "right/1": 3}
    data = load_dataset(write_colmap(tmp_path, dict(zip(names, photographs(4).values()))))
    assert [v.name for v in views(data)] == ["left_0", "left_1", "right_0", "right_1"]
    for view, pose in zip(views(data), poses(4)):
        np.testing.assert_allclose(view.camera.to_world, pose, atol=1e-9)
        check_dots(view)


def test_missing_photographs_do_not_move_the_split(tmp_path):
    write_colmap(tmp_path, photographs(17))
    for i in (0, 3):
        (tmp_path / f"images/v{i:02d}.png").unlink()
    with pytest.warns(UserWarning, match="2 of 17 frames have no image file and are skipped") as caught:
        data = load_dataset(tmp_path)
    assert len(caught) == 1 and [v.name for v in data.test] == ["v08", "v16"] and len(data.train) == 13


# ---- What goes wrong ----


def refused(root, message):
    with pytest.raises(UserError, match=message) as caught:
        load_dataset(root)
    assert "\n" not in str(caught.value)


def test_folders(tmp_path):
    write_colmap(tmp_path, photographs(2))
    (tmp_path / "sparse/0/cameras.bin").rename(tmp_path / "sparse/0/cameras.txt")
    refused(tmp_path, r"looked for transforms_train.json .*transforms.json .*sparse/0, .* \(COLMAP\); .*-camera.pkl")
    (tmp_path / "sparse/0/cameras.txt").rename(tmp_path / "sparse/0/cameras.bin")
    for file in (tmp_path / "images").iterdir():
        file.unlink()
    refused(tmp_path, "none of its 2 frames has an image file")
    (tmp_path / "images").rmdir()
    refused(tmp_path, "there is no folder 'images'")


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_lenses_that_are_not_for_pinholes(tmp_path, suffix):
    write_colmap(tmp_path, photographs(2), "OPENCV_FISHEYE", (*FOCAL, *PRINCIPAL, 0, 0, 0, 0), suffix)
    refused(tmp_path, "camera model OPENCV_FISHEYE is none of SIMPLE_PINHOLE, .*run 'colmap image_undistorter'")
    write_colmap(tmp_path, photographs(2))
    file = tmp_path / "sparse/0/cameras.bin"
    file.write_bytes(file.read_bytes()[:12] + struct.pack("<i", 99) + file.read_bytes()[16:])
    refused(tmp_path, "camera model number 99")


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin"])
def test_truncated_and_miscounted_binaries(tmp_path, name):
    write_colmap(tmp_path, photographs(3))
    file = tmp_path / "sparse/0" / name
    good = file.read_bytes()
    for bad, message in (
        (b"", "unpack_from requires"),
        (good[:5], "unpack_from requires"),
        (good[:-1], "it ends|the file has"),
        (good[:60], "it ends within record 0|no end"),
        (good + b"\0", "the file has"),
        (bytes(8), "no records"),
        (b"\xff" * 8 + good[8:], "it ends within|no end"),
        (struct.pack("<Q", 2**40) + good[8:], "it ends within|no end"),
    ):
        file.write_bytes(bad)
        refused(tmp_path, f"{name} cannot be used as a file of COLMAP .*({message}).*export the model again")


def test_keypoints_beyond_the_end(tmp_path):
    write_colmap(tmp_path, photographs(1))
    file = tmp_path / "sparse/0/images.bin"
    file.write_bytes(file.read_bytes()[:-8] + b"\xff" * 8)
    refused(tmp_path, "the file has")


@pytest.mark.parametrize(
    "name, old, new, message",
    [
        ("cameras", "PINHOLE", "OPENCV", "4 parameters, and OPENCV takes 8"),
        ("cameras", "PINHOLE 120", "PINHOLE wide", "invalid literal"),
        ("cameras", "100.0", "nan", "not finite"),
        ("cameras", "100.0", "1e300", "absurdly large"),
        ("cameras", "100.0", "-100.0", "focal length -100 x 94 is out of range"),
        ("cameras", "PINHOLE 120 96", "PINHOLE 0 96", "image size 0 x 96 is out of range"),
        ("cameras", "PINHOLE 120 96", "PINHOLE 96 120", "its camera is 96 x 120, the photograph 120 x 96"),
        ("cameras", "PINHOLE 120", "PINHOLE " + "9" * 400, "too large"),
        ("cameras", "7 PINHOLE", "8 PINHOLE", "has camera 7, which cameras.txt lacks"),
        ("images", " 7 v00.png", "", "invalid literal"),
        ("images", "7 v00.png", "seven v00.png", "invalid literal"),
        ("images", "v00.png", "v01.png", "same file name"),
        ("images", "v00.png", "..", "has no file name"),
        ("images", "v00.png", "v\t0\x1b.png", "has no file name"),
    ],
)
def test_bad_text(tmp_path, name, old, new, message):
    write_colmap(tmp_path, photographs(3), suffix=".txt")
    file = tmp_path / f"sparse/0/{name}.txt"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new, 1))
    refused(tmp_path, message)


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
@pytest.mark.parametrize(
    "pose, message",
    [
        ((0, 0, 0, 0, 1, 2, 3), "no rotation and translation: q = 0 0 0 0"),
        ((np.nan, 0, 0, 1, 1, 2, 3), "no rotation and translation: q = nan"),
        ((1, 0, 0, 0, 1, np.inf, 3), "no rotation and translation.*t = 1 inf 3"),
        ((1, 0, 0, 0, 1, 1e9, 3), "absurdly far"),
        ((1e9, 0, 0, 0, 1, 2, 3), "no rotation"),
    ],
)
def test_bad_poses(tmp_path, pose, message, suffix):
    write_colmap(tmp_path, photographs(3), suffix=suffix)
    file = tmp_path / f"sparse/0/images{suffix}"
    if suffix == ".bin":
        content = file.read_bytes()
        file.write_bytes(content[:12] + struct.pack("<7d", *pose) + content[68:])
    else:
        lines = file.read_text().splitlines()
        lines[1] = f"1 {' '.join(map(str, pose))} 7 v00.png"
        file.write_text("\n".join(lines))
    refused(tmp_path, message)


def test_a_quaternion_of_another_length_is_normalised(tmp_path):
    write_colmap(tmp_path, photographs(3), suffix=".txt")
    file = tmp_path / "sparse/0/images.txt"
    lines = file.read_text().splitlines()
    words = lines[1].split()
    lines[1] = " ".join([words[0], *(str(2 * float(w)) for w in words[1:5]), *words[5:]])
    file.write_text("\n".join(lines) + "\n")
    np.testing.assert_allclose(load_dataset(tmp_path).test[0].camera.to_world, poses(3)[0], atol=1e-9)


def test_text_that_is_no_text(tmp_path):
    write_colmap(tmp_path, photographs(2), suffix=".txt")
    (tmp_path / "sparse/0/images.txt").write_bytes(b"\xff\xfe\x00")
    refused(tmp_path, "utf-8")


def test_a_bad_photograph_is_named(tmp_path):
    write_colmap(tmp_path, photographs(3))
    (tmp_path / "images/v01.png").write_bytes(b"hello")
    refused(tmp_path, r"image 'v01.png': .*v01.png cannot be read as an image")
    save(tmp_path / "images/v01.png", np.zeros((120, 96, 3), np.uint8))
    refused(tmp_path, "its camera is 120 x 96, the photograph 96 x 120")


def test_lenses_that_show_nothing(tmp_path):
    write_colmap(tmp_path, photographs(2), "SIMPLE_RADIAL", (95, *PRINCIPAL, -1e7))
    refused(tmp_path, "alpha channel of every image is zero")

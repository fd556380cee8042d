"""The layout of nerfstudio: poses, lenses, splits and the points' frame proved by dots, and what can be bad about it."""

import json

import numpy as np
import pytest

from rgs_mi.core.color import srgb_decode
from rgs_mi.core.errors import UserError
from rgs_mi.datasets import load_dataset

from captures import (
    COLORS,
    FOCAL,
    POINTS,
    PRINCIPAL,
    SIZE,
    check_dots,
    frames,
    intrinsics,
    photographs,
    poses,
    save,
    write_cloud,
    write_colmap,
    write_nerfstudio,
    write_png16,
)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Undistorted photographs are kept below the current folder."""
    monkeypatch.chdir(tmp_path)


def views(data):
    return sorted(data.train + data.test, key=lambda view: view.name)


# ---- What comes out ----


def test_poses(tmp_path):
    data = load_dataset(write_nerfstudio(tmp_path, photographs()))
    assert [v.name for v in data.test] == ["v00", "v08"] and len(data.train) == 7 and data.points is None
    for view, pose in zip(views(data), poses()):
        np.testing.assert_allclose(view.camera.to_world, pose, atol=1e-9)
        assert view.camera.focal == FOCAL and view.camera.principal == PRINCIPAL and not view.masked
        check_dots(view)
    assert not (tmp_path / "data").exists()  # nothing to undistort


@pytest.mark.parametrize(
    "lens",
    [{"k1": -0.2}, {"k1": 0.05, "k2": -0.1, "p1": 0.02, "p2": -0.03}, {"k1": -0.1, "k2": 0.05, "k3": -0.6, "k4": 9.0}],
)
@pytest.mark.parametrize("per_frame", [False, True])
def test_lenses(tmp_path, lens, per_frame):
    """k4 goes with the eighth power of the radius, which is not OpenCV's k4."""
    drawn = {("poly4" if key == "k4" else key): value for key, value in lens.items()}
    images = photographs(**drawn)
    if per_frame:
        entries = [entry | intrinsics() | lens | {"camera_model": "OPENCV"} for entry in frames(images)]
        write_nerfstudio(tmp_path, images, entries, k1=0.5, fl_x=10)  # the frames' own count
    else:
        write_nerfstudio(tmp_path, images, **lens)
    for view in views(load_dataset(tmp_path)):
        check_dots(view)


def test_a_lens_of_one_frame_is_its_own(tmp_path):
    images, bent = photographs(), photographs(k1=-0.2)
    entries = frames(images)
    entries[3]["k1"] = -0.2
    entries[4] |= {
        "fl_x": 2 * FOCAL[0],
        "fl_y": 2 * FOCAL[1],
        "cx": 2 * PRINCIPAL[0],
        "cy": 2 * PRINCIPAL[1],
        "w": 2 * SIZE[0],
        "h": 2 * SIZE[1],
    }
    images["v03"] = bent["v03"]
    for view in views(load_dataset(write_nerfstudio(tmp_path, images, entries))):
        check_dots(view)


def test_instant_ngp(tmp_path):
    """No extension, no camera_model, an angle for the focal length."""
    images = photographs()
    meta = {
        "camera_angle_x": 2 * np.arctan(SIZE[0] / 2 / FOCAL[0]),
        "fl_y": FOCAL[1],
        "cx": PRINCIPAL[0],
        "cy": PRINCIPAL[1],
        "aabb_scale": 4,
        "frames": frames(images, "./images", ""),
    }
    for name, pixels in images.items():
        save(tmp_path / f"images/{name}.jpg", pixels)
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    for view in views(load_dataset(tmp_path)):
        check_dots(view)


def test_masks(tmp_path):
    images = photographs()
    entries = [entry | {"mask_path": f"masks/m{i}.png"} for i, entry in enumerate(frames(images))]
    mask = np.zeros((96, 120))
    mask[:50] = 1
    for i in range(9):
        if i % 2:
            write_png16(tmp_path / f"masks/m{i}.png", 32768 * mask)
        else:
            save(tmp_path / f"masks/m{i}.png", np.dstack([np.rint(128 * mask).astype(np.uint8)] * 3))
    for view in views(load_dataset(write_nerfstudio(tmp_path, images, entries))):
        assert view.masked and (view.pixels[:50, :, 3] == 128).all() and not view.pixels[50:, :, 3].any()
    (tmp_path / "masks/m4.png").unlink()
    with pytest.raises(UserError, match="frame 4: .*m4.png cannot be read as an image"):
        load_dataset(tmp_path)


def test_listed_splits(tmp_path):
    images = photographs()
    names = lambda *numbers: [f"./images/v0{i}.png" for i in numbers]
    split = lambda data: ([v.name[2] for v in data.train], [v.name[2] for v in data.test])
    every = range(9)
    for lists, train, test in (
        ({"train_filenames": names(1, 2, 3), "test_filenames": names(5, 6)}, "123", "56"),
        ({"test_filenames": names(5, 6)}, "0123478", "56"),
        ({"val_filenames": names(5, 6)}, "0123478", "56"),
        ({"test_filenames": names(1), "val_filenames": names(5, 6)}, "023478", "1"),
        ({"train_filenames": names(*every), "test_filenames": []}, "012345678", ""),
    ):
        found = split(load_dataset(write_nerfstudio(tmp_path, images, **lists)))
        assert found == (list(train), list(test)), lists


def test_smaller_copies(tmp_path):
    large = {key: 40 * value for key, value in intrinsics().items()}
    write_nerfstudio(tmp_path, photographs(), **large)
    for name, pixels in photographs(scale=2).items():
        save(tmp_path / f"images_4/{name}.png", pixels)
    for view in views(load_dataset(tmp_path)):
        assert view.camera.size == (240, 192)
        check_dots(view)


EXCHANGE = [[0, 0, 1.0, 0.5], [1, 0, 0, -1], [0, 1, 0, 2]]


def test_points_of_the_named_cloud_are_in_the_frame_of_the_poses(tmp_path):
    (tmp_path / "clouds").mkdir()
    write_cloud(tmp_path / "clouds/sparse.ply", POINTS)
    write_cloud(tmp_path / "points3d.ply", 0 * POINTS)
    data = load_dataset(
        write_nerfstudio(tmp_path, photographs(2), ply_file_path="clouds/sparse.ply", applied_transform=EXCHANGE)
    )
    np.testing.assert_allclose(data.points, POINTS, atol=1e-6)
    np.testing.assert_allclose(data.point_colors, srgb_decode(COLORS / 255), atol=1e-6)
    with pytest.warns(UserWarning, match="ply_file_path 'gone.ply' is not there"):
        assert load_dataset(write_nerfstudio(tmp_path, photographs(2), ply_file_path="gone.ply")).points is None
    np.testing.assert_array_equal(load_dataset(write_nerfstudio(tmp_path, photographs(2))).points, 0 * POINTS)


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_points_of_colmap_are_taken_there(tmp_path, suffix):
    write_colmap(tmp_path, photographs(2), folder="colmap/sparse/0", suffix=suffix)
    data = load_dataset(write_nerfstudio(tmp_path, photographs(2), applied_transform=EXCHANGE))
    np.testing.assert_allclose(data.points, POINTS[:, [2, 0, 1]] + [0.5, -1, 2], atol=1e-6)
    data = load_dataset(write_nerfstudio(tmp_path, photographs(2), applied_transform=EXCHANGE, applied_scale=0.5))
    np.testing.assert_allclose(data.points, (POINTS[:, [2, 0, 1]] + [0.5, -1, 2]) / 2, atol=1e-6)
    data = load_dataset(write_nerfstudio(tmp_path, photographs(2)))  # what nerfstudio did before it wrote the field
    np.testing.assert_allclose(data.points, POINTS[:, [1, 0, 2]] * [1, 1, -1], atol=1e-6)


# ---- What goes wrong ----


@pytest.mark.parametrize(
    "meta, message",
    [
        ({"camera_model": "OPENCV_FISHEYE"}, "'OPENCV_FISHEYE' is no perspective lens .*undistort the photographs first"),
        ({"camera_model": "EQUIRECTANGULAR"}, "is no perspective lens"),
        ({"camera_model": 7}, "is no perspective lens"),
        ({"camera_model": ["OPENCV"]}, "is no perspective lens"),
        ({"is_fisheye": True}, "is no perspective lens"),
        ({"k1": "bent"}, "\"k1\" is 'bent': give a number of distortion"),
        ({"k1": float("nan")}, "\"k1\" is 'nan'"),
        ({"p2": 1e9}, '"p2" is'),
        ({"w": 96, "h": 120}, "its camera is 96 x 120, the photograph 120 x 96"),
        ({"w": float("nan")}, "\"w\" is 'nan'"),
        ({"train_filenames": "all"}, '"train_filenames" is not a list'),
        ({"test_filenames": [3]}, '"test_filenames" is not a list'),
        ({"test_filenames": ["images/v77.png"]}, "'images/v77.png' in the lists of file names is no frame's file_path"),
        ({"test_filenames": ["images/v00.png", "images/v01.png"]}, "all 2 usable views are held out"),
        ({"ply_file_path": 3}, '"ply_file_path" is not a file name'),
        ({"frames": [{"file_path": "images/v00.png"}]}, 'frame 0: "transform_matrix" is missing'),
    ],
)
def test_bad_entries(tmp_path, meta, message):
    with pytest.raises(UserError, match=message) as caught:
        load_dataset(write_nerfstudio(tmp_path, photographs(2), **meta))
    assert "\n" not in str(caught.value) and "transforms.json" in str(caught.value)


@pytest.mark.parametrize(
    "meta",
    [
        {"applied_transform": [[1, 0, 0, 0]]},
        {"applied_transform": "none"},
        {"applied_transform": [[1, 0, 0, float("nan")]] * 3},
        {"applied_transform": [[1e300, 0, 0, 0]] * 3},
        {"applied_transform": None},
        {"applied_transform": [[1e8, 0, 0, 1e8]] * 3},
        {"applied_scale": 0},
        {"applied_scale": "large"},
    ],
)
def test_bad_transforms_of_points(tmp_path, meta):
    write_colmap(tmp_path, photographs(2), folder="colmap/sparse/0")
    with pytest.raises(UserError, match='applied_(transform|scale)"') as caught:
        load_dataset(write_nerfstudio(tmp_path, photographs(2), **meta))
    assert "\n" not in str(caught.value)


def test_bad_masks(tmp_path):
    images = photographs(2)
    entries = frames(images)
    entries[1]["mask_path"] = ["m.png"]
    with pytest.raises(UserError, match='frame 1: "mask_path" is not a file name'):
        load_dataset(write_nerfstudio(tmp_path, images, entries))


def test_missing_photographs(tmp_path):
    write_nerfstudio(tmp_path, photographs())
    (tmp_path / "images/v03.png").unlink()
    with pytest.warns(UserWarning, match="1 of 9 frames have no image file and are skipped .*v03.png"):
        assert len(load_dataset(tmp_path).train) == 6

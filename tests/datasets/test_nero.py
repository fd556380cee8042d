"""The layout of NeRO: poses proved by dots, masks from depths, the split; and pickles that want more than arrays."""

import os
import pickle

import numpy as np
import pytest

from rgs_mi.core.errors import UserError
from rgs_mi.datasets import load_dataset

from captures import FOCAL, POINTS, PRINCIPAL, check_dots, photograph, photographs, poses, write_cloud, write_exr, write_nero


def views(data):
    return sorted(data.train + data.test, key=lambda view: int(view.name))


# ---- What comes out ----


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_poses(tmp_path, protocol):
    data = load_dataset(write_nero(tmp_path, photographs(11), protocol=protocol))
    assert [v.name for v in data.test] == ["0", "8"]  # in the order of numbers
    assert [v.name for v in data.train] == ["1", "2", "3", "4", "5", "6", "7", "9", "10"]
    for view, pose in zip(views(data), poses(11)):
        np.testing.assert_allclose(view.camera.to_world, pose, atol=1e-9)
        assert view.camera.focal == FOCAL and view.camera.principal == PRINCIPAL and not view.masked
        check_dots(view)


def test_masks_from_depths(tmp_path):
    depths = np.full((96, 120), 15.0)
    depths[20:70, 30:90] = 4
    depths[40, 40], depths[41, 41] = 14.49, 14.51
    for view in load_dataset(write_nero(tmp_path, photographs(3), depths)).train:
        assert view.masked and set(np.unique(view.pixels[..., 3])) == {0, 255}
        np.testing.assert_array_equal(view.alpha > 0, depths < 14.5)


def test_linear_photographs(tmp_path):
    write_nero(tmp_path, photographs(3))
    for i, pose in enumerate(poses(3)):
        (tmp_path / f"{i}.png").unlink()
        write_exr(tmp_path / f"{i}.exr", photograph(pose))
    for view in views(load_dataset(tmp_path)):
        assert view.pixels.dtype == np.float32
        check_dots(view)


@pytest.mark.parametrize("above", [False, True])
def test_split(tmp_path, above):
    root = tmp_path / "bell"
    root.mkdir()
    write_nero(root, photographs(5))
    split = (tmp_path if above else root) / "synthetic_split_128.pkl"
    split.write_bytes(pickle.dumps([["4", "1", "99"], ["0", "2", "3"]]))
    assert [v.name for v in load_dataset(root).test] == ["1", "4"]
    split.write_bytes(pickle.dumps([np.array(["4", "1", "99"]), np.array(["0", "2", "3"])]))  # as published
    assert [v.name for v in load_dataset(root).test] == ["1", "4"]
    split.write_bytes(pickle.dumps([["98", "99"], ["0"]]))
    with pytest.warns(UserWarning, match="lists none of these views: every eighth is held out"):
        assert [v.name for v in load_dataset(root).test] == ["0"]
    for bad in (7, ["1"], [1, 2], None, [["1"], ["2"], ["3"]]):
        split.write_bytes(pickle.dumps(bad))
        with pytest.raises(UserError, match="synthetic_split_128.pkl holds no lists of test and training views"):
            load_dataset(root)


def test_the_truth_is_not_read(tmp_path):
    write_cloud(tmp_path / "eval_pts.ply")
    assert load_dataset(write_nero(tmp_path, photographs(3))).points is None
    write_cloud(tmp_path / "points.ply")
    np.testing.assert_allclose(load_dataset(tmp_path).points, POINTS, atol=1e-6)


# ---- What goes wrong ----


def test_missing_photographs(tmp_path):
    write_nero(tmp_path, photographs(4))
    (tmp_path / "2.png").unlink()
    with pytest.warns(UserWarning, match="1 of 4 frames have no image file and are skipped .*2.png"):
        assert [v.name for v in load_dataset(tmp_path).train] == ["1", "3"]


class Hostile:
    def __init__(self, file):
        self.file = str(file)

    def __reduce__(self):
        return os.system, (f"touch '{self.file}'",)


def test_hostile_pickles_are_not_run(tmp_path):
    write_nero(tmp_path, photographs(3))
    ran = tmp_path / "ran"
    for bad in (Hostile(ran), [Hostile(ran), np.eye(3)], [np.eye(4)[:3], np.array([Hostile(ran)], object)]):
        (tmp_path / "1-camera.pkl").write_bytes(pickle.dumps(bad))
        with pytest.raises(UserError, match="1-camera.pkl") as caught:
            load_dataset(tmp_path)
        assert "\n" not in str(caught.value) and not ran.exists()
    pickle.loads(pickle.dumps(Hostile(ran)))
    assert ran.exists()  # what a plain unpickler would have done


POSE, INTRINSICS = np.eye(4)[:3], np.array([[90.0, 0, 60], [0, 90, 48], [0, 0, 1]])


@pytest.mark.parametrize(
    "camera, message",
    [
        (b"", "1-camera.pkl"),
        (pickle.dumps([POSE, INTRINSICS])[:-20], "1-camera.pkl"),
        (pickle.dumps(POSE), "holds no camera"),
        (pickle.dumps([POSE]), "holds no camera"),
        (pickle.dumps([POSE, INTRINSICS, 3]), "holds no camera"),
        (pickle.dumps([POSE[:2], INTRINSICS]), "holds no camera"),
        (pickle.dumps([POSE[:, :3], INTRINSICS]), "holds no camera"),
        (pickle.dumps([POSE, INTRINSICS[:2]]), "holds no camera"),
        (pickle.dumps([POSE, "wide"]), "holds no camera"),
        (pickle.dumps([POSE, {"f": 3}]), "holds no camera"),
        (pickle.dumps([POSE, INTRINSICS + np.eye(3)]), "holds no camera"),
        (pickle.dumps([POSE, INTRINSICS + [[0, np.nan, 0], [0, 0, 0], [0, 0, 0]]]), "holds no camera"),
        (pickle.dumps([POSE, -INTRINSICS + 2 * np.diag([0, 0, 1])]), "focal length -90 x -90 is out of range"),
        (pickle.dumps([POSE, INTRINSICS * [[np.nan, 1, 1]]]), "holds no camera|out of range"),
        (pickle.dumps([POSE * np.nan, INTRINSICS]), "holds NaN"),
        (pickle.dumps([2 * POSE, INTRINSICS]), "scales"),
        (pickle.dumps([POSE * [[1], [1], [-1]], INTRINSICS]), "mirrors"),
        (pickle.dumps([POSE + [0, 0, 0, 1e9], INTRINSICS]), "absurdly far"),
    ],
)
def test_bad_cameras(tmp_path, camera, message):
    write_nero(tmp_path, photographs(3))
    (tmp_path / "1-camera.pkl").write_bytes(camera)
    with pytest.raises(UserError, match=message) as caught:
        load_dataset(tmp_path)
    assert "\n" not in str(caught.value) and "1-camera.pkl" in str(caught.value)


def test_bad_depths(tmp_path):
    write_nero(tmp_path, photographs(3), np.full((96, 120), 3.0))
    (tmp_path / "1-depth.png").write_bytes(b"damaged")
    with pytest.raises(UserError, match="1-depth.png cannot be read as an image"):
        load_dataset(tmp_path)

"""The layout of LLFF: poses and sizes proved by dots, smaller copies, masks, and what can be bad about it."""

import numpy as np
import pytest

from rgs_mi.core.errors import UserError
from rgs_mi.datasets import load_dataset

from captures import COLORS, FOCAL, POINTS, SIZE, check_dots, photographs, poses, save, write_cloud, write_llff


def views(data):
    return sorted(data.train + data.test, key=lambda view: view.name)


@pytest.fixture
def square(monkeypatch):
    """Photographs of a lens that the layout can tell: square pixels, the centre on the optical axis."""
    monkeypatch.setattr("captures.FOCAL", (FOCAL[0], FOCAL[0]))
    monkeypatch.setattr("captures.PRINCIPAL", (SIZE[0] / 2, SIZE[1] / 2))


def test_poses(tmp_path, square):
    write_cloud(tmp_path / "points3D.ply")
    data = load_dataset(write_llff(tmp_path, photographs()))
    assert [v.name for v in data.test] == ["v00", "v08"] and len(data.train) == 7
    for view, pose in zip(views(data), poses()):
        np.testing.assert_allclose(view.camera.to_world, pose, atol=1e-9)
        assert view.camera.focal == (FOCAL[0],) * 2 and view.camera.principal == (60, 48) and not view.masked
        check_dots(view)
    np.testing.assert_allclose(data.points, POINTS, atol=1e-6)
    assert data.point_colors.shape == COLORS.shape


def test_smaller_copies_of_other_names(tmp_path, square):
    """Sizes and the focal length are those of ``images``, of which the copies are in the same order."""
    write_llff(tmp_path, photographs(), "images_32", 32)
    for i in range(9):
        (tmp_path / f"images_32/v0{i}.png").rename(tmp_path / f"images_32/image{i:03d}.png")
    (tmp_path / "images_32/Thumbs.db").write_bytes(b"")  # no photograph
    data = load_dataset(tmp_path)
    assert [v.name for v in data.test] == ["image000", "image008"]
    for view in views(data):
        assert view.camera.focal == (FOCAL[0],) * 2
        check_dots(view)


def test_masks(tmp_path, square):
    write_llff(tmp_path, photographs(), suffix=".jpg")
    mask = np.zeros((48, 60), np.uint8)
    mask[8:40, 12:48] = 255
    for i in range(9):
        save(tmp_path / f"masks/v0{i}{'.png' if i % 2 else '.jpg'}", mask)
    for view in views(load_dataset(tmp_path)):
        assert view.masked and view.alpha[18:78, 26:94].min() > 0.95 and view.alpha[:14].max() < 0.05
    (tmp_path / "masks/v03.png").unlink()
    with pytest.warns(UserWarning, match=r"masks: 1 of 9 photographs have no mask \(first: v03\)"):
        assert sum(view.masked for view in views(load_dataset(tmp_path))) == 8
    save(tmp_path / "masks/v03.png", mask[:20])
    refused(tmp_path, "'v03.jpg': its mask is 60 x 20, the photograph 120 x 96: both must have the same proportions")


# ---- What goes wrong ----


def refused(root, message):
    with pytest.raises(UserError, match=message) as caught:
        load_dataset(root)
    assert "\n" not in str(caught.value) and str(root) in str(caught.value)


def test_unreadable_poses(tmp_path):
    file = write_llff(tmp_path, photographs(2)) / "poses_bounds.npy"
    whole = file.read_bytes()
    for content in (b"", b"no array", whole[:100], whole[:-8], whole.replace(b"(2, 17)", b"(9000000000, 17)", 1)):
        file.write_bytes(content)
        refused(tmp_path, "poses_bounds.npy cannot be used as LLFF's poses .*: export it again")
    for bad in (np.zeros((2, 15)), np.zeros(34), np.zeros((2, 17), bool), np.zeros((0, 17)), np.array([{}] * 2)):
        np.save(file, bad)
        refused(tmp_path, "poses_bounds.npy cannot be used as LLFF's poses .*: export it again")


@pytest.mark.parametrize(
    "column, value, message",
    [
        (0, np.nan, "row of 'v01.png': the matrix holds NaN or infinity: a row is a 3 x 5 matrix"),
        (0, 9.0, "row of 'v01.png': the matrix scales, shears, mirrors"),
        (3, 1e9, "row of 'v01.png': the matrix scales, shears, mirrors or lies absurdly far away"),
        (14, -1.0, "row of 'v01.png': the focal length -1 x -1 is out of range"),
        (14, np.nan, "row of 'v01.png': the focal length nan x nan is out of range"),
        (4, 0.0, "row of 'v01.png': the image size 120 x 0 is out of range"),
        (4, np.nan, "row of 'v01.png': the image size 120 x nan is out of range"),
        (4, 120.0, "row of 'v01.png': its camera is 120 x 120, the photograph 120 x 96"),
    ],
)
def test_bad_rows(tmp_path, column, value, message):
    file = write_llff(tmp_path, photographs(3)) / "poses_bounds.npy"
    table = np.load(file)
    table[1, column] = value
    np.save(file, table)
    refused(tmp_path, message)


def test_another_number_of_photographs(tmp_path):
    write_llff(tmp_path, photographs(3))
    (tmp_path / "images/v01.png").unlink()
    refused(tmp_path, r"poses_bounds.npy has 3 rows and .*images 2 photographs: a row is one of them")
    (tmp_path / "images").rename(tmp_path / "pictures")
    refused(tmp_path, "has 3 rows and .*images 0 photographs")


def test_depths_are_not_asked(tmp_path):
    assert len(load_dataset(write_llff(tmp_path, photographs(3), bounds=(np.nan, np.inf))).train) == 2

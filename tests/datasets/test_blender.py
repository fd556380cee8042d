"""The Blender layout: cameras, pixels and normals of a small set written here, and every way in which it can be bad."""

import json
import random
import struct
import warnings
import zlib

import numpy as np
import pytest
from PIL import Image

from rgs_mi.core.errors import UserError
from rgs_mi.datasets import blender, load_dataset

from captures import write_exr

SIZE = (24, 16)  # width, height
FOV = 0.7
POSE = [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]  # at z = 4, looking at the origin


def disc(value=200, alpha=255):
    """[H, W, 4] uint8: a disc on nothing."""
    width, height = SIZE
    x, y = np.meshgrid(np.arange(width) - width / 2 + 0.5, np.arange(height) - height / 2 + 0.5)
    image = np.zeros((height, width, 4), np.uint8)
    image[x**2 + y**2 < 36] = [value, 10, 20, alpha]
    return image


def frame(name, pose=POSE, **more):
    return {"file_path": f"./train/{name}", "rotation": 0.1, "transform_matrix": pose, **more}


def write(root, frames=None, split="train", images=None, **meta):
    """Write ``root``/transforms_<split>.json and, unless told otherwise, two images."""
    (root / "train").mkdir(exist_ok=True)
    for name, pixels in (images if images is not None else {"a.png": disc(), "b.png": disc(100)}).items():
        Image.fromarray(pixels).save(root / "train" / name)
    meta = {"camera_angle_x": FOV, **meta, "frames": [frame("a"), frame("b")] if frames is None else frames}
    (root / f"transforms_{split}.json").write_text(json.dumps({k: v for k, v in meta.items() if v is not None}))
    return root


def chunk(kind, body):
    """A chunk of a PNG file."""
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def only(root):
    data = load_dataset(root)
    assert len(data.train) == 1
    return data.train[0]


# ---- What comes out ----


def test_loads_both_splits(tmp_path):
    write(tmp_path)
    write(tmp_path, [{"file_path": "train/a.png", "transform_matrix": POSE}], "test")
    data = load_dataset(tmp_path)
    assert [v.name for v in data.train] == ["a", "b"] and [v.name for v in data.test] == ["a"]
    assert data.root == tmp_path and data.points is None
    view = data.train[0]
    np.testing.assert_array_equal(view.pixels, disc())
    assert view.pixels.dtype == np.uint8 and view.masked and view.path == tmp_path / "train" / "a.png"


def test_camera_projects_known_points(tmp_path):
    turned = [[0.0, 0, 1, 5], [1, 0, 0, 2], [0, 1, 0, 0], [0, 0, 0, 1]]  # at (5, 2, 0), looks along -x, up is z
    write(tmp_path, [frame("a"), frame("b", turned)])
    first, second = (view.camera for view in load_dataset(tmp_path).train)
    focal = 12 / np.tan(FOV / 2)
    pixel, depth = first.project(np.array([[0, 0, 0], [0.5, 0.25, 0]]))
    np.testing.assert_allclose(pixel, [[12, 8], [12 + focal * 0.5 / 4, 8 - focal * 0.25 / 4]])
    np.testing.assert_allclose(depth, 4)
    pixel, depth = second.project(np.array([[0, 2, 1.0], [0, 3, 0]]))
    np.testing.assert_allclose(pixel, [[12, 8 - focal / 5], [12 + focal / 5, 8]])
    np.testing.assert_allclose(depth, 5)


def test_intrinsics_of_file_and_frame(tmp_path):
    write(tmp_path, [frame("a", fl_x=30, cx=10), frame("b")], camera_angle_x=None, fl_x=20, fl_y=25, cy=7)
    a, b = (view.camera for view in load_dataset(tmp_path).train)
    assert a.focal == (30, 25) and a.principal == (10, 7) and b.focal == (20, 25) and b.principal == (12, 7)
    write(tmp_path, [frame("a")], fl_x=40, fl_y=40, w=48, h=32)  # photographs at half the size
    assert only(tmp_path).camera.focal == (20, 20) and only(tmp_path).camera.principal == (12, 8)


def test_images_of_other_kinds(tmp_path):
    grey16 = (np.arange(16 * 24, dtype=np.uint16) * 170).reshape(16, 24)
    write(
        tmp_path,
        [frame(n) for n in ("rgb", "grey", "photo", "small", "opaque")],
        images={
            "rgb.png": disc()[..., :3],
            "grey.png": grey16,
            "photo.jpg": disc()[..., :3],
            "small.png": disc()[:8, :9],
            "opaque.png": np.full((16, 24, 4), 255, np.uint8),
        },
    )
    rgb, grey, photo, small, opaque = load_dataset(tmp_path).train
    assert not any(v.masked for v in (rgb, grey, photo, opaque)) and small.masked
    assert (rgb.pixels[..., 3] == 255).all() and photo.path.suffix == ".jpg"
    np.testing.assert_array_equal(grey.pixels[..., 0], grey16 >> 8)
    assert small.pixels.shape == (8, 9, 4) and small.camera.size == (9, 8)


def test_16_bit_colour(tmp_path):
    rows = b"".join(b"\0" + struct.pack(">12H", *[0x1234, 0x8000, 0xFFFF, 0xFFFF] * 3) for _ in range(2))
    png = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", 3, 2, 16, 6, 0, 0, 0))
    write(tmp_path, [frame("c")])
    (tmp_path / "train/c.png").write_bytes(png + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b""))
    np.testing.assert_array_equal(only(tmp_path).pixels, np.full((2, 3, 4), [0x12, 0x80, 0xFF, 0xFF]))


def test_exr_is_linear_with_straight_alpha(tmp_path):
    write(tmp_path, [frame("a.exr")])
    alpha = np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4, 1)
    write_exr(tmp_path / "train/a.exr", alpha * np.float32([7, 0.5, 0]), alpha)
    view = only(tmp_path)
    assert view.pixels.dtype == np.float32 and view.masked
    np.testing.assert_allclose(view.pixels[..., :3].reshape(-1, 3)[1:], np.tile([7, 0.5, 0], (11, 1)), rtol=1e-5)
    write(tmp_path, [frame("a")])
    assert only(tmp_path).path.suffix == ".png"  # PNG comes first where the frame does not say
    write(tmp_path, [frame("c")], images={})
    write_exr(tmp_path / "train/c.exr", np.ones((3, 4, 3), np.float32))
    assert not only(tmp_path).masked and (only(tmp_path).pixels == 1).all()


def test_normals_of_test_views(tmp_path):
    truth = np.array([-0.48, 0.6, 0.64])
    encoded = np.broadcast_to(np.round(127.5 * (truth + 1)), (16, 24, 3)).astype(np.uint8)
    write(tmp_path, images={"a.png": disc(), "a_normal.png": encoded, "b.png": disc()})
    write(tmp_path, split="test", images={})
    data = load_dataset(tmp_path)
    assert data.train[0].normal is None and data.test[1].normal is None
    normal, inside = data.test[0].normal, disc()[..., 3] > 0
    assert normal.dtype == np.float32 and (normal[~inside] == 0).all()
    np.testing.assert_allclose(normal[inside], np.broadcast_to(truth, (inside.sum(), 3)), atol=0.01)


def test_normals_are_unknown_where_their_file_is_empty(tmp_path):
    """Along silhouettes: a photograph's partial alpha over a black or transparent texel."""
    encoded = np.full((16, 24, 4), [128, 128, 255, 255], np.uint8)
    encoded[:, :12, :3] = 0
    encoded[:8, :, 3] = 0
    write(tmp_path, images={"a.png": disc(alpha=40), "a_normal.png": encoded, "b.png": disc()})
    write(tmp_path, [frame("a")], split="test", images={})
    known = (load_dataset(tmp_path).test[0].normal != 0).any(-1)
    inside = disc()[..., 3] > 0
    inside[:8], inside[:, :12] = False, False
    np.testing.assert_array_equal(known, inside)


def test_clamped_normals_are_used_only_where_nothing_was_lost(tmp_path):
    encoded = np.zeros((16, 24, 3), np.uint8)
    encoded[:, :12] = [0, 203, 231]  # (0, .6, .8) through the sRGB curve
    encoded[:, 12:] = [0, 100, 100]  # something negative was cut away
    write(tmp_path, images={"a.png": disc(), "a_normal_0001.png": encoded, "b.png": disc()})
    write(tmp_path, [frame("a")], split="test", images={})
    normal, inside = load_dataset(tmp_path).test[0].normal, disc()[..., 3] > 0
    np.testing.assert_allclose(normal[:, :12][inside[:, :12]][0], [0, 0.6, 0.8], atol=5e-3)
    assert (normal[:, 12:] == 0).all()


def test_alpha_beside_the_photograph(tmp_path):
    """Shiny Blender's companions: an alpha counts where the photograph has none, a disparity never."""
    alpha = disc()[..., 3]
    write(
        tmp_path,
        [frame("a"), frame("b"), frame("c")],
        images={
            "a.png": disc()[..., :3],
            "a_alpha.png": alpha // 2,
            "b.png": disc(),
            "b_alpha.png": 255 - alpha,
            "c.png": np.dstack([disc()[..., :3], np.full((16, 24), 255, np.uint8)]),
            "c_alpha.png": np.dstack([alpha] * 3),
        },
    )
    (tmp_path / "train/a_disp.tiff").write_bytes(b"never read")
    a, b, c = load_dataset(tmp_path).train
    np.testing.assert_array_equal(a.pixels, np.dstack([disc()[..., :3], alpha // 2]))
    for view in (b, c):
        np.testing.assert_array_equal(view.pixels[..., 3], alpha)
    assert a.masked and b.masked and c.masked
    Image.fromarray(np.full((8, 12), 255, np.uint8)).save(tmp_path / "train/a_alpha.png")
    view = load_dataset(tmp_path).train[0]
    assert not view.masked and (view.pixels[..., 3] == 255).all()
    (tmp_path / "train/a_alpha.png").write_bytes(b"damaged")
    with pytest.raises(UserError, match="frame 0: .*a_alpha.png cannot be read as an image"):
        load_dataset(tmp_path)


# ---- What goes wrong ----


def test_folders(tmp_path):
    with pytest.raises(UserError, match="nowhere' does not exist"):
        load_dataset(tmp_path / "nowhere")
    with pytest.raises(UserError, match="looked for transforms_train.json"):
        load_dataset(tmp_path)
    with pytest.raises(UserError, match="transforms_train.json cannot be read"):
        blender.load(tmp_path)


@pytest.mark.parametrize(
    "text, message",
    [
        (b'{"frames": [\n  1,, 2]}', "line 2, column 5"),
        (b"\xff\xfe\xfa", "not a JSON text file"),
        (b'{"frames": [' + b"9" * 5000 + b"]}", "not a JSON text file"),
        (b"[" * 100000, "not a JSON text file|malformed JSON"),
        (b"[]", "outermost value must be an object"),
        (b"{}", '"frames" is missing'),
        (b'{"frames": 3}', '"frames" is missing or not a list'),
        (b'{"frames": []}', "empty"),
        (b'{"frames": [5]}', "frame 0 is not an object"),
        (b'{"frames": [{"file_path": 3}]}', 'frame 0: "file_path"'),
        (b'{"frames": [{"file_path": "./"}]}', 'frame 0: "file_path"'),
    ],
)
def test_bad_json(tmp_path, text, message):
    write(tmp_path)
    (tmp_path / "transforms_train.json").write_bytes(text)
    with pytest.raises(UserError, match=message):
        load_dataset(tmp_path)


def posed(row, column, value):
    pose = [list(r) for r in POSE]
    pose[row][column] = value
    return pose


@pytest.mark.parametrize(
    "pose, message",
    [
        (posed(0, 3, float("nan")), "NaN or infinity"),
        (posed(0, 3, float("inf")), "NaN or infinity"),
        (posed(0, 3, 10**400), "NaN or infinity"),
        (posed(0, 0, 2), "scales, shears"),
        (posed(0, 0, -1), "mirrors"),
        (posed(3, 3, 0), "scales"),
        (posed(0, 3, 1e30), "absurdly far"),
        (posed(0, 0, "1"), "not a list of numbers"),
        (posed(0, 0, True), "not a list of numbers"),
        (POSE[:2], r"shape \(2, 4\)"),
        ([[1, 2], [3]], "not a list of numbers"),
        (7, "not a list of numbers"),
        (None, "not a list of numbers"),
    ],
)
def test_bad_pose(tmp_path, pose, message):
    write(tmp_path, [frame("a"), frame("b", pose)])
    with pytest.raises(UserError, match=f"frame 1: .*{message}"):
        load_dataset(tmp_path)


@pytest.mark.parametrize(
    "meta, message",
    [
        ({"camera_angle_x": None}, 'neither "camera_angle_x" nor "fl_x"'),
        ({"camera_angle_x": 39.6}, "radians between"),
        ({"camera_angle_x": 0}, "radians between"),
        ({"camera_angle_x": "wide"}, "'wide': give a number"),
        ({"camera_angle_x": float("nan")}, "radians between"),
        ({"fl_x": -1}, "\"fl_x\" is '-1'"),
        ({"w": 0}, "\"w\" is '0'"),
        ({"cx": []}, '"cx" is'),
    ],
)
def test_bad_intrinsics(tmp_path, meta, message):
    with pytest.raises(UserError, match=message):
        load_dataset(write(tmp_path, **meta))


def test_frames_without_a_pose_or_with_one_name(tmp_path):
    with pytest.raises(UserError, match='frame 1: "transform_matrix" is missing'):
        load_dataset(write(tmp_path, [frame("a"), {"file_path": "train/b"}]))
    with pytest.raises(UserError, match="frame 1 has the same file name as .*frame 0"):
        load_dataset(write(tmp_path, [frame("a"), frame("a")]))


def test_missing_images_are_skipped_with_one_warning(tmp_path):
    frames = [frame("a"), frame("gone"), frame("gone2"), frame("x\0y"), frame("b.exr"), frame("n" * 5000)]
    with pytest.warns(UserWarning, match="5 of 6 frames have no image file") as caught:
        assert [v.name for v in load_dataset(write(tmp_path, frames)).train] == ["a"]
    assert len(caught) == 1
    with pytest.raises(UserError, match="none of its 1 frames has an image file"):
        load_dataset(write(tmp_path, [frame("gone")]))


def test_damaged_images(tmp_path):
    write(tmp_path)
    file = tmp_path / "train/b.png"
    good = file.read_bytes()
    for bad in (b"", b"hello", good[:60], good[:-30]):
        file.write_bytes(bad)
        with pytest.raises(UserError, match=r"frame 1: .*b\.png cannot be read as an image"):
            load_dataset(tmp_path)
    for size, message in (((60000, 60000), "cannot be read"), ((9000, 9000), "too many"), ((0, 5), "cannot be read")):
        header = struct.pack(">II", *size) + good[24:29]
        file.write_bytes(good[:8] + chunk(b"IHDR", header) + good[33:])
        with pytest.raises(UserError, match=f"frame 1: .*{message}"):
            load_dataset(tmp_path)


def test_damaged_exr(tmp_path):
    write(tmp_path, [frame("a.exr")])
    file = tmp_path / "train/a.exr"
    file.write_bytes(b"v/1\x01 nothing here")
    with pytest.raises(UserError, match="frame 0: .*a.exr cannot be read as an image"):
        load_dataset(tmp_path)
    write_exr(file, np.full((3, 4, 3), np.nan, np.float32))
    with pytest.raises(UserError, match="NaN or infinite pixels"):
        load_dataset(tmp_path)


def test_empty_masks(tmp_path):
    empty = np.zeros((16, 24, 4), np.uint8)
    with pytest.warns(UserWarning, match="1 views with an empty mask") as caught:
        assert only(write(tmp_path, images={"a.png": empty, "b.png": disc()})).name == "b"
    assert len(caught) == 1
    with pytest.raises(UserError, match="alpha channel of every image is zero"):
        load_dataset(write(tmp_path, images={"a.png": empty, "b.png": empty}))


def test_normals_of_another_size(tmp_path):
    write(tmp_path, images={"a.png": disc(), "a_normal.png": disc()[:5], "b.png": disc()})
    write(tmp_path, split="test", images={})
    with pytest.raises(UserError, match="a_normal.png is 24 x 5, its photograph 24 x 16"):
        load_dataset(tmp_path)


def test_mutated_bytes_never_give_a_traceback(tmp_path):
    """A fuzzer in small: changed, cut and repeated bytes in the JSON and in a PNG."""
    rng = random.Random(0)
    write(tmp_path)
    for file in (tmp_path / "transforms_train.json", tmp_path / "train/a.png"):
        good = file.read_bytes()
        for _ in range(300):
            bad = bytearray(good)
            for _ in range(rng.randint(1, 4)):
                i, n = rng.randrange(len(bad)), rng.choice([1, 1, 1, 8])
                bad[i : i + n] = rng.choice([bytes([rng.randrange(256)]), b"", b"9", b"null", bad[i : i + n] * 2]) or b" "
            file.write_bytes(bad)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                try:
                    view = load_dataset(tmp_path).train[0]
                    assert np.isfinite(view.camera.to_world).all() and view.pixels.shape[2] == 4
                except UserError as error:
                    assert "\n" not in str(error)
        file.write_bytes(good)

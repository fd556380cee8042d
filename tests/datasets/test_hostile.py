"""Captures that nobody should have made: pipes, names, nested pickles, images that promise much. Each is used, or refused in one
line, soon and in little memory."""

import json
import os
import pickle
import time
import tracemalloc
import warnings

import numpy as np
import pytest
from PIL import Image

from rgs_mi.core.errors import UserError
from rgs_mi.core.inputs import check_file, is_file, opened, read_file
from rgs_mi.datasets import frames, load_dataset, path_traced
from rgs_mi.datasets.images import read_image

from captures import (
    photographs,
    save,
    write_blender,
    write_cloud,
    write_colmap,
    write_exr,
    write_llff,
    write_nerfstudio,
    write_nero,
)

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pipes")


def refused(call, *words):
    """The one line with which ``call()`` ends, which has all ``words``; soon, and in little memory."""
    tracemalloc.start()
    start = time.process_time()
    try:
        with pytest.raises(UserError) as error:
            call()
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert all(word in str(error.value) for word in words), error.value
    assert time.process_time() - start < 5 and peak < 1 << 28
    return str(error.value)


# ---- The door ----


def test_only_regular_files_of_tolerable_size(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "file").write_bytes(b"12345")
    (tmp_path / "link").symlink_to("file")
    assert read_file(tmp_path / "link", 5) == b"12345" and is_file(tmp_path / "link")
    for path, words in (
        (tmp_path / "pipe", "a pipe or a device"),
        ("/dev/zero", "a pipe or a device"),
        (tmp_path, "a folder"),
        (tmp_path / "missing", "No such file"),
        (tmp_path / ("a" * 300), "too long"),
        ("a\0b", "no file has such a name"),
    ):
        for call in (lambda p: check_file(p), lambda p: opened(p).__enter__()):
            with pytest.raises(OSError) as error:
                call(path)
            assert words in error.value.strerror
        assert not is_file(path)
    with pytest.raises(OSError, match="5 bytes, and 4 are the most"):
        read_file(tmp_path / "file", 4)


@pytest.mark.parametrize("name", ["photograph", "mask", "cameras", "points"])
@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_what_is_no_file(tmp_path, name, kind):
    """Nothing hangs, whatever is no file in a capture of nerfstudio."""
    shots = photographs(3)
    root = write_nerfstudio(tmp_path, shots, ply_file_path="cloud.ply")
    meta = json.loads((root / "transforms.json").read_text())
    for frame in meta["frames"]:
        frame["mask_path"] = "masks/m.png"
    (root / "transforms.json").write_text(json.dumps(meta))
    save(root / "masks/m.png", np.full((96, 120), 200, np.uint8))
    write_cloud(root / "cloud.ply")
    path = {
        "photograph": next((root / "images").iterdir()),
        "mask": root / "masks/m.png",
        "cameras": root / "transforms.json",
    }
    path = path.get(name, root / "cloud.ply")
    path.unlink(missing_ok=True)
    {"pipe": os.mkfifo, "device": lambda p: p.symlink_to("/dev/zero"), "folder": os.mkdir}[kind](path)
    if name in ("photograph", "points"):
        with pytest.warns(UserWarning, match="no image file|not there"):
            assert load_dataset(root).train
    else:
        refused(
            lambda: load_dataset(root), "no layout" if name == "cameras" else "a folder" if kind == "folder" else "a pipe"
        )


@pytest.mark.parametrize("write", [write_blender, write_nerfstudio, write_colmap, write_llff, write_nero])
def test_pipes_in_place_of_any_file(tmp_path, write):
    """Every file of a capture in turn."""
    root = write(tmp_path, photographs(2))
    for path in [p for p in root.rglob("*") if p.is_file()]:
        good = path.read_bytes()
        path.unlink()
        os.mkfifo(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                load_dataset(root)
            except UserError as error:
                assert len(str(error).splitlines()) == 1
        path.unlink()
        path.write_bytes(good)


# ---- Names ----


@pytest.mark.parametrize(
    "name", ["**a/v.png", "a" * 300 + "/v.png", "a" * 300 + ".png", "[/v.png", "v\0.png", "a\nb\x1b[2J/v.png"]
)
def test_names_that_are_none(tmp_path, name):
    root = write_nerfstudio(tmp_path, photographs(2))
    meta = json.loads((root / "transforms.json").read_text())
    for k, frame in enumerate(meta["frames"]):
        frame["file_path"] = name if k == 0 else name.replace("v", "w")
        frame |= {"w": 5000, "h": 4000}  # then smaller copies are looked for
    (root / "transforms.json").write_text(json.dumps(meta))
    line = refused(lambda: load_dataset(root), "none of its 2 frames has an image file")
    assert line.isprintable()


def test_scenes_with_long_values(tmp_path):
    """A matrix of sixteen long numbers is no name of a file."""
    scene = tmp_path / "a.xml"
    scene.write_text(f'<scene version="3.0.0"><matrix value="{" ".join(["0.1234567890123456789"] * 16)}"/>\0</scene>')
    assert path_traced._digest(scene, set())


# ---- Pickles ----


def nested(depth):
    value = [1.0]
    for _ in range(depth):
        value = [value, value]
    return value


@pytest.mark.parametrize("what", ["shared", "deep", "long", "other"])
def test_pickles_that_unfold(tmp_path, what):
    root = write_nero(tmp_path, photographs(2))
    path = next(root.glob("*-camera.pkl"))
    if what == "shared":
        content = pickle.dumps([nested(40), nested(40)])
    elif what == "deep":
        content = b"(" + b"]" * 30_000 + b"a" * 29_999 + b"\x88l."
    elif what == "long":
        text = b"X" + (30_000).to_bytes(4, "little") + b"\xc3\xa9" * 15_000
        content = b"(" + b"c_codecs\nencode\nq\x00" + text + b"q\x01" + b"0(" + b"h\x00h\x01\x85R" * 4000 + b"l."
    else:
        content = pickle.dumps([["a", {}], "b"])
    path.write_bytes(content)
    refused(lambda: load_dataset(root), path.name)
    split = root / "synthetic_split_128.pkl"
    path.write_bytes(next(p for p in root.glob("*-camera.pkl") if p != path).read_bytes())
    split.write_bytes(pickle.dumps([nested(40), []]))
    refused(lambda: load_dataset(root), split.name)
    split.write_bytes(b"\0" * 70_000)
    refused(lambda: load_dataset(root), "65536 are the most")


# ---- Images ----


def test_data_windows_are_placed(tmp_path):
    """An EXR's image is its display window: what is rendered of it alone lies where it belongs, what is beyond is cut."""
    import OpenEXR

    image = np.random.default_rng(0).uniform(0.1, 1, (8, 10, 4)).astype(np.float32)

    def write(window, display):
        (x0, y0), (x1, y1) = window
        plane = lambda c: np.ascontiguousarray(image[:, :, c])
        header = {"type": OpenEXR.scanlineimage}
        header |= {"dataWindow": (np.array([x0, y0], "i4"), np.array([x1, y1], "i4"))}
        header |= {"displayWindow": tuple(np.array(corner, "i4") for corner in display)}
        many = {f"extra.{k}": np.full((8, 10), np.nan, np.float32) for k in range(48)}  # and none of these matters
        OpenEXR.File(header, {name: plane(k) for k, name in enumerate("RGBA")} | many).write(str(tmp_path / "a.exr"))
        return read_image(tmp_path / "a.exr", "here")[0]

    whole = write([(5, 7), (14, 14)], [(5, 7), (14, 14)])
    assert whole.shape == (8, 10, 4)
    inside = write([(3, 2), (12, 9)], [(0, 0), (19, 11)])
    assert inside.shape == (12, 20, 4)
    np.testing.assert_array_equal(inside[2:10, 3:13], whole)
    inside[2:10, 3:13] = 0
    assert not inside.any()
    np.testing.assert_array_equal(write([(-2, -3), (7, 4)], [(0, 0), (3, 2)]), whole[3:6, 2:6])
    assert not write([(50, 50), (59, 57)], [(0, 0), (3, 2)]).any()


def test_nothing_is_nothing(tmp_path):
    """Renderers leave NaN where alpha is 0; elsewhere it is damage."""
    rgb, alpha = np.full((4, 4, 3), 0.5, np.float32), np.ones((4, 4, 1), np.float32)
    rgb[0, 0], alpha[0, 0] = np.nan, 0
    write_exr(tmp_path / "a.exr", rgb, alpha)
    pixels, masked = read_image(tmp_path / "a.exr", "here")
    assert masked and not pixels[0, 0].any() and (pixels[1:] == [0.5, 0.5, 0.5, 1]).all()
    rgb[2, 2] = np.nan
    write_exr(tmp_path / "a.exr", rgb, alpha)
    refused(lambda: read_image(tmp_path / "a.exr", "here"), "NaN or infinite")


def test_photographs_that_lie_on_their_side_are_told(tmp_path):
    root = write_colmap(tmp_path, photographs(3), type=".jpg")
    path = sorted((root / "images").iterdir())[1]
    exif = Image.Exif()
    exif[0x0112] = 6
    with Image.open(path) as image:
        image.load()
        image.save(path, exif=exif)
    with pytest.warns(UserWarning, match=rf"EXIF of 1 photographs \(first: {path.name}\) says that they lie on their side"):
        views = load_dataset(root).train + load_dataset(root).test
    assert {view.pixels.shape for view in views} == {(96, 120, 4)}


# ---- Memory ----


@pytest.fixture
def large(tmp_path):
    """Two hundred photographs of 12 megapixels, which are one file of black and white."""
    root = write_nerfstudio(tmp_path, photographs(1))
    meta = json.loads((root / "transforms.json").read_text())
    (frame,) = meta["frames"]
    Image.new("1", (4000, 3200)).save(root / "images/large.png")
    meta["frames"] = []
    for k in range(200):
        (root / f"images/p{k}.png").symlink_to("large.png")
        meta["frames"].append(frame | {"file_path": f"images/p{k}.png"})
    (root / "transforms.json").write_text(json.dumps(meta))
    return root


def test_memory_is_planned_before_anything_is_decoded(large, monkeypatch):
    monkeypatch.setattr(frames, "read_image", lambda *_: pytest.fail("decoded"))
    monkeypatch.setattr(frames, "available", lambda: 4 << 30)
    line = refused(
        lambda: load_dataset(large, 8192), "200 photographs take 10.2 GB of memory at 4000 pixels", "4.3 GB are free"
    )
    assert line.endswith("give a smaller resolution: --set resolution=2200")


def test_memory_of_a_fit_is_told(large, monkeypatch):
    monkeypatch.setattr(frames, "available", lambda: 2 << 30)
    monkeypatch.setattr(frames, "_load_view", lambda *_, **__: pytest.fail("planned"))
    with pytest.warns(UserWarning, match=r"a fit to them up to 2\.7 GB, and 2\.1 GB are free: give a smaller resolution"):
        with pytest.raises(pytest.fail.Exception, match="planned"):
            load_dataset(large)


def test_photographs_are_read_within_a_budget():
    """Never more at the same time than fits; one that is larger than all of it has it for itself."""
    from concurrent.futures import ThreadPoolExecutor

    budget, held, most = frames._Budget(10), [], []

    def work(amount):
        with budget.taken(amount):
            held.append(min(amount, 10))
            most.append(sum(held))
            time.sleep(0.001)
            held.remove(min(amount, 10))

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(work, [3, 4, 20, 1, 9, 10, 5, 5] * 5))
    assert max(most) <= 10 and not held

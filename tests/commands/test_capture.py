"""`rgs-mi capture`: cameras found again, what is left out, masks, videos, and what can be wrong with all of it."""

import json
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from rgs_mi.commands import capture as command
from rgs_mi.commands.capture import capture
from rgs_mi.core.alignment import pose_errors
from rgs_mi.core.errors import UserError
from rgs_mi.datasets import load_dataset, sources, structure_from_motion
from rgs_mi.datasets.images import image_size
from rgs_mi.datasets.structure_from_motion import pairs

import photographs

COUNT = 10


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Undistorted photographs are kept below the current folder."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    """A folder of photographs of the corner, with one more of something else."""
    folder = photographs.write(tmp_path_factory.mktemp("taken") / "in", photographs.ring(COUNT), **photographs.LENS)
    noise = ndimage.gaussian_filter(np.random.default_rng(9).normal(size=(300, 400)), 2)
    Image.fromarray(np.uint8(np.clip(128 + 300 * noise, 0, 255))).convert("RGB").save(folder / "p03 other.jpg")
    return folder


@pytest.fixture(scope="module")
def masks(taken):
    folder = taken.parent / "masks"
    folder.mkdir()
    mask = np.zeros((150, 200), np.uint8)
    mask[40:110, 60:150] = 255
    for path in taken.iterdir():
        Image.fromarray(mask).save(folder / f"{path.stem}.png")
    return folder


@pytest.fixture(scope="module")
def made(taken, masks, tmp_path_factory):
    """(the capture, what was printed)."""
    pytest.importorskip("pycolmap")
    import contextlib
    import io

    with contextlib.redirect_stdout(io.StringIO()) as said:
        out = capture(taken, tmp_path_factory.mktemp("made") / "out", masks=masks)
    return out, said.getvalue()


# ---- What comes out ----


def test_cameras_and_lens(made):
    out, said = made
    meta = json.loads((out / "transforms.json").read_text())
    np.testing.assert_allclose([meta["fl_x"], meta["fl_y"]], photographs.FOCAL, rtol=0.01)
    np.testing.assert_allclose([meta["k1"], meta["k2"]], [*photographs.LENS.values()], atol=0.02)
    data = load_dataset(out)
    cameras = {view.name: view.camera for view in data.train + data.test}
    assert sorted(cameras) == [f"p{k:02d}" for k in range(COUNT)] and len(data.test) == 2
    truth = photographs.ring(COUNT)
    angles, distances = pose_errors([cameras[name] for name in sorted(cameras)], truth)
    assert np.median(angles) < 0.3 and angles.max() < 0.6 and np.median(distances) < 0.02
    assert all(view.masked for view in data.train) and len(data.points) > 100 and data.point_colors is not None
    assert f"{COUNT} photographs placed, 1 left out" in said and f"rgs-mi optimize object --data {out}" in said


def test_the_world(made):
    """z is up, the point that all look at is the origin, and cameras are about four units away."""
    data = load_dataset(made[0])
    cameras = {view.name: view.camera for view in data.train + data.test}
    origins = np.stack([cameras[name].origin for name in sorted(cameras)])
    assert 3.5 < np.median(np.linalg.norm(origins, axis=1)) < 4.5
    truth = np.stack([camera.origin for camera in photographs.ring(COUNT)])
    heights = np.polyfit(truth[:, 2], origins[:, 2], 1)
    assert np.corrcoef(truth[:, 2], origins[:, 2])[0, 1] > 0.99 and heights[0] > 0


def test_what_is_left_out_and_what_is_left(made):
    out, _ = made
    assert sorted(path.name for path in out.iterdir()) == [
        "capture.html",
        "images",
        "masks",
        "points.ply",
        "transforms.json",
    ]
    assert not list(out.rglob("*other*")) and [path.name for path in out.parent.iterdir()] == ["out"]
    page = (out / "capture.html").read_text("utf-8")
    assert "p03 other.jpg" in page and "nothing in common" in page and "are few for a shiny object" in page
    assert page.count("<svg") == 4 and page.count("data:image/jpeg") == COUNT + 1


# ---- Without COLMAP's work ----


@pytest.fixture
def poses_are_known(monkeypatch):
    """COLMAP is not asked: a capture ends where its poses would begin."""

    class Reached(Exception):
        pass

    def reached(images, sizes, *_):
        raise Reached(sizes)

    monkeypatch.setattr(command, "check", lambda: None)
    monkeypatch.setattr(command, "structure_from_motion", reached)
    return Reached


def save(path, size=(64, 48), **options):
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(0).integers(0, 255, (size[1], size[0], 3), np.uint8)
    Image.fromarray(pixels).save(path, **options)
    return path


def refused(message, *arguments, **options):
    with pytest.raises(UserError, match=message) as caught:
        capture(*arguments, **options, quiet=True)
    assert "\n" not in str(caught.value)


def test_photographs_are_upright_small_and_named_without_spaces(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6  # lies on its side
    exif.get_ifd(0x8769).update({0xA405: 28, 0x829A: 1 / 100, 0x829D: 2.0, 0x8827: 100})
    exif.get_ifd(0x8825)[1] = "N"  # where it was taken
    save(tmp_path / "in/a b.jpg", (64, 48), exif=exif)
    save(tmp_path / "in/c.PNG", (20, 16))
    save(tmp_path / "in/large.jpeg", (90, 60))
    (tmp_path / "in/notes.txt").write_text("no photograph")
    (tmp_path / "in/._c.png").write_bytes(b"what some systems leave beside files")
    (tmp_path / "out").mkdir()
    fractions = []
    found = sources.photographs(tmp_path / "in", tmp_path / "out", 60, fractions.append)
    assert [s.name for s in found] == ["a_b.jpg", "c.png", "large.jpg"] and fractions[-1] == 1
    assert [s.origin for s in found] == ["a b.jpg", "c.PNG", "large.jpeg"]
    with Image.open(tmp_path / "out/a_b.jpg") as turned:
        tags = {0xA405: 28, 0x829A: 1 / 100, 0x829D: 2.0, 0x8827: 100}  # what a fit can use
        assert turned.size == (45, 60) and dict(turned.getexif().get_ifd(0x8769)) == tags
        assert not turned.getexif().get_ifd(0x8825)
    with Image.open(tmp_path / "out/large.jpg") as scaled:
        assert scaled.size == (60, 40)
    assert (tmp_path / "out/c.png").read_bytes() == (tmp_path / "in/c.PNG").read_bytes()
    np.testing.assert_allclose(found[0].exposure, np.log2(400))
    assert found[1].exposure is None and all(s.sharpness > 100 for s in found)


def test_sharpness():
    grey = np.random.default_rng(0).integers(0, 255, (300, 400)).astype(np.float32)
    values = [sources.sharpness(ndimage.gaussian_filter(grey, s)) for s in (0, 1, 2)]
    assert values[0] > 3 * values[1] > 9 * values[2]


def test_the_sharpest_frames_of_a_video(tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    import imageio_ffmpeg

    texture = np.kron(np.random.default_rng(0).integers(0, 255, (60, 90, 3)), np.ones((4, 4, 1)))
    writer = imageio_ffmpeg.write_frames(str(tmp_path / "v.mp4"), (320, 240), fps=10, macro_block_size=1)
    writer.send(None)
    for k in range(20):
        frame = texture[:, k : k + 320] if k % 5 == 3 else ndimage.gaussian_filter(texture[:, k : k + 320], (3, 3, 0))
        writer.send(np.ascontiguousarray(frame.astype(np.uint8)))
    writer.close()
    (tmp_path / "out").mkdir()
    found = sources.frames(tmp_path / "v.mp4", tmp_path / "out", 4, 160, lambda fraction: None)
    assert [s.origin for s in found] == [f"frame {k} at {k / 10:.2f} s" for k in (3, 8, 13, 18)]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [s.name for s in found]
    with Image.open(tmp_path / "out/frame_0001.jpg") as first:
        assert first.size == (160, 120)
    assert len(sources.frames(tmp_path / "v.mp4", tmp_path / "out", 500, 160, lambda fraction: None)) == 20


def test_pairs():
    names = [str(k) for k in range(400)]
    assert len(pairs(names[:150])) == 150 * 149 / 2
    some = pairs(names)
    assert len(some) == len(set(some)) < 400 * 20 and ("0", "1") in some and ("10", "58") in some


@pytest.mark.parametrize("size", [0, 1])
def test_nothing_to_photograph(tmp_path, poses_are_known, size):
    (tmp_path / "in").mkdir()
    refused("'nowhere' does not exist: give a folder of photographs, or a video", "nowhere", "out")
    refused("holds no photographs .*: give the folder that they are in", "in", "out")
    (tmp_path / "in/a.HEIC").write_bytes(b"")
    refused("holds no photographs .*: convert its HEIC files to JPEG", "in", "out")
    (tmp_path / "in/a.jpg").write_bytes(b"not one")
    refused("in/a.jpg cannot be read as a photograph .*: remove it, or replace it", "in", "out")
    save(tmp_path / "in/a.jpg", (64, 8))
    refused("in/a.jpg is 64 x 8 pixels, too small", "in", "out")
    save(tmp_path / "in/a.jpg")
    save(tmp_path / "in/a.png")
    refused("in/a.png and a.jpg would have the same name", "in", "out")
    (tmp_path / "in/v.mp4").write_bytes(b"not one" * 100)
    refused("v.mp4 cannot be decoded as a video: export it as MP4", tmp_path / "in/v.mp4", "out")
    refused("--frames 2: give 3 at the very least", tmp_path / "in/v.mp4", "out", frames=2)
    save(tmp_path / "there/a.jpg")
    refused("there is there and not empty: choose another --out", "in", "there")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in", "there"]  # and nothing half made


def test_an_interrupt_leaves_nothing(tmp_path, monkeypatch, poses_are_known):
    save(tmp_path / "in/a.jpg")

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "structure_from_motion", interrupted)
    with pytest.raises(KeyboardInterrupt):
        capture("in", "new/out", quiet=True)
    assert not list((tmp_path / "new").iterdir())


def test_one_photograph(tmp_path):
    pytest.importorskip("pycolmap")
    save(tmp_path / "in/a.jpg")
    refused("1 photographs are too few: give 3 at the very least", "in", "out")


def test_exif_tells_the_focal_length(tmp_path):
    """Also of what is turned; photographs that lie and stand have a lens each."""
    pytest.importorskip("pycolmap")
    for name, orientation in (("a", 1), ("b", 6), ("c", 1)):
        exif = Image.Exif()
        exif[0x0112] = orientation
        exif.get_ifd(0x8769)[0xA405] = 40
        save(tmp_path / f"in/{name}.jpg", (160, 120), exif=exif)
    for name in ("out", "work"):
        (tmp_path / name).mkdir()
    found = sources.photographs(tmp_path / "in", tmp_path / "out", 1600, lambda fraction: None)
    sizes = {s.name: image_size(tmp_path / "out" / s.name, "") for s in found}
    database = tmp_path / "work/database.db"
    structure_from_motion._extract(database, tmp_path / "out", sizes, lambda *_: None, 1)
    lenses = structure_from_motion._query(database, "SELECT width, height, params FROM cameras")
    assert [lens[:2] for lens in lenses] == [(160, 120), (120, 160)]
    for *_, parameters in lenses:
        np.testing.assert_allclose(np.frombuffer(parameters)[:2], 40 / np.hypot(36, 24) * 200, rtol=1e-3)


def test_no_texture(tmp_path):
    pytest.importorskip("pycolmap")
    for k in range(3):
        (tmp_path / "in").mkdir(exist_ok=True)
        Image.new("RGB", (160, 120), (90, 90, 90 + k)).save(tmp_path / f"in/{k}.jpg")
    refused("too little texture .*: put the object on a textured ground", "in", "out")


def test_turning_on_the_spot(tmp_path):
    pytest.importorskip("pycolmap")
    photographs.write(tmp_path / "in", photographs.turning(5))
    refused("never turning on the spot", "in", "out")
    assert [path.name for path in tmp_path.iterdir()] == ["in"]


def test_colmap_is_missing(tmp_path, monkeypatch):
    save(tmp_path / "in/a.jpg")
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    refused(r"poses of photographs need COLMAP: pip install 'rgs-mi\[capture\]'", "in", "out")


# ---- Masks ----


def test_masks_of_a_folder(tmp_path, poses_are_known):
    source = [sources.Source("a_b.jpg", "a b.jpg", 1.0), sources.Source("c.jpg", "c.jpg", 1.0)]
    for each in source:
        save(tmp_path / "images" / each.name)
    mask = np.zeros((96, 128), np.uint8)
    mask[:, 64:] = 255
    (tmp_path / "masks").mkdir()
    Image.fromarray(mask).save(tmp_path / "masks/a b.png")
    Image.fromarray(mask).save(tmp_path / "masks/c.jpg.png")
    command.mask_files.from_folder(tmp_path / "masks", source, tmp_path / "images", tmp_path / "made")
    for name in ("a_b", "c"):
        with Image.open(tmp_path / f"made/{name}.png") as image:
            grey = np.asarray(image)
        assert grey.shape == (48, 64) and not grey[:, :31].any() and (grey[:, 33:] == 255).all()
        found = command.mask_files.silhouette(tmp_path / f"images/{name}.jpg", tmp_path / f"made/{name}.png")
        assert found is not None and found.coverage == 0.5 and found.cut_off
    assert command.mask_files.silhouette(tmp_path / "images/c.jpg", tmp_path / "none.png") is None
    for name in ("a b.jpg", "c.jpg"):
        save(tmp_path / "in" / name)
    (tmp_path / "masks/c.jpg.png").unlink()
    refused("masks: 1 of 2 photographs have no mask .first: c.jpg.: add c.png", "in", "out", masks="masks")
    Image.fromarray(mask[:50]).save(tmp_path / "masks/c.png")
    refused("masks/c.png: it is 128 x 50, the photograph 64 x 48", "in", "out", masks="masks")
    refused("the folder of masks 'nowhere' does not exist", "in", "out", masks="nowhere")
    refused("--masks and --mask-command both", "in", "out", masks="masks", mask_command="x {image} {mask}")


def test_masks_of_a_command(tmp_path, poses_are_known):
    source = [sources.Source("a b's.jpg", "a", 1.0)]
    save(tmp_path / "images/a b's.jpg")

    def run(text):
        program = tmp_path / "program.py"
        program.write_text(f"import sys\nfrom PIL import Image\nimage, mask = sys.argv[1:]\n{text}\n")
        words = command.mask_files.check_command(f"{shlex.quote(sys.executable)} program.py {{image}} {{mask}}")
        target = Path("made")
        command.mask_files.from_command(words, source, tmp_path / "images", target, lambda fraction: None)
        with Image.open(target / "a b's.png") as mask:
            return np.asarray(mask)

    assert (run("Image.new('L', Image.open(image).size, 255).save(mask)") == 255).all()
    for text, message in (
        ("print('no', 'model', sep='\\n'); sys.exit(3)", r"ended with 3 for a \(model\): try it by hand"),
        ("pass", r"wrote no mask for a \(it said nothing\)"),
        ("Image.new('L', (9, 90)).save(mask)", "it is 9 x 90, the photograph 64 x 48"),
        ("open(mask, 'w').write('x')", "cannot be read as an image"),
    ):
        for path in Path("made").iterdir():
            path.unlink()
        Path("made").rmdir()
        with pytest.raises(UserError, match=message):
            run(text)
    for text, message in (
        ("prog {image}", "write {image} for the photograph and {mask}"),
        ("no_such_program {image} {mask}", "there is no program 'no_such_program'"),
        ("'open {image} {mask}", "open quotation"),
    ):
        refused(message, "images", "out", mask_command=text)

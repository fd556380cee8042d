"""Damaged files: whatever happens to one file of a capture, a surfel file, a checkpoint or a depth map, what reads it
gives sound data or a UserError of one line.

A case is a number: it says which file is damaged and how. ``pytest`` runs the first `CASES`;
``python tests/test_fuzz.py 2000 [FIRST]`` runs 2000, in a process that may hold `MEMORY` bytes. Each is to end within `SECONDS`,
and to take no more than `MORE` bytes. The file of a case that fails is kept in `KEPT`.
"""

import faulthandler
import json
import os
import random
import re
import resource
import signal
import struct
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import ExifTags, Image

import rgs_mi
from rgs_mi.core.caches import cached_arrays
from rgs_mi.core.errors import UserError
from rgs_mi.core.scene_files import load_scene
from rgs_mi.datasets import exif, load_dataset
from rgs_mi.fit import checkpoint
from rgs_mi.fit.curves import Curves
from rgs_mi.priors import files as depth_files
from rgs_mi.report import cameras, results
from rgs_mi.settings.config import load_config, to_dict
from rgs_mi.settings.settings import Settings
from rgs_mi.shading.shader import Shader, initial_weights
from rgs_mi.surfels.ply import read_ply, write_ply

from captures import (
    FOCAL,
    PRINCIPAL,
    frames,
    photographs,
    save,
    write_blender,
    write_cloud,
    write_colmap,
    write_exr,
    write_llff,
    write_nerfstudio,
    write_nero,
    write_png16,
)

CASES, SECONDS, MEMORY, MORE = 200, 5, 2 << 30, 1 << 29
KEPT = Path(__file__).parents[1] / ".fuzz"
SCENE = """<scene version="3.0.0">
    <default name="spp" value="4"/>
    <integrator type="rgs_deferred"> <string name="diffuse" value="radiance"/> </integrator>
    <sensor type="perspective" id="one"> <float name="fov" value="40"/>
        <transform name="to_world"> <lookat origin="0, -4, 1" target="0, 0, 0" up="0, 0, 1"/> </transform>
        <film type="hdrfilm"> <integer name="width" value="30"/> <integer name="height" value="24"/> <rfilter type="box"/> </film>
        <sampler type="independent"> <integer name="sample_count" value="$spp"/> </sampler> </sensor>
    <shape type="surfels" id="object"> <string name="filename" value="object.ply"/> </shape>
    <emitter type="envmap"> <string name="filename" value="light.exr"/>
        <transform name="to_world"> <matrix value="1 0 0 0 0 0 -1 0 0 1 0 0 0 0 0 1"/> </transform> </emitter>
</scene>"""
OPENCV = (*FOCAL, *PRINCIPAL, -0.1, 0.02, 0.01, -0.01)


# ---- What is damaged ----


def write_all(root: Path) -> list:
    """(loader, files it reads) of small captures and other files below ``root``."""
    import mitsuba as mi  # after rgs_mi

    def folder(name):
        (root / name).mkdir()
        return root / name

    images = {name: pixels[::4, ::4].copy() for name, pixels in photographs(3).items()}
    mask = np.full((24, 30), 255, np.uint8)
    mask[:8] = 0

    blender = write_blender(folder("blender"), images)
    for name in images:
        save(blender / f"images/{name}_alpha.png", mask)
        save(blender / f"images/{name}_normal.png", images[name])
    write_cloud(blender / "points3d.ply")

    entries = [frame | {"mask_path": "masks/m.png"} for frame in frames(images)]
    studio = write_nerfstudio(
        folder("nerfstudio"),
        images,
        entries,
        k1=-0.1,
        k4=0.01,
        p1=0.01,
        ply_file_path="cloud.ply",
        test_filenames=["images/v01.png"],
    )
    save(studio / "masks/m.png", np.dstack([mask] * 3))
    write_cloud(studio / "cloud.ply")

    binary = write_colmap(folder("binary"), images, "OPENCV", OPENCV)
    save(binary / "masks/v01.png", mask)
    text = write_colmap(folder("text"), images, "OPENCV", OPENCV, suffix=".txt", type=".exr")
    nero = write_nero(folder("nero"), images, np.where(mask, 4.0, 15.0))
    nero_text = write_nero(folder("protocol0"), images, protocol=0)

    llff = write_llff(folder("llff"), images, scale=1 / 4)
    for name in images:
        save(llff / f"masks/{name}.png", mask)

    jpeg = write_llff(folder("jpeg"), images, scale=1 / 4, suffix=".jpg")
    for path in jpeg.glob("images/*.jpg"):  # as cameras write them, with an exposure
        exif = Image.Exif()
        exif.get_ifd(ExifTags.IFD.Exif).update({ExifTags.Base.ExposureTime: 0.01, ExifTags.Base.FNumber: 2.5})
        Image.open(path).save(path, exif=exif)

    rng = np.random.default_rng(0)
    surfels = {
        "centers": rng.normal(size=(5, 3)),
        "rotations": np.tile([0, 0, 0, 1.0], (5, 1)),
        "scales": np.full((5, 2), 0.1),
        "opacities": np.full((5, 1), 0.5),
        "sh": rng.normal(size=(5, 12)),
        "base_color": np.full((5, 3), 0.5),
        "roughness": np.full((5, 1), 0.3),
        "metallic": np.zeros((5, 1)),
        "delta_normal": np.zeros((5, 3)),
        "curvature": np.zeros((5, 3)),
    }
    write_ply(root / "surfels.ply", surfels)

    run = folder("run")
    for step in (1, 2):
        checkpoint.save(run, surfels, {"step": step})

    (root / "settings.yaml").write_text(yaml.safe_dump(to_dict(Settings())))
    Shader(mi.TensorXf(initial_weights(0))).save(root / "shader.npz")
    Curves([{"step": 1, "psnr": 20.5}, {"step": 2, "psnr": 21.5}]).write(run)
    (run / "metrics.json").write_text(json.dumps({"finished": True, "settings": to_dict(Settings()), "psnr": 30.5}))

    views, maps = load_dataset(blender).train, folder("depths")
    depth = np.linspace(1, 4, 24 * 30, dtype=np.float32).reshape(24, 30)
    views = [type(view)(f"d{i}", view.camera, view.pixels, view.masked, None, view.path) for i, view in enumerate(views * 2)]
    np.savez_compressed(maps / "d0.npz", depth=depth)
    np.save(maps / "d1.npy", depth)
    write_exr(maps / "d2.exr", np.dstack([depth] * 3))
    write_png16(maps / "d3.png", 1000 * depth)

    scene = folder("scene")
    write_ply(scene / "object.ply", surfels)
    write_exr(scene / "light.exr", np.full((8, 16, 3), 0.5, np.float32))
    (scene / "scene.xml").write_text(SCENE)

    cached = {"values": rng.normal(size=(20, 3)).astype(np.float32)}
    cached_arrays(root / "cache.npz", lambda arrays: None, lambda: cached)

    row = {"size": [30, 24], "focal": FOCAL, "principal": PRINCIPAL, "gain": [1.0, 1.1, 0.9]}
    row |= {"given": np.eye(4).tolist(), "to_world": np.eye(4).tolist()}
    row |= {"distortion": {"k1": 0.1, "k2": 0.0, "p1": 0.0, "p2": 0.0, "reach": 1.5}}
    learned = {"learned": {"poses": True, "exposure": True}, "train": {v.name: row for v in views}}
    (folder("learned") / cameras.FILE).write_text(json.dumps(learned))

    inside = lambda path: sorted(file for file in path.rglob("*") if file.is_file())
    targets = [
        (lambda path=path: check_dataset(load_dataset(path)), inside(path))
        for path in (blender, studio, binary, text, nero, nero_text, llff, jpeg)
    ]
    return targets + [
        (lambda: check_finite(read_ply(root / "surfels.ply").values()), [root / "surfels.ply"]),
        (lambda: check_checkpoint(checkpoint.load_latest(run)), inside(run)),
        (lambda: check_depths(depth_files.load(views, maps)), inside(maps)),
        (lambda: load_config(Settings, [root / "settings.yaml"]), [root / "settings.yaml"]),
        (lambda: check_finite([Shader.load(root / "shader.npz").weights.numpy()]), [root / "shader.npz"]),
        (lambda: check_scene(load_scene(scene / "scene.xml", {})), inside(scene)),
        (lambda: check_cache(cached_arrays(root / "cache.npz", check_cache, lambda: cached)), [root / "cache.npz"]),
        (lambda: check_cameras(cameras.read_training(root / "learned", views)), [root / "learned" / cameras.FILE]),
        (lambda: (results.saved_figures(run), Curves.read(run)), [run / "metrics.json", run / "curves.csv"]),
    ]


def check_dataset(data):
    assert data.train
    check_finite([exif.log_gains([view.path for view in data.train])])
    for view in data.train + data.test:
        camera = view.camera
        assert view.pixels.shape == (*camera.size[::-1], 4) and view.pixels[..., 3].any()
        check_finite([camera.to_world, camera.focal, camera.principal, view.pixels])
        assert np.abs(camera.to_world[:3, :3] @ camera.rotation - np.eye(3)).max() < 1e-6 and min(camera.focal) > 0
        assert view.normal is None or view.normal.shape == (*view.pixels.shape[:2], 3)
    if data.points is not None:
        check_finite([data.points])


def check_scene(scene):
    import mitsuba as mi

    params = mi.traverse(scene)
    check_finite([np.array(params[name]) for name in params.keys() if "data" in name or name.endswith("centers")])


def check_cache(arrays):
    assert arrays["values"].shape == (20, 3)
    check_finite(arrays.values())


def check_cameras(found):
    for seen in (found or {}).values():  # None: there is no such file
        check_finite([seen.camera.to_world, seen.camera.focal, seen.camera.principal, seen.gain])


def check_finite(arrays):
    for array in arrays:
        assert np.isfinite(array).all()


def check_checkpoint(found):
    arrays, meta = found
    assert isinstance(meta, dict) and all(isinstance(array, np.ndarray) for array in arrays.values())


def check_depths(priors):
    for prior in priors:
        assert prior.values.shape == (24, 30) and not np.isinf(prior.values).any()


# ---- How ----

NUMBERS = [b"nan", b"-inf", b"1e999", b"-1", b"0", b"1e-320", b"4294967296", b"9" * 30, b"1e9", b"null", b'"3"', b"[]"]
WORDS = [
    struct.pack(kind, value)
    for kind, value in (
        ("<Q", 2**64 - 1),
        ("<Q", 2**40),
        ("<q", -1),
        ("<d", float("nan")),
        ("<d", float("inf")),
        ("<d", 1e300),
        ("<d", 0.0),
        ("<i", -1),
        ("<I", 2**31),
        (">I", 65535),
        (">I", 2**31 - 1),
        ("<H", 65535),
        ("<f", float("nan")),
        ("<f", -1e30),
    )
]


def damaged(content: bytes, rng: random.Random) -> bytes:
    """One to three kinds of damage."""
    content = bytearray(content)
    for _ in range(rng.choice([1, 1, 2, 3])):
        if not content:
            break
        at, length = rng.randrange(len(content)), rng.choice([1, 2, 4, 8, 64, 512])
        numbers = list(re.finditer(rb"-?\d+(\.\d+)?(e-?\d+)?", bytes(content)))
        match rng.randrange(8):
            case 0:
                content[at] ^= 1 << rng.randrange(8)
            case 1:
                del content[at:]
            case 2:
                content[at:at] = rng.randbytes(length)
            case 3:
                del content[at : at + length]
            case 4:
                content[at:at] = content[at : at + length] * rng.choice([1, 1, 20])
            case 5 | 6 if len(numbers) > 1 and rng.random() < 0.7:
                one, other = rng.sample(numbers, 2)
                content[one.start() : one.end()] = rng.choice([other.group(), rng.choice(NUMBERS)])
            case 5:
                word = rng.choice(WORDS)
                content[at : at + len(word)] = word
            case 6:
                word = rng.choice(WORDS)
                at -= at % len(word)
                content[at : at + len(word)] = word
            case 7:
                content[at : at + 1] = rng.choice([b"\0", b"\n", b"\xff", b'"', b"{", b" ", b"."])
    return bytes(content)


def run_case(targets, number: int) -> str:
    """What the case gave: "data" or "UserError". Anything else is raised."""
    rng = random.Random(number)
    load, paths = targets[number % len(targets)]
    path = rng.choice(paths)
    good, bad = path.read_bytes(), b""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        if rng.random() < 0.02:
            path.unlink()
        else:
            path.write_bytes(bad := damaged(good, rng))
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            load()
        more = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak) << 10
        assert more < MORE, f"it took {more >> 20} MiB"
        return "data"
    except UserError as error:
        assert len(str(error).splitlines()) == 1, f"case {number}: not one line: {str(error)!r}"
        return "UserError"
    except Exception as error:
        KEPT.mkdir(exist_ok=True)
        (KEPT / f"{number}-{path.name}").write_bytes(bad)
        raise AssertionError(f"case {number}: {path.name}: {type(error).__name__}: {error}") from error
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        path.write_bytes(good)


def too_long(number, frame):
    raise TimeoutError(f"it takes more than {SECONDS} seconds")


signal.signal(signal.SIGPROF, too_long)


# ---- In the suite, and alone ----


@pytest.fixture(scope="module")
def targets(tmp_path_factory):
    root, before = tmp_path_factory.mktemp("fuzz"), Path.cwd()
    os.chdir(root)  # undistorted photographs are kept below the current folder
    rgs_mi.set_variant()
    found = write_all(root)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for load, _ in found:
            load()
    yield found
    os.chdir(before)


@pytest.mark.parametrize("number", range(CASES))
def test_damaged_files(targets, number):
    run_case(targets, number)


def test_damage_is_seen_and_is_not_always_fatal(targets):
    outcomes = Counter(run_case(targets, number) for number in range(0, CASES, 4))
    assert min(outcomes["data"], outcomes["UserError"]) > 5


def test_files_that_unpack_to_more_than_they_should(tmp_path, monkeypatch):
    """Compressed nothings of any size, and headers that promise much."""
    checkpoint.save(tmp_path, {"a": np.zeros(3)}, {"step": 1})
    np.savez_compressed(tmp_path / "checkpoints/step_0000001.npz", a=np.zeros(100000))
    with pytest.warns(UserWarning, match="unpacks to more than it holds"), pytest.raises(UserError, match="no checkpoint"):
        checkpoint.load_latest(tmp_path)

    view = load_dataset(write_blender(tmp_path, photographs(2))).train[0]
    for name, write in (
        ("v01.npz", lambda path: np.savez_compressed(path, depth=np.zeros((96, 120)))),
        ("v01.exr", lambda path: write_exr(path, np.zeros((96, 120, 3), np.float32))),
        ("v01.png", lambda path: write_png16(path, np.ones((96, 120)))),
    ):
        folder = tmp_path / name[4:]
        folder.mkdir()
        write(folder / name)
        with monkeypatch.context() as patch:
            patch.setattr("rgs_mi.priors.files.MAX_PIXELS", 700)
            patch.setattr("rgs_mi.datasets.images.MAX_PIXELS", 700)
            with pytest.raises(UserError, match=f"{name} cannot be read as a depth map .*(too large|too many)"):
                depth_files.load([view], folder)
        assert len(depth_files.load([view], folder)) == 1


def main(count: int, first: int = 0):
    """Run cases, print those that fail and what all gave, and exit with 1 where one failed."""
    rgs_mi.set_variant()
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    outcomes, slowest, failures = Counter(), (0.0, None), 0
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        targets = write_all(Path(folder))
        for number in range(first, first + count):
            faulthandler.dump_traceback_later(SECONDS, exit=True)
            print(f"\rcase {number}", end="", file=sys.stderr, flush=True)  # what a crash leaves on the screen
            start = time.perf_counter()
            try:
                outcomes[run_case(targets, number)] += 1
            except AssertionError as error:
                failures += 1
                print("\n" + " ".join(str(error).split()), flush=True)
            slowest = max(slowest, (time.perf_counter() - start, number))
        faulthandler.cancel_dump_traceback_later()
        os.chdir("/")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
    print(
        f"\n{count} cases: {json.dumps(outcomes)}, {failures} failures; slowest: case {slowest[1]}, {slowest[0]:.2f} s; "
        f"peak memory {peak} MiB"
    )
    sys.exit(bool(failures))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))

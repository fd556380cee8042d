"""Path-traced ground truth: any Mitsuba scene becomes a data set in the Blender layout (NeRF Synthetic, Shiny Blender).

    transforms_train.json, transforms_test.json    camera_angle_x (radians), frames[].transform_matrix: camera to world,
                                                   camera x right, y up, looking along -z
    train/r_0.png          RGBA, 8 bit sRGB, straight alpha
    train/r_0.exr          RGBA, half float linear radiance, premultiplied alpha (as EXR has it)
    train/r_0_normal.png   world-space shading normal * 0.5 + 0.5, alpha = coverage
    train/r_0_aov.exr      float: Depth.Z (along the viewing axis), Normal.X/Y/Z (world), Albedo.R/G/B, Roughness,
                           Metallic, Alpha; means over the covered part of a pixel, 0 where nothing is.
                           Look channels up by name: EXR files keep them in alphabetical order
    truth.json             what was rendered: a second call with the same settings returns at once, another resumes

The radiance is that of the scene's own integrator: with ``hide_emitters`` the background is transparent. Roughness and
metallic are those of `principled` BSDFs and 0 elsewhere.
"""

import hashlib
import importlib.util
import json
import math
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..core.camera import Camera, opaque, pixel_directions
from ..core.color import srgb_encode, to_8bit
from ..core.errors import UserError
from ..core.files import make_folder, write_bitmap, write_json
from ..core.inputs import is_file
from ..core.ownership import LOCK, owned
from ..core.progress import Progress
from ..core.scene_files import load_scene

if TYPE_CHECKING:
    import mitsuba as mi

MANIFEST = "truth.json"
MOST = {"train": 100_000, "test": 100_000, "size": 8192, "spp": 65_536}  # of what a data set is asked for
FOV = 39.6  # degrees, Blender's default camera (0.691 rad)
MARGIN = 1.02  # keeps the object's bounding sphere off the frame
TEST_SPP = 4  # times the samples of a training view: noise in a test view counts against every score
AOV_GRID = 4  # samples per pixel and axis of the geometry pass
AOV_CHANNELS = (
    "Depth.Z",
    "Normal.X",
    "Normal.Y",
    "Normal.Z",
    "Albedo.R",
    "Albedo.G",
    "Albedo.B",
    "Roughness",
    "Metallic",
    "Alpha",
)
_GOLDEN = math.pi * (3 - math.sqrt(5))
_CV_TO_BLENDER = np.diag([1.0, -1.0, -1.0, 1.0])


# ---- Viewpoints ----


def train_directions(count: int, seed: int = 0) -> np.ndarray:
    """Return unit directions [count, 3] from the object to the cameras: a Fibonacci lattice from −12 degrees to the
    zenith."""
    i = np.arange(count)
    z = math.sin(math.radians(-12)) + (0.995 - math.sin(math.radians(-12))) * (i + 0.5) / count
    return _direction(_GOLDEN * i + seed, z)


def test_directions(count: int, seed: int = 0) -> np.ndarray:
    """Return unit directions [count, 3] on a spiral of three turns that climbs from −6 to 65 degrees."""
    t = (np.arange(count) + 0.5) / count
    return _direction(6 * math.pi * t + 0.7 + seed, np.sin(np.radians(-6 + 71 * t)))


test_directions.__test__ = False  # a name that pytest would collect


def _direction(azimuth, z):
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], -1)


def bounds(scene: "mi.Scene") -> tuple[np.ndarray, float]:
    """Return the center [3] of the scene's bounding box and the radius of a sphere around it that holds every shape.

    Raises: UserError when the scene holds no geometry.
    """
    box = scene.bbox()
    if not scene.shapes() or not box.valid():
        raise UserError("the scene has no shapes: nothing to look at")
    center = np.array(box.center(), float).ravel()
    return center, max(_farthest(shape, center) for shape in scene.shapes())


def _farthest(shape, point: np.ndarray) -> float:
    """Distance from ``point`` [3] to the farthest point of a shape: exact for meshes and spheres, else of its box."""
    import mitsuba as mi

    box = shape.bbox()
    low, high = np.array(box.min, float).ravel(), np.array(box.max, float).ravel()
    if shape.shape_type() == mi.ShapeType.Sphere:
        return float(np.linalg.norm((low + high) / 2 - point) + (high - low)[0] / 2)
    vertices = np.array(mi.traverse(shape)["vertex_positions"]).reshape(-1, 3) if shape.is_mesh() else ()
    if not len(vertices):
        return float(np.linalg.norm(np.maximum(np.abs(low - point), np.abs(high - point))))
    return float(np.linalg.norm(vertices - point, axis=1).max())


# ---- One view ----


class Renderer:
    """A loaded scene and one camera that moves: kernels are compiled for the first view only."""

    def __init__(self, scene: "mi.Scene", size: int) -> None:
        import mitsuba as mi

        camera = Camera.look_at((1, 0, 0), (0, 0, 0), (0, 0, 1), FOV, (size, size))
        sensor = camera.to_sensor_dict()
        sensor["film"] |= {"pixel_format": "rgba", "component_format": "float32", "rfilter": {"type": "gaussian"}}
        sensor["sampler"] = {"type": "multijitter"}
        self.scene, self.sensor = scene, mi.load_dict(sensor)
        self.params = mi.traverse(self.sensor)

    def radiance(self, camera: Camera, spp: int, seed: int) -> np.ndarray:
        """Render linear radiance by the scene's integrator, [H, W, 4] float32, premultiplied."""
        import mitsuba as mi

        self.params["to_world"] = camera.to_sensor_dict()["to_world"]
        self.params.update()
        return np.array(mi.render(self.scene, sensor=self.sensor, spp=spp, seed=seed))

    def aov(self, camera: Camera) -> np.ndarray:
        """Render the maps in the order of `AOV_CHANNELS`, [H, W, 10] float32, from a regular grid of samples in each pixel."""
        import drjit as dr
        import mitsuba as mi

        (width, height), n = camera.size, AOV_GRID
        fine, _ = camera.subdivided(n * n)
        index = dr.arange(mi.UInt32, width * height * n * n)
        pixel, sub = index // (n * n), index % (n * n)
        column, row = pixel % width * n + sub % n, pixel // width * n + sub // n
        seen = opaque(camera)
        ray = mi.Ray3f(seen.origin, pixel_directions(fine, row * (n * width) + column))
        si = self.scene.ray_intersect(ray)
        hit, bsdf = si.is_valid(), si.bsdf(ray)
        normal = dr.select(dr.dot(si.n, ray.d) > 0, -si.sh_frame.n, si.sh_frame.n)
        depth = si.t * (seen.rotation @ ray.d).z
        albedo = bsdf.eval_diffuse_reflectance(si, hit)
        scalars = [
            dr.select(bsdf.has_attribute(k, hit), bsdf.eval_attribute_1(k, si, hit), 0) for k in ("roughness", "metallic")
        ]
        values = [dr.select(hit, v, 0) for v in (depth, *normal, *albedo, *scalars, mi.Float(1))]
        dr.eval(values)  # together: one kernel, rays traced once
        maps = np.stack([np.array(dr.block_sum(v, n * n)) for v in values], -1) / (n * n)
        maps[:, :-1] /= np.maximum(maps[:, -1:], 1e-9)
        maps[:, 1:4] /= np.maximum(np.linalg.norm(maps[:, 1:4], axis=1, keepdims=True), 1e-9)
        return maps.reshape(height, width, -1)


def _write_view(stem: Path, rgba: np.ndarray, aov: np.ndarray):
    """The files of one view; the photograph last, since its presence means that the view is complete."""
    import mitsuba as mi

    alpha = rgba[..., 3:]
    straight = rgba[..., :3] / np.maximum(alpha, 1e-6)
    half, formats = mi.Struct.Type.Float16, mi.Bitmap.PixelFormat
    encoded = to_8bit(np.concatenate([aov[..., 1:4] * 0.5 + 0.5, aov[..., 9:]], -1)) * (aov[..., 9:] > 0)
    photograph = to_8bit(np.concatenate([srgb_encode(np.clip(straight, 0, 1)), alpha], -1))
    write_bitmap(stem.with_name(stem.name + "_aov.exr"), mi.Bitmap(aov, formats.MultiChannel, list(AOV_CHANNELS)))
    write_bitmap(stem.with_name(stem.name + "_normal.png"), mi.Bitmap(encoded, formats.RGBA))
    write_bitmap(stem.with_suffix(".exr"), mi.Bitmap(rgba, formats.RGBA).convert(component_format=half))
    write_bitmap(stem.with_suffix(".png"), mi.Bitmap(photograph, formats.RGBA))


# ---- The data set ----


def _digest(path: Path, seen: set) -> str:
    """A hash of a scene file and of the files that it names, includes followed."""
    if path in seen:
        return ""
    seen.add(path)
    content = path.read_bytes()
    parts = [hashlib.sha256(content).hexdigest()]
    if path.suffix == ".xml":
        for name in sorted(set(re.findall(r'(?:value|filename)\s*=\s*"([^"]+)"', content.decode(errors="replace")))):
            if os.path.isfile(path.parent / name):  # unlike Path's it answers False to names that no file system takes
                parts.append(_digest((path.parent / name).resolve(), seen))
    return hashlib.sha256("".join(parts).encode()).hexdigest()


def _code_digest() -> str:
    """A hash of the code that decides what the images show."""
    package, procedural = Path(__file__).parents[1], importlib.util.find_spec("rgs_mi.plugins.procedural")
    assert procedural is not None and procedural.origin is not None, "it is a file of this package"
    files = [
        Path(__file__),
        package / "core" / "camera.py",
        Path(procedural.origin),
        *sorted((package / "targets").glob("*.py")),
    ]
    return hashlib.sha256(b"".join(f.read_bytes() for f in files)).hexdigest()


def _complete(out: Path, key: dict) -> bool:
    """Whether ``out`` holds the data set with the given key, all of it.

    Raises: UserError for a folder of something else.
    """
    manifest = out / MANIFEST
    if manifest.is_file():
        try:
            old = json.loads(manifest.read_text())
            return old["key"] == key and bool(old["complete"])
        except (ValueError, KeyError, TypeError) as error:
            raise UserError(f"{manifest} is damaged: delete the folder {out} and start again") from error
    if out.exists() and (not out.is_dir() or any(path.name != LOCK for path in out.iterdir())):
        raise UserError(f"{out} exists and is not a data set of render_dataset: choose another folder with --out")
    return False


def _prepare(out: Path, key: dict):
    """Make ``out`` ready for the rest of the data set with the given key: views with another are deleted."""
    manifest = out / MANIFEST
    if manifest.is_file() and json.loads(manifest.read_text())["key"] != key:
        write_json(manifest, {"key": None, "complete": False})  # of neither, until the other's views are gone
        for split in ("train", "test"):
            (out / f"transforms_{split}.json").unlink(missing_ok=True)
            for file in [*(out / split).glob("r_*"), *(out / split).glob(".r_*")]:
                file.unlink()
    write_json(manifest, {"key": key, "complete": False})  # first: it says whose the folder is
    for split in ("train", "test"):
        make_folder(out / split)


def _frame(split: str, index: int, camera: Camera) -> dict:
    return {"file_path": f"./{split}/r_{index}", "transform_matrix": (camera.to_world @ _CV_TO_BLENDER).tolist()}


def render_dataset(
    xml: str | Path,
    out: str | Path,
    *,
    train: int = 60,
    test: int = 20,
    size: int = 400,
    spp: int = 25,
    radius: float | None = None,
    variables: Mapping[str, object] | None = None,
    seed: int = 0,
    quiet: bool = False,
) -> Path:
    """Render a Mitsuba scene into a data set in the Blender layout (see the module), or return the one that is there.

    Args:
      xml: scene file; variables: its ``<default>``s to override
      out: folder to write; train, test: how many views; size: pixels along the side of the square images
      spp: samples per pixel of the training views; test views take `TEST_SPP` times as many. Rounded up to a grid.
      radius: distance of the cameras from the center of the scene's bounding box; None fits the object into the frame
      seed: turns the cameras around the object and reseeds the sampler

    Returns: ``out`` as a Path. Needs an active variant.
    Another process that renders into ``out`` is waited for.
    Raises: UserError for scenes that do not load or hold nothing, and for folders that can't be written.
    """
    xml, out, variables = Path(xml), Path(out), dict(variables or {})
    for name, value in {"train": train, "test": test, "size": size, "spp": spp}.items():
        if not 1 <= value <= MOST[name]:
            raise UserError(f"{name} is {value}: needs at least 1 and at most {MOST[name]}")
    if radius is not None and not 0 < radius < math.inf:
        raise UserError(f"radius is {radius:g}: needs a positive distance")
    if not is_file(xml):
        raise UserError(f"no scene at {xml}: check the path")
    key = {
        "scene": _digest(xml.resolve(), set()),
        "variables": {k: str(v) for k, v in sorted(variables.items())},
        "train": train,
        "test": test,
        "size": size,
        "spp": spp,
        "radius": radius,
        "seed": seed,
        "code": _code_digest(),
    }
    if not _complete(out, key):
        with owned(out, wait=True):
            if not _complete(out, key):  # another process may have been at it
                _prepare(out, key)
                _render(xml, out, key, variables, quiet)
    return out


def _render(xml, out, key, variables, quiet):
    """Render what ``out`` lacks of the data set with the given key."""
    train, test, size, spp, radius, seed = (key[name] for name in ("train", "test", "size", "spp", "radius", "seed"))
    scene = load_scene(xml, variables)
    try:
        center, extent = bounds(scene)
    except UserError as error:
        raise UserError(f"{xml}: {error}") from error
    distance = radius or MARGIN * extent / math.sin(math.radians(FOV / 2))
    directions = {"train": train_directions(train, seed), "test": test_directions(test, seed)}
    cameras = {
        split: [Camera.look_at(center + distance * d, center, (0, 0, 1), FOV, (size, size)) for d in ds]
        for split, ds in directions.items()
    }
    views = [(split, i, camera) for split, cs in cameras.items() for i, camera in enumerate(cs)]
    renderer = Renderer(scene, size)
    with Progress(quiet=quiet, label=f"rendering {xml.name}") as progress:
        for index, (split, i, camera) in enumerate(views):
            stem = out / split / f"r_{i}"
            if not stem.with_suffix(".png").is_file():
                samples = spp * (TEST_SPP if split == "test" else 1)
                _write_view(stem, renderer.radiance(camera, samples, seed * len(views) + index), renderer.aov(camera))
            progress.update((index + 1) / len(views), views=index + 1)
    for split, cs in cameras.items():
        frames = [_frame(split, i, camera) for i, camera in enumerate(cs)]
        write_json(out / f"transforms_{split}.json", {"camera_angle_x": math.radians(FOV), "frames": frames})
    write_json(out / MANIFEST, {"key": key, "complete": True})

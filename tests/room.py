"""A shiny object in a room that photographs show, without masks and points: what phones make of it.

``python tests/room.py DATA`` path-traces the helmet, or another ``--object`` of the suite, in a closed room, with textures on
its walls, into a capture in nerfstudio's layout, which fits take for photographs, without masks; silhouettes in them lie beside
them. ``--masked FROM`` takes the photographs that lie in FROM, with their silhouettes as masks.
``rgs-mi optimize object --data DATA --out RUN --minutes 10`` fits it, and ``python tests/room.py DATA --score RUN`` prints
how good RUN is within the object's silhouette.
"""

import argparse
import math
import shutil
from pathlib import Path

import rgs_mi  # before mitsuba, so that it can choose a working LLVM

# isort: split
import mitsuba as mi
import numpy as np
from PIL import Image
from scipy import ndimage

from rgs_mi.core.camera import Camera
from rgs_mi.core.color import srgb_encode, to_8bit
from rgs_mi.core.files import write_json
from rgs_mi.core.progress import Progress
from rgs_mi.core.scene_files import load_scene
from rgs_mi.datasets.path_traced import _CV_TO_BLENDER, FOV, Renderer, bounds

TARGETS = Path(__file__).parents[1] / "scenes" / "targets"
COUNTS, SIZE, SPP = {"train": 60, "test": 8}, 400, 64  # test views take twice the samples
SIDE, HEIGHT = 4.4, 5.0  # of the room: half its width, and its height, in radii of the object
DISTANCE = 1.25  # of the cameras, over that at which the object fills the frame
ELEVATIONS = 8, 62  # degrees
EXPOSURE = 0.9


def texture(colors, blotch, seed):
    """A tile of noise of three sizes between two colours, [256, 256, 3], whose pattern repeats nowhere within it."""
    rng, noise = np.random.default_rng(seed), np.zeros((256, 256))
    for sigma, share in ((blotch, 1.0), (blotch / 4, 0.6), (blotch / 12, 0.35)):
        octave = ndimage.gaussian_filter(rng.normal(size=noise.shape), sigma, mode="wrap")
        noise += share * octave / octave.std()
    level = np.clip(0.5 + 0.3 * noise / noise.std(), 0, 1)[..., None]
    return np.float32((1 - level) * np.array(colors[0]) + level * np.array(colors[1]))


def wall(center, u, v, colors, seed, blotch=12.0):
    """A diffuse rectangle with a `texture`, seen from the side of u × v."""
    matrix = np.eye(4)
    matrix[:3] = np.stack([u, v, np.cross(u, v) / np.linalg.norm(np.cross(u, v)), center], 1)
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(texture(colors, blotch, seed)), "raw": True}
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f(matrix.tolist()),
        "bsdf": {"type": "diffuse", "reflectance": bitmap},
    }


def lamp(center, u, v, radiance):
    """A rectangle that shines to the side of u × v."""
    return wall(center, u, v, ((0, 0, 0), (0, 0, 0)), 0) | {
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance}}
    }


def room(center, radius, floor):
    """The shapes of a room around an object of ``radius`` that stands on ``floor`` below ``center``."""
    a, h = SIDE * radius, HEIGHT * radius
    x, y, z = np.eye(3)
    middle = np.array([center[0], center[1], floor])
    up = middle + h / 2 * z
    return {
        "floor": wall(middle, a * x, a * y, ((0.45, 0.30, 0.18), (0.22, 0.13, 0.07)), 1, 16),
        "ceiling": wall(middle + h * z, a * y, a * x, ((0.75, 0.74, 0.72), (0.62, 0.62, 0.62)), 2),
        "east": wall(up + a * x, h / 2 * z, a * y, ((0.62, 0.60, 0.52), (0.30, 0.38, 0.40)), 3),
        "west": wall(up - a * x, a * y, h / 2 * z, ((0.66, 0.50, 0.36), (0.36, 0.18, 0.14)), 4),
        "north": wall(up + a * y, a * x, h / 2 * z, ((0.55, 0.60, 0.45), (0.22, 0.30, 0.20)), 5),
        "south": wall(up - a * y, h / 2 * z, a * x, ((0.70, 0.68, 0.66), (0.40, 0.38, 0.44)), 6),
        "lamp": lamp(middle + 0.99 * h * z + 0.8 * radius * x, 1.4 * radius * y, 1.1 * radius * x, (9.0, 8.4, 7.4)),
        "window": lamp(up - 0.99 * a * x + 0.1 * h * z, 1.3 * radius * y, 0.25 * h * z, (5.0, 6.0, 7.5)),
    }


def directions(count, split):
    """Unit directions [count, 3] from the object to the cameras of a ``split``, spread over the elevations that people hold them
    at."""
    low, high = np.sin(np.radians(ELEVATIONS))
    z = low + (high - low) * (np.arange(count) + 0.5) / count
    azimuth = math.pi * (3 - math.sqrt(5)) * np.arange(count) + (split == "test")
    return np.stack([np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z], -1)


def render(target, variables, out):
    """Write the data set of a ``target`` with these ``variables``; what is there already stays."""
    scene = load_scene(TARGETS / f"{target}.xml", variables)
    center, radius = bounds(scene)
    floor = float(np.array(scene.bbox().min).ravel()[2])
    shapes = {f"object{k}": shape for k, shape in enumerate(scene.shapes())}
    scene = mi.load_dict(
        {"type": "scene", "integrator": {"type": "path", "max_depth": 6}, **shapes, **room(center, radius, floor)}
    )
    alone = mi.load_dict({"type": "scene", **shapes})
    distance = DISTANCE * radius / math.sin(math.radians(FOV / 2))
    highest = center[2] - floor + distance * math.sin(math.radians(ELEVATIONS[1]))
    assert distance < 0.95 * SIDE * radius and highest < 0.95 * HEIGHT * radius, "cameras stand within the room"
    renderer, silhouettes = Renderer(scene, SIZE), Renderer(alone, SIZE)
    focal = SIZE / 2 / math.tan(math.radians(FOV / 2))
    frames, views = [], [(split, i, d) for split, count in COUNTS.items() for i, d in enumerate(directions(count, split))]
    for folder in ("images", "silhouettes"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    with Progress(label="rendering the room") as progress:
        for split, i, direction in views:
            camera = Camera.look_at(center + distance * direction, center, (0, 0, 1), FOV, (SIZE, SIZE))
            path = out / "images" / f"{split}_{i}.png"
            frames.append(
                {"file_path": f"images/{path.name}", "transform_matrix": (camera.to_world @ _CV_TO_BLENDER).tolist()}
            )
            if not path.is_file():
                test = split == "test"
                linear = renderer.radiance(camera, SPP * (2 if test else 1), 1000 * test + i)[..., :3]
                Image.fromarray(to_8bit(silhouettes.aov(camera)[..., -1])).save(out / "silhouettes" / path.name)
                Image.fromarray(to_8bit(srgb_encode(np.clip(EXPOSURE * linear, 0, 1)))).save(path)
            progress.update(len(frames) / len(views), views=len(frames))
    names = {f"{split}_filenames": [f["file_path"] for f in frames if f"/{split}_" in f["file_path"]] for split in COUNTS}
    lens = {"fl_x": focal, "fl_y": focal, "cx": SIZE / 2, "cy": SIZE / 2, "w": SIZE, "h": SIZE}
    write_json(out / "transforms.json", {"camera_model": "PINHOLE", **lens, "frames": frames, **names})


def mask(source, out):
    """Write the data set of ``source`` with its silhouettes as masks."""
    for folder in ("images", "silhouettes"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    shutil.copy(source / "transforms.json", out)
    for path in sorted((source / "images").glob("*.png")):
        silhouette = Image.open(source / "silhouettes" / path.name)
        photograph = Image.open(path).convert("RGB")
        photograph.putalpha(silhouette)
        photograph.save(out / "images" / path.name)
        silhouette.save(out / "silhouettes" / path.name)


def score(data, run):
    """Print the mean PSNR of the held-out views of ``run`` within the object's silhouette, and of whole pictures."""
    inside, whole = [], []
    for i in range(COUNTS["test"]):
        name, read = f"test_{i}.png", lambda path: np.asarray(Image.open(path).convert("RGB"), np.float64) / 255
        square = ((read(data / "images" / name) - read(run / "test" / name)) ** 2).mean(-1)
        mask = np.asarray(Image.open(data / "silhouettes" / name)) > 127
        inside.append(-10 * np.log10(square[mask].mean()))
        whole.append(-10 * np.log10(square.mean()))
    print(
        f"{np.mean(inside):.2f} dB within the silhouette ({min(inside):.2f} to {max(inside):.2f}), {np.mean(whole):.2f} dB in all"
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--object", default="helmet")
    parser.add_argument(
        "-D", action="append", default=[], dest="variables", metavar="NAME=VALUE", help="a variable of its scene"
    )
    parser.add_argument("--masked", type=Path, metavar="FROM")
    parser.add_argument("--score", type=Path, metavar="RUN")
    args = parser.parse_args()
    rgs_mi.set_variant()
    if args.score:
        score(args.data, args.score)
    elif args.masked:
        mask(args.masked, args.data)
    else:
        render(args.object, dict(word.split("=", 1) for word in args.variables), args.data)


if __name__ == "__main__":
    main()

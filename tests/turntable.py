"""A shiny object on a turntable: what product and museum photography is mostly.

``python tests/turntable.py DATA`` path-traces an object of the suite from two heights into a data set in the Blender layout,
while the lamps go round with the camera, as they do for an object that turns. ``--fixed`` leaves them where they are: the
same photographs of an object that stands still. ``--moved DEG`` turns the lamps of the upper ring by so much more. Then
``rgs-mi optimize object --data DATA --out RUN`` fits it.
"""

import argparse
import math
from pathlib import Path

import rgs_mi  # before mitsuba, so that it can choose a working LLVM

# isort: split
import mitsuba as mi
import numpy as np

from rgs_mi.core.camera import Camera
from rgs_mi.core.files import write_json
from rgs_mi.core.progress import Progress
from rgs_mi.core.scene_files import load_scene
from rgs_mi.datasets.path_traced import FOV, MARGIN, TEST_SPP, Renderer, _frame, _write_view, bounds

TARGETS = Path(__file__).parents[1] / "scenes" / "targets"
ELEVATIONS = 12, 42  # degrees
COUNTS = {"train": 60, "test": 12}  # views of both rings together


def ring_cameras(count, center, distance, size, offset):
    """``count`` cameras, half of them on either ring, and at which azimuth each stands, in degrees."""
    for k in range(count):
        azimuth = 360 * (k // 2 + offset + 0.25 * (k % 2)) / (count / 2)
        elevation, around = math.radians(ELEVATIONS[k % 2]), math.radians(azimuth)
        direction = [
            math.cos(elevation) * math.cos(around),
            math.cos(elevation) * math.sin(around),
            math.sin(elevation),
        ]
        yield Camera.look_at(center + distance * np.array(direction), center, (0, 0, 1), FOV, (size, size)), azimuth


def render(target, out, size, spp, fixed, moved):
    """Write the data set; views that are there already stay."""
    scene = load_scene(TARGETS / f"{target}.xml", {})
    center, radius = bounds(scene)
    distance = MARGIN * radius / math.sin(math.radians(FOV / 2))
    light = mi.traverse(scene.environment())
    to_world = mi.ScalarTransform4f(np.array(light["to_world"].matrix).reshape(4, 4))
    renderer = Renderer(scene, size)
    for split in COUNTS:
        (out / split).mkdir(parents=True, exist_ok=True)
    with Progress(label=f"rendering {target} on a turntable") as progress:
        for number, (split, count) in enumerate(COUNTS.items()):
            cameras = list(ring_cameras(count, center, distance, size, 0.4 * number))
            for k, (camera, azimuth) in enumerate(cameras):
                stem = out / split / f"r_{k}"
                if not stem.with_suffix(".png").is_file():
                    turn = 0 if fixed else azimuth + moved * (k % 2)
                    light["to_world"] = mi.Transform4f(mi.ScalarTransform4f().rotate([0, 0, 1], turn) @ to_world)
                    light.update()
                    image = renderer.radiance(camera, spp * (TEST_SPP if split == "test" else 1), 1000 * number + k)
                    _write_view(stem, image, renderer.aov(camera))
                progress.update((number + (k + 1) / count) / len(COUNTS))
            frames = [_frame(split, k, camera) for k, (camera, _) in enumerate(cameras)]
            write_json(out / f"transforms_{split}.json", {"camera_angle_x": math.radians(FOV), "frames": frames})


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--target", default="helmet")
    parser.add_argument("--size", type=int, default=400)
    parser.add_argument("--spp", type=int, default=25)
    parser.add_argument("--fixed", action="store_true", help="lamps stand still, and the camera goes round")
    parser.add_argument("--moved", type=float, default=0.0, metavar="DEG", help="turn of the upper ring's lamps")
    args = parser.parse_args()
    rgs_mi.set_variant()
    render(args.target, args.data, args.size, args.spp, args.fixed, args.moved)

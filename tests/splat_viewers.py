"""How exported splats of a run look in Babylon.js, against our own renderings of the same views.

``python tests/splat_viewers.py RUN [--views 10] [--size W] [--refine MINUTES] [--data DIR] [--out DIR]`` exports PLY and GLB,
draws them in a headless Chromium, and prints the PSNR of each view over white. Views are the run's own test views, which
refining has not seen, or, where ``--data`` names the capture that it was fitted to, photographs of that: cameras that baking
has not seen. ``--out`` keeps the pairs of pictures.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np

import rgs_mi

from judges import babylon


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--views", type=int, default=10)
    parser.add_argument("--size", type=int)
    parser.add_argument("--refine", type=float)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    rgs_mi.set_variant("llvm_ad_rgb")
    from rgs_mi.commands.export import export, to_y_up
    from rgs_mi.core.camera import Camera
    from rgs_mi.core.files import write_png
    from rgs_mi.core.scene_files import load_scene
    from rgs_mi.datasets import load_dataset
    from rgs_mi.evaluation.metrics import psnr

    path = args.run / "scene.xml"
    scene = load_scene(path, {})
    cameras = [Camera.from_sensor(sensor) for sensor in scene.sensors()]
    if args.data:
        cameras = [view.camera for view in load_dataset(args.data).train]
    chosen = sorted({round(k) for k in np.linspace(0, len(cameras) - 1, args.views)})
    cameras = [cameras[k] for k in chosen]
    if args.size:
        cameras = [c.resized(args.size, round(args.size * c.size[1] / c.size[0])) for c in cameras]
    ours = [rendered(scene, camera) for camera in cameras]
    with tempfile.TemporaryDirectory() as folder:
        for to, rotation in (("splat", np.eye(3)), ("gltf-splat", to_y_up(scene, path))):
            (file,) = export(args.run, to, out=folder, refine=args.refine, quiet=True)
            with babylon(file) as draw:
                theirs = [draw(camera, rotation) for camera in cameras]
            scores = [psnr(a, b) for a, b in zip(theirs, ours)]
            print(f"{to}: {np.mean(scores):.2f} dB of {len(scores)} views:", *(f"{s:.1f}" for s in scores), flush=True)
            for k, pair in enumerate(zip(ours, theirs)) if args.out else ():
                write_png(args.out / f"{to}_{k}.png", np.concatenate(pair, 1))


def rendered(scene, camera):
    """Our own rendering over white, as `rgs-mi render` makes it, [H, W, 3] display values."""
    import mitsuba as mi

    from rgs_mi.export.render import sensor_dict, straight

    image = straight(np.array(mi.render(scene, sensor=mi.load_dict(sensor_dict(camera, scene)), spp=4)))
    return image[..., :3] * image[..., 3:] + 1 - image[..., 3:]


if __name__ == "__main__":
    main()

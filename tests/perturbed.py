"""What is lost where cameras, exposures and masks are as people have them, and what learning them brings back.

``python tests/perturbed.py DATA OUT [--clean] [--set a.b=value ...]`` fits a path-traced data set (`rgs-mi render-dataset`) after
`captures.perturbed`, or as it is, leaves the run in OUT, and prints how good it is and how far cameras are from the true ones.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

import rgs_mi
from rgs_mi.commands.optimize import start
from rgs_mi.core.alignment import pose_errors
from rgs_mi.core.camera import focus_point
from rgs_mi.datasets import load_dataset
from rgs_mi.fit.scene import PHOTOGRAPHS, FitScene
from rgs_mi.report import results

from captures import perturbed

SCENE = Path(__file__).parents[1] / "scenes" / "object.xml"


def described(cameras, truth, distance):
    """The errors in words."""
    rotation, position = pose_errors(cameras, truth)
    position = position / distance
    focal = np.mean([c.focal[0] / t.focal[0] - 1 for c, t in zip(cameras, truth)])
    return (
        f"rotation {np.median(rotation):.3f}° (max {rotation.max():.3f}°), position {100 * np.median(position):.3f} % "
        f"(max {100 * position.max():.3f} %) of the distance, focal length {100 * focal:+.3f} %"
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--clean", action="store_true", help="the data set as it is")
    parser.add_argument("--seed", type=int, default=0, help="of what is perturbed")
    parser.add_argument("--dilation", type=int, default=3, help="pixels that masks are too large; -1: masks as they are")
    parser.add_argument("--every", type=int, default=1, help="only every so many training views")
    parser.add_argument("--set", action="append", default=[], dest="overrides", metavar="NAME=VALUE")
    args = parser.parse_args()
    rgs_mi.set_variant()
    scene, truth = FitScene.load(SCENE, args.data), load_dataset(args.data)
    truth = replace(truth, train=truth.train[:: args.every])
    dataset, exposures = (
        (truth, {})
        if args.clean
        else perturbed(truth, seed=args.seed, dilation=args.dilation if args.dilation >= 0 else None)
    )
    dataset = replace(dataset, test=truth.test)  # what is judged is what came out, by clean photographs
    cameras = [view.camera for view in truth.train]
    center, _ = focus_point(cameras)
    distance = float(np.mean([np.linalg.norm(c.origin - center) for c in cameras]))
    fit = start(scene, dataset, scene.settings(PHOTOGRAPHS, args.overrides))
    print("given:  ", described([v.camera for v in dataset.train], cameras, distance), flush=True)
    each = 0
    while fit.progress < 1:
        fit.step()
        if fit.cameras and fit.progress >= each:
            learned = [fit.cameras.camera(k) for k in range(len(cameras))]
            print(f"{100 * fit.progress:3.0f} %:   {described(learned, cameras, distance)}, {fit.psnr:.2f} dB", flush=True)
            each += 0.1
    args.out.mkdir(parents=True, exist_ok=True)
    if fit.cameras:
        learned = [fit.cameras.camera(k) for k in range(len(cameras))]
        print("learned:", described(learned, cameras, distance))
        gains = np.log2([fit.cameras.gain(k) for k in range(len(cameras))])
        true = np.array([exposures.get(view.name, 0.0) for view in truth.train])
        error = gains - (true - true.mean())[:, None]
        print(f"exposure off by {np.sqrt(np.mean(error**2)):.3f} stops (rms), given {true.std():.3f}")
    results.write(fit, scene, args.out, quiet=True)
    figures = json.loads((args.out / results.METRICS).read_text())
    print({name: figures.get(name) for name in ("psnr", "psnr_unaligned", "ssim", "normal_mae_deg", "train_seconds")})


if __name__ == "__main__":
    main()

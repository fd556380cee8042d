#!/usr/bin/env python
"""Path-trace a Mitsuba scene into a data set in the Blender layout: photographs, cameras, normals and other maps."""

import argparse
from pathlib import Path

import rgs_mi
from rgs_mi.core.errors import parse_variables, run_main


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path, help="Mitsuba scene, for instance scenes/targets/helmet.xml")
    parser.add_argument("--out", type=Path, help="folder to write (default: data/NAME_OF_THE_SCENE)")
    parser.add_argument("--train", type=int, default=60, help="training views (default: %(default)s)")
    parser.add_argument("--test", type=int, default=20, help="test views (default: %(default)s)")
    parser.add_argument("--size", type=int, default=400, help="pixels along a side (default: %(default)s)")
    parser.add_argument(
        "--spp",
        type=int,
        default=25,
        help="samples per pixel of training views, test views take 4 times that (default: %(default)s)",
    )
    parser.add_argument("--radius", type=float, help="distance of the cameras (default: the object fills the frame)")
    parser.add_argument(
        "-D", dest="define", action="append", default=[], metavar="NAME=VALUE", help="a variable of the scene"
    )
    parser.add_argument("--seed", type=int, default=0, help="turns the cameras and reseeds the sampler")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant (default: %(default)s)")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    args = parser.parse_args()

    rgs_mi.set_variant(args.variant)
    from rgs_mi.datasets.path_traced import render_dataset

    out = render_dataset(
        args.scene,
        args.out or Path("data") / args.scene.stem,
        train=args.train,
        test=args.test,
        size=args.size,
        spp=args.spp,
        radius=args.radius,
        variables=parse_variables(args.define),
        seed=args.seed,
        quiet=args.quiet,
    )
    print(out)


if __name__ == "__main__":
    run_main(main)

#!/usr/bin/env python
"""Fit reflective surfels and their environment to photographs, and write a scene that Mitsuba renders."""

import argparse
from pathlib import Path

import rgs_mi
from rgs_mi.core.errors import parse_variables, run_main


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "scene",
        type=Path,
        metavar="SCENE.xml",
        help="what to fit, e.g. scenes/helmet.xml; a YAML of the same name beside it says how",
    )
    parser.add_argument("--data", type=Path, metavar="DIR", help="a capture's folder, or a Mitsuba scene to render one from")
    parser.add_argument(
        "-D", dest="define", action="append", default=[], metavar="NAME=VALUE", help="a variable of the scene"
    )
    parser.add_argument("--config", metavar="PRESET|FILE", help="settings: a preset's name or a YAML file")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="A.B=VALUE", help="one setting")
    parser.add_argument("--minutes", type=float, help="plan the whole fit to end within this time")
    parser.add_argument("--out", type=Path, metavar="DIR", help="the run's folder (default: runs/NAME)")
    parser.add_argument("--resume", action="store_true", help="go on from the run's newest checkpoint")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant (default: %(default)s)")
    parser.add_argument("--seed", type=int, help="of everything random")
    parser.add_argument("--tensorboard", action="store_true", help="write event files into the run's folder tensorboard/")
    parser.add_argument("--quiet", action="store_true", help="no progress")
    args = parser.parse_args()

    rgs_mi.set_variant(args.variant)
    from rgs_mi.commands.optimize import optimize

    optimize(
        args.scene,
        data=args.data,
        variables=parse_variables(args.define),
        config=args.config,
        overrides=args.overrides,
        minutes=args.minutes,
        seed=args.seed,
        out=args.out,
        resume=args.resume,
        quiet=args.quiet,
        tensorboard=args.tensorboard,
    )


if __name__ == "__main__":
    run_main(main)

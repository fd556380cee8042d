#!/usr/bin/env python
"""Fit variants of the method to a suite of scenes, and table what each part of it brings. The same command goes on where it
was interrupted, and does not repeat what is done."""

import argparse
from pathlib import Path

import rgs_mi
from rgs_mi.core.errors import listed, run_main

_SCENES = Path(__file__).parents[1] / "scenes"


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "suite",
        type=Path,
        nargs="?",
        default=_SCENES / "targets",
        metavar="SUITE",
        help="a folder of scenes to path-trace, or of captures (default: scenes/targets)",
    )
    parser.add_argument("--scenes", type=listed(), metavar="A,B", help="these only")
    parser.add_argument(
        "--variants",
        type=listed(),
        metavar="A,B",
        help="these only: rows of the table in rgs_mi/commands/ablate.py, or presets",
    )
    parser.add_argument("--minutes", type=float, help="plan each fit to end within this time")
    parser.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="A.B=VALUE", help="one setting of all fits"
    )
    parser.add_argument(
        "--seeds",
        "--seed",
        type=listed(int),
        default=[0],
        metavar="N,M",
        help="of everything random; fit with each of them (default: 0)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("runs") / "ablation",
        metavar="DIR",
        help="folder of the tables and of all runs (default: %(default)s)",
    )
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant (default: %(default)s)")
    parser.add_argument("--quiet", action="store_true", help="no progress")
    args = parser.parse_args()

    rgs_mi.set_variant(args.variant)
    from rgs_mi.commands.ablate import ablate

    failed = ablate(
        args.suite,
        _SCENES / "object.xml",
        scenes=args.scenes,
        variants=args.variants,
        minutes=args.minutes,
        overrides=args.overrides,
        seeds=args.seeds,
        out=args.out,
        quiet=args.quiet,
    )
    return 1 if failed else 0


if __name__ == "__main__":
    run_main(main)

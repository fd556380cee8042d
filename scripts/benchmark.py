#!/usr/bin/env python
"""Time the splatter, alone or in turns with another implementation, or the step of a fit."""

import argparse
from pathlib import Path

import rgs_mi
from rgs_mi.errors import run_main

_OBJECT = Path(__file__).parents[1] / "scenes" / "object.xml"


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant (default: %(default)s)")
    commands = parser.add_subparsers(dest="command", required=True)
    splat = commands.add_parser("splat", help="lists, forward and backward of random surfels on a sphere")
    splat.add_argument("--surfels", type=int, default=50_000, help="(default: %(default)s)")
    splat.add_argument("--res", type=int, default=800, help="pixels along a side (default: %(default)s)")
    splat.add_argument("--against", type=Path, metavar="FILE.py", help="a script that takes --surfels and --res and "
                       "prints 'lists', 'forward' and 'backward', each with its time in ms")
    splat.add_argument("--rounds", type=int, default=3, help="(default: %(default)s)")
    step = commands.add_parser("step", help="a warm step at full resolution")
    step.add_argument("--scene", type=Path, default=_OBJECT, help="(default: object.xml)")
    step.add_argument("--data", type=Path, required=True, metavar="DIR", help="a capture's folder")
    step.add_argument("--surfels", type=int, default=15_000, help="(default: %(default)s)")
    step.add_argument("--steps", type=int, default=20, help="(default: %(default)s)")
    step.add_argument("--set", dest="overrides", action="append", default=[], metavar="A.B=VALUE", help="one setting")
    args = parser.parse_args()

    rgs_mi.set_variant(args.variant)
    from rgs_mi import benchmark

    if args.command == "splat":
        benchmark.splat(args.surfels, args.res, args.against, args.rounds)
    else:
        benchmark.step(args.scene, args.data, args.surfels, args.steps, args.overrides)


if __name__ == "__main__":
    run_main(main)

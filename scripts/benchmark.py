#!/usr/bin/env python
"""Fit and judge a suite of captures beside the paper's tables; or time the splatter, or the step of a fit."""

import argparse
from pathlib import Path

import rgs_mi
from rgs_mi.core.errors import listed, run_main

_SCENES = Path(__file__).parents[1] / "scenes"
_OBJECT = _SCENES / "object.xml"


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant (default: %(default)s)")
    commands = parser.add_subparsers(dest="command", required=True)
    suite = commands.add_parser(
        "suite",
        help="fit and judge all captures of a folder; the same command goes on where it "
        "was interrupted, and does not repeat what is done",
        epilog="On a cluster: one job a scene, "
        "'suite ROOT --scenes $NAME --out DIR', all with the same settings, and at last the same "
        "without --scenes for the tables.",
    )
    suite.add_argument(
        "root",
        type=Path,
        nargs="?",
        default=_SCENES / "targets",
        metavar="ROOT",
        help="a folder of captures, in any layout, and of scenes to path-trace (default: scenes/targets)",
    )
    suite.add_argument("--scenes", type=listed(), metavar="A,B", help="these only")
    suite.add_argument("--config", metavar="PRESET|FILE", help="settings of all fits: a preset's name or a YAML file")
    suite.add_argument("--minutes", type=float, help="plan each fit to end within this time")
    suite.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="A.B=VALUE", help="one setting of all fits"
    )
    suite.add_argument(
        "--workers",
        type=int,
        default=1,
        metavar="N",
        help="fits at a time, which share the cores, and with them the FPS (default: %(default)s)",
    )
    suite.add_argument(
        "--out",
        type=Path,
        default=Path("runs") / "suite",
        metavar="DIR",
        help="folder of the tables and of all runs (default: %(default)s)",
    )
    suite.add_argument("--quiet", action="store_true", help="no progress")
    splat = commands.add_parser("splat", help="lists, forward and backward of random surfels on a sphere")
    splat.add_argument("--surfels", type=int, default=50_000, help="(default: %(default)s)")
    splat.add_argument("--res", type=int, default=800, help="pixels along a side (default: %(default)s)")
    splat.add_argument(
        "--against",
        type=Path,
        metavar="FILE.py",
        help="a script that takes --surfels and --res and "
        "prints 'lists', 'forward' and 'backward', each with its time in ms",
    )
    splat.add_argument("--rounds", type=int, default=3, help="(default: %(default)s)")
    step = commands.add_parser("step", help="a warm step at full resolution")
    step.add_argument("--scene", type=Path, default=_OBJECT, help="(default: object.xml)")
    step.add_argument("--data", type=Path, required=True, metavar="DIR", help="a capture's folder")
    step.add_argument("--surfels", type=int, default=15_000, help="(default: %(default)s)")
    step.add_argument("--steps", type=int, default=20, help="(default: %(default)s)")
    step.add_argument("--set", dest="overrides", action="append", default=[], metavar="A.B=VALUE", help="one setting")
    args = parser.parse_args()

    rgs_mi.set_variant(args.variant)
    if args.command == "suite":
        from rgs_mi.commands.suite import fit_suite

        failed = fit_suite(
            args.root,
            _OBJECT,
            scenes=args.scenes,
            config=args.config,
            minutes=args.minutes,
            overrides=args.overrides,
            workers=args.workers,
            out=args.out,
            quiet=args.quiet,
        )
        return 1 if failed else 0
    from rgs_mi.commands import benchmark

    if args.command == "splat":
        benchmark.splat(args.surfels, args.res, args.against, args.rounds)
    else:
        benchmark.step(args.scene, args.data, args.surfels, args.steps, args.overrides)


if __name__ == "__main__":
    run_main(main)

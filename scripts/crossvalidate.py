#!/usr/bin/env python
"""Compare our estimators of what a principled BSDF reflects with Mitsuba's path tracer; 1 where a bound is broken."""

import argparse
from pathlib import Path

import rgs_mi
from rgs_mi.core.errors import listed, run_main


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--shapes",
        type=listed(),
        default=["sphere"],
        metavar="A,B",
        help="sphere, and models of the suite, e.g. helmet (default: sphere)",
    )
    parser.add_argument("--environments", type=listed(), metavar="A,B", help="of the suite (default: three)")
    parser.add_argument("--roughness", type=listed(float), metavar="R,S", help="of materials (default: seven, 0.02 to 1)")
    parser.add_argument("--size", type=int, default=64, help="pixels along a side (default: %(default)s)")
    parser.add_argument(
        "--samples",
        type=int,
        default=128,
        help="per pixel, of each of 16 batches of the path tracer; ours take twice as many (default: %(default)s)",
    )
    parser.add_argument("--seed", type=int, default=0, help="of everything random (default: %(default)s)")
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("runs") / "crossvalidation",
        metavar="DIR",
        help="folder of the page, the table and the maps (default: %(default)s)",
    )
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant (default: %(default)s)")
    parser.add_argument("--quiet", action="store_true", help="no progress")
    args = parser.parse_args()

    rgs_mi.set_variant(args.variant)
    from rgs_mi.validation.cases import ENVIRONMENTS, ROUGHNESS, Validator, grid
    from rgs_mi.validation.report import crossvalidate

    cases = grid(args.shapes, args.environments or ENVIRONMENTS, args.roughness or ROUGHNESS)
    broken = crossvalidate(args.out, cases, Validator(args.size, args.samples, args.seed), args.quiet)
    return 1 if broken else 0


if __name__ == "__main__":
    run_main(main)

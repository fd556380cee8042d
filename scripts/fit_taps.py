#!/usr/bin/env python
"""Fit where split-sum looks the environment up (``rgs_mi/shading/taps.npy``) to the Monte Carlo estimator; minutes."""

import argparse
from pathlib import Path

import rgs_mi
from rgs_mi.core.errors import run_main


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--environments", type=int, default=24, help="random ones to fit to (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=1500, help="of the optimiser (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of everything random (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("taps.npy"), help="file to write (default: %(default)s)")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant (default: %(default)s)")
    args = parser.parse_args()

    rgs_mi.set_variant(args.variant)
    from rgs_mi.commands.fit_taps import fit_taps

    fit_taps(args.out, args.environments, args.steps, args.seed)


if __name__ == "__main__":
    run_main(main)

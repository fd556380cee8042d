#!/usr/bin/env python
"""Judge a run again on its held-out views, as when LPIPS's weights were installed after it; writes metrics.json anew."""

import argparse
from pathlib import Path

import rgs_mi
from rgs_mi.core.errors import run_main


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="a run's folder")
    parser.add_argument("--data", type=Path, metavar="DIR", help="the folder of its photographs (default: where they were)")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant (default: %(default)s)")
    parser.add_argument("--quiet", action="store_true", help="no progress")
    args = parser.parse_args()

    rgs_mi.set_variant(args.variant)
    from rgs_mi.commands.evaluate import reevaluate

    reevaluate(args.run, args.data, args.quiet)


if __name__ == "__main__":
    run_main(main)

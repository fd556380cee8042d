#!/usr/bin/env python
"""How true a fit's light and materials are, against the path-traced scene that it was fitted to, also under other lights."""

import argparse
import json
from pathlib import Path

import rgs_mi
from rgs_mi.core.errors import listed, run_main


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="a run's folder")
    parser.add_argument(
        "truth", type=Path, metavar="TRUTH.xml", help="the scene of its photographs, e.g. scenes/targets/helmet.xml"
    )
    parser.add_argument("--lights", type=listed(), default=[], metavar="A,B", help="environments of the suite to relight it")
    parser.add_argument(
        "--size", type=int, default=400, help="pixels along a side of the path-traced views (default: %(default)s)"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="where to (default: recovery in the run's folder)")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant (default: %(default)s)")
    parser.add_argument("--quiet", action="store_true", help="no progress")
    args = parser.parse_args()

    rgs_mi.set_variant(args.variant)
    from rgs_mi.commands.recovery import recovery

    print(json.dumps(recovery(args.run, args.truth, args.lights, size=args.size, out=args.out, quiet=args.quiet), indent=1))


if __name__ == "__main__":
    run_main(main)

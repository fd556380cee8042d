#!/usr/bin/env python
"""Render a fitted scene from one of its views, along them or from a turntable; under another light or with another
material."""

import argparse
from pathlib import Path

import rgs_mi
from rgs_mi.core.errors import parse_variables, run_main


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path, metavar="RUN_OR_SCENE.xml", help="a run's folder, or a scene")
    parser.add_argument(
        "-D", dest="define", action="append", default=[], metavar="NAME=VALUE", help="a variable of the scene"
    )
    views = parser.add_mutually_exclusive_group()
    views.add_argument("--view", metavar="NAME|INDEX", help="a sensor of the scene (default: the first)")
    views.add_argument("--turntable", type=int, metavar="N", help="N frames around the object")
    views.add_argument(
        "--path",
        type=int,
        nargs="?",
        const=0,
        metavar="N",
        help="all views in their order, a run's test views; or N frames of a camera that moves from one to the next",
    )
    parser.add_argument(
        "--video",
        action="store_true",
        help="make the frames a video, too, and a contact sheet; needs `pip install imageio-ffmpeg`",
    )
    parser.add_argument("--size", type=int, metavar="W", help="width in pixels (default: the sensor's)")
    parser.add_argument(
        "--spp", type=int, help="samples per pixel; for surfels alone a square number (default: as the scene says)"
    )
    parser.add_argument("--out", type=Path, metavar="FILE_OR_DIR", help="where to (default: a folder beside the scene)")
    parser.add_argument("--aovs", action="store_true", help="write the G-buffer as well, a multichannel EXR")
    parser.add_argument(
        "--envmap",
        metavar="FILE",
        help="light it by this image, latitude-longitude EXR or HDR, or by an environment of the suite, e.g. kitchen",
    )
    parser.add_argument("--rotate", type=float, default=0.0, metavar="DEG", help="turn the light about the vertical")
    parser.add_argument(
        "--set",
        dest="changes",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="the material of all surfels: roughness, metallic or base_color",
    )
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant (default: %(default)s)")
    parser.add_argument("--quiet", action="store_true", help="no progress")
    args = parser.parse_args()

    rgs_mi.set_variant(args.variant)
    from rgs_mi.export.render import render_scene

    for path in render_scene(
        args.scene,
        variables=parse_variables(args.define),
        view=args.view,
        turntable=args.turntable,
        along=args.path,
        filmed=args.video,
        size=args.size,
        spp=args.spp,
        out=args.out,
        aovs=args.aovs,
        envmap=args.envmap,
        rotate=args.rotate,
        changes=args.changes,
        quiet=args.quiet,
    ):
        print(path)


if __name__ == "__main__":
    run_main(main)

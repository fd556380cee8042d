"""The verbs that render: render, render-dataset."""

import argparse
from pathlib import Path

from ..core.color import TONES
from ..core.errors import parse_variables
from ..core.runtime import CACHE_VARIABLE, cache_folder, set_variant
from ..core.scene_files import find_scene
from .arguments import Parser, Run, add_common, add_integer, add_variables, known


def render(parser: Parser) -> Run:
    """Render a fitted scene from one of its views, along them or from a turntable; under another light or with another
    material."""
    parser.add_argument("scene", metavar="RUN_OR_SCENE", help=f"a run's folder, an XML file, or {known('scenes')}")
    add_variables(parser)
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
    parser.add_argument(
        "--camera",
        dest="poses",
        action="append",
        default=[],
        metavar="POSE",
        help="instead of a view, a camera as the window's 'command' writes it: --camera=X,Y,Z,X,Y,Z,X,Y,Z,DEG, where it is, "
        "what it looks at, up, horizontal field of view; again for more, which --path goes through",
    )
    parser.add_argument(
        "--size", type=_width_or_both, metavar="W|WxH", help="width in pixels, or width and height (default: the sensor's)"
    )
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
    parser.add_argument("--brighten", type=float, default=0.0, metavar="STOPS", help="make the light brighter")
    parser.add_argument(
        "--set",
        dest="changes",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="the material of all surfels: roughness, metallic or base_color; NAME*=FACTOR scales it, and @X,Y,Z,RADIUS at the "
        "end keeps to a ball",
    )
    parser.add_argument(
        "--background",
        action=argparse.BooleanOptionalAction,
        help="show the light behind the object (default: as the scene says)",
    )
    parser.add_argument("--exposure", type=float, default=0.0, metavar="STOPS", help="of the pictures, not of the EXRs")
    parser.add_argument("--tone", default="clip", choices=TONES, help="what lies beyond white (default: %(default)s)")
    add_common(parser)

    def run(args):
        scene = find_scene(args.scene, "scenes")
        set_variant(args.variant)
        from ..export.render import render_scene

        for path in render_scene(
            scene,
            variables=parse_variables(args.define),
            view=args.view,
            poses=args.poses,
            turntable=args.turntable,
            along=args.path,
            as_video=args.video,
            size=args.size,
            spp=args.spp,
            out=args.out,
            aovs=args.aovs,
            envmap=args.envmap,
            rotate=args.rotate,
            brighten=args.brighten,
            changes=args.changes,
            background=args.background,
            exposure=args.exposure,
            tone=args.tone,
            quiet=args.quiet,
        ):
            print(path)

    return run


def _width_or_both(text):
    """A width, or (width, height)."""
    width, times, height = text.partition("x")
    return (int(width), int(height)) if times else int(width)


def render_dataset(parser: Parser) -> Run:
    """Path-trace a Mitsuba scene into a data set in the Blender layout: photographs, cameras, normals and other maps."""
    parser.add_argument("scene", help=f"an XML file, or {known('targets')}")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help=f"folder to write (default: NAME in that of {CACHE_VARIABLE})"
    )
    add_integer(parser, "--train", 60, "training views")
    add_integer(parser, "--test", 20, "test views")
    add_integer(parser, "--size", 400, "pixels along a side")
    add_integer(parser, "--spp", 25, "samples per pixel of training views, test views take 4 times that")
    parser.add_argument("--radius", type=float, help="distance of the cameras (default: the object fills the frame)")
    add_variables(parser)
    add_integer(parser, "--seed", 0, "turns the cameras and reseeds the sampler")
    add_common(parser)

    def run(args):
        scene = find_scene(args.scene, "targets")
        set_variant(args.variant)
        from ..datasets.path_traced import render_dataset

        numbers = {name: getattr(args, name) for name in ("train", "test", "size", "spp", "radius", "seed", "quiet")}
        out = args.out or cache_folder(scene.stem)
        print(render_dataset(scene, out, variables=parse_variables(args.define), **numbers))

    return run

"""The verb that makes a capture: capture."""

from pathlib import Path

from ..datasets.resolution import LONGEST
from .arguments import Parser, Run, add_integer


def capture(parser: Parser) -> Run:
    """Make a capture of a folder of photographs or of a video: cameras, lens, points, masks, and a page on how good it is."""
    parser.add_argument("source", type=Path, metavar="PHOTOGRAPHS|VIDEO", help="a folder of JPEGs and PNGs, or a video")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="the capture's folder")
    masks = parser.add_mutually_exclusive_group()
    masks.add_argument(
        "--masks", type=Path, metavar="DIR", help="masks of the photographs' names, white where the object is"
    )
    masks.add_argument(
        "--mask-command",
        metavar="'PROG {image} {mask}'",
        help="a program that reads the photograph {image} and writes its mask {mask}, a PNG; runs once a photograph",
    )
    add_integer(parser, "--frames", 80, "frames of a video: the sharpest of so many equal stretches")
    add_integer(
        parser, "--resolution", LONGEST, "photographs are scaled to this longer side, in pixels, if theirs is longer"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress")

    def run(args):
        from ..commands.capture import capture

        capture(
            args.source,
            args.out,
            masks=args.masks,
            mask_command=args.mask_command,
            frames=args.frames,
            longest=args.resolution,
            quiet=args.quiet,
        )

    return run

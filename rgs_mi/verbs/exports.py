"""The verb that writes what other programs open: export."""

from pathlib import Path

from ..core.runtime import set_variant
from .arguments import Parser, Run, add_common


def export(parser: Parser) -> Run:
    """Write a finished run in a format that viewers and other programs open: splats as PLY, glTF or USD."""
    parser.add_argument("run_folder", type=Path, metavar="RUN", help="a run's folder")
    parser.add_argument(
        "--to",
        required=True,
        metavar="FORMAT",
        help="splat (PLY of 3DGS), gltf-splat (GLB with KHR_gaussian_splatting), "
        "or usd (particle field and dome light; needs `pip install usd-core`)",
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="where to (default: export/FORMAT in the run's folder)")
    parser.add_argument("--kernel", metavar="NAME", help="of usd: ellipsoid, which readers know (default), or surflet, flat")
    add_common(parser)

    def run(args):
        set_variant(args.variant)
        from ..commands.export import export

        for path in export(args.run_folder, args.to, out=args.out, kernel=args.kernel, quiet=args.quiet):
            print(path)

    return run

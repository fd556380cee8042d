"""The verb that writes what other programs open: export."""

from pathlib import Path

from ..core.runtime import set_variant
from .arguments import Parser, Run, add_common


def export(parser: Parser) -> Run:
    """Write a finished run in a format that viewers and other programs open: splats as PLY, glTF or USD, or a mesh."""
    parser.add_argument("run_folder", type=Path, metavar="RUN", help="a run's folder")
    parser.add_argument(
        "--to",
        required=True,
        metavar="FORMAT",
        help="splat (PLY of 3DGS), gltf-splat (GLB with KHR_gaussian_splatting), "
        "usd (particle field and dome light; needs `pip install usd-core`), or mesh (GLB, and a scene of stock Mitsuba; needs "
        "`pip install 'rgs-mi[mesh]'`)",
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="where to (default: export/FORMAT in the run's folder)")
    parser.add_argument("--kernel", metavar="NAME", help="of usd: ellipsoid, which readers know (default), or surflet, flat")
    parser.add_argument(
        "--refine",
        type=float,
        metavar="MINUTES",
        help="so long Mitsuba's path tracer fits a mesh's textures and light to the training photographs, or splats are fitted "
        "to what the run looks like, also behind its mirrors",
    )
    parser.add_argument(
        "--data", type=Path, metavar="DIR", help="of mesh, and with --refine: the photographs (default: where they were)"
    )
    add_common(parser)

    def run(args):
        set_variant(args.variant)
        from ..commands.export import export

        options = {name: getattr(args, name) for name in ("out", "kernel", "refine", "data", "quiet")}
        for path in export(args.run_folder, args.to, **options):
            print(path)

    return run

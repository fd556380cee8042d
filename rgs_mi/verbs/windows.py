"""The verb that opens a window: view."""

from pathlib import Path

from ..core.errors import parse_variables
from ..core.runtime import set_variant
from ..core.scene_files import find_scene
from .arguments import Parser, Run, add_address, add_common, add_variables, known


def view(parser: Parser) -> Run:
    """Look at a fit in a browser, turn it, relight it, compare it with its photographs; needs `pip install 'rgs-mi[viewer]'`."""
    parser.add_argument("scene", metavar="RUN_OR_SCENE", help=f"a run's folder, an XML file, or {known('scenes')}")
    add_variables(parser)
    parser.add_argument("--data", type=Path, metavar="DIR", help="the folder of its photographs (default: where they were)")
    parser.add_argument(
        "--envmap",
        dest="envmaps",
        type=Path,
        action="append",
        default=[],
        metavar="FILE",
        help="offer this image as a light, latitude-longitude EXR or HDR, beside the environments of the suite; again for more",
    )
    add_address(parser)
    add_common(parser, quiet=False)

    def run(args):
        scene = find_scene(args.scene, "scenes")
        set_variant(args.variant)
        from ..commands.view import view

        view(
            scene,
            variables=parse_variables(args.define),
            data=args.data,
            envmaps=args.envmaps,
            host=args.host,
            port=args.port,
        )

    return run

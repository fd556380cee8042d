"""The verbs of one fit: optimize, evaluate, recovery."""

import json
from pathlib import Path

from ..core.errors import parse_variables
from ..core.runtime import set_variant
from ..core.scene_files import find_scene
from .arguments import (
    Parser,
    Run,
    add_address,
    add_budget,
    add_common,
    add_integer,
    add_names,
    add_variables,
    check_settings,
    known,
)


def optimize(parser: Parser) -> Run:
    """Fit reflective surfels and their environment to photographs, and write a scene that Mitsuba renders."""
    parser.add_argument(
        "scene", help=f"what to fit: {known('scenes')}, or an XML file; a YAML of the same name beside it says how"
    )
    parser.add_argument(
        "--data",
        help=f"a capture's folder, or a Mitsuba scene to render one from: {known('targets')}, or an XML file",
    )
    add_variables(parser)
    add_budget(parser)
    parser.add_argument("--out", type=Path, metavar="DIR", help="the run's folder (default: runs/NAME)")
    parser.add_argument("--resume", action="store_true", help="go on from the run's newest checkpoint")
    parser.add_argument("--seed", type=int, help="of everything random")
    parser.add_argument("--tensorboard", action="store_true", help="write event files into the run's folder tensorboard/")
    parser.add_argument("--view", action="store_true", help="show the fit in a window, a page that a browser opens")
    add_address(parser)
    add_common(parser)

    def run(args):
        scene, data = find_scene(args.scene, "scenes"), args.data and find_scene(args.data, "targets")
        check_settings(args)
        set_variant(args.variant)
        from ..commands.optimize import join, optimize
        from ..fit.ranks import restarted, started

        variables = parse_variables(args.define)
        with started() as ranks:
            if ranks.rank:
                return join(ranks, scene, data, variables)
            optimize(
                scene,
                data=data,
                variables=variables,
                config=args.config,
                overrides=args.overrides,
                minutes=args.minutes,
                seed=args.seed,
                out=args.out,
                resume=args.resume or restarted(),
                quiet=args.quiet,
                tensorboard=args.tensorboard,
                window=(args.host, args.port) if args.view else None,
                ranks=ranks,
            )

    return run


def evaluate(parser: Parser) -> Run:
    """Judge a run again on its held-out views, as when LPIPS's weights were installed after it; writes metrics.json anew."""
    parser.add_argument("run_folder", type=Path, metavar="RUN", help="a run's folder")
    parser.add_argument("--data", type=Path, metavar="DIR", help="the folder of its photographs (default: where they were)")
    add_common(parser)

    def run(args):
        set_variant(args.variant)
        from ..commands.evaluate import reevaluate

        reevaluate(args.run_folder, args.data, args.quiet)

    return run


def recovery(parser: Parser) -> Run:
    """How true a fit's light and materials are, against the path-traced scene that it was fitted to, also under other lights."""
    parser.add_argument("run_folder", type=Path, metavar="RUN", help="a run's folder")
    parser.add_argument("truth", help=f"the scene of its photographs: an XML file, or {known('targets')}")
    add_variables(parser)
    add_names(parser, "--lights", "environments of the suite to relight it", default=[])
    add_integer(parser, "--size", 400, "pixels along a side of the path-traced views")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where to (default: recovery in the run's folder)")
    add_common(parser)

    def run(args):
        truth = find_scene(args.truth, "targets")
        set_variant(args.variant)
        from ..commands.recovery import recovery

        variables, size = parse_variables(args.define), args.size
        figures = recovery(
            args.run_folder, truth, args.lights, variables=variables, size=size, out=args.out, quiet=args.quiet
        )
        print(json.dumps(figures, indent=1))

    return run

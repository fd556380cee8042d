"""The verbs of many fits and of measurements: ablate, benchmark, crossvalidate, fit-taps."""

from pathlib import Path

from ..core.runtime import set_variant
from ..core.scene_files import bundled, find_scene
from .arguments import Parser, Run, add_budget, add_common, add_integer, add_names, add_out, add_set, check_settings


def ablate(parser: Parser) -> Run:
    """Fit variants of the method to a suite of scenes, and table what each part of it brings. The same command goes on where it
    was interrupted, and does not repeat what is done."""
    _suite_of(parser, "suite")
    add_names(parser, "--variants", "these only: rows of the table in rgs_mi/commands/ablate.py, or presets")
    add_budget(parser, config=False)
    add_names(parser, "--seeds", "of everything random; fit with each (default: 0)", int, "N,M", default=[0])
    _add_workers(parser)
    add_out(parser, "runs/ablation", "folder of the tables and of all runs")
    add_common(parser)

    def run(args):
        check_settings(args)
        set_variant(args.variant)
        from ..commands.ablate import ablate

        names = ("scenes", "variants", "minutes", "overrides", "seeds", "workers", "scheduler", "out", "quiet")
        return bool(ablate(args.suite, bundled("scenes")["object"], **{name: getattr(args, name) for name in names}))

    return run


def _suite_of(parser: Parser, name: str):
    parser.add_argument(
        name,
        type=Path,
        nargs="?",
        default=bundled("targets")["helmet"].parent,
        metavar=name.upper(),
        help="a folder of captures, in any layout, and of scenes to path-trace (default: our own targets)",
    )
    add_names(parser, "--scenes", "these only")


def _add_workers(parser: Parser):
    add_integer(parser, "--workers", 1, "fits at a time, which share the cores, and with them the FPS")
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="of a Dask cluster (tcp://HOST:8786), whose workers fit instead, on a shared disk: pip install 'rgs-mi[cluster]'",
    )


def benchmark(parser: Parser) -> Run:
    """Fit and judge a suite of captures beside the paper's tables; or time the splatter, or the step of a fit; or
    measure how a fit grows."""
    commands = parser.add_subparsers(dest="command", required=True, parser_class=Parser)
    for define in (_suite, _splat, _step, _growth):
        command = commands.add_parser(define.__name__[1:], help=define.__doc__, description=define.__doc__)
        run = define(command)
        add_common(command, quiet=define is _suite)
        command.set_defaults(measure=run)
    return lambda args: args.measure(args)


def _suite(parser: Parser) -> Run:
    """Fit and judge all captures of a folder; the same command goes on where it was interrupted, and does not repeat what is
    done."""
    _suite_of(parser, "root")
    add_budget(parser)
    _add_workers(parser)
    add_out(parser, "runs/suite", "folder of the tables and of all runs")

    def run(args):
        check_settings(args)
        set_variant(args.variant)
        from ..commands.suite import fit_suite

        names = ("scenes", "config", "minutes", "overrides", "workers", "scheduler", "out", "quiet")
        return bool(fit_suite(args.root, bundled("scenes")["object"], **{name: getattr(args, name) for name in names}))

    return run


def _splat(parser: Parser) -> Run:
    """Tile intersections, forward and backward of random surfels on a sphere."""
    add_integer(parser, "--surfels", 50_000, "")
    add_integer(parser, "--res", 800, "pixels along a side")
    parser.add_argument(
        "--against",
        type=Path,
        metavar="FILE.py",
        help="a script that takes --surfels and --res and prints 'lists', 'forward' and 'backward', each with its time in ms",
    )
    add_integer(parser, "--rounds", 3, "")

    def run(args):
        set_variant(args.variant)
        from ..commands import benchmark

        benchmark.splat(args.surfels, args.res, args.against, args.rounds)

    return run


def _step(parser: Parser) -> Run:
    """A warm step at full resolution."""
    parser.add_argument("--scene", default="object", help="what to fit (default: %(default)s)")
    parser.add_argument("--data", required=True, help="a capture's folder, or one of our targets")
    add_integer(parser, "--surfels", 15_000, "")
    add_integer(parser, "--steps", 20, "")
    parser.shows_settings = True
    add_set(parser)

    def run(args):
        scene, data = find_scene(args.scene, "scenes"), find_scene(args.data, "targets")
        check_settings(args)
        set_variant(args.variant)
        from ..commands import benchmark

        benchmark.step(scene, data, args.surfels, args.steps, args.overrides)

    return run


def _growth(parser: Parser) -> Run:
    """What start, step and memory come to with more surfels, larger photographs and more of them: half an hour."""
    parser.add_argument("--scene", default="object", help="what to fit (default: %(default)s)")
    parser.add_argument("--data", required=True, help="a capture's folder, or one of our targets, which is enlarged")
    add_out(parser, "runs/growth", "folder of the table and the plot")

    def run(args):
        scene, data = find_scene(args.scene, "scenes"), find_scene(args.data, "targets")
        set_variant(args.variant)
        from ..commands.growth import growth

        growth(scene, data, args.out)

    return run


def crossvalidate(parser: Parser) -> Run:
    """Compare our estimators of what a principled BSDF reflects with Mitsuba's path tracer; 1 where a bound is broken."""
    add_names(parser, "--shapes", "sphere, and models of the suite, e.g. helmet (default: sphere)", default=["sphere"])
    add_names(parser, "--environments", "of the suite (default: three)")
    add_names(parser, "--roughness", "of materials (default: seven, 0.02 to 1)", float, "R,S")
    add_integer(parser, "--size", 64, "pixels along a side")
    add_integer(parser, "--samples", 128, "per pixel, of each of 16 batches of the path tracer; ours take twice as many")
    add_integer(parser, "--seed", 0, "of everything random")
    add_out(parser, "runs/crossvalidation", "folder of the page, the table and the maps")
    add_common(parser)

    def run(args):
        set_variant(args.variant)
        from ..validation.cases import ENVIRONMENTS, ROUGHNESS, Validator, grid
        from ..validation.report import crossvalidate

        cases = grid(args.shapes, args.environments or ENVIRONMENTS, args.roughness or ROUGHNESS)
        return bool(crossvalidate(args.out, cases, Validator(args.size, args.samples, args.seed), args.quiet))

    return run


def fit_taps(parser: Parser) -> Run:
    """Fit where split-sum looks the environment up (rgs_mi/shading/taps.npy) to the Monte Carlo estimator; minutes."""
    add_integer(parser, "--environments", 24, "random ones to fit to")
    add_integer(parser, "--steps", 1500, "of the optimiser")
    add_integer(parser, "--seed", 0, "of everything random")
    parser.add_argument("--out", type=Path, default=Path("taps.npy"), help="file to write (default: %(default)s)")
    add_common(parser, quiet=False)

    def run(args):
        set_variant(args.variant)
        from ..commands.fit_taps import fit_taps

        fit_taps(args.out, args.environments, args.steps, args.seed)

    return run

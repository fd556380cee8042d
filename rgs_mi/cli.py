"""The console command ``rgs-mi VERB …``. A verb's function adds its arguments to a parser and returns what runs it, so that
neither help nor a bad option starts Mitsuba."""

import argparse
import sys

from .core.errors import run_main
from .core.runtime import CACHE_VARIABLE, cache_folder
from .verbs import captures, exports, fits, renderings, suites, windows
from .verbs.arguments import Parser

VERBS = {
    "capture": captures.capture,
    "optimize": fits.optimize,
    "evaluate": fits.evaluate,
    "recovery": fits.recovery,
    "render": renderings.render,
    "render-dataset": renderings.render_dataset,
    "export": exports.export,
    "view": windows.view,
    "ablate": suites.ablate,
    "benchmark": suites.benchmark,
    "crossvalidate": suites.crossvalidate,
    "fit-taps": suites.fit_taps,
}


def main(verb: str | None = None) -> None:
    """Run what the command line says, and end the process (`run_main`); the scripts of a clone give the ``verb``."""
    run_main(lambda: _run([*([verb] if verb else []), *sys.argv[1:]]))


def _run(arguments):
    parser = argparse.ArgumentParser(
        prog="rgs-mi",
        description="Reflection-aware Gaussian splatting: photographs of a shiny object in, a relightable Mitsuba asset out.",
        epilog=f"What takes long to compute is kept in the folder that the environment variable {CACHE_VARIABLE} names, now "
        f"'{cache_folder()}'. 'rgs-mi VERB --help' says more, for 'optimize' also of all settings.",
    )
    verbs = parser.add_subparsers(required=True, metavar="VERB", parser_class=Parser)
    for name, define in VERBS.items():
        verb = verbs.add_parser(name, help=define.__doc__, description=define.__doc__)
        verb.set_defaults(run=define(verb))
    args = parser.parse_args(arguments)
    return args.run(args)

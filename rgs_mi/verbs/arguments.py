"""Arguments that several verbs have."""

import argparse
import shutil
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..core.errors import listed
from ..core.runtime import HOST, PORT
from ..core.scene_files import bundled

#: What a verb does with its arguments: returns the exit code, or None for 0.
Run = Callable[[argparse.Namespace], int | None]


class Parser(argparse.ArgumentParser):
    """A parser whose help ends with all settings where ``shows_settings`` is set: where it has the option --set."""

    shows_settings = False

    def format_help(self) -> str:
        """Return the help of argparse, and all settings."""
        return super().format_help() + (_settings_help() if self.shows_settings else "")


def _settings_help():
    """A line or two for each setting."""
    from ..settings.fields import walk
    from ..settings.settings import Settings

    entries, width = [], max(60, shutil.get_terminal_size().columns)
    for s in walk(Settings):
        values = ", ".join(filter(None, (s.kind, s.range)))
        text = textwrap.wrap(f"{values}. {s.description}", width - 6)
        entries.append("\n      ".join([f"  {s.key} = {s.default}", *text]))
    return "\n".join(["\nsettings, which --set and YAML files change:", *entries, ""])


def add_common(parser: argparse.ArgumentParser, quiet: bool = True) -> None:
    """Add --variant, and --quiet where asked."""
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant (default: %(default)s)")
    if quiet:
        parser.add_argument("--quiet", action="store_true", help="no progress")


def add_integer(parser: argparse.ArgumentParser, name: str, default: int, text: str) -> None:
    """Add the option ``name`` of an integer, whose help is ``text`` and its default."""
    parser.add_argument(name, type=int, default=default, help=f"{text} (default: %(default)s)".strip())


def add_names(
    parser: argparse.ArgumentParser, name: str, text: str, kind: type = str, metavar: str = "A,B", **options: Any
) -> None:
    """Add the option ``name`` of a list with commas, each entry a ``kind``; ``options`` are those of argparse."""
    parser.add_argument(name, type=listed(kind), metavar=metavar, help=text, **options)


def add_out(parser: argparse.ArgumentParser, default: str, text: str) -> None:
    """Add --out, a folder."""
    parser.add_argument("--out", type=Path, default=Path(default), metavar="DIR", help=f"{text} (default: %(default)s)")


def add_address(parser: argparse.ArgumentParser) -> None:
    """Add --host and --port, where a window's page is."""
    parser.add_argument(
        "--host", default=HOST, help="address to listen at; 0.0.0.0 lets other machines in (default: %(default)s)"
    )
    add_integer(parser, "--port", PORT, "of the page, 0 for any that is free")


def add_variables(parser: argparse.ArgumentParser) -> None:
    """Add -D, the variables of a scene, as `parse_variables` reads them."""
    parser.add_argument(
        "-D", dest="define", action="append", default=[], metavar="NAME=VALUE", help="a variable of the scene"
    )


def add_budget(parser: Parser, config: bool = True) -> None:
    """Add what says how to fit: --config where asked, --minutes and --set, with all settings in the help."""
    parser.shows_settings = True
    if config:
        parser.add_argument("--config", metavar="PRESET|FILE", help="settings: a preset's name or a YAML file")
    parser.add_argument("--minutes", type=float, help="plan a fit to end within this time")
    add_set(parser)


def add_set(parser: argparse.ArgumentParser) -> None:
    """Add --set, as `load_config` reads overrides."""
    parser.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="A.B=VALUE", help="one setting (see below)"
    )


def check_settings(args: argparse.Namespace) -> None:
    """Refuse bad settings before Mitsuba starts. Raises: UserError as `load_config` does."""
    from ..settings.config import load_config
    from ..settings.settings import Settings

    config = getattr(args, "config", None)
    load_config(Settings, [config] if config else [], args.overrides)


def known(kind: str) -> str:
    """Return the names of the scenes of one ``kind`` that come with the package (`bundled`), in words."""
    return ", ".join(bundled(kind))

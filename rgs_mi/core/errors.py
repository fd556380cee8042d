"""The one exception that reaches a person: a single line that names the file and the remedy."""

import sys
import warnings
from collections.abc import Callable
from typing import NoReturn


class UserError(Exception):
    """Bad input. The message is one line: what is wrong, in which file, and what to do about it."""


def listed(kind: Callable = str) -> Callable[[str], list]:
    """Return the type (of argparse) of an option that is a list: it takes 'a,b' to [kind('a'), kind('b')]."""

    def parse(text: str) -> list:
        return [kind(entry.strip()) for entry in text.split(",") if entry.strip()]

    parse.__name__ = f"list of {kind.__name__}"  # what argparse calls a bad one
    return parse


def parse_variables(pairs: list[str]) -> dict[str, str]:
    """Return ["name=value", …], as -D gives them, as a dictionary. Raises: UserError for a pair without '='."""
    if bad := [p for p in pairs if "=" not in p]:
        raise UserError(f"-D {bad[0]}: write name=value")
    return dict(p.split("=", 1) for p in pairs)


def run_main(main: Callable[[], int | str | None]) -> NoReturn:
    """Call ``main()`` as a command and exit with what it returns: a `UserError` prints one line and exits with 2, Ctrl-C
    with 130; warnings print one line each."""
    with warnings.catch_warnings():
        warnings.showwarning = _print_warning
        try:
            sys.exit(main())
        except UserError as error:
            print(f"error: {error}", file=sys.stderr)
            sys.exit(2)
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
            sys.exit(130)


def _print_warning(message, *_, **__):
    print("warning:", *str(message).split(), file=sys.stderr)

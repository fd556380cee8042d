"""The one exception that reaches a person: a single line that names the file and the remedy."""

import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NoReturn

from .telling import one_line, patient_streams


class UserError(Exception):
    """Bad input. The message is one line: what is wrong, in which file, and what to do about it. Whatever does not print in it,
    as in the names of files, is escaped."""

    def __init__(self, message: str) -> None:
        super().__init__(one_line(message))


class Stopped(KeyboardInterrupt):
    """Someone, or a scheduler, has stopped the command by a ``signal``; ``message`` is what to do about it."""

    def __init__(self, number: int, message: str = "interrupted") -> None:
        super().__init__(message)
        self.code = 128 + number  # as shells have it: 130 for Ctrl-C, 143 for SIGTERM, 129 for a terminal that is gone


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
    """Call ``main()`` as a command and exit with what it returns: a `UserError` prints one line and exits with 2, Ctrl-C and
    SIGTERM with the code of `Stopped`; warnings print one line each. Nothing that is told ends the command (`telling`)."""
    with warnings.catch_warnings(), patient_streams(), _terminable() as stops:
        warnings.showwarning = _print_warning
        try:
            sys.exit(main())
        except (KeyboardInterrupt, Exception) as error:
            if stop := _stop_behind(error) or next(iter(stops), None):
                stopped = stop if isinstance(stop, Stopped) else Stopped(signal.SIGINT)
                print(stopped, file=sys.stderr)
                sys.exit(stopped.code)
            if isinstance(error, UserError):
                print(f"error: {error}", file=sys.stderr)
                sys.exit(2)
            if isinstance(error, MemoryError):
                print(f"error: out of memory ({one_line(error)}): use fewer or smaller photographs", file=sys.stderr)
                sys.exit(2)
            raise


@contextmanager
def _terminable() -> Iterator[list[Stopped]]:
    """SIGTERM unwinds, so that locks and half-written files go, also in process 1 of a container, which it does not end, as
    does Ctrl-C, unless it is ignored. Gives what has been raised: code in between, as of plugins that a scene loads, may make
    something else of it."""
    stops: list[Stopped] = []

    def stop(number, frame):
        stops.append(Stopped(number))
        raise stops[-1]

    main = threading.current_thread() is threading.main_thread()
    numbers = [signal.SIGTERM] + [signal.SIGINT] * (signal.getsignal(signal.SIGINT) is signal.default_int_handler)
    before = {number: signal.signal(number, stop) for number in numbers} if main else {}
    try:
        yield stops
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


def _stop_behind(error):
    """The KeyboardInterrupt that ``error`` is, or was caused by: one that comes while C++ calls Python, in Dr.Jit or as Mitsuba
    is imported, is wrapped in whatever they have. None if there is none."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__
    return error


def _print_warning(message, *_, **__):
    print("warning:", one_line(" ".join(str(message).split())), file=sys.stderr)

"""What a command says on stdout and stderr, and how: a line for each thing, and never at the cost of the work.

A full disk below ``2> run.log``, a reader that is gone (``| head``) or a terminal that is gone costs the words alone.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO, cast


def one_line(text: object) -> str:
    """Return ``text`` as a line: newlines and whatever else does not print, which names of files may hold, as escapes."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in str(text))


class _Patient:
    """A text stream that drops what can't be written."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except (OSError, ValueError):  # of a stream that is closed
            return len(text)

    def flush(self) -> None:
        with suppress(OSError, ValueError):
            self._stream.flush()

    def writelines(self, lines: Any) -> None:
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def patient_streams() -> Iterator[None]:
    """Within the block, and when the process ends, nothing that is said on stdout or stderr raises, also not for a character that
    their encoding lacks."""
    before = sys.stdout, sys.stderr
    for stream in filter(None, before):
        if reconfigure := getattr(stream, "reconfigure", None):  # not of a test's stand-in
            reconfigure(errors="backslashreplace")
    sys.stdout, sys.stderr = (cast(TextIO, stream and _Patient(stream)) for stream in before)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before
        for stream in filter(None, before):
            _emptied(stream)


def _emptied(stream):
    """Flush a stream; one that can't be goes nowhere from here on, because Python flushes it again at the end."""
    try:
        stream.flush()
    except (OSError, ValueError):
        with suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, stream.fileno())
            os.close(nowhere)
            stream.flush()

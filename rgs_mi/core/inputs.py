"""The door by which files of others come in: regular files of tolerable size. Pipes, which would wait for ever, and devices,
which never end, stay outside.

What is refused is an `OSError` with its reason as ``strerror``, like that of a file that is missing: who reads names the file
and the remedy in a `UserError`.
"""

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

#: Bytes that a file may have: of a camera or a list of names, of settings, of JSON, and of anything else.
CAMERA, SETTINGS, JSON, MOST = 1 << 16, 1 << 20, 1 << 28, 1 << 33


def is_file(path: str | Path) -> bool:
    """Return whether ``path`` is a regular file; False for names that no file system takes, which `Path.is_file` raises for."""
    return os.path.isfile(path)


def check_file(path: str | Path, most: int = MOST) -> None:
    """Check that ``path`` is a regular file of ``most`` bytes or fewer, for what opens it by itself. Raises: OSError."""
    try:
        found = os.stat(path)
    except ValueError as error:  # NUL in its name
        raise OSError(errno.EINVAL, "no file has such a name") from error
    _check(found, most)


@contextmanager
def opened(path: str | Path, most: int = MOST) -> Iterator[BinaryIO]:
    """Open a regular file of ``most`` bytes or fewer to read it as binary. Raises: OSError."""
    check_file(path, most)
    with open(os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)), "rb") as stream:
        _check(os.fstat(stream.fileno()), most)  # of what was opened: the name may be another's by now
        yield stream


def read_file(path: str | Path, most: int = MOST) -> bytes:
    """Return what is in a regular file of ``most`` bytes or fewer. Raises: OSError."""
    with opened(path, most) as stream:
        return stream.read()


def _check(found, most):
    if not stat.S_ISREG(found.st_mode):
        kind = "a folder" if stat.S_ISDIR(found.st_mode) else "a pipe or a device"
        raise OSError(errno.EINVAL, f"{kind}, not a file")
    if found.st_size > most:
        raise OSError(errno.EFBIG, f"{found.st_size} bytes, and {most} are the most that it may have")

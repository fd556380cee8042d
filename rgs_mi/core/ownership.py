"""One process at a time writes into a folder, and what stood there is moved aside, not overwritten.

The lock is the system's own, of the open file ``FOLDER/.lock`` (flock): it ends with the process that holds it, however that
ends, so that no lock is ever stale, whether the other process was one of this machine, of another container or, over NFS, of
another host. What the file says of its owner only serves the message.
"""

import errno
import json
import os
import re
import socket
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from .errors import UserError
from .files import TEMPORARY, explained

try:
    import fcntl
except ImportError:  # Windows: nobody is kept out
    fcntl = None

LOCK = ".lock"
_NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS, errno.EINVAL)  # what file systems say that have none


class Owned:
    """A ``folder`` that this process alone writes into, from `owned`."""

    def __init__(self, folder: Path, wait: bool) -> None:
        self.folder = folder
        with explained(folder):
            self._made = not folder.exists()
            self._descriptor = _acquire(_real(folder) / LOCK, wait)
        self._sweep()

    def move_aside(self) -> Path:
        """Rename the folder to the first of FOLDER.1, FOLDER.2 … that is free, make an empty one in its place, and return the
        new name of the old one. Raises: UserError where that can't be."""
        real = _real(self.folder)
        if Path.cwd().is_relative_to(real):
            raise UserError(f"{self.folder} holds a run and is the current folder: choose another --out")
        number = 1
        while os.path.lexists(aside := real.with_name(f"{real.name}.{number}")):
            number += 1
        with explained(self.folder):
            os.rename(real, aside)
            before = self._descriptor
            self._descriptor = _acquire(real / LOCK, wait=False)
        _release(aside / LOCK, before)
        return self.folder.with_name(aside.name) if self.folder.name == real.name else aside

    def release(self) -> None:
        """Let others write; a folder that was made for this and is empty goes."""
        _release(self.folder / LOCK, self._descriptor)
        if self._made:
            with suppress(OSError):  # as a rule it is not empty
                self.folder.rmdir()

    def _sweep(self):
        """Delete what owners before this one have left half written."""
        for pattern in (".*.tmp", "*/.*.tmp"):
            for path in self.folder.glob(pattern):
                if re.fullmatch(TEMPORARY, path.name):
                    path.unlink(missing_ok=True)


@contextmanager
def owned(folder: str | Path, wait: bool = False) -> Iterator[Owned]:
    """Make ``folder``, and keep other processes from it until the block ends.

    Args:
      wait: whether to wait for another process that has it, which a line on stderr says

    Raises: UserError where another process has it, or where the folder can't be written.
    """
    mine = Owned(Path(folder), wait)
    try:
        yield mine
    finally:
        mine.release()


def _real(folder: Path) -> Path:
    """What links lead to, also where nothing is there yet."""
    return Path(os.path.realpath(folder))


def _acquire(path: Path, wait: bool) -> int | None:
    """The descriptor of the lock file, locked, in a folder that is made where need be; None where there are no locks."""
    while True:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except FileExistsError:
            if os.path.lexists(path.parent) and not path.parent.is_dir():
                raise
            continue  # its owner has just removed the folder, which was empty
        if not fcntl:
            return None
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except FileNotFoundError:  # its owner has just removed the folder, which was empty
            continue
        try:
            _lock(descriptor, path, wait)
        except BaseException as error:
            os.close(descriptor)
            if not isinstance(error, OSError) or error.errno not in _NO_LOCKS:
                raise
            path.unlink(missing_ok=True)
            warnings.warn(
                f"{path.parent}: its file system has no locks: see to it that no other process writes there", stacklevel=5
            )
            return None
        if _is_at(descriptor, path):
            _sign(descriptor)
            return descriptor
        os.close(descriptor)  # its owner has deleted it meanwhile


def _lock(descriptor, path, wait):
    """Lock the open file. Raises: UserError where another process has it, and ``wait`` is not asked for."""
    assert fcntl is not None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        owner = _owner(descriptor)
        if not wait:
            raise UserError(f"{path.parent} is in use by {owner}: wait for it, or choose another folder") from None
        print(f"waiting for {path.parent}, which is in use by {owner}", file=sys.stderr)
        fcntl.flock(descriptor, fcntl.LOCK_EX)


def _sign(descriptor):
    """Say whose the lock is, if the disk takes it."""
    about = {"host": socket.gethostname(), "pid": os.getpid(), "since": time.strftime("%Y-%m-%d %H:%M:%S")}
    with suppress(OSError):
        os.ftruncate(descriptor, 0)
        os.write(descriptor, json.dumps(about).encode())


def _owner(descriptor) -> str:
    """Who says that a lock is theirs, in words."""
    try:
        about = json.loads(os.pread(descriptor, 4096, 0))
        return f"process {about['pid']} on {about['host']} since {about['since']}"
    except (OSError, ValueError, KeyError, TypeError):
        return "another process"


def _is_at(descriptor, path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False


def _release(path, descriptor):
    if descriptor is not None:
        with suppress(OSError):
            if _is_at(descriptor, path):  # else it is another's
                path.unlink()  # first: who has opened it meanwhile sees that it is gone
        os.close(descriptor)

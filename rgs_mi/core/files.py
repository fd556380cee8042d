"""Files that are there whole or not at all: a reader never sees half of one."""

import errno
import json
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from .color import to_8bit
from .errors import UserError

if TYPE_CHECKING:
    import mitsuba as mi

TEMPORARY = r"\..+\.[0-9a-f]{12}\.tmp"  # what names of half-written files match


@contextmanager
def atomic_file(path: str | Path) -> Iterator[BinaryIO]:
    """Open a binary file that replaces ``path`` when the block ends, and leaves it untouched when the block raises.

    Raises: UserError where the disk is full or the folder can't be written.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(6)}.tmp")  # no process's number: containers share disks
    try:
        with explained(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            with open(temporary, "wb") as stream:
                yield stream
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(temporary, path)
            _sync_folder(path.parent)
    finally:
        try:
            temporary.unlink(missing_ok=True)
        except OSError:
            pass  # the folder itself is unusable, which is reported above


def make_folder(folder: str | Path) -> None:
    """Make a run's folder, so that one that can't be is found before anything is computed for it.

    Raises: UserError where it can't be made.
    """
    with explained(folder):
        Path(folder).mkdir(parents=True, exist_ok=True)


@contextmanager
def explained(path: str | Path) -> Iterator[None]:
    """Turn what the system says against writing ``path`` into a `UserError`."""
    try:
        yield
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        remedy = "free some space" if full else "check the folder's permissions and free space"
        raise UserError(
            f"{path}: can't be written ({error.strerror or error}): {remedy} or choose another folder, "
            "what was there before is untouched"
        ) from error


def write_png(path: str | Path, image: np.ndarray) -> None:
    """Write display values in [0, 1], [H, W, 3 or 4], as an 8-bit PNG, whole or not at all.

    Raises: UserError as `atomic_file` does.
    """
    from PIL import Image

    with atomic_file(path) as stream:
        Image.fromarray(to_8bit(image)).save(stream, "PNG")


def write_exr(path: str | Path, pixels: np.ndarray, channels: list[str] | None = None) -> None:
    """Write ``pixels`` [H, W, C] as a float32 EXR, whole or not at all; ``channels`` names them (None: RGB).

    Raises: UserError as `atomic_file` does.
    """
    import mitsuba as mi

    formats = mi.Bitmap.PixelFormat
    pixels = np.ascontiguousarray(pixels, np.float32)
    write_bitmap(path, mi.Bitmap(pixels, formats.MultiChannel, channels) if channels else mi.Bitmap(pixels, formats.RGB))


def write_bitmap(path: str | Path, bitmap: "mi.Bitmap") -> None:
    """Write a Mitsuba bitmap as an EXR or PNG, as the name says, whole or not at all.

    Raises: UserError as `atomic_file` does.
    """
    import mitsuba as mi

    formats, memory = mi.Bitmap.FileFormat, mi.MemoryStream()
    bitmap.write(memory, formats.OpenEXR if Path(path).suffix == ".exr" else formats.PNG)
    with atomic_file(path) as stream:
        stream.write(memory.raw_buffer())


def write_json(path: str | Path, data: dict) -> None:
    """Write ``data`` as JSON, whole or not at all; what JSON does not know is written as its text.

    Raises: UserError as `atomic_file` does.
    """
    with atomic_file(path) as stream:
        stream.write((json.dumps(data, indent=1, default=str) + "\n").encode())


def _sync_folder(folder):
    """Make a rename in ``folder`` durable; Windows can neither open a folder nor needs to."""
    if os.name == "posix":
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

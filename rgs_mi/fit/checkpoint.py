"""Checkpoints that survive a kill, a full disk and a damaged file.

A checkpoint is one uncompressed zip of ``.npy`` members and a ``meta.json``, so ``numpy.load`` opens it too. It is
written under a temporary name, flushed to the disk and renamed: a reader sees the whole file or none of it.
"""

import json
import os
import re
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import UserError
from ..core.files import atomic_file

KEEP = 2
FORMAT = 1  # of what is in a checkpoint, and in metrics.json: another number is another meaning
_NAME = re.compile(r"step_(\d+)\.npz")


def save(folder: str | Path, arrays: Mapping[str, npt.ArrayLike], meta: Mapping[str, Any]) -> Path:
    """Write ``FOLDER/checkpoints/step_XXXXXXX.npz`` atomically and return its path.

    Keeps the newest two. A checkpoint of a later step belongs to a run that was given up (its file is damaged, or the
    fit was started anew) and is removed.

    Args:
      folder: the run's output folder, created if missing
      arrays: name -> array of numbers, any shape (anything ``numpy.asarray`` takes; objects are refused)
      meta:   JSON values, with the integer ``step`` among them; numpy scalars and arrays, and paths, are converted. The file
              also has the number of its `FORMAT`

    Raises: UserError where the disk is full or the folder can't be written; the checkpoints there stay as they are.
    """
    step = int(meta["step"])
    folder = Path(folder) / "checkpoints"
    path = folder / f"step_{step:07d}.npz"
    with atomic_file(path) as stream, zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("meta.json", json.dumps({"format": FORMAT, **meta}, default=_to_json))
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)
    checkpoints = _checkpoints(folder)
    kept = [s for s in checkpoints if s <= step][-KEEP:]
    for stale in [checkpoints[s] for s in checkpoints if s not in kept] + list(folder.glob(".step_*.tmp")):
        stale.unlink(missing_ok=True)
    return path


def load_latest(folder: str | Path) -> tuple[dict[str, np.ndarray], dict[str, Any]] | None:
    """Return ``(arrays, meta)`` of the newest readable checkpoint of the run in ``folder``; None where there is none.

    Where the newest is damaged it warns, and falls back to the one before.
    Raises: UserError where there are checkpoints and none can be read, and for one of another `FORMAT`.
    """
    checkpoints = _checkpoints(Path(folder) / "checkpoints")
    for path in reversed(checkpoints.values()):
        try:
            return _load(path)
        except UserError:
            raise
        except Exception as error:  # a damaged zip fails in a dozen ways, and each means the same here
            warnings.warn(f"{path} is damaged ({error}): trying the checkpoint before it", stacklevel=2)
    if checkpoints:
        raise UserError(f"{Path(folder) / 'checkpoints'}: no checkpoint can be read: start again without --resume")
    return None


def _load(path):
    with zipfile.ZipFile(path) as archive:
        if max(info.file_size for info in archive.infolist()) > path.stat().st_size:
            raise ValueError("it unpacks to more than it holds, and none of ours is compressed")
        meta = json.loads(archive.read("meta.json"))
        if (number := meta.pop("format", None)) != FORMAT:
            whose = "a newer" if isinstance(number, int) and number > FORMAT else "another"
            raise UserError(
                f"{path} has format {str(number)[:20]} of {whose} version, and this one reads {FORMAT}: go on with the version "
                "that wrote it, or choose another --out"
            )
        arrays = {}
        for name in archive.namelist():
            if name.endswith(".npy"):
                with archive.open(name) as member:
                    arrays[name[:-4]] = np.lib.format.read_array(member, allow_pickle=False)
    return arrays, meta


def _checkpoints(folder):
    """step -> path, ascending."""
    found = {int(m[1]): p for p in folder.glob("step_*.npz") if (m := _NAME.fullmatch(p.name))}
    return dict(sorted(found.items()))


def _to_json(value):
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    raise TypeError(f"checkpoint meta: {type(value).__name__} is not a JSON value")

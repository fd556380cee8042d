"""Arrays that take long to compute, and are kept."""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .errors import UserError
from .files import atomic_file


def cached_arrays(
    path: str | Path,
    check: Callable[[dict[str, np.ndarray]], None],
    compute: Callable[[], dict[str, np.ndarray]],
) -> dict[str, np.ndarray]:
    """Return the arrays that the file ``path`` (.npz) keeps; where it is missing or, with a warning, damaged, those that
    ``compute()`` returns, which are then kept. A disk that takes no more costs the cache, not the result.

    Args:
      check: called with the arrays that were read, by name; raises an exception where they are not what they should be
    """
    path = Path(path)
    if path.is_file():
        try:
            with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as stored:
                arrays = dict(stored)
            check(arrays)
            return arrays
        except Exception as error:  # a damaged zip fails in a dozen ways, and each means the same here
            warnings.warn(f"{path} is damaged ({error}): computing it again", stacklevel=3)
    computed: dict[str, Any] = compute()
    try:
        with atomic_file(path) as stream:
            np.savez_compressed(stream, **computed)
    except UserError as error:
        warnings.warn(str(error), stacklevel=3)
    return computed

"""Sums over processes of which several are on one machine, in memory that these share: what PyTorch's gloo sends between them
goes through the loopback device."""
# pyright: reportPrivateImportUsage=false

import math
import os
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

_MEMORY = Path("/dev/shm")  # Linux: files that are memory alone
_ROOM = 1.25  # times what is asked for is taken, so that a model which grows seldom asks for more


class SharedSum:
    """The sum over all processes that torchrun has started, which must make one of these, and call `sum`, in the same order.

    Each process of a machine writes a row, and adds up its share of the rows; the first one of each machine then adds what
    others have there. ``number`` of ``here`` is this process on its machine; ``gather`` is `Ranks.gather`.
    """

    def __init__(self, number: int, here: int, gather: Callable[[Any], list[Any]]) -> None:
        from torch import distributed

        self._distributed, self._gather = distributed, gather
        self._number, self._here = number, here
        firsts = [rank for rank, other in enumerate(gather(number)) if other == 0]
        self._firsts = distributed.new_group(firsts) if len(firsts) > 1 else None
        self._rows = np.zeros((here + 1, 0), np.float32)  # of each process of this machine, and the sum

    def sum(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        """Return the sum of flat arrays of floats, which are as long everywhere, one after the other; to be read before the next
        call. Raises, in all: OSError where a machine has no memory to share."""
        n = sum(map(len, parts))
        if n > self._rows.shape[1]:
            self._share(int(_ROOM * n))
        *rows, total = self._rows[:, :n]
        np.concatenate(parts, out=rows[self._number])
        self._distributed.barrier()
        part = slice(n * self._number // self._here, n * (self._number + 1) // self._here)
        total[part] = rows[0][part]
        for row in rows[1:]:
            total[part] += row[part]
        self._distributed.barrier()
        if self._firsts:
            if self._number == 0:
                import torch

                self._distributed.all_reduce(torch.from_numpy(total), group=self._firsts)
            self._distributed.barrier()
        return total

    def _share(self, n):
        """Share rows of ``n`` floats. Their file loses its name once all have it, and goes when they end, however they do."""
        shape, own, rows = (self._here + 1, n), None, None
        try:
            if self._number == 0:
                own = _file(4 * math.prod(shape))
            path = self._gather(own)[self._distributed.get_rank() - self._number]
            if path:
                with suppress(OSError):
                    rows = np.memmap(path, np.float32, "r+", shape=shape)
            if not all(self._gather(rows is not None)):
                raise OSError("no memory to share")
        finally:
            if own:
                os.unlink(own)
        assert rows is not None
        self._rows = rows


def _file(size):
    """A new file of so many bytes, which are there to be written; None where they are not."""
    folder = _MEMORY if os.access(_MEMORY, os.W_OK) else None
    try:
        handle, path = tempfile.mkstemp(prefix="rgs_mi.", dir=folder)
    except OSError:
        return None
    try:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(handle, 0, size)  # memory that is promised alone ends a process when it is written
        else:
            os.truncate(handle, size)
        return path
    except OSError:
        os.unlink(path)
        return None
    finally:
        os.close(handle)

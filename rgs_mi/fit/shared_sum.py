"""Sums over processes of which several are on one machine, in memory that these share: what PyTorch's gloo sends between them
goes through the loopback device."""
# pyright: reportPrivateImportUsage=false

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

_MEMORY = Path("/dev/shm")  # Linux: files that are memory alone
_ROOM = 1.25  # times what is asked for is taken, so that a model which grows seldom asks for more


class SharedSum:
    """The sum over all processes that torchrun has started, which must make one of these, and call `sum`, in the same order.

    Each process of a machine writes a row, and adds up its share of the rows; the first one of each machine then adds what
    others have there.
    """

    def __init__(self) -> None:
        from torch import distributed

        self._distributed = distributed
        self._rank, self._size = int(os.environ["LOCAL_RANK"]), int(os.environ["LOCAL_WORLD_SIZE"])
        firsts = [rank for rank, number in enumerate(self._all(self._rank)) if number == 0]
        self._firsts = distributed.new_group(firsts) if len(firsts) > 1 else None
        self._rows = np.zeros((self._size + 1, 0), np.float32)  # of each process of this machine, and the sum

    def sum(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        """Return the sum of flat arrays of floats, which are as long everywhere, one after the other; to be read before the next
        call. Raises, in all: OSError where a machine has no memory to share."""
        n = sum(map(len, parts))
        if n > self._rows.shape[1]:
            self._share(int(_ROOM * n))
        *rows, total = self._rows[:, :n]
        np.concatenate(parts, out=rows[self._rank])
        self._distributed.barrier()
        part = slice(n * self._rank // self._size, n * (self._rank + 1) // self._size)
        total[part] = rows[0][part]
        for row in rows[1:]:
            total[part] += row[part]
        self._distributed.barrier()
        if self._firsts:
            if self._rank == 0:
                import torch

                self._distributed.all_reduce(torch.from_numpy(total), group=self._firsts)
            self._distributed.barrier()
        return total

    def _share(self, n):
        """Share rows of ``n`` floats. Their file loses its name once all have it, and goes when they end, however they do."""
        first, path = self._rank == 0, None
        if first:
            path = _file((self._size + 1) * n * 4)
        paths = self._all(path if first else "")
        try:
            if None in paths:
                raise OSError("no memory to share")
            own = paths[self._distributed.get_rank() - self._rank]
            self._rows = np.memmap(own, np.float32, "r+", shape=(self._size + 1, n))
            self._distributed.barrier()
        finally:
            if path:
                os.unlink(path)

    def _all(self, value) -> list[Any]:
        """What each process says, in their order."""
        values: list[Any] = [None] * self._distributed.get_world_size()
        self._distributed.all_gather_object(values, value)
        return values


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

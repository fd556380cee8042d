"""Several processes that make one fit, on one machine or many: each renders its share of a step's views (data parallel).

``torchrun`` starts them. Each has the whole model and moves it in the same way: gradients are averaged over all in one
all-reduce, random numbers have the same seeds, and what a clock or a signal decides, the first process decides for all.
"""
# pyright: reportPrivateImportUsage=false
# PyTorch exports its stores under a private name alone.

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi

from ..core.errors import UserError
from ..core.runtime import cores
from .shared_sum import SharedSum

T = TypeVar("T")
_PATIENCE = timedelta(days=1)  # of processes that wait for one that evaluates, or that a person has paused


class Ranks:
    """The processes of a fit: this one is number ``rank`` of ``size``. By default it is alone, and collects its own.

    All must call the same methods in the same order. Raises, from each: UserError where another process has ended.
    """

    def __init__(self, rank: int = 0, size: int = 1, here: int = 1, shared: SharedSum | None = None) -> None:
        self.rank, self.size = rank, size
        self._here, self._shared = here, shared  # processes of this machine, and what adds up where several share one

    @contextmanager
    def sharing_cores(self) -> Iterator[None]:
        """Take only this process's part of the machine's cores until the block ends."""
        before = dr.thread_count()
        try:
            if self._here > 1:
                dr.set_thread_count(max(1, cores() // self._here))
            yield
        finally:
            if self._here > 1:
                dr.set_thread_count(before)  # `set_variant` says why one is too few for results

    def mean(self, arrays: Sequence[Any]) -> list[Any]:
        """Return the mean over all processes of each of ``arrays``, Dr.Jit's, flat ones of floats or tensors, whose shapes are
        the same everywhere; they travel as one. Those that are None stay None."""
        if self.size == 1:
            return list(arrays)
        there = [array for array in arrays if array is not None]
        flat = [a.array if dr.is_tensor_v(a) else a for a in there]
        with _together(self):
            together, means, first = self._sum(flat) / self.size, [], 0
        for array, part in zip(there, flat):
            own = dr.gather(mi.Float, together, dr.opaque(mi.UInt32, first) + dr.arange(mi.UInt32, dr.width(part)))
            means.append(type(array)(own, array.shape) if dr.is_tensor_v(array) else own)
            first += dr.width(part)
        dr.eval(means)
        ordered = iter(means)
        return [None if array is None else next(ordered) for array in arrays]

    def _sum(self, arrays):
        """The sum over all processes of flat ``arrays``, one after the other."""
        if self._shared:
            dr.eval(arrays)
            try:
                return mi.Float(self._shared.sum([array.numpy() for array in arrays]))
            except OSError:
                self._shared = None
        from torch import distributed

        together: Any = dr.concat(arrays)
        dr.eval(together)
        distributed.all_reduce(shared := together.torch())
        return mi.Float(shared)

    def gather(self, value: T) -> list[T]:
        """Return what each process gives as ``value``, in their order; anything that can be pickled."""
        if self.size == 1:
            return [value]
        import torch.distributed

        values: list[Any] = [None] * self.size
        with _together(self):
            torch.distributed.all_gather_object(values, value)
        return values

    def same(self, value: T) -> T:
        """Return the first process's ``value`` in all; anything that can be pickled."""
        if self.size == 1:
            return value
        import torch.distributed

        values = [value]
        with _together(self):
            torch.distributed.broadcast_object_list(values, src=0)
        return values[0]


@contextmanager
def started() -> Iterator[Ranks]:
    """The processes that torchrun has started this one with, until the block ends. Raises: UserError where PyTorch is missing."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield Ranks()
        return
    try:
        from torch import distributed
        from torch.distributed.rendezvous import rendezvous
    except ImportError as error:
        raise UserError("several processes need PyTorch: pip install 'rgs-mi[distributed]'") from error
    backend = "nccl" if mi.variant() and mi.variant().startswith("cuda") else "gloo"
    store, rank, size = next(rendezvous("env://"))
    store = distributed.PrefixStore(f"start {_starts()}", store)  # which still has the addresses of those before a restart
    distributed.init_process_group(backend, store=store, rank=rank, world_size=size, timeout=_PATIENCE)
    try:
        here = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
        gather, shared = Ranks(rank, size).gather, None
        if backend == "gloo" and max(gather(here)) > 1:
            shared = SharedSum(int(os.environ["LOCAL_RANK"]), here, gather)
        yield Ranks(rank, size, here, shared)
    finally:
        distributed.destroy_process_group()


def restarted() -> bool:
    """Return whether torchrun has started this process again, after one of them ended too soon."""
    return _starts() > 0


def _starts():
    """How often torchrun has started all processes again."""
    return int(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"))


@contextmanager
def _together(ranks):
    """What PyTorch says of a process that is gone, as a line."""
    try:
        yield
    except RuntimeError as error:
        raise UserError(
            f"process {ranks.rank + 1} of {ranks.size}: another one of this fit has ended: with --max-restarts torchrun starts "
            "all again from the last checkpoint"
        ) from error

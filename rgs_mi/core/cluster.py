"""Function calls on the workers of a Dask cluster, as `subprocesses.each_apart` makes them on this machine."""

import os
import socket
import uuid
from collections.abc import Callable, Generator, Iterable
from contextlib import suppress
from multiprocessing.connection import wait
from typing import Any

import mitsuba as mi

from .errors import UserError
from .runtime import set_variant
from .subprocesses import Call

_PATIENCE = 10.0  # seconds, for a scheduler
_ASKS = 1.0  # seconds after which a worker looks again whether its call is to end


def each_on(
    scheduler: str, function: Callable, calls: Iterable[tuple]
) -> Generator[tuple[tuple, Any, UserError | None], None, None]:
    """Call ``function`` for each of ``calls``, tuples of arguments, on the workers of the cluster at the address ``scheduler``,
    one at a time on each thread of theirs: each in a process of its own, under the same Mitsuba variant and in the folder of
    the same name as the current one, so that relative paths of a shared disk mean the same. Pickle must take all of it.

    Where a worker dies or is retired, its process hears of it, as of SIGTERM (see `GracefulInterrupt`), and another worker calls
    again.

    Yields: (arguments, value, None) or (arguments, None, UserError), as they end.
    Raises: UserError where there is no such cluster; KeyboardInterrupt after Ctrl-C, when all have ended.
    """
    try:
        import distributed
    except ImportError as error:
        raise UserError("--scheduler needs Dask: pip install 'rgs-mi[cluster]'") from error
    try:
        client = distributed.Client(scheduler, timeout=_PATIENCE)
    except (OSError, ValueError, TypeError) as error:
        raise UserError(
            f"--scheduler {scheduler}: nobody answers there: give the address that 'dask scheduler' tells"
        ) from error
    with client:
        name = f"rgs-mi-{uuid.uuid4().hex}"
        submitted = {
            client.submit(_there, function, arguments, mi.variant(), os.getcwd(), name, pure=False): arguments
            for arguments in calls
        }
        try:
            for future in distributed.as_completed(list(submitted)):
                arguments, (value, error) = submitted.pop(future), _result(future)
                del future  # so that no cluster keeps what came out, or makes it again where a worker that has it dies
                yield arguments, value, error
        except (KeyboardInterrupt, GeneratorExit):
            distributed.Event(name, client=client).set()
            distributed.wait(list(submitted))
            raise


def _result(future) -> tuple[Any, UserError | None]:
    """(value, None) or (None, UserError)."""
    if future.status == "finished":
        return future.result()
    error = future.exception() if future.status == "error" else None
    return None, UserError(
        f"{type(error).__name__}: {error}" if error else "the scheduler has lost it: the same command goes on"
    )


def _there(function, arguments, variant, folder, name):
    """What a worker does: (value, None) or (None, UserError). The event ``name`` says that all are to end."""
    import distributed

    set_variant(variant)
    worker, stop = distributed.get_worker(), distributed.Event(name)
    call = Call(_inside, (folder, function, *arguments))
    while not wait([call.receive], _ASKS):
        if worker.status in (distributed.Status.closing, distributed.Status.closing_gracefully, distributed.Status.closed):
            call.process.terminate()
            call.process.join()
            raise distributed.Reschedule()
        with suppress(OSError):  # without a scheduler a worker ends by itself
            if stop.is_set():
                call.process.terminate()
                break
    return call.result()


def _inside(folder, function, *arguments):
    """Call in the current folder of who has asked."""
    try:
        os.chdir(folder)
    except OSError as error:
        raise UserError(f"{socket.gethostname()} has no folder {folder}: workers need the same disk") from error
    return function(*arguments)

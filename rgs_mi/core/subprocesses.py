"""Function calls in processes of their own: their memory goes back, their crash is not ours, Ctrl-C lets them save."""

import contextlib
import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable, Generator, Iterable
from multiprocessing.connection import wait
from typing import Any

import drjit as dr
import mitsuba as mi

from .errors import UserError, run_main
from .runtime import cores, set_variant


def apart(function: Callable, *arguments: object) -> Any:
    """Return ``function(*arguments)``, called in a process of its own under the same Mitsuba variant; pickle must take all of
    it. SIGTERM tells that process to stop (see `GracefulInterrupt`) when Ctrl-C is pressed here, or when this process dies.

    Raises: UserError, in one line, for whatever goes wrong there, a crash or kill included; KeyboardInterrupt after Ctrl-C,
    when the process has ended. Pressing again kills it.
    """
    ((_, value, error),) = each_apart(function, [arguments])
    if error:
        raise error
    return value


def each_apart(
    function: Callable, calls: Iterable[tuple], workers: int = 1
) -> Generator[tuple[tuple, Any, UserError | None], None, None]:
    """Call ``function`` as `apart` does for each of ``calls``, tuples of arguments, up to ``workers`` at a time, among which
    the cores are divided.

    Yields: (arguments, value, None) or (arguments, None, UserError), as they end.
    Raises: KeyboardInterrupt after Ctrl-C, when all have ended.
    """
    waiting, running = list(calls), {}
    # set_variant() says why never one
    threads = max(2, cores() // workers) if min(workers, len(waiting)) > 1 else None
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                call = Call(function, waiting.pop(0), threads)
                running[call.receive] = call
            for receive in wait(list(running)):
                result = running[receive].result()
                yield running.pop(receive).arguments, *result
    except (KeyboardInterrupt, GeneratorExit):
        for call in running.values():
            call.process.terminate()
        for call in running.values():
            call.process.join()
        raise
    finally:
        for call in running.values():
            call.process.kill()


class Call:
    """A call of ``function`` that runs in ``process``, on so many ``threads`` (None: all), and ends with something to
    ``receive``."""

    def __init__(self, function: Callable, arguments: tuple, threads: int | None = None) -> None:
        self.arguments = arguments
        context = multiprocessing.get_context("spawn")
        self.receive, send = context.Pipe(duplex=False)
        self.process = context.Process(target=_work, args=(send, mi.variant(), threads, function, arguments))
        main = threading.current_thread() is threading.main_thread()  # where alone handlers can be set
        # inherited: of Ctrl-C the process hears from us alone
        before = signal.signal(signal.SIGINT, signal.SIG_IGN) if main else None
        try:
            self.process.start()
        finally:
            if main:
                signal.signal(signal.SIGINT, before)
        send.close()

    def result(self) -> tuple[Any, UserError | None]:
        """Wait for its end, and return (value, None) or (None, UserError)."""
        try:
            value, error = self.receive.recv()
        except (EOFError, OSError):  # it ended without a word, or in the middle of one
            value, error = None, None
        self.process.join()
        code = self.process.exitcode
        assert code is not None, "it has been joined"
        if code < 0:
            hint = ", perhaps for want of memory" if code == -signal.SIGKILL else ""
            error = f"killed by {signal.Signals(-code).name}{hint}"
        elif code:
            error = error or f"ended with code {code}"
        return (None, UserError(error)) if error else (value, None)


def _work(send, variant, threads, function, arguments):
    """What the process does: send (value, None), or (None, what went wrong)."""

    def main():
        try:
            set_variant(variant)
            if threads:
                dr.set_thread_count(threads)
            end = function(*arguments), None
        except UserError as error:
            end = None, str(error)
        except Exception as error:
            traceback.print_exc()
            end = None, f"{type(error).__name__}: {' '.join(str(error).split())}"
        with contextlib.suppress(BrokenPipeError):  # nobody hears of it any more
            send.send(end)

    os.setpgrp()  # out of reach of the terminal's Ctrl-C
    threading.Thread(target=_end_with_parent, daemon=True).start()
    run_main(main)


def _end_with_parent():
    parent = multiprocessing.parent_process()
    assert parent is not None, "this runs in a process that `Call` started"
    parent.join()
    os.kill(os.getpid(), signal.SIGTERM)

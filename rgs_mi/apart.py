"""A function call in a process of its own: its memory goes back, its crash is not ours, Ctrl-C lets it save."""

import multiprocessing
import os
import signal
import threading
import traceback

import mitsuba as mi

from .errors import UserError, run_main
from .runtime import set_variant


def apart(function, *arguments):
    """``function(*arguments)`` in a process of its own, under the same Mitsuba variant; pickle must take all of it. SIGTERM
    tells that process to stop (see `GracefulInterrupt`) when Ctrl-C is pressed here, or when this process dies.

    Raises: UserError, in one line, for whatever goes wrong there, a crash or kill included; KeyboardInterrupt after Ctrl-C,
    when the process has ended. Pressing again kills it.
    """
    context = multiprocessing.get_context("spawn")
    receive, send = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(send, mi.variant(), function, arguments))
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # inherited: of Ctrl-C the process hears from us alone
    try:
        process.start()
    finally:
        signal.signal(signal.SIGINT, before)
    send.close()
    try:
        try:
            value, error = receive.recv()
        except EOFError:  # it ended without a word
            value, error = None, None
        process.join()
    except KeyboardInterrupt:
        process.terminate()
        process.join()
        raise
    finally:
        process.kill()
    if process.exitcode < 0:
        hint = ", perhaps for want of memory" if process.exitcode == -signal.SIGKILL else ""
        raise UserError(f"killed by {signal.Signals(-process.exitcode).name}{hint}")
    if error or process.exitcode:
        raise UserError(error or f"ended with code {process.exitcode}")
    return value


def _work(send, variant, function, arguments):
    """What the process does: send (value, None), or (None, what went wrong)."""
    def main():
        try:
            set_variant(variant)
            send.send((function(*arguments), None))
        except UserError as error:
            send.send((None, str(error)))
        except Exception as error:
            traceback.print_exc()
            send.send((None, f"{type(error).__name__}: {' '.join(str(error).split())}"))

    os.setpgrp()  # out of reach of the terminal's Ctrl-C
    threading.Thread(target=_end_with_parent, daemon=True).start()
    run_main(main)


def _end_with_parent():
    multiprocessing.parent_process().join()
    os.kill(os.getpid(), signal.SIGTERM)

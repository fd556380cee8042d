"""Signals that let a fit finish its step and save, instead of throwing the work away."""

import os
import signal
import threading

from .errors import Stopped

_HUP = getattr(signal, "SIGHUP", None)  # not on Windows
_SIGNALS = tuple(filter(None, (signal.SIGINT, signal.SIGTERM, _HUP)))
_MESSAGE = b"\nstopping after this step; press again to abort\n"


class GracefulInterrupt:
    """A context manager in which the first SIGINT, SIGTERM or SIGHUP is noted as ``signal``, and a second one raises `Stopped`,
    unless it is ``patient``.

    The handlers that were there before return on exit; SIGHUP stays ignored where it was, below ``nohup``. Outside the main
    thread, where Python allows no handlers, it does nothing and ``signal`` stays None.
    """

    signal: int | None = None

    def __init__(self, patient: bool = False) -> None:
        self._patient = patient

    def __enter__(self) -> "GracefulInterrupt":
        main = threading.current_thread() is threading.main_thread()
        asked = [s for s in _SIGNALS if s != _HUP or signal.getsignal(s) != signal.SIG_IGN] if main else []
        self._before = {s: signal.signal(s, self._handle) for s in asked}
        return self

    def __exit__(self, *_) -> None:
        for number, handler in self._before.items():
            # None: a handler that C code installed, which Python can't put back
            signal.signal(number, signal.SIG_DFL if handler is None else handler)

    def _handle(self, number, frame):
        again, self.signal = self.signal is not None, self.signal or number
        if self._patient:
            return
        if again:
            raise Stopped(number)
        try:
            os.write(2, _MESSAGE)  # not print(): a handler may run inside a print, whose buffer is not reentrant
        except OSError:
            pass

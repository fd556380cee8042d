"""Ctrl-C that lets a fit finish its step and save, instead of throwing the work away."""

import os
import signal
import threading

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_MESSAGE = b"\nstopping after this step; press again to abort\n"


class GracefulInterrupt:
    """A context manager in which the first SIGINT or SIGTERM sets ``requested``, and a second one raises KeyboardInterrupt.

    The handlers that were there before return on exit. Outside the main thread, where Python allows no handlers, it
    does nothing and ``requested`` stays False.
    """

    requested: bool = False

    def __enter__(self) -> "GracefulInterrupt":
        main = threading.current_thread() is threading.main_thread()
        self._before = {s: signal.signal(s, self._handle) for s in _SIGNALS} if main else {}
        return self

    def __exit__(self, *_) -> None:
        for number, handler in self._before.items():
            # None: a handler that C code installed, which Python can't put back
            signal.signal(number, signal.SIG_DFL if handler is None else handler)

    def _handle(self, number, frame):
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True
        try:
            os.write(2, _MESSAGE)  # not print(): a handler may run inside a print, whose buffer is not reentrant
        except OSError:
            pass

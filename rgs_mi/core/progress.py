"""The one line that tells how a fit or a rendering is getting on.

fitting ━━━━━━━━━━━━━━━━━━━━ 42% · PSNR 29.81 · 15 230 surfels · 96 ms/step · 200 px · 3:12 left
"""

import sys
import time

from rich.console import Console
from rich.live import Live
from rich.text import Text

PLAIN_INTERVAL = 10.0  # seconds between lines where there is no terminal
_BAR = 20
_WORDS = {
    "psnr": lambda v: f"PSNR {v:.2f}",
    "surfels": lambda v: f"{v:,} surfels".replace(",", " "),
    "ms": lambda v: f"{v:.0f} ms/step",
    "pixels": lambda v: f"{v} px",
}


class Progress:
    """A context manager that shows progress on stderr: one live line on a terminal, elsewhere a plain one now and then.

    Args:
      total: planned wall-clock seconds, from which the time left follows; None to extrapolate it from the fraction done
             since the first update
      quiet: whether to show nothing
      label: what is going on
    """

    def __init__(self, total: float | None = None, quiet: bool = False, label: str = "fitting") -> None:
        self.total, self.quiet, self.label = total, quiet, label
        self.fraction, self.fields = 0.0, {}
        self._live = None
        self._first = None  # time and fraction of the first update

    def __enter__(self) -> "Progress":
        self._start = self._printed = time.monotonic()
        console = Console(stderr=True)
        # FORCE_COLOR makes rich take a pipe for a terminal, so the file is asked as well
        if not self.quiet and console.is_terminal and not console.is_dumb_terminal and sys.stderr.isatty():
            self._live = Live(self, console=console, refresh_per_second=4)
            self._live.start()
        return self

    def update(self, fraction: float, **fields: object) -> None:
        """Set the fraction done, in [0, 1], and what else to tell. ``psnr`` (dB), ``surfels``, ``ms`` (milliseconds a step)
        and ``pixels`` have their own words; other fields read 'name value'. A field stays until it is given again."""
        self.fraction = min(max(float(fraction), 0.0), 1.0)
        self._first = self._first or (time.monotonic(), self.fraction)
        self.fields |= fields
        if not self._live and time.monotonic() - self._printed >= PLAIN_INTERVAL:
            self._print()

    def __exit__(self, *_) -> None:
        if self._live:
            self._live.stop()
        elif self.fields or self.fraction:
            self._print()

    def __rich__(self):
        done = round(_BAR * self.fraction)
        return Text.assemble(
            f"{self.label} ",
            ("━" * done, "green"),
            ("━" * (_BAR - done), "bright_black"),
            " ",
            self._text(),
            no_wrap=True,
            overflow="ellipsis",
        )

    def _print(self):
        self._printed = time.monotonic()
        if not self.quiet:
            print(self.label, self._text(), file=sys.stderr, flush=True)

    def _text(self):
        words = [
            _WORDS[name](value) if name in _WORDS else f"{name.replace('_', ' ')} {_plain(value)}"
            for name, value in self.fields.items()
        ]
        return " · ".join([f"{100 * self.fraction:.0f}%", *words, *self._time()])

    def _time(self):
        elapsed = time.monotonic() - self._start
        if self.fraction == 1:
            return [f"took {_clock(elapsed)}"]
        if self.total is not None:
            return [f"{_clock(max(self.total - elapsed, 0))} left"]
        begin, before = self._first or (self._start, 0.0)  # a resumed fit begins with something done
        done = self.fraction - before
        return [f"{_clock((time.monotonic() - begin) / done * (1 - self.fraction))} left"] if done > 0 else []


def _plain(value):
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _clock(seconds):
    """192 -> '3:12', 3792 -> '1:03:12'."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"

"""A window on a fit in progress: what surfels are by now, curves, and what someone may tell it to do."""

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.runtime import HOST, PORT
from ..fit.trainer import Fit
from ..surfels.surfels import CHANNELS, Surfels
from .lights import Lights
from .server import Server
from .subject import Subject
from .window import Window

if TYPE_CHECKING:
    import viser

_SHARE = 0.08  # of the fit's time that pictures may take
_DEBT, _CREDIT = -0.25, 0.25  # seconds of it that are carried on, at most
_GRIDS = 2  # of `pace.GRIDS`, the smallest: there is no time for more
_RENEW = 0.5  # seconds from one state of the surfels that is shown to the next, at least


class Watch:
    """Shows a ``fit`` in a window. The fit calls `between` after every step, in its own thread, where all pictures are made.

    ``name``: of its run. ``stopped``: whether someone has asked it to stop and save.
    Raises: UserError as `Server` does.
    """

    def __init__(self, fit: Fit, name: str, host: str = HOST, port: int = PORT) -> None:
        self.stopped = self.paused = False
        self._fit, self._credit, self._elapsed = fit, 0.0, fit.elapsed
        self._shown, self._renewed = -1, 0.0  # step and time of what is shown
        self._controls: dict[int, _Controls] = {}
        self._server = Server(_subject(fit), name, host, port, self._enter)
        self.address = self._server.address

    def close(self) -> None:
        """Close the window."""
        self._server.close()

    def between(self, interrupted: Callable[[], bool] = lambda: False) -> None:
        """Draw what windows ask for, as far as its share of the time goes; wait while someone has the fit paused, and nobody has
        ``interrupted`` it elsewhere."""
        self._credit = min(self._credit + _SHARE * (self._fit.elapsed - self._elapsed), _CREDIT)
        self._elapsed = self._fit.elapsed
        if not self._server.windows:
            return
        while self.paused and not (self.stopped or interrupted()) and self._server.windows:
            self._renew()
            self._hurry(False)
            if not self._server.turn(idle=False):
                self._server.wake.wait(0.05)
                self._server.wake.clear()
        self._hurry(True)
        while self._credit > 0:
            start, warm = time.perf_counter(), len(self._server.pace.seconds)
            self._renew()
            worked = self._server.turn(idle=warm < _GRIDS)
            if len(self._server.pace.seconds) == warm:  # what is compiled once costs no share
                self._credit = max(self._credit - (time.perf_counter() - start), _DEBT)
            if not worked:
                break

    def _hurry(self, hurried):
        for window in list(self._server.windows.values()):
            if window.hurried != hurried:
                window.hurried = hurried
                window.redraw()

    def _renew(self):
        """Show the surfels as they are by now."""
        fit, now = self._fit, time.monotonic()
        if self._shown == fit.step_number or now - self._renewed < _RENEW:
            return
        self._shown, self._renewed = fit.step_number, now
        subject = self._server.subject
        _update(subject, fit)
        for number, window in list(self._server.windows.items()):
            window.redraw()
            self._controls[number].tell(fit)
        for gone in self._controls.keys() - self._server.windows.keys():
            self._controls.pop(gone, None)

    def _enter(self, server: Server, client: "viser.ClientHandle", window: Window) -> None:
        window.hurried = not self.paused
        self._controls[client.client_id] = _Controls(client, self)


def _subject(fit):
    """What there is to see of a fit."""
    views = fit.dataset.train
    with dr.suspend_grad():
        lights = Lights(fit.model.environment())
    return Subject(_surfels(fit), fit.shading, None, lights, [view.camera for view in views], list(views), changing=True)


def _update(subject, fit):
    """Put what the fit has by now in place of what it had."""
    with dr.suspend_grad():
        subject.surfels, subject.shading, subject.shader = _surfels(fit), fit.shading, fit.model.shader()
        subject.proxies, subject.irradiance_visibility = fit.proxies, fit.irradiance_visibility
        subject.lights.set_own(fit.model.environment().filtered())
    subject.forget()


def _surfels(fit):
    """The surfels of a fit, computed and without derivatives."""
    with dr.suspend_grad():
        live = fit.model.surfels(fit.sh_order)
        fields = {name: mi.TensorXf(dr.detach(getattr(live, name))) for name in CHANNELS}
        dr.eval(fields)
    return Surfels(**fields, two_sided=live.two_sided)


class _Controls:
    """What one window says of the fit, and can tell it."""

    def __init__(self, client, watch):
        import viser.uplot

        gui = client.gui
        with gui.add_folder("Fit"):
            self._state = gui.add_markdown("…")
            nothing = np.zeros(1)
            self._plot = gui.add_uplot(
                (nothing, nothing),
                (viser.uplot.Series(label="seconds"), viser.uplot.Series(label="PSNR, dB", stroke="#3366cc", width=2)),
                scales={"x": viser.uplot.Scale(time=False)},
                aspect=2.0,
            )
            pause, stop = gui.add_button("pause"), gui.add_button("stop and save")

        @pause.on_click
        async def _(_event) -> None:
            watch.paused = not watch.paused
            pause.label = "go on" if watch.paused else "pause"

        @stop.on_click
        async def _(_event) -> None:
            watch.stopped = True

    def tell(self, fit):
        """Tell how the ``fit`` is getting on."""
        self._state.content = (
            f"{100 * fit.progress:.0f}% · PSNR {fit.psnr:.1f} · {len(fit.model)} surfels · step {fit.step_number}"
        )
        rows = [row for row in fit.curves.rows if "psnr" in row]
        if len(rows) > 1:
            self._plot.data = tuple(np.array([float(row[name]) for row in rows]) for name in ("seconds", "psnr"))

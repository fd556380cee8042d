"""A window on a fit in progress: what it costs, what it shows, what it can tell the fit."""

import threading
import time
from dataclasses import replace

import pytest

from rgs_mi.fit.trainer import Fit
from rgs_mi.viewer import live
from rgs_mi.viewer.look import Look
from rgs_mi.viewer.pace import GRIDS
from rgs_mi.viewer.window import Window

from fits import SETTINGS, model
from scenes import orbit_camera
from windows import Panel


class Controls:
    """Takes what `live._Controls` tells."""

    told = 0

    def tell(self, fit):
        self.told += 1


@pytest.fixture
def watch(dataset):
    fit = Fit(dataset, model(), replace(SETTINGS, iterations=400), 1.0)
    watch = live.Watch(fit, "run", port=0)
    yield watch
    watch.close()


def enter(watch):
    window, panel = Window(Look(orbit_camera(0.4, size=(56, 48)))), Panel()
    server = watch._server
    window.hurried = True
    server.windows[1], server._panels[1], watch._controls[1] = window, panel, Controls()
    server._turns.append(1)
    return window, panel


def test_nobody_looks(watch, monkeypatch):
    """Then nothing is drawn, nor filtered, nor compiled."""
    monkeypatch.setattr(watch._server, "turn", lambda idle: pytest.fail("draws"))
    monkeypatch.setattr(watch, "_renew", lambda: pytest.fail("renews"))
    watch._fit.step()
    start = time.perf_counter()
    for _ in range(1000):
        watch.between()
    assert time.perf_counter() - start < 0.5


def test_somebody_looks(watch):
    """Pictures follow the fit, and take their share of its time."""
    window, panel = enter(watch)
    watch._server.pace.seconds = dict.fromkeys(GRIDS, 0.01)
    for _ in range(3):
        watch._fit.step()
        watch.between()
    fit, spent, drawn = watch._fit, 0.0, len(panel.pictures)
    elapsed = fit.elapsed
    while fit.elapsed < elapsed + 4:
        fit.step()
        start = time.perf_counter()
        watch.between()
        spent += time.perf_counter() - start
    assert spent < 0.08 * (fit.elapsed - elapsed) + 0.5 + 0.25  # what was carried on, and the last picture
    assert len(panel.pictures) > drawn and watch._controls[1].told > 1
    assert panel.pictures[-1].pixels.std() > 5 and window.refined.passes == 0  # never at rest while the fit goes on


def test_what_is_shown_is_the_fit(watch):
    before = live._surfels(watch._fit).centers.numpy()
    enter(watch)
    for _ in range(20):
        watch._fit.step()
    watch._credit, watch._renewed = 1.0, 0.0
    watch._renew()
    shown = watch._server.subject.surfels
    assert abs(shown.centers.numpy() - before).max() > 0
    assert (shown.centers.numpy() == live._surfels(watch._fit).centers.numpy()).all()


def test_pause_and_stop(watch):
    """While it is paused pictures come to rest; then it goes on, or stops."""
    window, panel = enter(watch)
    watch._server.pace.seconds = {128: 0.01}
    watch._fit.step()
    watch.paused = True
    threading.Thread(target=_until, args=(lambda: window.refined.passes >= 4, watch), daemon=True).start()
    watch.between()
    assert window.refined.passes >= 4 and watch.stopped


def _until(condition, watch):
    end = time.monotonic() + 60
    while not condition() and time.monotonic() < end:
        time.sleep(0.02)
    watch.stopped = True


def test_an_interrupt_ends_a_pause(watch):
    enter(watch)
    watch.paused = True
    watch.between(lambda: True)
    assert not watch.stopped


def test_windows_that_vanish_do_not_hold_a_paused_fit(watch):
    enter(watch)
    watch.paused = True
    threading.Timer(0.3, watch._server.windows.clear).start()
    start = time.monotonic()
    watch.between()
    assert 0.2 < time.monotonic() - start < 60

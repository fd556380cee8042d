"""The progress line on a terminal and off it, and Ctrl-C."""

import os
import signal
import subprocess
import sys
import threading

import pytest

from rgs_mi.core import progress
from rgs_mi.core.errors import Stopped
from rgs_mi.core.interrupt import GracefulInterrupt
from rgs_mi.core.progress import Progress

FIELDS = {"psnr": 29.812, "surfels": 15230, "ms": 96.3, "pixels": 200}


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_plain(clock, capsys, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    with Progress() as p:
        for _ in range(25):
            clock[0] += 1
            p.update((clock[0] - 100) / 100, **FIELDS)
    out, err = capsys.readouterr()
    assert out == "" and "\x1b" not in err and "\r" not in err
    assert err.splitlines() == [
        f"fitting {n}% · PSNR 29.81 · 15 230 surfels · 96 ms/step · 200 px · {left} left"
        for n, left in ((10, "1:30"), (20, "1:20"), (25, "1:15"))
    ]


def test_budget_and_other_fields(clock, capsys):
    with Progress(total=4000, label="rendering") as p:
        clock[0] += 8
        p.update(0.5, view="3/20", L_rgb=0.123456)
    assert capsys.readouterr().err == "rendering 50% · view 3/20 · L rgb 0.1235 · 1:06:32 left\n"
    with Progress() as p:
        clock[0] += 8
        p.update(1.0)
    assert capsys.readouterr().err == "fitting 100% · took 0:08\n"


def test_time_left_of_a_resumed_fit(clock, capsys):
    with Progress() as p:
        for fraction in (0.5, 0.6):
            clock[0] += 4
            p.update(fraction)
    assert capsys.readouterr().err == "fitting 60% · 0:16 left\n"


def test_quiet_and_untouched(clock, capsys):
    with Progress(quiet=True) as p:
        clock[0] += 30
        p.update(0.5)
    with Progress():
        pass
    assert capsys.readouterr() == ("", "")


_ON_TERMINAL = """
import sys
sys.path.append(sys.argv[1])  # the module alone: no need to start Dr.Jit
from progress import Progress
with Progress() as p:
    p.update(0.42, psnr=29.81, surfels=15230)
    raise ValueError("inside")
"""


@pytest.mark.skipif(os.name != "posix", reason="needs a pseudo-terminal")
def test_error_leaves_the_terminal_clean():
    import pty

    controller, terminal = pty.openpty()
    command = [sys.executable, "-c", _ON_TERMINAL, os.path.dirname(progress.__file__)]
    environment = os.environ | {"TERM": "xterm", "COLUMNS": "100"}
    subprocess.run(command, stderr=terminal, stdout=terminal, env=environment)
    os.close(terminal)
    shown = b""
    try:
        while piece := os.read(controller, 65536):
            shown += piece
    except OSError:  # how Linux says that the other end is closed
        pass
    os.close(controller)
    shown = shown.decode()
    assert "42%" in shown and "PSNR 29.81 · 15 230 surfels" in shown and "ValueError: inside" in shown
    assert shown.rindex("\x1b[?25h") > shown.rindex("\x1b[?25l")  # the cursor is back
    assert shown.rindex("Traceback") > shown.rindex("42%")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_interrupt(number, capfd):
    before = signal.getsignal(number)
    with GracefulInterrupt() as interrupt:
        assert interrupt.signal is None
        signal.raise_signal(number)
        assert interrupt.signal == number
        with pytest.raises(Stopped) as stop:
            signal.raise_signal(number)
    assert stop.value.code == 128 + number
    assert signal.getsignal(number) is before
    assert capfd.readouterr().err.count("stopping after this step") == 1


def test_a_terminal_that_goes_is_no_matter_below_nohup():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with GracefulInterrupt() as interrupt:
            signal.raise_signal(signal.SIGHUP)
        assert interrupt.signal is None
    finally:
        signal.signal(signal.SIGHUP, before)


def test_interrupt_elsewhere():
    before, seen = signal.getsignal(signal.SIGINT), []

    def work():
        with GracefulInterrupt() as interrupt:
            seen.append((interrupt.signal, signal.getsignal(signal.SIGINT)))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [(None, before)] and signal.getsignal(signal.SIGINT) is before

"""What a person sees of errors and warnings: a line each."""

import signal
import warnings

import drjit as dr
import mitsuba as mi
import pytest

from rgs_mi.core.errors import Stopped, UserError, run_main


def outcome(main, capsys):
    """(exit code, stderr)."""
    with pytest.raises(SystemExit) as end:
        run_main(main)
    return end.value.code, capsys.readouterr().err


def test_errors(capsys):
    def fail(error):
        raise error

    assert outcome(lambda: fail(UserError("no data: give --data")), capsys) == (2, "error: no data: give --data\n")
    assert outcome(lambda: fail(KeyboardInterrupt), capsys) == (130, "interrupted\n")
    assert outcome(lambda: None, capsys) == (None, "")


def test_warnings_are_one_line_inside_a_command_only(capsys):
    before = warnings.showwarning
    with warnings.catch_warnings():
        warnings.simplefilter("default")  # an error in tests
        found = outcome(lambda: warnings.warn("3 views\n left out", stacklevel=1), capsys)
    assert found == (None, "warning: 3 views left out\n")
    assert warnings.showwarning is before


def test_a_line_is_a_line(capsys):
    """Names of files may hold newlines, what terminals obey, and bytes that are no text."""
    error = UserError("a\nb\x1b[2J\udcff é 日: no file")
    assert str(error) == r"a\nb\x1b[2J\udcff é 日: no file"
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        assert outcome(lambda: warnings.warn("x\x07\ny", stacklevel=1), capsys)[1] == "warning: x\\x07 y\n"


def test_signals_have_their_codes(capsys):
    before = signal.getsignal(signal.SIGTERM)
    assert outcome(lambda: signal.raise_signal(signal.SIGTERM), capsys) == (143, "interrupted\n")
    assert signal.getsignal(signal.SIGTERM) is before

    def stop():
        raise Stopped(signal.SIGINT, "stopped at 3%")

    assert outcome(stop, capsys) == (130, "stopped at 3%\n")


def test_signals_that_come_inside_dr_jit_have_their_codes(capsys):
    class Stopping(dr.CustomOp):
        def eval(self, x):
            signal.raise_signal(signal.SIGTERM)
            return x

    assert outcome(lambda: dr.custom(Stopping, mi.Float(1)), capsys) == (143, "interrupted\n")


def test_out_of_memory_is_a_line(capsys):
    def allocate():
        raise MemoryError("Unable to allocate 9 GiB")

    assert outcome(allocate, capsys) == (
        2,
        "error: out of memory (Unable to allocate 9 GiB): use fewer or smaller photographs\n",
    )


@pytest.mark.parametrize("wrapped", [SystemError("a result with an exception set"), UserError("the variant does not run")])
def test_signals_that_were_wrapped_have_their_codes(wrapped, capsys):
    """As when they come while Mitsuba is imported, which then is said to be missing."""

    def main():
        try:
            raise Stopped(signal.SIGTERM)
        except Stopped as stop:
            raise wrapped from stop

    assert outcome(main, capsys) == (143, "interrupted\n")


@pytest.mark.parametrize("number, code", [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_signals_that_plugins_swallowed_have_their_codes(number, code, capsys):
    """As when they come while a scene loads: Mitsuba makes of what a plugin raises an error of its own, without a cause."""

    def main():
        try:
            signal.raise_signal(number)
        except KeyboardInterrupt:
            pass
        raise UserError("cannot load ball.xml")

    assert outcome(main, capsys) == (code, "interrupted\n")

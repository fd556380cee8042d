"""What a person sees of errors and warnings: a line each."""

import warnings

import pytest

from rgs_mi.core.errors import UserError, run_main


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

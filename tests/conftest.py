import signal

import pytest

import rgs_mi

from fits import random_photographs
from runs import end_all, make_inputs
from variants import VARIANT

# A shell that starts the tests in the background has them ignore Ctrl-C, and nohup a terminal that goes, which processes that
# they start would inherit.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.fixture(autouse=True)
def variant():
    """Every test runs in the variant that the package is for; a test that changes it is put right again."""
    rgs_mi.set_variant(VARIANT)


@pytest.fixture(autouse=True)
def processes():
    """What a test starts ends with it."""
    yield
    end_all()


@pytest.fixture(scope="session")
def inputs(tmp_path_factory):
    """(scene to fit, its photographs) of `runs.make_inputs`, which no test changes."""
    rgs_mi.set_variant(VARIANT)
    return make_inputs(tmp_path_factory.mktemp("inputs"))


@pytest.fixture(scope="session")
def dataset():
    """`fits.random_photographs`, which no test changes."""
    rgs_mi.set_variant(VARIANT)
    return random_photographs()

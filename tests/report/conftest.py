import pytest

from pages import SMALL


@pytest.fixture(scope="package")
def run(inputs, tmp_path_factory):
    """The folder of a finished run, with event files, which no test changes."""
    from rgs_mi.commands.optimize import optimize

    folder = tmp_path_factory.mktemp("runs") / "a <ball> & 'more'"
    scene, data = inputs
    return optimize(scene, data=data, out=folder, overrides=SMALL, quiet=True, tensorboard=True)

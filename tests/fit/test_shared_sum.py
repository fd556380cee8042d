"""Sums over processes, by memory that those of a machine share."""

import json
import os
import socket

import numpy as np
import pytest

from runs import PATIENCE, ROOT, start
from shared_sums import SIZES, parts

pytest.importorskip("torch", reason="needs PyTorch: pip install torch")


def said(tmp_path, machines, here, failing=-1):
    """What each process says, of so many ``machines`` with ``here`` processes each; one may have no memory to share."""
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        port = probe.getsockname()[1]
    size, processes = machines * here, []
    for rank in range(size):
        of = {"RANK": rank, "LOCAL_RANK": rank % here, "WORLD_SIZE": size, "LOCAL_WORLD_SIZE": here}
        of |= {"MASTER_ADDR": "localhost", "MASTER_PORT": port, "FAILS": int(rank == failing)}
        environment = os.environ | {name: str(value) for name, value in of.items()}
        processes.append(start(ROOT / "tests" / "shared_sums.py", tmp_path / f"{rank}.json", env=environment))
    assert [process.wait(PATIENCE) for process in processes] == [0] * size
    return [json.loads((tmp_path / f"{rank}.json").read_text()) for rank in range(size)]


@pytest.mark.parametrize("machines, here", [(1, 2), (1, 3), (2, 2)])
def test_sums_over_processes_of_machines(machines, here, tmp_path):
    ranks = range(machines * here)
    expected = [np.sum([np.concatenate(parts(rank, sizes)) for rank in ranks], axis=0) for sizes in SIZES]
    for sums, named in said(tmp_path, machines, here):
        assert not named  # the file goes, however the processes end
        assert [len(found) for found in sums] == [sum(sizes) for sizes in SIZES]
        for found, wanted in zip(sums, expected):
            np.testing.assert_allclose(found, wanted, atol=1e-5)


def test_all_hear_of_a_machine_without_memory_to_share(tmp_path):
    assert said(tmp_path, 2, 1, failing=1) == [["no memory to share", []]] * 2

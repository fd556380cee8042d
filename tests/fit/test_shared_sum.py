"""Sums over processes, by memory that those of a machine share."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs PyTorch: pip install torch")

PATIENCE = 120
SIZES = (1, 5), (1000, 3), (7, 0)  # of the parts of one sum after another: it takes more memory once


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
        command = [sys.executable, __file__, tmp_path / f"{rank}.json"]
        processes.append(subprocess.Popen(command, env=environment))
    assert [process.wait(PATIENCE) for process in processes] == [0] * size
    return [json.loads((tmp_path / f"{rank}.json").read_text()) for rank in range(size)]


def parts(rank, sizes):
    rng = np.random.default_rng((rank, *sizes))
    return [rng.normal(size=n).astype(np.float32) for n in sizes]


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


def main():
    import resource

    from torch import distributed

    from rgs_mi.fit.shared_sum import SharedSum

    distributed.init_process_group("gloo")
    if os.environ["FAILS"] == "1":
        resource.setrlimit(resource.RLIMIT_FSIZE, (16, resource.RLIM_INFINITY))
    shared = SharedSum()
    rank = distributed.get_rank()
    try:
        found = [shared.sum(parts(rank, sizes)).tolist() for sizes in SIZES]
    except OSError as error:
        found = str(error)
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)
    held = Path("/proc/self/maps")
    lines = held.read_text().splitlines() if held.exists() else []
    named = [line for line in lines if "/rgs_mi." in line and not line.endswith("(deleted)")]
    Path(sys.argv[1]).write_text(json.dumps([found, named]))
    distributed.destroy_process_group()


if __name__ == "__main__":
    main()

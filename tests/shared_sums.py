"""What several processes add up, for `fit/test_shared_sum.py`, which starts them as torchrun does; each writes FILE, a JSON."""

import json
import os
import resource
import sys
from pathlib import Path

import numpy as np

from rgs_mi.fit.ranks import Ranks
from rgs_mi.fit.shared_sum import SharedSum

SIZES = (1, 5), (1000, 3), (7, 0)  # of the parts of one sum after another: it takes more memory once


def parts(rank, sizes):
    rng = np.random.default_rng((rank, *sizes))
    return [rng.normal(size=n).astype(np.float32) for n in sizes]


def main():
    from torch import distributed

    distributed.init_process_group("gloo")
    if os.environ["FAILS"] == "1":
        resource.setrlimit(resource.RLIMIT_FSIZE, (16, resource.RLIM_INFINITY))
    rank, number, here = distributed.get_rank(), int(os.environ["LOCAL_RANK"]), int(os.environ["LOCAL_WORLD_SIZE"])
    shared = SharedSum(number, here, Ranks(rank, distributed.get_world_size()).gather)
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

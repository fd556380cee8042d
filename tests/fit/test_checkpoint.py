"""Checkpoints under kill, damage and a full disk."""

import errno
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from rgs_mi.core.errors import UserError
from rgs_mi.core.files import atomic_file
from rgs_mi.fit import checkpoint

ARRAYS = {"centers": np.arange(12, dtype=np.float32).reshape(4, 3), "step": np.int64(7), "file": np.zeros((0, 2))}


def names(folder):
    return sorted(os.listdir(folder / "checkpoints"))


def test_round_trip(tmp_path):
    meta = {"step": np.int32(12), "psnr": np.float32(29.5), "seed": np.int64(3), "ok": np.bool_(True), "path": tmp_path}
    path = checkpoint.save(tmp_path, ARRAYS, meta | {"a": {"b": [1, None]}})
    assert path == tmp_path / "checkpoints" / "step_0000012.npz"
    arrays, meta = checkpoint.load_latest(tmp_path)
    assert meta == {"step": 12, "psnr": 29.5, "seed": 3, "ok": True, "path": str(tmp_path), "a": {"b": [1, None]}}
    assert arrays.keys() == ARRAYS.keys()
    for name, value in ARRAYS.items():
        np.testing.assert_array_equal(arrays[name], value)
        assert arrays[name].dtype == value.dtype
    with np.load(path, allow_pickle=False) as data:
        np.testing.assert_array_equal(data["centers"], ARRAYS["centers"])


def test_two_may_write_the_same_file(tmp_path):
    """Their halves have names of their own, also where their processes have the same number; the last one is there in the end."""
    with atomic_file(tmp_path / "a") as one, atomic_file(tmp_path / "a") as other:
        one.write(b"one")
        other.write(b"other")
    assert os.listdir(tmp_path) == ["a"] and (tmp_path / "a").read_bytes() == b"one"


def test_none(tmp_path):
    assert checkpoint.load_latest(tmp_path) is None
    assert checkpoint.load_latest(tmp_path / "missing") is None


def test_keeps_two_and_clears_temporaries(tmp_path):
    for step in (1, 2, 3):
        checkpoint.save(tmp_path, ARRAYS, {"step": step})
    stale = tmp_path / "checkpoints" / ".step_0000009.npz.0123456789ab.tmp"
    stale.write_bytes(b"half")
    checkpoint.save(tmp_path, ARRAYS, {"step": 4})
    assert names(tmp_path) == ["step_0000003.npz", "step_0000004.npz"]


def test_a_new_run_in_an_old_folder(tmp_path):
    for step in (100, 200, 5):
        checkpoint.save(tmp_path, ARRAYS, {"step": step})
    assert checkpoint.load_latest(tmp_path)[1]["step"] == 5


def test_falls_back(tmp_path):
    for step in (1, 2):
        newest = checkpoint.save(tmp_path, ARRAYS, {"step": step})
    data = newest.read_bytes()
    flipped = bytearray(data)
    flipped[data.index(ARRAYS["centers"].tobytes()) + 5] ^= 1
    for damaged in (b"", data[:100], data[:-10], bytes(flipped), b"x" * 500):
        newest.write_bytes(damaged)
        with pytest.warns(UserWarning, match="step_0000002.npz is damaged"):
            arrays, meta = checkpoint.load_latest(tmp_path)
        assert meta["step"] == 1
    (tmp_path / "checkpoints" / "step_0000001.npz").write_bytes(b"")
    with pytest.raises(UserError, match="no checkpoint"), pytest.warns(UserWarning):
        checkpoint.load_latest(tmp_path)


def test_no_pickles(tmp_path):
    with pytest.raises(ValueError):
        checkpoint.save(tmp_path, {"a": np.array([{}])}, {"step": 1})
    assert names(tmp_path) == []


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_disk_full(tmp_path, monkeypatch, call):
    checkpoint.save(tmp_path, ARRAYS, {"step": 1})
    before = (tmp_path / "checkpoints" / "step_0000001.npz").read_bytes()

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, call, full)
    for step in (1, 2):
        with pytest.raises(UserError, match=f"step_000000{step}.npz.*No space.*free some space"):
            checkpoint.save(tmp_path, ARRAYS, {"step": step})
    monkeypatch.undo()
    assert names(tmp_path) == ["step_0000001.npz"]
    assert (tmp_path / "checkpoints" / "step_0000001.npz").read_bytes() == before


@pytest.mark.skipif(sys.platform != "linux", reason="limits the size of files")
def test_write_fails_halfway(tmp_path):
    """A real short write, by the limit on a file's size."""
    checkpoint.save(tmp_path, ARRAYS, {"step": 1})
    import resource

    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
        with pytest.raises(UserError, match="step_0000002.npz: can't be written"):
            checkpoint.save(tmp_path, {"a": np.zeros(1_000_000)}, {"step": 2})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert names(tmp_path) == ["step_0000001.npz"]


_SAVER = """
import importlib.util, sys, types
import numpy as np
package = types.ModuleType("rgs_mi")  # without __init__: no need to start Dr.Jit
package.__path__ = [sys.argv[2]]
sys.modules["rgs_mi"] = package
from rgs_mi.fit import checkpoint
latest = checkpoint.load_latest(sys.argv[1])
step = latest[1]["step"] if latest else 0
while True:
    step += 1
    checkpoint.save(sys.argv[1], {"a": np.full((200, 1000), step)}, {"step": step})
    print(step, flush=True)
"""


@pytest.mark.skipif(os.name != "posix", reason="SIGKILL")
def test_killed_at_random_moments(tmp_path):
    rng = np.random.default_rng(0)
    last = 0
    for _ in range(10):
        command = [sys.executable, "-c", _SAVER, str(tmp_path), str(Path(checkpoint.__file__).parents[1])]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            first = int(process.stdout.readline())
            time.sleep(rng.uniform(0, 0.05))
            process.send_signal(signal.SIGKILL)
            done = max([first, *map(int, process.stdout.read().split())])
        arrays, meta = checkpoint.load_latest(tmp_path)
        assert meta["step"] >= done > last and (arrays["a"] == meta["step"]).all()
        assert len([n for n in names(tmp_path) if not n.startswith(".")]) <= 3
        last = meta["step"]

"""How much memory there is: of the machine, of control groups of both versions, and of limits."""

import resource

import numpy as np
import pytest

from rgs_mi.core import memory


def groups(tmp_path, line, files):
    own = tmp_path / "own"
    own.write_text(line)
    for name, text in files.items():
        path = tmp_path / "fs" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return list(memory._groups(tmp_path / "fs", own))


def test_machine():
    assert 1 << 26 < memory.available() < 1 << 45 and memory.words(2_560_000_000) == "2.6 GB"


def test_what_is_held_grows_with_what_is_written():
    before = memory.held()
    array = np.ones(10_000_000)
    assert memory.held() - before == pytest.approx(array.nbytes, rel=0.2)


def test_control_groups(tmp_path):
    """A batch job's limit counts, on whichever level it is set; cached files can go."""
    gib = 1 << 30
    stat = f"anon 5\ninactive_file {gib}\n"
    two = {"memory.max": "max", "memory.current": "0", "memory.stat": stat}
    two |= {"job/memory.max": str(8 * gib), "job/memory.current": str(6 * gib), "job/memory.stat": stat}
    two |= {"job/step/memory.max": "max", "job/step/memory.current": "1", "job/step/memory.stat": stat}
    assert groups(tmp_path, "0::/job/step\n", two) == [3 * gib]
    one = {f"memory/a/memory.{k}": v for k, v in (("limit_in_bytes", str(2 * gib)), ("usage_in_bytes", str(4 * gib)))}
    one["memory/a/memory.stat"] = f"total_inactive_file {gib}"
    assert groups(tmp_path, "3:cpu,memory:/a\n2:cpu:/b\n", one) == [0]
    assert groups(tmp_path, "0::/nowhere\n", {}) == []
    assert list(memory._groups(tmp_path, tmp_path / "missing")) == []


@pytest.mark.skipif(not hasattr(resource, "RLIMIT_AS"), reason="limits of memory")
def test_limits(monkeypatch):
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (1 << 50, 1 << 50) if kind == resource.RLIMIT_AS else (-1, -1))
    (left,) = memory._limits()
    assert 0 < (1 << 50) - left < 1 << 42

"""What is told never ends what is done: full disks, readers that are gone, closed streams, characters without an encoding."""

import subprocess
import sys

import pytest

from runs import ROOT, start

_TELLER = f"""
import sys, types
package = types.ModuleType("rgs_mi")  # without __init__: no need to start Dr.Jit
package.__path__ = [{str(ROOT / "rgs_mi")!r}]
sys.modules["rgs_mi"] = package
from rgs_mi.core.errors import run_main
from rgs_mi.core.progress import Progress
import warnings

def main():
    with Progress(label="telling") as progress:
        for k in range(2000):
            print("a line that is long enough to fill any buffer \u2501", flush=k % 2 == 0)
            print("another", file=sys.stderr)
            progress.update(k / 2000)
    warnings.warn("no checkpoint")
    open(sys.argv[1], "w").write("done")
    return 7

run_main(main)
"""


@pytest.mark.parametrize("where", ["full", "gone", "closed", "ascii"])
def test_work_is_done_and_ends_with_its_code(tmp_path, where, monkeypatch):
    command = ["-c", _TELLER, tmp_path / "done"]
    if where == "ascii":
        monkeypatch.setenv("PYTHONIOENCODING", "ascii")
    if where == "closed":
        process = subprocess.Popen(["sh", "-c", 'exec "$0" "$@" >&- 2>&-', sys.executable, *map(str, command)])
    elif where == "full":
        with open("/dev/full", "w") as full:
            process = start(*command, stdout=full, stderr=full)
    else:
        process = start(*command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        if where == "gone":
            process.stdout.read(10)
            process.stdout.close()
            process.stderr.close()
        else:
            out, error = process.communicate(timeout=60)
            assert b"buffer \\u2501" in out and b"warning: no checkpoint" in error
    assert process.wait(timeout=60) == 7
    assert (tmp_path / "done").read_text() == "done"

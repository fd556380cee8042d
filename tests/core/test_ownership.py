"""Folders that one process at a time writes into: others are kept out, the dead leave no lock, and runs are moved aside."""

import errno
import json
import os
import signal
import threading
import time

import pytest

from rgs_mi.core import ownership
from rgs_mi.core.errors import UserError
from rgs_mi.core.ownership import LOCK, owned

from runs import ROOT, start, wait_for

_HOLDER = f"""
import sys, time, types
package = types.ModuleType("rgs_mi")  # without __init__: no need to start Dr.Jit
package.__path__ = [{str(ROOT / "rgs_mi")!r}]
sys.modules["rgs_mi"] = package
from rgs_mi.core.ownership import owned
with owned(sys.argv[1]):
    time.sleep(float(sys.argv[2]))
"""


def holder(folder, seconds=100):
    """A process that has the folder, until it is killed or so many seconds have passed."""
    process = start("-c", _HOLDER, folder, seconds)
    wait_for(lambda: (folder / LOCK).exists() and (folder / LOCK).read_text(), process)
    return process


def test_others_are_kept_out_until_the_process_is_dead(tmp_path):
    process = holder(tmp_path / "run")
    with pytest.raises(UserError, match=rf"run is in use by process {process.pid} on .*: wait for it, or choose another"):
        with owned(tmp_path / "run"):
            pass
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert (tmp_path / "run" / LOCK).exists()  # which nobody holds
    with owned(tmp_path / "run"):
        assert json.loads((tmp_path / "run" / LOCK).read_text())["pid"] == os.getpid()
        (tmp_path / "run" / "kept").touch()
    assert os.listdir(tmp_path / "run") == ["kept"]


def test_waiting(tmp_path, capsys):
    process = holder(tmp_path / "run", 1)
    with owned(tmp_path / "run", wait=True):
        assert process.wait(timeout=10) == 0
        with pytest.raises(UserError, match="in use by process"), owned(tmp_path / "run"):
            pass
    assert capsys.readouterr().err.startswith(f"waiting for {tmp_path / 'run'}, which is in use by process {process.pid}")


def test_many_at_once(tmp_path):
    """Of threads that come and go, never two have it, whoever deletes the lock when."""
    inside, most, done = [], [], []

    def work():
        for _ in range(50):
            with owned(tmp_path / "run", wait=True):
                inside.append(1)
                most.append(len(inside))
                time.sleep(0.0002)
                inside.pop()
        done.append(1)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(done) == 4 and max(most) == 1 and [p.name for p in tmp_path.rglob("*")] in ([], ["run"])


def test_what_was_made_for_nothing_goes(tmp_path):
    with pytest.raises(UserError, match="no data"), owned(tmp_path / "a" / "run"):
        raise UserError("no data")
    assert not (tmp_path / "a" / "run").exists()
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="can't be written"), owned(tmp_path / "file" / "run"):
        pass


def test_moved_aside(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for number in (1, 2):
        with owned("runs/a") as mine:
            (mine.folder / "result").write_text(str(number))
            assert str(mine.move_aside()) == f"runs/a.{number}"
            assert os.listdir("runs/a") == [LOCK]
            with pytest.raises(UserError, match="in use"), owned("runs/a"):
                pass
            (mine.folder / "new").touch()
        assert os.listdir("runs/a") == ["new"] and os.listdir(f"runs/a.{number}") != []
        os.unlink("runs/a/new")
    assert [(tmp_path / f"runs/a.{number}/result").read_text() for number in (1, 2)] == ["1", "2"]
    assert not os.path.exists("runs/a.1/.lock")

    (tmp_path / "disk").mkdir()
    (tmp_path / "link").symlink_to("disk/run")  # a link stays one
    with owned(tmp_path / "disk" / "run") as mine:
        (mine.folder / "result").touch()
    with owned(tmp_path / "link") as mine:
        assert mine.move_aside() == tmp_path / "disk" / "run.1"
    assert os.listdir("disk/run.1") == ["result"] and os.path.islink("link")

    monkeypatch.chdir("runs/a.1")
    with owned(".") as mine, pytest.raises(UserError, match="current folder"):
        mine.move_aside()


def test_who_comes_between_has_it(tmp_path, monkeypatch):
    """Another process takes the folder while what was there is moved aside: it stays the other's."""
    rename = os.rename

    def rename_and_lose(source, target):
        rename(source, target)
        monkeypatch.undo()
        others.append(holder(tmp_path / "run"))

    others = []
    with pytest.raises(UserError, match="in use by process"), owned(tmp_path / "run") as mine:
        monkeypatch.setattr(os, "rename", rename_and_lose)
        mine.move_aside()
    with pytest.raises(UserError, match="in use by process"), owned(tmp_path / "run"):
        pass
    others[0].kill()
    others[0].wait()


def test_halves_of_files_are_swept(tmp_path):
    (tmp_path / "test").mkdir()
    kept = {".a.tmp", "b.tmp", ".c.1234.tmp"}
    for name in kept | {".object.ply.0123456789ab.tmp", "test/.r_0.png.ba9876543210.tmp"}:
        (tmp_path / name).touch()
    with owned(tmp_path):
        pass
    assert {*os.listdir(tmp_path)} == kept | {"test"} and os.listdir(tmp_path / "test") == []


def test_a_file_system_without_locks(tmp_path, monkeypatch):
    def none(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(ownership.fcntl, "flock", none)
    with pytest.warns(UserWarning, match="has no locks"), owned(tmp_path / "run") as mine:
        (mine.folder / "a").touch()
    assert os.listdir(tmp_path / "run") == ["a"]

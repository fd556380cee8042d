"""Suites on a Dask cluster: a worker is killed, nothing is fitted twice; Ctrl-C; no cluster."""

import json
import os
import signal

import pytest

from rgs_mi.commands import suite
from rgs_mi.core.errors import UserError
from rgs_mi.fit import checkpoint

from runs import PATIENCE, SMALL, make_suite, start_script, wait_for

dask = pytest.importorskip("dask", reason="needs Dask: pip install distributed")
distributed = pytest.importorskip("distributed", reason="needs Dask: pip install distributed")

NAMES = ("a", "b", "c")


@pytest.fixture(scope="module")
def captures(inputs, tmp_path_factory):
    return make_suite(*inputs, tmp_path_factory.mktemp("suite"), *NAMES)[1]


@pytest.fixture
def cluster(tmp_path, monkeypatch):
    """Two workers of one thread, which may have processes of their own."""
    monkeypatch.chdir(tmp_path)
    with dask.config.set({"distributed.worker.daemon": False}):
        with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster:
            yield cluster


def started(captures, cluster, out, *settings):
    words = [word for setting in (*SMALL, *settings) for word in ("--set", setting)]
    address = cluster.scheduler_address
    return start_script("benchmark.py", "suite", captures, "--scheduler", address, "--out", out, "--quiet", *words)


def checkpoints(out):
    return [name for name in NAMES if any((out / name / "checkpoints").glob("step_*[1-9].npz"))]


@pytest.mark.parametrize("way", ["killed", "retired"])
def test_a_worker_goes(captures, cluster, tmp_path, way):
    out = tmp_path / "out"
    process = started(captures, cluster, out, "iterations=60")
    finished = lambda: {name: (out / name / "metrics.json").stat().st_mtime_ns for name in NAMES if done(out / name)}
    wait_for(lambda: finished() and set(checkpoints(out)) - set(finished()), process)
    with distributed.Client(cluster) as client:
        pids = client.run(os.getpid)
        busy = next(worker for worker, tasks in client.processing().items() if tasks)
        if way == "killed":
            os.kill(pids[busy], signal.SIGKILL)
        else:
            client.retire_workers([busy])
    before = finished()
    _, error = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, error
    rows = json.loads((out / "suite.json").read_text())["runs"]
    assert [r["status"] for r in rows] == ["finished"] * len(NAMES) and {r["iterations"] for r in rows} == {60}
    assert before.items() <= finished().items()  # what had ended was let be,
    assert sorted(path.name for path in out.iterdir() if path.is_dir()) == sorted(NAMES)  # and nothing was begun anew


def done(run):
    file = run / "metrics.json"
    return file.exists() and json.loads(file.read_text())["finished"]


def test_stopped(captures, cluster, tmp_path):
    """Ctrl-C saves what runs, and begins no other."""
    out = tmp_path / "out"
    process = started(captures, cluster, out, "iterations=1000000")
    wait_for(lambda: len(checkpoints(out)) == 2, process)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130 and "same command goes on" in error and "Traceback" not in error, error
    assert len(checkpoints(out)) == 2 and all(checkpoint.load_latest(out / name)[1]["step"] > 0 for name in checkpoints(out))


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nobody"])
def test_nobody_there(captures, inputs, tmp_path, address):
    with pytest.raises(UserError, match=f"--scheduler {address}: nobody answers there"):
        suite.fit_suite(captures, inputs[0], scheduler=address, out=tmp_path)

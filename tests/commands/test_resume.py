"""Killed at random moments and resumed, a fit ends where an undisturbed one does.

``python tests/commands/test_resume.py 20`` does it with twenty kills.
"""

import json
import random
import sys
import tempfile
import time
from pathlib import Path

import pytest

import rgs_mi  # before mitsuba, which runs imports

from runs import make_inputs, start_script

OPTIONS = ["--quiet", "--set", "iterations=300", "--set", "initialization.surfels=2000", "--set", "checkpoint_seconds=0.3"]
TOLERANCE = 0.2  # dB: sums of floats differ from run to run


def kill_and_resume(folder: Path, kills: int, seed=0) -> tuple[float, float, int]:
    """(PSNR undisturbed, PSNR after being killed, kills that hit a fit which had saved something of its own)."""
    scene, data = make_inputs(folder, size=96)
    options = [scene, "--data", data, *OPTIONS]
    finish(start_script("optimize.py", *options, "--out", folder / "whole"))
    rng, hits = random.Random(seed), 0
    for kill in range(kills):
        saved = newest_checkpoint(folder / "killed")
        process = start_script("optimize.py", *options, "--out", folder / "killed", "--resume")
        if kill % 4 < 3:  # after it has saved; otherwise at any moment, while it starts as a rule
            while process.poll() is None and newest_checkpoint(folder / "killed") == saved:
                time.sleep(0.01)
        time.sleep(rng.uniform(0, 0.5))
        hits += process.poll() is None and newest_checkpoint(folder / "killed") != saved
        process.kill()
        process.communicate()
    finish(start_script("optimize.py", *options, "--out", folder / "killed", "--resume"))
    return metrics(folder / "whole")["psnr"], metrics(folder / "killed")["psnr"], hits


def newest_checkpoint(run):
    return max((path.name for path in run.glob("checkpoints/step_*.npz")), default=None)


def metrics(run):
    return json.loads((run / "metrics.json").read_text())


def finish(process):
    _, error = process.communicate(timeout=600)
    assert process.returncode == 0, error


@pytest.mark.slow
def test_killed_and_resumed(tmp_path):
    whole, killed, hits = kill_and_resume(tmp_path, kills=3)
    assert hits > 0
    assert abs(whole - killed) < TOLERANCE


if __name__ == "__main__":
    rgs_mi.set_variant()
    with tempfile.TemporaryDirectory() as temporary:
        whole, killed, hits = kill_and_resume(Path(temporary), int(sys.argv[1]))
        print(f"undisturbed {whole:.2f} dB, killed {killed:.2f} dB, {hits} of the kills hit")

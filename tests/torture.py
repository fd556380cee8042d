"""Whether anything is lost: a small fit killed, starved and poisoned at every moment, by hand.

    python tests/torture.py [--trials N] [CAMPAIGN ...]

Campaigns, all of them unless some are named; N trials each (default 200, some hours on two cores):

    kill    SIGKILL at a random moment of a whole run, from path tracing to its report; then --resume until it has ended
    term    the same with SIGTERM, which has two seconds to save in
    over    SIGKILL at a random moment of a second run in the folder of a finished one
    fault   ENOSPC or EIO from each call in turn by which a whole run writes: of every file open, the first write, fsync, rename,
            and fsync of its folder (all, or N spread)
    two     two runs that start in one folder at the same time
    poison  NaN in gradients, surfels, environment or photographs at a random step

Held: no traceback and no hang; whatever fails says so in one line; each file is the old or the new one, whole; a run that had
ended is still there; and the run ends, within `TOLERANCE` of an undisturbed one. The last line of a campaign says how many
trials held; what did not is printed, and its folder stays.
"""

import argparse
import contextlib
import errno
import io
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np

import rgs_mi  # before mitsuba, which runs imports

from runs import ROOT, TARGET

TOLERANCE = 0.2  # dB: sums of floats differ from run to run
PATIENCE = 600  # seconds for a run, on a busy machine
SETTINGS = ("iterations=40", "initialization.surfels=300", "checkpoint_seconds=0.2", "stages=[{views: 1}]")
SEED = 0


class Lost(AssertionError):
    """Something that must hold does not."""


def hold(condition, *words):
    if not condition:
        raise Lost(*words)


# ---- A run ----


class Run:
    """A small fit from a scene, of which everything lies below ``root``: photographs, caches and results."""

    def __init__(self, root: Path) -> None:
        self.root, self.out = root, root / "runs" / "ball"
        root.mkdir(parents=True, exist_ok=True)
        (root / "ball.xml").write_text(TARGET)
        text = (ROOT / "scenes" / "object.xml").read_text()
        (root / "object.xml").write_text(text.replace('name="height" value="256"', 'name="height" value="16"'))

    def start(self, *options: str) -> subprocess.Popen:
        code = (
            f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
            "import torture; torture.small()\n"
            "from rgs_mi.cli import main; main('optimize')"
        )
        command = [sys.executable, "-c", code, "object.xml", "--data", "ball.xml", *options]
        command += ["--out", self.out, *(word for s in SETTINGS for word in ("--set", s))]
        environment = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{Path(__file__).parent}"}
        return subprocess.Popen(
            [*map(str, command)], cwd=self.root, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )

    def finish(self, *options: str) -> None:
        ended(self.start(*options), 0)
        hold(self.psnr() is not None, "the run has not ended")

    def psnr(self) -> float | None:
        """Of the held-out views; None where the run has not ended."""
        try:
            figures = json.loads((self.out / "metrics.json").read_text())
        except FileNotFoundError:
            return None
        return figures["psnr"] if figures["finished"] else None


def small() -> None:
    """Path-trace photographs of 24 pixels, 6 to fit and 2 held out."""
    from functools import partial

    from rgs_mi.datasets import path_traced
    from rgs_mi.fit import scene

    scene.render_dataset = partial(path_traced.render_dataset, train=6, test=2, size=24, spp=4, radius=6)


def ended(process: subprocess.Popen, *codes: int) -> str:
    """What a process said on stderr that ends by itself, with one of ``codes``."""
    try:
        _, error = process.communicate(timeout=PATIENCE)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        raise Lost("it hangs") from None
    hold("Traceback" not in error, "a traceback:", error)
    hold(process.returncode in codes, f"it ended with {process.returncode}:", error)
    return error


def whole(folder: Path) -> None:
    """Every file below ``folder`` can be read, and none is half written."""
    import zipfile

    from PIL import Image

    from rgs_mi.surfels.ply import read_ply

    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        hold(path.suffix != ".tmp", f"{path} is left")
        if path.suffix == ".png":
            with Image.open(path) as image:
                image.load()
        elif path.suffix == ".json":
            json.loads(path.read_text())
        elif path.suffix == ".npz":
            with zipfile.ZipFile(path) as archive:
                hold(archive.testzip() is None, f"{path} is damaged")
        elif path.suffix == ".exr":
            import OpenEXR

            with OpenEXR.File(str(path), header_only=False):
                pass
        elif path.suffix == ".ply":
            read_ply(path)


# ---- Campaigns: each gets a folder, a number, and what an undisturbed run gave ----


def kill(root, number, undisturbed, by=signal.SIGKILL):
    """Killed once or twice, then left alone."""
    rng, run = random.Random(SEED + number), Run(root)
    for _ in range(1 + number % 2):
        process = run.start("--resume")
        time.sleep(rng.uniform(0, undisturbed["seconds"]))
        process.send_signal(by)
        asked = time.monotonic()
        try:
            _, error = process.communicate(timeout=PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            raise Lost("it does not end") from None
        waited = time.monotonic() - asked
        if by == signal.SIGTERM:
            # before Python has its handlers, the signal itself ends the process
            hold(process.returncode in (0, 143, -by), f"it ended with {process.returncode}: {error}")
            undisturbed["longest"] = max(undisturbed.get("longest", 0), waited)
    run.finish("--resume")
    hold(abs(run.psnr() - undisturbed["psnr"]) < TOLERANCE, f"{run.psnr():.2f} dB instead of {undisturbed['psnr']:.2f}")
    whole(run.root / "runs")


def term(root, number, undisturbed):
    kill(root, number, undisturbed, signal.SIGTERM)


def over(root, number, undisturbed):
    """A second run where one has ended: the first stays, in its place or aside."""
    run = Run(root)
    shutil.copytree(undisturbed["folder"], root, dirs_exist_ok=True)
    first = {p.relative_to(run.out): p.read_bytes() for p in run.out.rglob("*") if p.is_file()}
    process = run.start()
    time.sleep(random.Random(SEED + number).uniform(0, undisturbed["seconds"]))
    process.kill()
    process.communicate()
    aside = run.out.with_name("ball.1")
    there = aside if aside.exists() else run.out
    now = {p.relative_to(there): p.read_bytes() for p in there.rglob("*") if p.is_file() and p.name != ".lock"}
    hold(now == first, f"{there} is not what it was: {set(now) ^ set(first)}")
    unfinished = aside.exists() and any(run.out.glob("checkpoints/step_*.npz")) and run.psnr() is None
    run.finish(*["--resume"] * unfinished)


def two(root, number, undisturbed):
    """One goes on, the other is told; both may end well only where one came after the other."""
    run = Run(root)
    processes = [run.start(*["--resume"] * (number % 2)) for _ in range(2)]
    errors = [ended(process, 0, 2) for process in processes]
    codes = sorted(process.returncode for process in processes)
    for process, error in zip(processes, errors):
        hold(process.returncode == 0 or "is in use by process" in error, error)
    hold(codes[0] == 0, "neither has ended well")
    hold(abs(run.psnr() - undisturbed["psnr"]) < TOLERANCE, f"{run.psnr():.2f} dB")
    whole(run.root / "runs")


def inside(run: Run, *overrides: str, resume: bool = True):
    """A run in this process; returns what it told, or a UserError."""
    from rgs_mi.commands.optimize import optimize
    from rgs_mi.core.errors import UserError

    small()
    said, before = io.StringIO(), Path.cwd()
    os.chdir(run.root)
    try:
        with (
            contextlib.redirect_stderr(said),
            contextlib.redirect_stdout(said),
            warnings.catch_warnings(record=True) as told,
        ):
            warnings.simplefilter("always")
            optimize("object.xml", data="ball.xml", overrides=[*SETTINGS, *overrides], out=run.out, resume=resume)
    except UserError as error:
        hold(len(str(error).splitlines()) == 1, f"not a line: {error}")
        return error
    finally:
        os.chdir(before)
    return [str(warning.message) for warning in told]


@contextlib.contextmanager
def faults(at: int | None, code: int):
    """The call number ``at`` of those that write files raises an OSError of this ``code``; counts them."""
    from rgs_mi.core import files

    count = [0]

    def counted(function):
        def call(*arguments, **options):
            count[0] += 1
            if count[0] - 1 == at:
                raise OSError(code, os.strerror(code))
            return function(*arguments, **options)

        return call

    class Stream:
        """The file that is written, whose first write counts."""

        def __init__(self, stream):
            self._stream, self._first = stream, counted(stream.write)

        def write(self, content):
            write, self._first = self._first, self._stream.write
            return write(content)

        def __getattr__(self, name):
            return getattr(self._stream, name)

        def __enter__(self):
            return self

        def __exit__(self, *_):
            self._stream.close()

    before = os.fsync, os.replace
    files.open = counted(lambda *arguments, **options: Stream(open(*arguments, **options)))
    os.fsync, os.replace = map(counted, before)
    try:
        yield count
    finally:
        os.fsync, os.replace = before
        del files.open


def fault(root, number, undisturbed):
    """One call fails; the run goes on, or ends with a line, and in any case the next one ends."""
    at = (
        number if undisturbed["trials"] >= undisturbed["writes"] else number * undisturbed["writes"] // undisturbed["trials"]
    )
    run = Run(root)
    with faults(at, (errno.ENOSPC, errno.EIO)[number % 2]) as count:
        result = inside(run)
    hold(count[0] > at, f"only {count[0]} writes")
    whole(root / "runs")
    hold(not isinstance(result, Exception) or "can't be written" in str(result), str(result))
    follow(run)
    hold(abs(run.psnr() - undisturbed["psnr"]) < TOLERANCE, f"{run.psnr():.2f} dB")


def follow(run):
    """The next run goes on to the end."""
    result = inside(run)
    hold(not isinstance(result, Exception), f"the next run fails: {result}")


def poison(root, number, undisturbed):
    """The fit goes on with finite numbers, or says that it has diverged and leaves a good checkpoint."""
    import mitsuba as mi

    from rgs_mi.fit import checkpoint
    from rgs_mi.fit.model import ENVIRONMENT
    from rgs_mi.fit.trainer import Fit

    rng, run = random.Random(SEED + number), Run(root)
    what, when = ("gradient", "view", "surfels", "environment")[number % 4], rng.randrange(1, 38)
    step, view = Fit.step, Fit._view

    def poisoned_step(self):
        recorded = step(self)
        if self.step_number == when and what in ("surfels", "environment"):
            name = ENVIRONMENT
            if what == "surfels":
                name = rng.choice(["centers", "log_scales", "logit_roughness", "sh_dc"])
            values = self.model.numpy(name)
            values.reshape(-1)[rng.randrange(values.size)] = np.nan
            self.model.set(name, values)
        return recorded

    def poisoned_view(self, *arguments):
        found = view(self, *arguments)
        if self.step_number == when and what == "gradient":
            import drjit as dr

            _, rows, _ = self.model._taken[-1]
            dr.set_grad(rows, dr.grad(rows) * np.nan)
        if self.step_number == when and what == "view":
            found["error"] = mi.Float(np.nan)
        return found

    Fit.step, Fit._view = poisoned_step, poisoned_view
    try:
        result = inside(run)
    finally:
        Fit.step, Fit._view = step, view
    if isinstance(result, Exception):
        hold("diverged" in str(result), str(result))
        arrays, _ = checkpoint.load_latest(run.out)
        hold(all(np.isfinite(array).all() for array in arrays.values()), "the checkpoint is not finite")
        follow(run)
    hold(np.isfinite(run.psnr()), f"{run.psnr()} dB")
    whole(root / "runs")


CAMPAIGNS = {f.__name__: f for f in (kill, term, over, fault, two, poison)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("campaigns", nargs="*", choices=[*CAMPAIGNS, []], metavar="CAMPAIGN")
    parser.add_argument("--trials", type=int, default=200)
    args = parser.parse_args()
    rgs_mi.set_variant()
    root = Path(tempfile.mkdtemp(prefix="torture."))
    print(f"below {root}")
    first = Run(root / "undisturbed")
    first.finish()  # compiles its kernels, so that the next one's time is that of all others
    shutil.rmtree(first.root)
    start, first = time.monotonic(), Run(root / "undisturbed")
    first.finish()
    facts = {"psnr": first.psnr(), "seconds": time.monotonic() - start, "folder": first.root, "trials": args.trials}
    print(f"undisturbed {facts['psnr']:.2f} dB in {facts['seconds']:.1f} s", flush=True)
    failed = 0
    for name in args.campaigns or CAMPAIGNS:
        if name == "fault":
            with faults(None, 0) as count:
                inside(Run(root / "counted"))
            facts["writes"] = count[0]
        trials = min(args.trials, facts["writes"]) if name == "fault" else args.trials
        held, start = 0, time.monotonic()
        for number in range(trials):
            folder = root / f"{name}-{number}"
            try:
                CAMPAIGNS[name](folder, number, facts)
                held += 1
                shutil.rmtree(folder, ignore_errors=True)
            except Exception as error:
                print(f"{name} {number}: {type(error).__name__}: {error}", flush=True)
        told = f" of {facts['writes']} calls that write" if name == "fault" else ""
        told += f", at most {facts['longest']:.1f} s to end" if name == "term" else ""
        print(f"{name}: {held} of {trials} trials held{told}; {time.monotonic() - start:.0f} s", flush=True)
        failed += trials - held
    if not failed:
        shutil.rmtree(root, ignore_errors=True)
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()

"""What a window costs and how quick it is.

``python tests/window_figures.py RUN`` measures one on a finished run: how long from the command to the first picture (in a
headless Chromium, where there is one), how it is in motion and at rest, what it compiles, how it agrees with `mi.render`, and
its memory over moves of all kinds. ``--fit SCENE`` measures one on a fit of that scene, ``--steps`` of it: stretches with and
without a window take turns, from the fit's beginning to its end.
"""

import argparse
import io
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

import rgs_mi

import browser
from runs import PATIENCE, ROOT

SIZE = 400, 400
STRETCH = 75  # steps of a fit with the same windows: fewer would count debts that later ones pay back
RATE = 60  # moves a second


class Panel:
    """Encodes pictures as they are sent, and notes when: (seconds, picture) each."""

    def __init__(self):
        self.pictures = []

    def show(self, picture):
        file = io.BytesIO()
        Image.fromarray(picture.pixels).save(
            file, *(["PNG"] if picture.quality is None else ["JPEG"]), quality=picture.quality or 0
        )
        self.pictures.append((time.perf_counter(), picture))


class Moves:
    """Turns a ``window`` about a ``subject``, `RATE` times a second, in a thread of its own: ``at`` has when each move came."""

    def __init__(self, window, subject):
        self.at, self._window, self._subject, self._end = [], window, subject, threading.Event()
        self._thread = threading.Thread(target=self._move, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._end.set()
        self._thread.join()

    def _move(self):
        start = self._window.look.camera
        while not self._end.wait(1 / RATE):
            camera = orbited(start, self._subject.center, self._subject.up, 0.01 * len(self.at))
            self.at.append(time.perf_counter())
            self._window.change(camera=camera)


def orbited(camera, center, up, angle):
    """The ``camera`` turned about the axis ``up`` through ``center``, radians."""
    from scipy.spatial.transform import Rotation

    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec(angle * up).as_matrix()
    turn[:3, 3] = center - turn[:3, :3] @ center
    return replace(camera, to_world=turn @ camera.to_world)


def entered(server, camera):
    """A window without a browser."""
    from rgs_mi.viewer.look import Look
    from rgs_mi.viewer.window import Window

    number = max(server.windows, default=0) + 1
    server.windows[number], server._panels[number] = Window(Look(camera), server.wake.set), Panel()
    server._turns.append(number)
    return number, server.windows[number], server._panels[number]


def megabytes():
    """Resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20


def first_picture(run):
    """Seconds from the command to the first picture in a browser, whose own start is not counted."""
    with browser.open_tab(webgl=True) as page:
        start = time.perf_counter()
        command = [sys.executable, ROOT / "scripts" / "view.py", run, "--port", "0"]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            page.goto(process.stdout.readline().split()[0])
            page.get_by_text("128 × 128").or_(page.get_by_text("1280 × 900")).first.wait_for(timeout=1000 * PATIENCE)
            return time.perf_counter() - start
        finally:
            process.terminate()
            process.communicate()


def finished(run):
    """Figures of a window on a finished ``run``."""
    import drjit as dr
    import mitsuba as mi

    from rgs_mi.core.scene_files import load_scene
    from rgs_mi.export.render import sensor_dict, straight
    from rgs_mi.viewer.server import Server
    from rgs_mi.viewer.subject import Subject

    scene = load_scene(run / "scene.xml", {})
    subject = Subject.of(scene)
    server = Server(subject, str(run), port=0)
    camera = subject.cameras[0].resized(*SIZE)
    while server.turn():  # compiles all sizes
        pass
    _, window, panel = entered(server, camera)
    server.run(until=lambda: window.due() == float("inf"))
    print(f"{len(subject.surfels)} surfels, a window of {SIZE[0]} × {SIZE[1]}; frames of each size, ms:", end=" ")
    print(", ".join(f"{grid}²: {1e3 * seconds:.0f}" for grid, seconds in server.pace.seconds.items()))

    dr.set_flag(dr.JitFlag.KernelHistory, True)
    dr.kernel_history_clear()
    panel.pictures.clear()
    end = time.perf_counter() + 10
    with Moves(window, subject) as moves:
        server.run(until=lambda: time.perf_counter() > end)
    seconds = [at for at, _ in panel.pictures]
    sizes = [picture.pixels.shape[1] for _, picture in panel.pictures]
    # the newest move that a picture could have seen came before it was begun: the last picture's end, about
    latency = [done - next((m for m in moves.at if m >= begun), begun) for begun, done in zip(seconds, seconds[1:])]
    compiled = sum(not k["cache_hit"] or k["cache_disk"] for k in dr.kernel_history((dr.KernelType.JIT,)))
    dr.set_flag(dr.JitFlag.KernelHistory, False)
    print(
        f"in motion: {len(seconds) / 10:.1f} frames a second, of {int(np.median(sizes))}² as a rule, {min(sizes)}² at least; "
        f"latency {1e3 * np.median(latency):.0f} ms, at most {1e3 * max(latency):.0f}; {compiled} kernels compiled"
    )

    rests = []
    for k in range(5):
        window.change(camera=orbited(camera, subject.center, subject.up, 1 + k))
        panel.pictures.clear()
        server.run(until=lambda: not window.moving)
        start = time.perf_counter()
        server.run(until=lambda: window.due() == float("inf"))
        full = next(at for at, picture in panel.pictures if picture.part is not None)
        rests.append((full - start, panel.pictures[-1][0] - start))
    print("at rest: full size after {:.2f} s, 16 samples after {:.2f} s".format(*np.median(rests, 0)))

    sensor = mi.load_dict(sensor_dict(window.look.camera))
    image = straight(np.array(mi.render(scene, sensor=sensor, spp=16)))
    expected = image[..., :3] * image[..., 3:] + 1 - image[..., 3:]
    error = panel.pictures[-1][1].pixels / 255 - np.clip(expected, 0, 1)
    print(f"against mi.render: {-10 * np.log10((error**2).mean()):.1f} dB")

    rng, told = np.random.default_rng(0), []
    for k in range(601):
        angle, wait = 6 * rng.random(), (0, 0, 0, 0.3)[rng.integers(4)]
        rotate = float(rng.integers(360)) if rng.random() < 0.1 else window.look.rotate
        chosen = str(rng.choice(["picture", "normals", "specular"])) if rng.random() < 0.1 else window.look.map
        window.change(camera=orbited(camera, subject.center, subject.up, angle), rotate=rotate, map=chosen)
        until = time.perf_counter() + wait
        while server.turn() and time.perf_counter() < until:
            pass
        panel.pictures.clear()
        if k % 200 == 0:
            told.append(f"{megabytes():.0f}")
    print("memory after 0, 200, 400, 600 events, MB:", ", ".join(told))
    server.close()


def fit(scene_file, steps):
    """What windows on a fit cost: medians over pairs of neighbouring stretches, with and without."""
    from rgs_mi.commands.optimize import start
    from rgs_mi.fit.scene import FitScene
    from rgs_mi.viewer.live import Watch

    scene = FitScene.load(scene_file, None)
    settings = scene.settings(None, ["minutes=null", f"iterations={steps}"])
    work = start(scene, scene.dataset(settings.resolution), settings, quiet=False)
    watch = Watch(work, scene.name, port=0)
    watch._controls = dict.fromkeys(range(9), Silent())
    camera = work.dataset.train[0].camera.resized(*SIZE)

    def stretch(kind):
        server = watch._server
        if kind in ("at rest", "moving"):
            number, window, _ = entered(server, camera)
        moves = Moves(window, server.subject) if kind == "moving" else None
        if moves:
            moves.__enter__()
        watch._credit = 0.0  # what was saved up while nobody looked is not a part of this stretch
        begin = time.perf_counter()
        for _ in range(STRETCH):
            work.step()
            if kind != "alone":
                watch.between()
        seconds = time.perf_counter() - begin
        if moves:
            moves.__exit__()
        for number in list(server.windows):
            for known in (server.windows, server._panels):
                known.pop(number)
            server._turns.remove(number)
        return seconds

    for kind in ("moving", "moving"):  # compiles
        stretch(kind)
    ratios = {"nobody looks": [], "at rest": [], "moving": []}
    while work.progress < 1 and work.step_number < steps:
        for kind, found in ratios.items():
            before, with_it, after = stretch("alone"), stretch(kind), stretch("alone")
            found.append(2 * with_it / (before + after))
    for kind, found in ratios.items():
        print(f"{kind}: {100 * (np.median(found) - 1):+.1f} % (median of {len(found)}, half within "
              f"{100 * (np.percentile(found, 25) - 1):+.1f} and {100 * (np.percentile(found, 75) - 1):+.1f})")  # fmt: skip
    watch.close()


class Silent:
    """Takes what a fit tells."""

    def tell(self, _fit):
        pass


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, nargs="?")
    parser.add_argument("--fit", type=Path, metavar="SCENE")
    parser.add_argument("--steps", type=int, default=4000)
    args = parser.parse_args()
    rgs_mi.set_variant("llvm_ad_rgb")
    if args.run:
        try:
            print(f"first picture after {first_picture(args.run):.1f} s")
        except BaseException as error:  # pytest's skip: no browser
            print(f"first picture: {error}")
        finished(args.run)
    if args.fit:
        fit(args.fit, args.steps)


if __name__ == "__main__":
    main()

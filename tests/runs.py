"""A ball to fit in seconds, for the tests of the command line."""

import subprocess
import sys
import time
from pathlib import Path

import mitsuba as mi
import numpy as np
from PIL import Image

from rgs_mi.fit import losses

ROOT = Path(__file__).parents[1]
TARGET = """<scene version="3.0.0">
    <integrator type="path"> <boolean name="hide_emitters" value="true"/> </integrator>
    <emitter type="procedural_envmap"> <string name="name" value="studio"/> <integer name="height" value="32"/>
        <transform name="to_world"> <rotate x="1" angle="90"/> </transform> </emitter>
    <shape type="sphere">
        <bsdf type="principled"> <rgb name="base_color" value="0.6, 0.4, 0.2"/> <float name="metallic" value="1"/>
            <float name="roughness" value="0.25"/> </bsdf>
    </shape>
</scene>"""


def make_inputs(folder: Path, size=32) -> tuple[Path, Path]:
    """Write a scene to fit (object.xml with a small environment) and photographs into ``folder``: both paths."""
    from rgs_mi.datasets.path_traced import render_dataset

    (folder / "ball.xml").write_text(TARGET)
    data = render_dataset(folder / "ball.xml", folder / "ball", train=12, test=3, size=size, spp=4, radius=6, quiet=True)
    text = (ROOT / "scenes" / "object.xml").read_text()
    (folder / "object.xml").write_text(text.replace('name="height" value="256"', 'name="height" value="16"'))
    return folder / "object.xml", data


def make_suite(scene: Path, data: Path, folder: Path, *names) -> tuple[Path, Path]:
    """The photographs ``data`` as captures ``names`` in ``folder``: the scene to fit, and the captures' folder."""
    for name in names:
        (folder / name).symlink_to(data)
    return scene, folder


SMALL = ["iterations=20", "initialization.surfels=300", "checkpoint_seconds=0", "stages=[{views: 2}]"]  # fitted in seconds
PATIENCE = 100  # seconds, on a busy machine
_started = []


def assert_renders_as_written(scene, run):
    """Mitsuba's images of the exported scene are those that the metrics are of."""
    for k, sensor in enumerate(scene.sensors()):
        image = np.array(mi.render(scene, sensor=k))
        color = mi.Color3f(np.ascontiguousarray(image[..., :3].reshape(-1, 3).T))
        shown = losses.display(color, mi.Float(image[..., 3].ravel()), 1.0).numpy().T.reshape(*image.shape[:2], 3)
        written = np.asarray(Image.open(run / "test" / f"{sensor.id()}.png")) / 255
        assert abs(np.clip(shown, 0, 1) - written).max() < 1 / 255


def start(*command, **options) -> subprocess.Popen:
    """Start a process, which does not outlive the test."""
    _started.append(subprocess.Popen([sys.executable, *map(str, command)], **options))
    return _started[-1]


def start_script(name, *arguments) -> subprocess.Popen:
    """Start a script of the project in a process of its own."""
    return start(ROOT / "scripts" / name, *arguments, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def end_all():
    """Kill what a failed test has left running."""
    while _started:
        process = _started.pop()
        if process.poll() is None:
            process.kill()


def wait_for(condition, process=None):
    """Until ``condition()`` holds, while ``process`` goes on."""
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "too slow"
        assert process is None or process.poll() is None, process.stderr and process.stderr.read()
        time.sleep(0.05)

"""Programs of others that judge exports: packages of npm, in ``tests/npm``, OpenUSD, and Blender. Tests are skipped without
them; CONTRIBUTING.md says how to install them."""

import base64
import io
import json
import os
import shutil
import subprocess
from contextlib import contextmanager
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from browser import open_tab

BLENDER = "RGS_MI_BLENDER"  # names a Python that has Blender's module
FOLDER = Path(__file__).parent / "npm"
_SITE = "http://viewer.test/"
_SECONDS = 100


def package(name: str) -> Path:
    """The folder of a package of npm."""
    folder = FOLDER / "node_modules" / name
    if not folder.is_dir():
        pytest.skip(f"needs npm's {name}: npm install --prefix tests/npm")
    return folder


def run_node(*arguments, new: bool = False) -> str:
    """What Node prints; ``new``: that of npm's package, which is newer than many systems'."""
    program = str(package("node") / "bin" / "node") if new else shutil.which("node")
    if not program:
        pytest.skip("needs Node: apt-get install nodejs")
    done = subprocess.run([program, *map(str, arguments)], capture_output=True, text=True, timeout=_SECONDS)
    assert done.returncode == 0, done.stderr
    return done.stdout


def validated_gltf(path: Path) -> list[dict]:
    """The messages of Khronos's validator of glTF."""
    script = f"""require({json.dumps(str(package("gltf-validator")))}).validateBytes(
        new Uint8Array(require("fs").readFileSync({json.dumps(str(path))})), {{maxIssues: 0}}
    ).then((report) => console.log(JSON.stringify(report.issues.messages)))"""
    return json.loads(run_node("-e", script))


def splat_transform(*arguments) -> str:
    """What PlayCanvas's splat-transform prints."""
    return run_node(package("@playcanvas/splat-transform") / "bin" / "cli.mjs", "-w", *arguments, new=True)


def filmed(camera) -> "mi.Sensor":
    """The sensor of a `Camera` whose film is Mitsuba's own, as photographs of the suite have it, and Blender here: Gaussian, of
    half a pixel."""
    sensor = camera.to_sensor_dict()
    sensor["film"]["rfilter"] = {"type": "gaussian"}
    return mi.load_dict(sensor)


def blender(glb: Path, light: Path, camera, rotation, folder: Path, samples: int = 64) -> np.ndarray:
    """What Blender's Cycles shows to a `Camera` of a GLB under the environment map ``light``, linear, [H, W, 3]; ``rotation``
    [3, 3] takes the camera's world to the glTF's. Files between are in ``folder``."""
    if not os.environ.get(BLENDER):
        pytest.skip(f"needs Blender: pip install bpy==5.0.1 in an environment of Python 3.11, whose python {BLENDER} names")
    to_world = camera.to_world.copy()
    to_world[:3] = rotation @ to_world[:3]
    view = {"to_world": to_world.tolist(), "size": list(camera.size)}
    view["fov_x"] = 2 * float(np.arctan(0.5 * camera.size[0] / camera.focal[0]))
    (folder / "camera.json").write_text(json.dumps(view))
    out = folder / "blender.exr"
    arguments = [FOLDER.parent / "blender_render.py", glb, light, folder / "camera.json", out, samples]
    done = subprocess.run([os.environ[BLENDER], *map(str, arguments)], capture_output=True, text=True, timeout=_SECONDS)
    assert done.returncode == 0, done.stderr
    return np.array(mi.Bitmap(str(out)))[..., :3]


@contextmanager
def babylon(path: Path):
    """A function that takes a `Camera` (rotated, perhaps, by a matrix [3, 3]) to what Babylon.js shows of the splats in the
    file ``path`` over white, [H, W, 3] in [0, 1]."""
    files = {
        "viewer.html": FOLDER / "viewer.html",
        "babylon.js": package("babylonjs") / "babylon.js",
        "loaders.js": package("babylonjs-loaders") / "babylonjs.loaders.min.js",
        path.name: path,
    }
    with open_tab(webgl=True) as page:
        page.set_default_timeout(1000 * _SECONDS)
        page.route(f"{_SITE}**", lambda route: _fulfill(route, files))
        page.goto(_SITE + "viewer.html")
        page.evaluate("(file) => load(file)", path.name)

        def draw(camera, rotation=np.eye(3)):
            axes = rotation @ camera.to_world[:3]
            shown = page.evaluate(
                "(camera) => draw(camera)",
                {
                    "size": list(camera.size),
                    "origin": axes[:, 3].tolist(),
                    "target": (axes[:, 3] + axes[:, 2]).tolist(),
                    "up": (-axes[:, 1]).tolist(),
                    "fov": 2 * float(np.arctan(0.5 * camera.size[1] / camera.focal[1])),
                },
            )
            image = Image.open(io.BytesIO(base64.b64decode(shown.partition(",")[2]))).convert("RGB")
            assert image.size == camera.size and not page.errors, page.errors
            return np.asarray(image) / 255

        yield draw


def _fulfill(route, files):
    name = route.request.url.removeprefix(_SITE)
    if name in files:
        route.fulfill(path=files[name])
    else:
        route.fulfill(status=404)

"""A scene to look at, in windows without a browser."""

from pathlib import Path

import numpy as np

from rgs_mi.core.color import exposed, to_8bit
from rgs_mi.core.files import write_exr
from rgs_mi.datasets.types import View
from rgs_mi.evaluation import metrics
from rgs_mi.surfels.ply import write_ply
from rgs_mi.viewer import passes
from rgs_mi.viewer.look import Look

from scenes import orbit_camera, tangent_surfels

_SENSOR = """    <sensor type="perspective" id="r_{k}">
        <transform name="to_world"> <lookat origin="{x}, {y}, 0.8" target="0, 0, 0" up="0, 0, 1"/> </transform>
        <float name="fov" value="38"/>
        <film type="hdrfilm"> <integer name="width" value="48"/> <integer name="height" value="40"/>
            <string name="pixel_format" value="rgba"/> <rfilter type="box"/> </film>
        <sampler type="independent"> <integer name="sample_count" value="1"/> </sampler>
    </sensor>"""
_SCENE = """<scene version="3.0.0">
    <integrator type="{integrator}"> <boolean name="hide_emitters" value="true"/> {properties} </integrator>
    <shape type="surfels" id="object"> <string name="filename" value="object.ply"/>
        <boolean name="two_sided" value="false"/> <bsdf type="principled"/> </shape>
    <emitter type="procedural_envmap" id="environment"> <string name="name" value="studio"/>
        <integer name="height" value="16"/> <transform name="to_world"> <rotate x="1" angle="90"/> </transform> </emitter>
{sensors}
</scene>"""


def write_scene(folder: Path, integrator="rgs_deferred", indirect="one_bounce", count=1500, **properties) -> Path:
    """Write ``scene.xml``: two balls of surfels, four cameras around them; ``properties`` are strings of the integrator. Beside
    it lies another light, ``light.exr``."""
    ball, other = (tangent_surfels(n).numpy() for n in (count, count // 2))
    other |= {"centers": 0.5 * other["centers"] + (1.1, 0.6, 0.4), "scales": 0.5 * other["scales"]}
    surfels = {name: np.concatenate([ball[name], other[name]]) for name in ball}
    shade = 0.5 + 0.5 * np.sin(3 * surfels["centers"])
    materials = {"roughness": 0.1 + 0.3 * shade[:, :1], "metallic": shade[:, 1:2], "base_color": 0.2 + 0.7 * shade}
    write_ply(folder / "object.ply", surfels | materials | {"sh": np.tile(surfels["sh"].mean(0), (len(shade), 1))})
    if integrator == "rgs_deferred":
        properties["indirect"] = indirect
    angles = np.linspace(0.3, 5, 4)
    text = _SCENE.format(
        integrator=integrator,
        properties=" ".join(f'<string name="{name}" value="{value}"/>' for name, value in properties.items()),
        sensors="\n".join(_SENSOR.format(k=k, x=4 * np.cos(a), y=4 * np.sin(a)) for k, a in enumerate(angles)),
    )
    write_exr(folder / "light.exr", np.random.default_rng(2).uniform(0, 2, (8, 16, 3)) ** 3)
    (folder / "scene.xml").write_text(text)
    return folder / "scene.xml"


def photographs(subject) -> list[View]:
    """What is seen from three places, as photographs."""
    views = []
    for k, angle in enumerate((0.0, 1.5, 4.0)):
        camera = orbit_camera(angle, size=(60, 50))
        refined = passes.Refined()
        while not refined.complete:
            refined.add(subject, Look(camera))
        alpha = np.clip(refined.means["alpha"], 0, 1)
        color = exposed(refined.means["color"] / np.maximum(alpha, 1e-6))
        views.append(View(f"p_{k}", camera, to_8bit(np.concatenate([color, alpha], -1)), True, None, Path(f"p_{k}.png")))
    return views


def psnr(a, b):
    """In dB, of pictures of 8 bits, or of display values in [0, 1]."""
    scale = 255 if np.asarray(a).dtype == np.uint8 else 1
    return metrics.psnr(np.asarray(a) / scale, np.asarray(b) / scale)


class Panel:
    """Takes pictures as `rgs_mi.viewer.panel.Panel` does."""

    def __init__(self):
        self.pictures = []

    def show(self, picture):
        self.pictures.append(picture)

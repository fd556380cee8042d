"""A fit as files that Mitsuba loads: surfels, environment, shader, and the scene that puts them together."""

import copy
import itertools
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..core.errors import UserError
from ..core.files import atomic_file, write_exr
from ..core.film import rfilter
from ..datasets.types import View
from ..shading.environment import Environment
from ..shading.lighting import Shading
from ..shading.shader import Shader
from ..surfels.ply import write_ply
from ..surfels.surfels import Surfels

if TYPE_CHECKING:
    from ..fit.scene import FitScene

_SQUARE = 2e-3  # a pixel in five hundred is no ground to warn: focal lengths that are learned come out as different
SURFELS, ENVIRONMENT, SHADER, SCENE = "object.ply", "environment.exr", "shader.npz", "scene.xml"


def export(
    folder: str | Path,
    scene: "FitScene",
    surfels: Surfels,
    environment: Environment,
    shading: Shading,
    shader: Shader | None,
    views: Sequence[View],
    spp: int = 1,
    stddev: float | None = None,
) -> list[Path]:
    """Write ``object.ply``, ``environment.exr``, ``shader.npz`` (where ``shader`` is not None, the identity) and
    ``scene.xml`` into ``folder`` and return their paths.

    The scene is the one that was fitted with the results in place of where the fit started, its ``shading``, and a sensor of
    ``spp`` samples per pixel, which a Gaussian of ``stddev`` pixels filters (0, None: a box), for each of ``views``, whose id is
    the view's name: ``mi.render(mi.load_file("scene.xml", parallel=False), sensor=i)``.
    Raises: UserError where the disk is full or the folder can't be written.
    """
    folder = Path(folder)
    write_ply(folder / SURFELS, surfels.numpy())
    write_exr(folder / ENVIRONMENT, environment.texels.numpy())
    if shader:
        shader.save(folder / SHADER)
    root = _fitted(
        scene,
        surfels,
        environment,
        shading.eta,
        {
            "specular": shading.specular,
            "diffuse": shading.diffuse,
            "indirect": shading.indirect,
            "shader": SHADER if shader else None,
            "box": shading.box,
            "turntable": shading.turntable,
            "room": environment.room,
        },
    )
    if any(abs(v.camera.focal[0] / v.camera.focal[1] - 1) > _SQUARE for v in views):
        warnings.warn(f"{folder / SCENE}: the cameras' pixels are not square, those of its sensors are", stacklevel=2)
    ids = sensor_ids([view.name for view in views], _ids(root))
    root.extend(_sensor(view, name, spp, stddev) for view, name in zip(views, ids))
    ET.indent(root, "    ")
    with atomic_file(folder / SCENE) as stream:
        ET.ElementTree(root).write(stream, encoding="utf-8", xml_declaration=True)
    return [folder / name for name in (SCENE, SURFELS, ENVIRONMENT, *([SHADER] if shader else []))]


def sensor_ids(names: Sequence[str], taken: Iterable[str] = ()) -> list[str]:
    """Return the ids of the sensors of views called ``names``, each its own and none of those ``taken``: the name, with '_' for
    what XML does not hold or Mitsuba understands, as '.' in the path of a parameter or '$' before a variable's name, and a number
    behind it where another is called so already."""
    ids = list(taken)
    for name in names:
        clean = "".join(c if c.isalnum() or c in "-_" else "_" for c in name) or "_"
        count = itertools.count(2)
        found = clean
        while found in ids:
            found = f"{clean}_{next(count)}"
        ids.append(found)
    return ids[len(ids) - len(names) :]


def ids_of(path: Path) -> list[str]:
    """Return the ids in an exported scene file that are not those of sensors. Raises: UserError for malformed XML."""
    try:
        return _ids(ET.parse(path).getroot())
    except (OSError, ET.ParseError) as error:
        raise UserError(f"{path}: can't be read as XML ({error}): export the scene again") from error


def _ids(root):
    return [found for e in root.iter() if e.tag != "sensor" and (found := e.get("id"))]


def _fitted(scene, surfels, environment, eta, properties):
    """The scene's XML with results in place of photographs and of the starting light, with the surfels' index of refraction
    ``eta``, with ``properties`` of the integrator (None: its default), and without sensors."""
    root = copy.deepcopy(scene.root)
    for sensor in root.findall("sensor"):
        root.remove(sensor)
    shape = scene.surfels_element(root)
    shape.remove(shape.find("*[@name='photographs']"))
    shape.insert(0, _element("string", "filename", SURFELS))
    shape.insert(1, _element("boolean", "two_sided", str(surfels.two_sided).lower()))
    if eta != scene.shading.eta:
        for element in [e for e in shape if e.tag == "bsdf" or root.find(f"bsdf[@id='{e.get('id')}']") is not None]:
            shape.remove(element)
        shape.append(ET.Element("bsdf", type="principled"))
        shape[-1].append(_element("float", "eta", f"{eta:.6g}"))
    emitter = scene.emitter_element(root)
    emitter[:] = [_element("string", "filename", ENVIRONMENT), _transform(environment.rotation)]
    emitter.set("type", "envmap")
    integrator = scene.integrator_element(root)
    for name, value in properties.items():
        for element in integrator.findall(f"*[@name='{name}']"):
            integrator.remove(element)
        if value:
            integrator.append(_element("string", name, value))
    for default in root.findall("default"):
        name = default.get("name")
        default.set("value", scene.variables.get(name, default.get("value")))
        if f"${name}" not in ET.tostring(root, encoding="unicode"):
            root.remove(default)
    return root


def _sensor(view, name, spp, stddev):
    d, kind = view.camera.to_sensor_dict(), rfilter(stddev)
    sensor = ET.Element("sensor", type="perspective", id=name)
    numbers = ("fov", "principal_point_offset_x", "principal_point_offset_y")
    film = ET.Element("film", type="hdrfilm")
    film.extend(
        [
            _element("integer", "width", d["film"]["width"]),
            _element("integer", "height", d["film"]["height"]),
            _element("string", "pixel_format", "rgba"),
            ET.Element("rfilter", type=kind.pop("type")),
        ]
    )
    film[-1].extend(_element("float", key, value) for key, value in kind.items())
    sampler = ET.Element("sampler", type="independent")
    sampler.append(_element("integer", "sample_count", spp))
    sensor.extend(
        [
            _transform(np.array(d["to_world"].matrix)),
            _element("string", "fov_axis", "x"),
            *(_element("float", name, f"{d[name]:.9g}") for name in numbers),
            film,
            sampler,
        ]
    )
    return sensor


def _transform(matrix):
    """A ``to_world`` from [3, 3] or [4, 4]."""
    full = np.eye(4)
    full[: len(matrix), : len(matrix)] = matrix
    transform = ET.Element("transform", name="to_world")
    ET.SubElement(transform, "matrix", value=" ".join(f"{v:.9g}" for v in full.ravel()))
    return transform


def _element(tag, name, value):
    return ET.Element(tag, name=name, value=str(value))

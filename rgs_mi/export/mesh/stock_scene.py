"""A textured mesh as a scene that Mitsuba renders as it comes: nothing of this package is needed.

    scene.xml            integrator path, the mesh under a twosided normalmap of a principled BSDF, an area emitter where
                         surfels have a radiance of their own, the environment, and the sensors of the run
    mesh.ply             vertices, normals and texture coordinates, in the run's own world
    base_color.exr, roughness.exr, metallic.exr, normal.exr, radiance.exr    its textures, half floats, linear
    environment.exr      latitude-longitude

Where there is an environment the emitter has the sampling weight 0: rays find it, but none is sent to look for it. It is seen
wherever the object is, so that the integrator must show emitters, and with them the environment behind the object.
"""

import copy
import xml.etree.ElementTree as ET
from pathlib import Path

import mitsuba as mi
import numpy as np

from ...core.files import atomic_file, write_bitmap, write_exr
from .surface import UVMesh, as_mitsuba
from .textures import Texels, Textures, mitsuba_frames, normal_map

SCENE, MESH, ENVIRONMENT = "scene.xml", "mesh.ply", "environment.exr"
LIGHT = "environment"  # the emitter's id
DEPTH = 6  # of paths


def write(
    folder: str | Path,
    mesh: UVMesh,
    texels: Texels,
    textures: Textures,
    eta: float,
    environment: np.ndarray | None,
    run: Path,
) -> list[Path]:
    """Write the module's files into ``folder`` and return their paths. ``environment`` are the texels [rows, columns, 3] of the
    light (None: it has none), and ``run`` is the scene file whose emitter and sensors are taken over.

    Raises: UserError where the disk is full or the folder can't be written.
    """
    folder = Path(folder)
    images = {
        "base_color": textures.base_color,
        "roughness": textures.roughness,
        "metallic": textures.metallic,
        "normal": normal_map(mesh, texels, textures.normal, mitsuba_frames),
    }
    if textures.radiance is not None:
        images["radiance"] = textures.radiance
    for name, image in images.items():
        _write_half(folder / f"{name}.exr", image)
    if environment is not None:
        write_exr(folder / ENVIRONMENT, environment)
    _write_ply(folder / MESH, mesh)
    root = _scene(images, eta, ET.parse(run).getroot(), environment is not None)
    ET.indent(root, "    ")
    with atomic_file(folder / SCENE) as stream:
        ET.ElementTree(root).write(stream, encoding="utf-8", xml_declaration=True)
    names = [SCENE, MESH, *(f"{name}.exr" for name in images), *([ENVIRONMENT] if environment is not None else [])]
    return [folder / name for name in names]


def _write_half(path, image):
    formats = {1: mi.Bitmap.PixelFormat.Y, 3: mi.Bitmap.PixelFormat.RGB}
    bitmap = mi.Bitmap(np.ascontiguousarray(image, np.float32), formats[image.shape[-1]])
    write_bitmap(path, bitmap.convert(component_format=mi.Struct.Type.Float16))


def _write_ply(path, mesh):
    memory = mi.MemoryStream()
    as_mitsuba(mesh).write_ply(memory)
    with atomic_file(path) as stream:
        stream.write(memory.raw_buffer())


# ---- The XML ----


def _scene(images, eta, run, lit):
    """The root element; ``run`` is that of the run's scene."""
    root = ET.Element("scene", version="3.0.0")
    ET.SubElement(_named(root, "integrator", "path"), "integer", name="max_depth", value=str(DEPTH))
    shape = _named(root, "shape", "ply", id="mesh")
    ET.SubElement(shape, "string", name="filename", value=MESH)
    both = _named(shape, "bsdf", "twosided")  # at the outline, interpolated normals may be turned away: it would be black
    normals = _named(both, "bsdf", "normalmap")
    ET.SubElement(normals, "boolean", name="use_shadowing_function", value="false")  # surfels know no such term
    _texture(normals, "normalmap", "normal")
    material = _named(normals, "bsdf", "principled", id="material")
    ET.SubElement(material, "float", name="eta", value=f"{eta:.6g}")
    for name in ("base_color", "roughness", "metallic"):
        _texture(material, name, name)
    if "radiance" in images:
        emitter = _named(shape, "emitter", "area")
        if lit:  # Mitsuba wants one emitter that it can sample
            ET.SubElement(emitter, "float", name="sampling_weight", value="0")
        _texture(emitter, "radiance", "radiance")
    emitter = run.find("emitter[@type='envmap']")
    if emitter is not None and lit:
        light = _named(root, "emitter", "envmap", id=LIGHT)
        ET.SubElement(light, "string", name="filename", value=ENVIRONMENT)
        light.extend(copy.deepcopy(turn) for turn in emitter.findall("transform"))  # its scale is in the texels
    root.extend(copy.deepcopy(sensor) for sensor in run.findall("sensor"))
    return root


def _named(parent, tag, kind, **attributes):
    return ET.SubElement(parent, tag, {"type": kind, **attributes})


def _texture(parent, parameter, name):
    texture = _named(parent, "texture", "bitmap", name=parameter, id=name)
    ET.SubElement(texture, "string", name="filename", value=f"{name}.exr")
    ET.SubElement(texture, "boolean", name="raw", value="true")
    ET.SubElement(texture, "string", name="format", value="variant")  # single precision, for who differentiates

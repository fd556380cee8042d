"""Splats as glTF: one GLB with the extension KHR_gaussian_splatting (Khronos 2026)."""

import json
import struct
from pathlib import Path

import numpy as np

from ..core.color import srgb_decode
from ..core.files import atomic_file
from .splats import DEGREE, Splats, sh_basis

NAME = "splats.glb"
EXTENSION = "KHR_gaussian_splatting"
_MAGIC, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
_FLOAT, _ARRAY_BUFFER, _POINTS = 5126, 34962, 0
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def write(folder: str | Path, splats: Splats) -> list[Path]:
    """Write ``splats``, in a world whose y axis points up, as `NAME` into ``folder`` and return the path, in a list: floats
    throughout, linear scales and opacities, quaternions (x, y, z, w), coefficients of display sRGB. Who does not know the
    extension sees points of the mean colour.

    Raises: UserError where the disk is full or the folder can't be written.
    """
    attributes = _attributes(splats)
    binary = b"".join(values.tobytes() for values in attributes.values())
    document = json.dumps(_document(attributes, len(binary)), separators=(",", ":")).encode()
    chunks = _chunk(_JSON, document, b" ") + _chunk(_BINARY, binary, b"\0")
    path = Path(folder) / NAME
    with atomic_file(path) as stream:
        stream.write(struct.pack("<III", _MAGIC, 2, 12 + len(chunks)))
        stream.write(chunks)
    return [path]


def _attributes(splats):
    """{semantic: [N] or [N, 3 or 4] little-endian floats}."""
    mean = np.clip(0.5 + sh_basis(np.array([[0.0, 0.0, 1.0]]))[0, 0] * splats.harmonics[:, 0], 0, 1)
    harmonics = {
        f"SH_DEGREE_{degree}_COEF_{order}": splats.harmonics[:, degree**2 + order]
        for degree in range(DEGREE + 1)
        for order in range(2 * degree + 1)
    }
    own = {"ROTATION": splats.rotations, "SCALE": splats.thick_scales, "OPACITY": splats.opacities, **harmonics}
    attributes = {
        "POSITION": splats.centers,
        "COLOR_0": np.column_stack([srgb_decode(mean), splats.opacities]),  # glTF's own colours are linear
        **{f"{EXTENSION}:{name}": values for name, values in own.items()},
    }
    return {name: np.ascontiguousarray(values, "<f4") for name, values in attributes.items()}


def _document(attributes, length):
    """The JSON of a GLB whose one buffer, of ``length`` bytes, has the ``attributes`` one after the other."""
    views, accessors, first = [], [], 0
    for name, values in attributes.items():
        views.append({"buffer": 0, "byteOffset": first, "byteLength": values.nbytes, "target": _ARRAY_BUFFER})
        bounds = {"min": values.min(0).tolist(), "max": values.max(0).tolist()} if name == "POSITION" else {}
        kind = _TYPES[values.shape[1] if values.ndim > 1 else 1]
        accessors.append(
            {"bufferView": len(accessors), "componentType": _FLOAT, "count": len(values), "type": kind} | bounds
        )
        first += values.nbytes
    primitive = {
        "mode": _POINTS,
        "attributes": {name: k for k, name in enumerate(attributes)},
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    return {
        "asset": {"version": "2.0", "generator": "rgs_mi"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": length}],
    }


def _chunk(kind, content, padding):
    """A chunk of a GLB, padded to four bytes."""
    content += padding * (-len(content) % 4)
    return struct.pack("<II", len(content), kind) + content

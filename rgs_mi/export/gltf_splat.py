"""Splats as glTF: one GLB with the extension KHR_gaussian_splatting (Khronos 2026)."""

from pathlib import Path

import numpy as np

from ..core.color import srgb_decode
from .glb import Buffer
from .splats import DEGREE, Splats, sh_basis

NAME = "splats.glb"
EXTENSION = "KHR_gaussian_splatting"
_POINTS = 0


def write(folder: str | Path, splats: Splats) -> list[Path]:
    """Write ``splats``, in a world whose y axis points up, as `NAME` into ``folder`` and return the path, in a list: floats
    throughout, linear scales and opacities, quaternions (x, y, z, w), coefficients of display sRGB. Who does not know the
    extension sees points of the mean colour. A node puts them where their origin is.

    Raises: UserError where the disk is full or the folder can't be written.
    """
    buffer = Buffer()
    indices = {name: buffer.add_array(values, bounds=name == "POSITION") for name, values in _attributes(splats).items()}
    primitive = {
        "mode": _POINTS,
        "attributes": indices,
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    path = Path(folder) / NAME
    buffer.write(path, buffer.document(primitive, [EXTENSION], splats.origin))
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

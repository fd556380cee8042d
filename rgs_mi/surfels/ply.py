"""Surfels as PLY files, in the convention of the 3DGS and 2DGS viewers.

A vertex holds ``x y z nx ny nz f_dc_0..2 f_rest_* opacity scale_0..2 rot_0..3`` as those viewers read it: opacity as a
logit, scales as logarithms, the quaternion as (w, x, y, z), SH channel-major. The material follows in plain values,
under names that viewers ignore: ``base_color_0..2 roughness metallic delta_normal_0..2 curvature_0..2``.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..core.errors import UserError
from ..core.ply_format import names_of, read_vertices, write_vertices

THICKNESS = 1e-3  # of the smaller scale: what a 3DGS viewer, which draws ellipsoids, gets as the third
_TINY = np.finfo(np.float32).tiny
_OPACITY = (1e-7, 1 - 2.0**-24)  # the open interval (0, 1) in float32
_REMEDY = "give a PLY of surfels, from 2DGS, 3DGS or rgs_mi"

# field -> properties in the field's order; the material's with their defaults
_CORE = {
    "centers": ("x", "y", "z"),
    "f_dc": ("f_dc_0", "f_dc_1", "f_dc_2"),
    "opacities": ("opacity",),
    "scales": ("scale_0", "scale_1"),
    "rotations": ("rot_1", "rot_2", "rot_3", "rot_0"),
}
_MATERIAL = {
    "base_color": (("base_color_0", "base_color_1", "base_color_2"), 0.5),
    "roughness": (("roughness",), 0.5),
    "metallic": (("metallic",), 0.0),
    "delta_normal": (("delta_normal_0", "delta_normal_1", "delta_normal_2"), 0.0),
    "curvature": (("curvature_0", "curvature_1", "curvature_2"), 0.0),
}
_SIGNED = ("delta_normal", "curvature")  # the others of the material are in [0, 1]


def write_ply(path: str | Path, fields: dict[str, np.ndarray]) -> None:
    """Write surfels as a binary little-endian PLY; the file appears whole or not at all.

    Args:
      path:   the file; its folder is created if missing
      fields: physical values: centers [N, 3], rotations [N, 4] unit quaternions (x, y, z, w), scales [N, 2] > 0,
              opacities [N, 1] in (0, 1), sh [N, 3*(L+1)^2] coefficient-major (``sh[:, 3*k + c]``), base_color [N, 3],
              roughness [N, 1], metallic [N, 1], delta_normal [N, 3], curvature [N, 3]

    Raises: UserError where the disk is full or the folder can't be written.
    """
    columns = core_columns(fields) | {names: fields[field] for field, (names, _) in _MATERIAL.items()}
    write_columns(path, columns)


def core_columns(fields: dict[str, np.ndarray]) -> dict[tuple[str, ...], np.ndarray]:
    """Return the columns of 3DGS, names -> [N, len(names)], of what `write_ply` takes, without the material."""
    f = {name: np.asarray(fields[name], np.float64) for name in ("centers", "rotations", "scales", "opacities", "sh")}
    sh = f["sh"].reshape(len(f["sh"]), -1, 3)  # [N, K, 3]
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(len(sh), -1)  # [N, 3*(K-1)] channel-major
    x, y, z, w = f["rotations"].T
    normals = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1)
    opacities = np.clip(f["opacities"], *_OPACITY)
    scales = np.maximum(f["scales"], _TINY)
    return {
        ("x", "y", "z"): f["centers"],
        ("nx", "ny", "nz"): normals,
        _CORE["f_dc"]: sh[:, 0],
        tuple(f"f_rest_{i}" for i in range(rest.shape[1])): rest,
        ("opacity",): np.log(opacities) - np.log1p(-opacities),
        ("scale_0", "scale_1", "scale_2"): np.log(np.column_stack([scales, THICKNESS * scales.min(1)])),
        ("rot_0", "rot_1", "rot_2", "rot_3"): np.stack([w, x, y, z], -1),
    }


def write_columns(path: str | Path, columns: dict[tuple[str, ...], np.ndarray], comments: Sequence[str] = ()) -> None:
    """Write ``columns`` as `core_columns` returns them as a PLY, with ``comments`` in its header, whole or not at all.

    Raises: UserError where the disk is full or the folder can't be written.
    """
    table = np.concatenate(list(columns.values()), 1, dtype=np.float32)
    vertices = table.view([(name, "f4") for names in columns for name in names])[:, 0]
    write_vertices(path, vertices, comments)


def read_ply(path: str | Path) -> dict[str, np.ndarray]:
    """Read surfels from a PLY of ours, of 2DGS or of 3DGS (whose third scale is ignored); binary or ASCII, L = 0 to 3.

    Returns the fields of `write_ply`, float32. What the file lacks of the material is base_color 0.5, roughness 0.5,
    metallic 0, delta_normal 0, curvature 0.
    Raises: UserError where the file is missing, damaged, or holds no surfels.
    """
    path = Path(path)
    vertices = _read_vertices(path)
    fields: dict[str, np.ndarray] = {field: _columns(path, vertices, names) for field, names in _CORE.items()}

    count = sum(re.fullmatch(r"f_rest_\d+", name) is not None for name in names_of(vertices))
    if count not in (0, 9, 24, 45):
        raise UserError(
            f"{path}: {count} properties f_rest_*, which is no spherical-harmonics degree from 0 to 3: "
            "expected 0, 9, 24 or 45"
        )
    n, dc = len(vertices), fields.pop("f_dc")
    rest = _columns(path, vertices, [f"f_rest_{i}" for i in range(count)]).reshape(n, 3, -1).transpose(0, 2, 1)
    fields["sh"] = np.concatenate([dc, rest.reshape(n, -1)], 1)

    for field, (names, default) in _MATERIAL.items():
        present = any(name in names_of(vertices) for name in names)
        fields[field] = _columns(path, vertices, names) if present else np.full((n, len(names)), default, np.float32)
        if field not in _SIGNED and not ((fields[field] >= 0) & (fields[field] <= 1)).all():
            raise UserError(f"{path}: '{field}' lies outside [0, 1]: export the file again, with activated values")

    with np.errstate(over="ignore"):
        fields["opacities"] = np.clip(1 / (1 + np.exp(-fields["opacities"].astype(np.float64))), *_OPACITY)
        fields["scales"] = np.maximum(np.exp(fields["scales"].astype(np.float64)), _TINY)
    length = np.linalg.norm(fields["rotations"].astype(np.float64), axis=1, keepdims=True)
    if not length.all():
        raise UserError(f"{path}: 'rot_*' is zero at vertex {length.argmin()}: remove such surfels or export the file again")
    if fields["scales"].max() > np.finfo(np.float32).max:
        raise UserError(
            f"{path}: 'scale_*' is too large at vertex {fields['scales'].max(1).argmax()}: "
            "scales are stored as natural logarithms"
        )
    fields["rotations"] = fields["rotations"] / length
    return {field: np.ascontiguousarray(value, np.float32) for field, value in fields.items()}


def _read_vertices(path):
    """The vertices as a structured array."""
    try:
        return read_vertices(path)
    except OSError as error:
        raise UserError(f"{path}: can't be read ({error.strerror or error}): check the path") from error
    except (ValueError, OverflowError, MemoryError) as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise UserError(f"{path}: not a PLY of surfels, or damaged ({reason}): {_REMEDY}") from error


def _columns(path, vertices, names):
    """[N, len(names)] float32 properties of the vertices."""
    missing = [name for name in names if name not in (vertices.dtype.names or ())]
    if missing:
        raise UserError(f"{path}: vertices have no property '{missing[0]}': {_REMEDY}")
    table = np.empty((len(vertices), len(names)), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        for i, name in enumerate(names):
            table[:, i] = vertices[name]
            if not np.isfinite(table[:, i]).all():
                raise UserError(
                    f"{path}: '{name}' is not finite at vertex {np.isfinite(table[:, i]).argmin()}: "
                    "remove such surfels or export the file again"
                )
    return table

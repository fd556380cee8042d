"""The sparse reconstruction beside the photographs: a PLY point cloud, or COLMAP's points3D in text or binary."""

import io
import os
import struct
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..core.color import srgb_decode
from ..core.errors import UserError
from ..core.inputs import opened, read_file
from ..core.ply_format import names_of, read_vertices

FILES = (
    "points3d.ply",
    "points3D.ply",
    "points.ply",
    "sparse/0/points3D.ply",
    "sparse/0/points3D.bin",
    "sparse/0/points3D.txt",
    "sparse/points3D.bin",
    "sparse/points3D.txt",
    "points3D.bin",
    "points3D.txt",
)
FARTHEST = 1e8  # as for cameras: earth-centred ones have 1e7. Beyond is damage, or an outlier that no photograph shows
_COLMAP_POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])
_COLMAP_TRACK_ITEM = 8  # bytes: int32 image, int32 keypoint


def sparse_points(root: str | Path, files: Sequence[str] = FILES) -> tuple[np.ndarray, np.ndarray | None] | None:
    """Read the points of the first of ``files`` that folder ``root`` has, in the file's own world frame.

    Returns: positions [N, 3] float32, N > 0; linear colours [N, 3] float32 in [0, 1], decoded from sRGB, or None where the
    file has none. None without a file.
    Raises: UserError where the file is damaged or empty, a coordinate is not finite or beyond `FARTHEST`, or a colour
    lies outside its range.
    """
    path = next((Path(root) / name for name in files if os.path.isfile(Path(root) / name)), None)
    if path is None:
        return None
    read = {".bin": _read_colmap_binary, ".txt": _read_colmap_text}.get(path.suffix, _read_ply)
    try:
        positions, encoded = read(path)
        _check(positions, encoded)
    except (OSError, ValueError, OverflowError, MemoryError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())[:200] or type(error).__name__
        raise UserError(
            f"{path} cannot be used as a point cloud ({reason}): export it again, or remove it to start without one"
        ) from error
    return positions.astype(np.float32), None if encoded is None else srgb_decode(encoded).astype(np.float32)


# The readers return positions [N, 3] and sRGB-encoded colours [N, 3] (or None), both float64, of whatever the file says;
# they, and `_check`, raise a ValueError whose message is the reason alone.


def _check(positions, encoded):
    if not len(positions):
        raise ValueError("it holds no points")
    near = (np.abs(positions) <= FARTHEST).all(1)  # False for NaN
    if not near.all():
        raise ValueError(f"point {near.argmin()} has a coordinate that is not finite or beyond {FARTHEST:g}")
    if encoded is not None and not (good := ((encoded >= 0) & (encoded <= 1)).all(1)).all():
        raise ValueError(f"the colour of point {good.argmin()} lies outside 0..255 for integers or 0..1 for floats")


# ---- PLY ----


def _read_ply(path):
    """``x y z`` and, if all three are there, ``red green blue`` of the vertices; ASCII or binary of either order."""
    vertices = read_vertices(path)

    def columns(*names):
        with np.errstate(invalid="ignore"):  # signalling NaN
            return np.stack([vertices[name].astype(np.float64) for name in names], -1)

    if missing := {"x", "y", "z"} - set(names_of(vertices)):
        raise ValueError(f"its vertices have no property '{min(missing)}'")
    if not {"red", "green", "blue"} <= set(names_of(vertices)):
        return columns("x", "y", "z"), None
    scale = [1.0 if vertices.dtype[name].kind == "f" else 255.0 for name in ("red", "green", "blue")]
    return columns("x", "y", "z"), columns("red", "green", "blue") / scale


# ---- COLMAP ----


def _read_colmap_text(path):
    """``POINT3D_ID X Y Z R G B ERROR TRACK...`` in each line but comments (#)."""
    with opened(path) as stream, io.TextIOWrapper(stream, "utf-8") as text, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "loadtxt: input contained no data")
        table = np.loadtxt(text, usecols=range(1, 7), ndmin=2)
    return table[:, :3], table[:, 3:] / 255


def _read_colmap_binary(path):
    """A uint64 count, then as many `_COLMAP_POINT`, each followed by its track."""
    content = read_file(path)
    size, at = len(content), 8
    count = int.from_bytes(content[:at], "little")
    if count > (size - at) // _COLMAP_POINT.itemsize:
        raise ValueError(f"it declares {count} points in {size} bytes")
    fixed = bytearray()
    for index in range(count):
        end = at + _COLMAP_POINT.itemsize
        if end > size:
            raise ValueError(f"it ends within point {index} of {count}")
        fixed += content[at:end]
        at = end + _COLMAP_TRACK_ITEM * struct.unpack_from("<Q", content, end - 8)[0]
    if at != size:
        raise ValueError(f"its {count} points take {at} bytes, the file has {size}")
    points = np.frombuffer(fixed, _COLMAP_POINT)
    return points["xyz"], points["rgb"] / 255

"""The layout of NeRO's Glossy Synthetic (Liu et al. 2023): ``N-camera.pkl``, ``N.png`` and ``N-depth.png`` in one folder.

A camera is a pickle (`unpickle`) of a world-to-camera matrix [3, 4] (x right, y down, z forward: `Camera`'s own
convention) and the intrinsics K [3, 3] in pixels of the image. The photographs have no alpha; the mask is where the 16-bit
depth, 15 units at its largest value, is below 14.5. ``synthetic_split_128.pkl``, in the folder or the one above, lists
the numbers of the test views; without it every eighth view is held out. The points in ``eval_pts.ply`` are the truth that
reconstructions are measured with, test views' depths, so they are not read.
"""

import os
import warnings
from functools import partial
from pathlib import Path

import numpy as np

from ..core import unpickle
from ..core.errors import UserError
from ..core.inputs import CAMERA as CAMERA_FILE
from .frames import Frame, every_eighth, load_split, pinhole, rigid
from .images import read_grey
from .points import sparse_points
from .resolution import LONGEST
from .transforms import find_image
from .types import Dataset

CAMERA, DEPTH, SPLIT = "-camera.pkl", "-depth.png", "synthetic_split_128.pkl"
LOOKED_FOR = f"*{CAMERA} (NeRO)"
PHOTOGRAPHED = False  # NeRO's photographs have a path-traced sibling in the same layout
_DEPTH_RANGE, _BACKGROUND = 15.0, 14.5
_REMEDY = "a camera is a pickle of a rigid world-to-camera matrix [3, 4] and K [3, 3]"


def found(root: Path) -> bool:
    """Return whether folder ``root`` has this layout."""
    return any(root.glob(f"?*{CAMERA}"))


def load(root: Path, longest: int = LONGEST) -> Dataset:
    """Load a capture, photographs of more than ``longest`` pixels along a side scaled. Frames without an image file and views
    with an empty mask are left out, each kind with one warning.

    Raises: UserError for anything in the folder that cannot be used, naming the file.
    """
    files = sorted(root.glob(f"?*{CAMERA}"), key=lambda file: (len(file.name), file.name))  # 2 before 10
    frames = [_frame(file) for file in files]
    points, colors = sparse_points(root) or (None, None)
    return Dataset(
        *load_split(root, frames, _held_out(root, [frame.name for frame in frames]), longest),
        points=points,
        point_colors=colors,
        root=root,
        photographed=PHOTOGRAPHED,
    )


def _frame(file: Path) -> Frame:
    name, where = file.name.removesuffix(CAMERA), str(file)
    image, depth = find_image(file.with_name(name)), file.with_name(name + DEPTH)
    try:
        pose, intrinsics = map(_numbers, unpickle.load(file, CAMERA_FILE))
        ((fx, skew, cx), (zero, fy, cy), last), moved = intrinsics, np.vstack([pose, [0, 0, 0, 1]])
        if not abs(skew) <= 1e-6 * abs(fx) or zero or tuple(last) != (0, 0, 1) or moved.shape != (4, 4):
            raise ValueError
    except (TypeError, ValueError) as error:
        raise UserError(f"{where} holds no camera: {_REMEDY}") from error
    to_world = np.linalg.inv(rigid(moved, where, _REMEDY))
    return Frame(
        where,
        name,
        image or file.with_name(f"{name}.png"),
        lambda size: pinhole(to_world, (fx, fy), (cx, cy), size, size, where),
        mask=partial(_mask, depth, where) if os.path.isfile(depth) else None,
        missing=image is None,
    )


def _numbers(value) -> np.ndarray:
    """A matrix [rows, columns] of three or four each. Raises: ValueError for anything else, before it is looked at closely:
    lists in a pickle may be nested without end."""
    if isinstance(value, list) and all(
        isinstance(row, list) and all(isinstance(x, int | float) for x in row) for row in value
    ):
        value = np.array(value, np.float64)
    if not isinstance(value, np.ndarray) or value.shape not in ((3, 4), (3, 3)):
        raise ValueError
    return value.astype(np.float64)


def _mask(depth: Path, where: str) -> np.ndarray:
    return (_DEPTH_RANGE * read_grey(depth, where) < _BACKGROUND).astype(np.float32)


def _held_out(root: Path, names: list[str]) -> set[str]:
    """The names of test views: those of the split file that are there, else every eighth."""
    file = next((folder / SPLIT for folder in (root, root.absolute().parent) if (folder / SPLIT).is_file()), None)
    if file is None:
        return every_eighth(names)
    try:
        test, _ = unpickle.load(file, CAMERA_FILE)
        if not all(isinstance(name, str | int | np.integer) for name in test):
            raise ValueError
        listed = {str(name) for name in test} & set(names)
    except (TypeError, ValueError) as error:
        raise UserError(f"{file} holds no lists of test and training views: get it again, or remove it") from error
    if not listed:
        warnings.warn(f"{file} lists none of these views: every eighth is held out", stacklevel=4)
    return listed or every_eighth(names)

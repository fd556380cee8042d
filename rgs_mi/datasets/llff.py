"""The layout of LLFF (Mildenhall et al. 2019): ``poses_bounds.npy`` beside a folder ``images``.

The array [N, 17] has a row for each photograph in the order of their names: a matrix [3, 5], row by row, whose columns are
the camera's down, right and backward axes, its position, and (height, width, focal length) in pixels of ``images``; then
the nearest and the farthest depth, which are not read. The principal point is the centre.
``images_2``, ``images_4`` … are smaller copies (`resolution.chosen`), in the same order whatever they are called. ``masks``
may hold a grey image of a photograph's name, of any type, white where the object is. Every eighth photograph is held out. A
sparse point cloud (`points.FILES`) may stand beside the poses, in the same world frame.
"""

import warnings
from functools import partial
from pathlib import Path
from tokenize import TokenError

import numpy as np

from ..core.errors import UserError
from ..core.inputs import check_file
from .frames import Frame, every_eighth, load_split, pinhole, rigid
from .images import EXTENSIONS, read_grey
from .points import sparse_points
from .resolution import LONGEST, chosen
from .transforms import find_image
from .types import Dataset

FILE, COLUMNS = "poses_bounds.npy", 17
LOOKED_FOR = f"{FILE} (LLFF)"
PHOTOGRAPHED = True
_REMEDY = "a row is a 3 x 5 matrix of a rigid pose and (height, width, focal length), then two depths"


def found(root: Path) -> bool:
    """Return whether folder ``root`` has this layout."""
    return (root / FILE).is_file()


def load(root: Path, longest: int = LONGEST) -> Dataset:
    """Load a capture, photographs of more than ``longest`` pixels along a side scaled. Views with an empty mask are left out,
    with one warning.

    Raises: UserError for anything in the folder that cannot be used, naming the file.
    """
    file = root / FILE
    table = _read(file)
    folder = chosen(root / "images", table[:, [4, 9]].max(), longest)
    paths = sorted(path for path in folder.glob("*") if path.suffix.lower() in EXTENSIONS)
    if len(paths) != len(table):
        raise UserError(
            f"{file} has {len(table)} rows and {folder} {len(paths)} photographs: a row is one of them, in the order of "
            "their names: put back what is missing, and remove what is not of the capture"
        )
    frames = [_frame(row, path, file, root / "masks") for row, path in zip(table, paths)]
    if (bare := [frame for frame in frames if not frame.mask]) and (root / "masks").is_dir():
        warnings.warn(
            f"{root / 'masks'}: {len(bare)} of {len(frames)} photographs have no mask (first: {bare[0].name})", stacklevel=3
        )
    points, colors = sparse_points(root) or (None, None)
    return Dataset(
        *load_split(file, frames, every_eighth([frame.name for frame in frames]), longest),
        points=points,
        point_colors=colors,
        root=root,
        photographed=PHOTOGRAPHED,
    )


def _read(file: Path) -> np.ndarray:
    """[N, 17] float64, N > 0; memory is taken for what the file holds, not for what its header promises."""
    try:
        check_file(file)
        table = np.lib.format.open_memmap(file, mode="r")
        if table.ndim != 2 or table.shape[1] != COLUMNS or not len(table) or table.dtype.kind not in "fiu":
            raise ValueError(f"it holds {table.dtype} {list(table.shape)}, not numbers [N, {COLUMNS}]")
        with np.errstate(over="ignore", invalid="ignore"):
            return np.array(table, np.float64)
    except (OSError, ValueError, OverflowError, MemoryError, SyntaxError, TokenError, TypeError) as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise UserError(f"{file} cannot be used as LLFF's poses ({reason}): export it again") from error


def _frame(row: np.ndarray, path: Path, file: Path, masks: Path) -> Frame:
    where, matrix = f"{file}: the row of {path.name!r}", row[:15].reshape(3, 5)
    (down, right, back, origin), (height, width, focal) = matrix[:, :4].T, matrix[:, 4].tolist()
    pose = np.vstack([np.stack([right, down, -back, origin], 1), [0, 0, 0, 1]])
    to_world, mask = rigid(pose, where, _REMEDY), find_image(masks / path.stem)
    return Frame(
        where,
        path.stem,
        path,
        lambda size: pinhole(to_world, (focal, focal), (width / 2, height / 2), (width, height), size, where),
        mask=partial(read_grey, mask, where) if mask else None,
    )

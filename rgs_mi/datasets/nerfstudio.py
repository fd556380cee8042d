"""The layout of nerfstudio and instant-ngp: one ``transforms.json`` (`transforms.py`) beside folders of images.

``mask_path`` of a frame is a grey image, white where the object is. ``images_2``, ``images_4`` … beside the folder
``images`` that frames name are smaller copies (`resolution.chosen`). Held out are the files in ``test_filenames``, else
those in ``val_filenames``, else every eighth by name; ``train_filenames``, where given, says which of the others are
trained with.

Points. ``applied_transform`` [3, 4] and ``applied_scale`` took the original reconstruction to the frame of the poses in
the file, which stays the world's. ``ply_file_path`` is in that frame already; COLMAP's points in ``colmap/sparse/0``, used
where no PLY is named, are not, and are taken there (by nerfstudio's exchange of axes where the file tells no transform,
as it did before the field existed). Else a cloud of `points.FILES` counts, in the frame of the poses.
"""

import os
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from ..core.errors import UserError
from .frames import Frame, every_eighth, load_split
from .images import read_grey
from .points import FARTHEST, FILES, sparse_points
from .resolution import LONGEST, chosen
from .transforms import frame_of, matrix, number, read_json
from .types import Dataset

FILE = "transforms.json"
LOOKED_FOR = f"{FILE} (nerfstudio)"
PHOTOGRAPHED = True
COLMAP_POINTS = ("colmap/sparse/0/points3D.bin", "colmap/sparse/0/points3D.txt")
_EXCHANGE = [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]


def found(root: Path) -> bool:
    """Whether folder ``root`` has this layout."""
    return (root / FILE).is_file()


def load(root: Path, longest: int = LONGEST) -> Dataset:
    """Load a capture, photographs of more than ``longest`` pixels along a side scaled. Frames without an image file and views
    with an empty mask are left out, each kind with one warning.

    Raises: UserError for anything in the folder that cannot be used, naming the file and the frame.
    """
    file = root / FILE
    meta = read_json(file)
    frames = [_frame(file, meta, index, longest) for index in range(len(meta["frames"]))]
    kept, held_out = _split(file, meta, frames)
    points, colors = _points(file, meta) or (None, None)
    views = load_split(file, kept, held_out, longest)
    return Dataset(*views, points=points, point_colors=colors, root=root, photographed=PHOTOGRAPHED)


def _frame(file: Path, meta: dict, index: int, longest: int) -> Frame:
    where, entry = f"{file}: frame {index}", meta["frames"][index]
    size = [number(meta, entry, key, 0, (0, 1e6), "pixels", where) for key in ("w", "h")]
    frame = frame_of(file, meta, index, smaller=lambda path: chosen(path.parent, max(size), longest) / path.name)
    mask = entry.get("mask_path")
    if mask is None:
        return frame
    if not isinstance(mask, str):
        raise UserError(f'{where}: "mask_path" is not a file name')
    return replace(frame, mask=partial(read_grey, file.parent / mask, where))


def _split(file: Path, meta: dict, frames: list[Frame]) -> tuple[list[Frame], set[str]]:
    """The frames that are used, and the names of those held out."""
    listed = {}
    for split in ("train", "test", "val"):
        names = meta.get(f"{split}_filenames")
        if names is None:
            continue
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise UserError(f'{file}: "{split}_filenames" is not a list of file names')
        listed[split] = {os.path.normpath(name) for name in names}
    if not listed:
        return frames, every_eighth(sorted(frame.name for frame in frames))
    entries = dict(zip((os.path.normpath(entry["file_path"]) for entry in meta["frames"]), frames))
    if unknown := set().union(*listed.values()) - entries.keys():
        raise UserError(f"{file}: {min(unknown)!r} in the lists of file names is no frame's file_path: export it again")
    test = listed.get("test") or listed.get("val") or set()
    train = listed.get("train") or entries.keys() - set().union(*listed.values())
    return (
        [frame for name, frame in entries.items() if name in train or name in test],
        {entries[name].name for name in test},
    )


def _points(file: Path, meta: dict):
    """`sparse_points` in the frame of the poses."""
    root, named = file.parent, meta.get("ply_file_path")
    if named is not None:
        if not isinstance(named, str):
            raise UserError(f'{file}: "ply_file_path" is not a file name')
        if not os.path.isfile(root / named):
            warnings.warn(f"{file}: its ply_file_path {named!r} is not there: the sparse points are not used", stacklevel=4)
        return sparse_points(root, [named])
    if (cloud := sparse_points(root, COLMAP_POINTS)) is None:
        return sparse_points(root, FILES)
    where, remedy = f'{file}: "applied_transform"', "it must hold 3 rows of 4 numbers: export it again"
    transform = matrix(meta.get("applied_transform", _EXCHANGE), where, remedy)[:3]
    if transform.shape != (3, 4) or not (np.abs(transform) <= FARTHEST).all():  # False for NaN
        raise UserError(f"{where}: {remedy}")
    scale = number(meta, {}, "applied_scale", 1.0, (0, FARTHEST), "the scale", str(file))
    positions = scale * (cloud[0] @ transform[:, :3].T + transform[:, 3])
    if not (np.abs(positions) <= FARTHEST).all():
        raise UserError(f"{where}: it moves points beyond {FARTHEST:g}: export it again")
    return positions.astype(np.float32), cloud[1]

"""The layout of NeRF Synthetic and Shiny Blender: ``transforms_{train,test}.json`` beside folders of images.

The files are `transforms.py`'s; ``transforms_val.json`` is not read. Beside an image ``r_0`` may stand ``r_0_alpha.png``,
its mask where it has no alpha of its own, and ``r_0_normal.png`` or ``r_0_normal_0001.png`` (`images.read_normal`), which
only test views look at; depths and disparities are not. A sparse point cloud (`points.FILES`) may stand beside the
transforms, in the same world frame.
"""

import os
from dataclasses import replace
from functools import partial
from pathlib import Path

from ..core.errors import UserError
from ..core.film import GAUSSIAN
from ..core.inputs import is_file
from .frames import Frame, load_views
from .images import read_grey
from .path_traced import MANIFEST
from .points import sparse_points
from .resolution import LONGEST
from .transforms import frame_of, image_stem, read_json
from .types import Dataset

TRAIN, TEST = "transforms_train.json", "transforms_test.json"
LOOKED_FOR = f"{TRAIN} (Blender)"
PHOTOGRAPHED = False


def found(root: Path) -> bool:
    """Return whether folder ``root`` has this layout."""
    return (root / TRAIN).is_file()


def load(root: Path, longest: int = LONGEST) -> Dataset:
    """Load a capture, photographs of more than ``longest`` pixels along a side scaled; without ``transforms_test.json``
    nothing is held out.

    Frames without an image file and views with an empty mask are left out, each kind with one warning per split.
    Raises: UserError for anything in the folder that cannot be used, naming the file and the frame.
    """
    root = Path(root)
    if not root.is_dir():
        raise UserError(f"data folder '{root}' does not exist: give a capture's folder with --data")
    points, colors = sparse_points(root) or (None, None)
    splits = {"train": load_views(root / TRAIN, _frames(root / TRAIN, ()), longest), "test": []}
    if (root / TEST).is_file():
        splits["test"] = load_views(root / TEST, _frames(root / TEST, ("_normal.png", "_normal_0001.png")), longest)
    scaled = any(view.scaled_from for views in splits.values() for view in views)
    rfilter = GAUSSIAN if is_file(root / MANIFEST) and not scaled else 0.0
    return Dataset(**splits, points=points, point_colors=colors, root=root, photographed=PHOTOGRAPHED, rfilter=rfilter)


def _frames(file: Path, normals: tuple[str, ...]) -> list[Frame]:
    """The frames of one transforms file with the images' companions, of which ``normals`` are the endings looked for."""
    meta, frames = read_json(file), []
    for index in range(len(meta["frames"])):
        frame = frame_of(file, meta, index)
        stem = image_stem(frame.path)
        companion = lambda *ends: next((path for end in ends if os.path.isfile(path := Path(f"{stem}{end}"))), None)
        alpha = companion("_alpha.png")
        mask = partial(read_grey, alpha, frame.where) if alpha else None
        frames.append(replace(frame, mask=mask, normal=companion(*normals)))
    return frames

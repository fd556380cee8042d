"""The layout of COLMAP: a sparse model (`colmap_files`) in one of `FOLDERS` and photographs in ``images``.

``images_2``, ``images_4`` … beside it are smaller copies (`resolution.chosen`), of the same names, or of another type, or,
as LLFF has it, called image000.png … in the order of the photographs' names.
``masks`` may hold ``NAME.png`` or, as COLMAP has it, ``NAME.jpg.png`` for a photograph NAME.jpg: grey, white where the
object is. Every eighth photograph by name is held out. The sparse points are the model's own.
"""

import os
import warnings
from functools import partial
from pathlib import Path

import numpy as np

from ..core.errors import UserError
from .colmap_files import Image, read_model
from .frames import Frame, every_eighth, load_split, pinhole, rigid
from .images import read_grey
from .points import sparse_points
from .resolution import LONGEST, chosen
from .transforms import find_image, image_stem
from .types import Dataset

FOLDERS = ("sparse/0", "sparse", ".", "colmap/sparse/0")
LOOKED_FOR = f"cameras and images (.bin or .txt) in {', '.join(FOLDERS)} (COLMAP)"
PHOTOGRAPHED = True
_REMEDY = "COLMAP's pose must be a rotation and a near translation"


def found(root: Path) -> bool:
    """Return whether folder ``root`` has this layout."""
    return _model(root) is not None


def load(root: Path, longest: int = LONGEST) -> Dataset:
    """Load a capture, photographs of more than ``longest`` pixels along a side scaled. Photographs that are not there and
    views with an empty mask are left out, each kind with one warning. Raises: UserError for anything in the folder that
    cannot be used, naming the file."""
    files = _model(root)
    assert files is not None, "found() says that they are there"
    model, suffix = files
    images = read_model(root / model, suffix)
    source = root / model / f"images{suffix}"
    folder = chosen(root / "images", max(max(image.lens.size) for image in images), longest)
    if not folder.is_dir():
        raise UserError(f"{root}: there is no folder 'images' for the photographs that {source} names: add it")
    paths = _paths([image.name for image in images], root / "images", folder)
    frames = [_frame(image, source, paths[image.name] or folder / image.name, root / "masks") for image in images]
    if (bare := [frame for frame in frames if not frame.mask]) and (root / "masks").is_dir():
        warnings.warn(
            f"{root / 'masks'}: {len(bare)} of {len(frames)} photographs have no mask (first: {bare[0].name})", stacklevel=3
        )
    points, colors = sparse_points(root, [f"{model}/points3D{e}" for e in (".bin", ".txt", ".ply")]) or (None, None)
    return Dataset(
        *load_split(source, frames, every_eighth(sorted(frame.name for frame in frames)), longest),
        points=points,
        point_colors=colors,
        root=root,
        photographed=PHOTOGRAPHED,
    )


def _model(root: Path) -> tuple[str, str] | None:
    """The folder and the suffix of the model's files, None where there is none."""
    return next(
        (
            (model, suffix)
            for model in FOLDERS
            for suffix in (".bin", ".txt")
            if all(os.path.isfile(root / model / (name + suffix)) for name in ("cameras", "images"))
        ),
        None,
    )


def _paths(names: list[str], originals: Path, copies: Path) -> dict[str, Path | None]:
    """name -> its file in the folder ``copies``, None where there is none."""
    paths = {name: find_image(copies / name) or find_image(copies / image_stem(Path(name))) for name in names}
    if originals.is_dir() and not any(paths.values()):
        order = [sorted(os.listdir(folder)) for folder in (originals, copies)]
        if len(order[0]) == len(order[1]):
            paths |= {name: find_image(copies / copy) for name, copy in zip(*order) if name in paths}
    return paths


def _frame(image: Image, source: Path, path: Path, masks: Path) -> Frame:
    where, lens = f"{source}: image {image.name!r}", image.lens
    if not image.name.strip("./") or not image.name.isprintable():
        raise UserError(f"{where} has no file name: export the model again")
    to_world = np.linalg.inv(rigid(image.to_camera, where, _REMEDY))
    stem = image_stem(Path(image.name))
    mask = next((m for m in (masks / f"{stem}.png", masks / f"{image.name}.png") if os.path.isfile(m)), None)
    return Frame(
        where,
        "_".join(part for part in stem.parts if part.strip("./")),
        path,
        lambda size: pinhole(to_world, lens.focal, lens.principal, lens.size, size, where),
        lens.distortion,
        mask=partial(read_grey, mask, where) if mask else None,
        missing=not os.path.isfile(path),
    )

"""Photographs and their cameras: a folder in, lists of `View` out."""

import os
import sys
from pathlib import Path

from ..core.errors import UserError
from . import blender, colmap, llff, nerfstudio, nero
from .resolution import LONGEST
from .types import Dataset
from .world_frame import recentred

_LAYOUTS = blender, nerfstudio, colmap, llff, nero  # the first that fits is the one


def load_dataset(root: str | Path, longest: int = LONGEST, quiet: bool = True) -> Dataset:
    """Load the capture in folder ``root``, in the first layout that it has: `blender`, `nerfstudio`, `colmap`, `llff`, `nero`.

    World and cameras stay as in the files, but for a world whose origin is far away (`world_frame.recentred`). Photographs of
    lenses with distortion are made those of pinholes (`distortion.undistorted`, which keeps them). Those of more than
    ``longest`` pixels along a side are scaled to it, with masks and cameras. Unless ``quiet``, a line on stderr says how many,
    and another where the origin is.
    Raises: UserError when the folder is missing, has no known layout, or when a file in it is bad.
    """
    root = Path(root)
    if not os.path.isdir(root):  # unlike Path's it answers False to names that no file system takes
        raise UserError(f"data folder '{root}' does not exist: give a capture's folder with --data")
    layout = _layout(root)
    if layout is None:
        raise UserError(f"data folder '{root}' has no layout that is known: looked for {looked_for()}")
    dataset = recentred(layout.load(root, longest))
    if not quiet:
        _tell_scaled(dataset, longest)
        if any(dataset.origin):
            words = ", ".join(f"{x:.9g}" for x in dataset.origin)
            print(f"{root} is far from the origin of its world: that is moved to ({words})", file=sys.stderr)
    return dataset


def _layout(root):
    """The first layout that the folder ``root`` has, or None."""
    return next((layout for layout in _LAYOUTS if layout.found(root)), None)


def _tell_scaled(dataset, longest):
    views = [*dataset.train, *dataset.test]
    if scaled := [view.scaled_from for view in views if view.scaled_from]:
        width, height = scaled[0]
        print(
            f"{dataset.root}: {len(scaled)} of {len(views)} photographs are scaled to {longest} pixels along their longer side "
            f"(the first from {width} x {height})",
            file=sys.stderr,
        )


def is_capture(root: Path) -> bool:
    """Return whether ``root`` is a folder with one of the layouts of `load_dataset`; what is in its files is not asked."""
    return os.path.isdir(root) and _layout(root) is not None


def is_photographed(root: Path) -> bool:
    """Return whether ``root`` is a folder whose layout is one of photographs (`Dataset.photographed`); its files are not
    read."""
    layout = _layout(root) if os.path.isdir(root) else None
    return layout is not None and layout.PHOTOGRAPHED


def looked_for() -> str:
    """Return the files that tell a capture, in words."""
    return "; ".join(layout.LOOKED_FOR for layout in _LAYOUTS)

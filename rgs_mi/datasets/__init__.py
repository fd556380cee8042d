"""Photographs and their cameras: a folder in, lists of `View` out."""

from pathlib import Path

from ..core.errors import UserError
from . import blender, colmap, nerfstudio, nero
from .types import Dataset

_LAYOUTS = blender, nerfstudio, colmap, nero  # the first that fits is the one


def load_dataset(root: str | Path) -> Dataset:
    """Load the capture in folder ``root``, in the first layout that it has: `blender`, `nerfstudio`, `colmap`, `nero`.

    World and cameras stay as in the files. Photographs of lenses with distortion are made those of pinholes
    (`distortion.undistorted`, which keeps them).
    Raises: UserError when the folder is missing, has no known layout, or when a file in it is bad.
    """
    root = Path(root)
    if not root.is_dir():
        raise UserError(f"data folder '{root}' does not exist: give a capture's folder with --data")
    for layout in _LAYOUTS:
        if layout.found(root):
            return layout.load(root)
    raise UserError(f"data folder '{root}' has no layout that is known: looked for {looked_for()}")


def is_capture(root: Path) -> bool:
    """Return whether ``root`` is a folder with one of the layouts of `load_dataset`; what is in its files is not asked."""
    return root.is_dir() and any(layout.found(root) for layout in _LAYOUTS)


def looked_for() -> str:
    """Return the files that tell a capture, in words."""
    return "; ".join(layout.LOOKED_FOR for layout in _LAYOUTS)

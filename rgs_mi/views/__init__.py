"""Photographs and their cameras: a folder in, lists of `View` out."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..camera import Camera
from ..errors import UserError


@dataclass(frozen=True)
class View:
    """One photograph.

    Attributes
      name:   file stem, unique within its split
      camera: its pinhole camera
      pixels: [H, W, 4] RGBA with straight (not premultiplied) alpha. uint8: sRGB-encoded; float32: linear radiance
              (HDR). Alpha is 255 or 1 everywhere when the photograph has none.
      masked: whether the photograph came with an alpha channel or mask
      normal: [H, W, 3] float32 unit normals in world space (0 where there is none), or None
      path:   the image file
    """

    name: str
    camera: Camera
    pixels: np.ndarray
    masked: bool
    normal: np.ndarray | None
    path: Path

    @property
    def alpha(self) -> np.ndarray:
        """[H, W] float32 coverage in [0, 1]."""
        alpha = self.pixels[..., 3]
        return alpha / np.float32(255) if alpha.dtype == np.uint8 else alpha


@dataclass(frozen=True)
class Dataset:
    """A capture. ``train`` is fitted, ``test`` is held out (and only ever looked at); ``points`` are [N, 3] positions
    and ``point_colors`` [N, 3] linear colours of a sparse reconstruction where the layout has one."""

    train: list[View]
    test: list[View]
    points: np.ndarray | None = None
    point_colors: np.ndarray | None = None
    root: Path = field(default_factory=Path)


def load_dataset(root: Path) -> Dataset:
    """Load the capture in folder ``root``, in the first layout that it has: `blender`, `nerfstudio`, `colmap`, `nero`.

    World and cameras stay as in the files. Photographs of lenses with distortion are made those of pinholes
    (`distortion.undistorted`, which keeps them below the current folder).
    Raises: UserError when the folder is missing, has no known layout, or when a file in it is bad.
    """
    root = Path(root)
    if not root.is_dir():
        raise UserError(f"data folder '{root}' does not exist: give a capture's folder with --data")
    for layout in _layouts():
        if layout.found(root):
            return layout.load(root)
    raise UserError(f"data folder '{root}' has no layout that is known: looked for {looked_for()}")


def is_capture(root: Path) -> bool:
    """Whether ``root`` is a folder with one of the layouts of `load_dataset`; what is in its files is not asked."""
    return root.is_dir() and any(layout.found(root) for layout in _layouts())


def looked_for() -> str:
    """The files that tell a capture, in words."""
    return "; ".join(layout.LOOKED_FOR for layout in _layouts())


def _layouts():
    from . import blender, colmap, nerfstudio, nero

    return blender, nerfstudio, colmap, nero

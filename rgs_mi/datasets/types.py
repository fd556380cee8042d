"""The types of a capture: photographs with their cameras, and what is known of their depths."""

import hashlib
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from ..core.camera import Camera


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
      scaled_from: (width, height) of the file where the photograph was scaled when read, else None
    """

    name: str
    camera: Camera
    pixels: np.ndarray
    masked: bool
    normal: np.ndarray | None
    path: Path
    scaled_from: tuple[int, int] | None = None

    @property
    def alpha(self) -> np.ndarray:
        """The coverage in [0, 1], [H, W] float32."""
        alpha = self.pixels[..., 3]
        return alpha / np.float32(255) if alpha.dtype == np.uint8 else alpha


@dataclass(frozen=True)
class Dataset:
    """A capture in the folder ``root``. ``train`` is fitted, ``test`` is held out (and only ever looked at); ``points`` are
    world-space positions [N, 3] and ``point_colors`` linear colours [N, 3] of a sparse reconstruction where the layout has
    one. ``photographed`` says whether the images are photographs, whose cameras and exposures someone has estimated, or
    path-traced ones, whose are known; ``rfilter`` by a Gaussian of which standard deviation, in pixels, their film has filtered
    them (0: by a box of one pixel, or nobody knows). ``origin`` is where the world's origin lies in the world of the files
    (`world_frame.recentred`)."""

    train: list[View]
    test: list[View]
    points: np.ndarray | None = None
    point_colors: np.ndarray | None = None
    root: Path = field(default_factory=Path)
    photographed: bool = False
    rfilter: float = 0.0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @cached_property
    def digest(self) -> str:
        """What tells these photographs from all others: a hash of the names, pixels and cameras of all views. Cameras count to
        four decimals, because processors round their last bits in different ways."""
        digest = hashlib.sha256()
        for kind, views in (("train", self.train), ("test", self.test)):
            for view in views:
                camera = view.camera
                numbers = np.concatenate([np.ravel(camera.to_world), camera.focal, camera.principal])
                digest.update(repr((kind, view.name, view.pixels.shape, (np.round(numbers, 4) + 0.0).tolist())).encode())
                digest.update(np.ascontiguousarray(view.pixels).data)
        return digest.hexdigest()


@dataclass(frozen=True)
class DepthPrior:
    """The depth of one view as a prior knows it, up to a scale and a shift of its own.

    Attributes
      values:     [H, W] float32 at the photograph's size, NaN where unknown: z-depth along the viewing axis, or its inverse.
                  Their unit is the prior's: only the shape of the map counts (docs/method.md §4)
      inverse:    whether they are inverse depths, larger where nearer
      confidence: [H, W] float32, larger where surer, 0 where unknown; in the prior's own unit. None: not told
    """

    values: np.ndarray
    inverse: bool = False
    confidence: np.ndarray | None = None

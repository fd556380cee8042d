"""The photographs as a fit looks at them: levels of a pyramid, windows around the object."""

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage
from skimage.transform import downscale_local_mean

from ..core.arrays import as_float, as_half
from ..core.camera import Camera
from ..core.color import display
from .frames import MOST_KEPT
from .images import resize
from .rims import without_rim
from .types import DepthPrior, View

MOST_SAMPLES = 320_000  # that a step looks at: of larger windows one tile at a time, for more steps and less memory
_CROP_MARGIN = 8  # pixels of background around the object that training looks at


@dataclass(frozen=True)
class Photograph:
    """One photograph, or a tile of the window of it around the object, with one entry per pixel.

    camera   that of the tile
    color    display values over what lies behind
    alpha    coverage
    behind   display values of what lies behind the object
    prior    depth up to scale and shift, NaN where unknown; or None
    inverse  whether the prior is one of inverse depth
    size     (width, height) of the whole photograph
    window   that of the window
    """

    camera: Camera
    color: "mi.Color3f"
    alpha: "mi.Float"
    behind: "mi.Color3f"
    prior: "mi.Float | None"
    inverse: bool
    size: tuple[int, int]
    window: tuple[int, int]

    @property
    def part(self) -> float:
        """The part of the window's pixels that the tile has."""
        return float(np.prod(self.camera.size) / np.prod(self.window))

    @property
    def of_image(self) -> float:
        """The part of the photograph's pixels that the window has."""
        return float(np.prod(self.window) / np.prod(self.size))


class Photographs:
    """The training photographs of one pyramid level as the losses want them: display space, over the background, and
    cropped to windows of one size that hold the object in every view (one size, since each needs its own kernels), or, of
    windows of more than `MOST_SAMPLES`, to tiles of one size.

    ``downscale`` is how many pixels of a view's side make one of the level's; ``background`` a display value; ``priors`` has
    one entry per view. Masks are too large by ``rim`` pixels of a view (`rims`). Where they may be wrong, within ``tolerance``
    pixels of a view from their borders, the photograph itself is what lies behind: a surface that looks different does not
    belong there, and transparency costs nothing.
    """

    def __init__(
        self,
        views: Sequence[View],
        downscale: int,
        background: float,
        priors: Sequence[DepthPrior] | None = None,
        tolerance: int = 0,
        rim: int | None = None,
    ) -> None:
        self.views, self.downscale, self.background, self.priors = views, downscale, background, priors
        self.tolerance, self.rim = tolerance, rim
        self._kept: dict[int, list[np.ndarray]] = {}
        self._windows = _windows(views, downscale)

    @property
    def window(self) -> tuple[int, int]:
        """(width, height) of the windows."""
        _, _, width, height = self._windows[0]
        return width, height

    def tile(self, i: int, turn: int = 0, spp: int = 1) -> Photograph:
        """Return what a step with ``spp`` samples per pixel looks at of view ``i``: its window, or one of the tiles of it, whose
        ``turn`` it is."""
        view, (x, y, *_) = self.views[i], self._windows[i]
        left, top, width, height = part = _tile(self.window, turn, spp)
        images, prior = self._planes(i, part)
        floats, n = as_half(images), width * height
        planes = [
            mi.Float(dr.gather(mi.Float16, floats, dr.arange(mi.UInt32, n) + dr.opaque(mi.UInt32, k * n)))
            for k in range(len(images))
        ]
        dr.eval(planes)
        depth = [as_float(p.ravel()) for p in prior]
        behind = mi.Color3f(*planes[4:] or [self.background])
        size = self._size(view)
        return Photograph(
            view.camera.resized(*size).cropped(x + left, y + top, width, height),
            mi.Color3f(*planes[:3]) + behind * (1 - planes[3]),
            planes[3],
            behind,
            depth[0] if depth else None,
            bool(self.priors and self.priors[i].inverse),
            size,
            self.window,
        )

    def _planes(self, i, part):
        """Of a ``part`` (x, y, width, height) of the window of view ``i``: colour over black, coverage and, where that is no grey
        level, what lies behind, [4 or 7, height, width]; and the prior [1, height, width], or [0, …] where there is none."""
        if i not in self._kept:
            if sum(planes.nbytes for kept in self._kept.values() for planes in kept) >= MOST_KEPT:
                return self._made(i, part)
            self._kept[i] = self._made(i, (0, 0, *self.window))
        left, top, width, height = part
        return [planes[:, top : top + height, left : left + width] for planes in self._kept[i]]

    def _made(self, i, part):
        view, (x, y, *_), (left, top, *shape) = without_rim(self.views[i], self.rim), self._windows[i], part
        size, block = self._size(view), _block(view.camera.size, self.downscale)
        places = list(zip((y + top, x + left), shape[::-1]))
        cut = lambda image, scale: image[tuple(slice(scale * low, scale * (low + n)) for low, n in places)]
        images = [display(cut(view.pixels, block), 0.0), cut(view.alpha, block)[..., None]]
        if self.tolerance and view.masked:
            opaque = cut(view.pixels, block).copy()
            opaque[..., 3] = 255 if opaque.dtype == np.uint8 else 1
            near = cut(_border(view.alpha > 0.5, self.tolerance), block)[..., None]
            images.append(np.where(near, display(opaque, 0.0), np.float32(self.background)))
        images = shrink(np.concatenate(images, 2), block)
        prior = images[..., :0] if self.priors is None else cut(resize(self.priors[i].values, *size[::-1]), 1)[..., None]
        # Half precision keeps colours; of depths it would make steps. Copies: views, of no prior too, would keep all of `images`.
        return [np.array(p.transpose(2, 0, 1), kind, order="C") for p, kind in ((images, np.float16), (prior, np.float32))]

    def _size(self, view):
        """(width, height) of a whole photograph of this level."""
        width, height = (n // _block(view.camera.size, self.downscale) for n in view.camera.size)
        return width, height


def _block(size, downscale):
    """How many pixels along the side of a photograph of ``size`` make one of a level: as `shrink` has it."""
    return downscale if min(size) >= downscale else 1


def _border(mask, distance):
    """Of which pixels of a ``mask`` [H, W] another is not as they are, so many pixels away, or fewer, along both sides."""
    size = 2 * distance + 1
    return ndimage.maximum_filter(mask, size) != ndimage.minimum_filter(mask, size)


def _windows(views, downscale):
    """(x, y, width, height) of each view, in pixels of the level: around the mask, of one size where photographs are."""
    sizes = [tuple(n // _block(v.camera.size, downscale) for n in v.camera.size) for v in views]
    if len(set(sizes)) > 1 or not all(v.masked for v in views):
        return [(0, 0, *size) for size in sizes]
    boxes = []
    for view in views:
        rows, columns = (np.flatnonzero((view.pixels[..., 3] > 0).any(axis)) for axis in (1, 0))
        boxes.append([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1])
    boxes = np.array(boxes) / _block(views[0].camera.size, downscale)
    wanted = (boxes[:, 2:] - boxes[:, :2]).max(0) + 2 * _CROP_MARGIN
    size = np.minimum(np.ceil(wanted / 8) * 8, sizes[0]).astype(int)
    corners = np.clip(np.round((boxes[:, :2] + boxes[:, 2:] - size) / 2), 0, sizes[0] - size).astype(int)
    return [(int(x), int(y), int(size[0]), int(size[1])) for x, y in corners]


def tiling(window: tuple[int, int], spp: int = 1) -> tuple[int, int]:
    """Return into how many (columns, rows) of tiles a ``window`` (width, height) falls, which have `MOST_SAMPLES` at most,
    ``spp`` a pixel."""
    (width, height), columns, rows = window, 1, 1
    while width * height * spp > MOST_SAMPLES * columns * rows:
        columns, rows = (columns + 1, rows) if width * rows >= height * columns else (columns, rows + 1)
    return columns, rows


def _tile(window, turn, spp):
    """(x, y, width, height) of the tile of a ``window`` (width, height) whose ``turn`` it is: one of a grid of equal tiles,
    which overlap."""
    (width, height), (columns, rows) = window, tiling(window, spp)
    size = -(-width // columns), -(-height // rows)
    row, column = divmod(turn % (columns * rows), columns)
    place = lambda k, n, whole, part: round(k * (whole - part) / max(n - 1, 1))
    return place(column, columns, width, size[0]), place(row, rows, height, size[1]), *size


def shrink(image: np.ndarray, factor: int) -> np.ndarray:
    """Return an ``image`` [H, W, channels] as means over factor × factor blocks; the last rows and columns that fill no block
    are left out, and an image smaller than a block stays as it is."""
    factor = _block(image.shape[:2], factor)
    if factor == 1:
        return image
    height, width = (n - n % factor for n in image.shape[:2])
    return downscale_local_mean(image[:height, :width], (factor, factor, 1))

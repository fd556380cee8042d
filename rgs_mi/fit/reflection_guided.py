"""Reflection-guided densification (RGS, Algorithm 1): which surfels lie where several views see something reflective.

For each view: roughness map → reflective mask β̂ → its components' boxes B_v. The rays through the corners of a box bound a
pyramid, and the pyramids of two views meet in a region of space; density control is more generous there. All arrays are
NumPy's, and nothing here is differentiated.
"""

from collections.abc import Iterable

import numpy as np
from scipy import ndimage
from skimage import measure

from ..core.camera import Camera
from ..core.color import to_8bit

_WIDTH = 800  # pixels that a debug picture has at least
_LINE_WIDTH = 2  # pixels of it
TINT, LINE, DOT = (0, 170, 255), (255, 40, 0), (255, 225, 0)  # of the mask, the boxes, the surfels


def reflective_mask(roughness: np.ndarray, alpha: np.ndarray, percentile: float = 0.9) -> np.ndarray:
    """β̂: where the rendered roughness is at most its ``percentile`` (a fraction, the paper's p) over the view's foreground.

    ``roughness`` [H, W]: the mean roughness of a pixel, not premultiplied; ``alpha`` [H, W]: its coverage, foreground above
    one half. Returns [H, W] bool, false outside the foreground and where the roughness is not finite.
    """
    foreground = (alpha > 0.5) & np.isfinite(roughness)
    if not foreground.any():
        return foreground
    return foreground & (roughness <= np.quantile(roughness[foreground], percentile))


def boxes(mask: np.ndarray, least_pixels: int = 16) -> np.ndarray:
    """B_v: the bounds of the 8-connected components of ``mask`` [H, W] that have at least ``least_pixels`` pixels: an array
    [B, 4] of integers (x0, y0, x1, y1), in pixels, half-open. Boxes of one view may overlap."""
    components = np.asarray(measure.label(mask, connectivity=2))
    pixels = np.bincount(components.ravel())[1:]
    around = [
        (x.start, y.start, x.stop, y.stop)
        for (y, x), n in zip(ndimage.find_objects(components), pixels)
        if n >= least_pixels
    ]
    return np.array(around, np.intp).reshape(-1, 4)


def guided(centers: np.ndarray, cameras: Iterable[Camera], boxes_per_view: Iterable[np.ndarray]) -> np.ndarray:
    """The surfels that lie in the meeting of two views' pyramids: [N] bool.

    ``centers`` [N, 3]: world space; ``cameras``: a `Camera` a view; ``boxes_per_view``: for each the [B, 4] of `boxes`, in
    pixels of that camera. A pyramid holds the points in front of the camera that project into its box, so a surfel is in a
    meeting when its centre projects into boxes of two views or more; nothing is intersected, and no pairs are formed. What
    hides a surfel from a view does not matter. Raises: ValueError when views and boxes differ in number.
    """
    centers = np.asarray(centers, np.float64)
    count = np.zeros(len(centers), np.int8)
    for camera, found in zip(cameras, boxes_per_view, strict=True):
        if len(found):
            undecided = np.flatnonzero(count < 2)
            pixel, depth = camera.project(centers[undecided])
            count[undecided] += _inside(pixel, depth, found)
    return count == 2


def _inside(pixel, depth, found):
    """[N] whether points that project to ``pixel`` [N, 2] lie in any of the boxes ``found`` [B, 4], by a look into a raster
    of their union: exact, since bounds are whole numbers and x0 ≤ x < x1 says the same of x and of its floor."""
    left, top = found[:, :2].min(0)
    right, bottom = found[:, 2:].max(0)
    union = np.zeros((bottom - top, right - left), bool)
    for x0, y0, x1, y1 in found:
        union[y0 - top : y1 - top, x0 - left : x1 - left] = True
    x, y = pixel.T
    inside = (depth > 0) & (x >= left) & (x < right) & (y >= top) & (y < bottom)
    at = np.flatnonzero(inside)
    inside[at] = union[np.floor(y[at]).astype(np.intp) - top, np.floor(x[at]).astype(np.intp) - left]
    return inside


def picture(image: np.ndarray, mask: np.ndarray, found: np.ndarray, camera: Camera, centers: np.ndarray) -> np.ndarray:
    """A view as people can check it: β̂ tinted blue, the boxes in red, the surfels at ``centers`` as yellow dots.

    ``image`` [H, W, 3]: display values in [0, 1] of ``camera``'s view, a rendering or the photograph; ``mask`` [H, W] and
    ``found`` [B, 4]: of `reflective_mask` and `boxes`; ``centers`` [N, 3]: world space, such as those that are `guided`.
    Surfels on the far side are shown, too. Returns [H', W', 3] uint8, enlarged by a whole number when it is small.
    """
    scale = -(-_WIDTH // image.shape[1])
    enlarge = lambda v: v.repeat(scale, 0).repeat(scale, 1)
    grey = enlarge(image.mean(-1, keepdims=True))
    tinted = grey + 0.45 * (np.array(TINT) / 255 - grey) * enlarge(mask)[..., None]
    canvas = to_8bit(tinted)
    height, width = canvas.shape[:2]

    pixel, depth = camera.project(centers)
    x, y = np.where(depth > 0, pixel.T * scale, -1)[:2]
    seen = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    canvas[y[seen].astype(int), x[seen].astype(int)] = DOT
    for x0, y0, x1, y1 in found * scale:
        inner = canvas[y0 + _LINE_WIDTH : y1 - _LINE_WIDTH, x0 + _LINE_WIDTH : x1 - _LINE_WIDTH].copy()
        canvas[y0:y1, x0:x1] = LINE
        canvas[y0 + _LINE_WIDTH : y1 - _LINE_WIDTH, x0 + _LINE_WIDTH : x1 - _LINE_WIDTH] = inner
    return canvas

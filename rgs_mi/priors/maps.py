"""One view's prior depth, and what all priors do with their maps."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage


@dataclass(frozen=True)
class DepthPrior:
    """What a prior knows of one view's depth, up to a scale and a shift of its own.

    Attributes
      values:     [H, W] float32 at the photograph's size, NaN where unknown: z-depth along the viewing axis, or its inverse.
                  Their unit is the prior's: only the shape of the map counts (`losses.pearson_depth`)
      inverse:    whether they are inverse depths, larger where nearer
      confidence: [H, W] float32, larger where surer, 0 where unknown; in the prior's own unit. None: not told
    """

    values: np.ndarray
    inverse: bool = False
    confidence: np.ndarray | None = None


def inside(view) -> np.ndarray:
    """[H, W] bool: the pixels of a `View` that its mask calls the object; all of them where it has none."""
    return view.alpha > 0.5


def outlined(values: np.ndarray, view) -> np.ndarray:
    """``values`` [H, W] as float32, NaN outside the view's mask and where they are not finite."""
    with np.errstate(over="ignore"):
        values = values.astype(np.float32)
    return np.where(inside(view) & np.isfinite(values), values, np.float32(np.nan))


def resize(values: np.ndarray, height: int, width: int) -> np.ndarray:
    """A map [h, w] on another pixel grid over the same image plane: [height, width] float32.

    Bilinear between those of the four neighbours that are known, unknown (NaN) where the nearest one is. A smaller grid
    takes samples, not means, which would mix the object with what lies behind it.
    """
    if values.shape == (height, width):
        return values.astype(np.float32)
    known = np.isfinite(values)
    # Pixel centres are at half integers on both grids.
    rows, columns = (np.clip((np.arange(n) + 0.5) * (m / n) - 0.5, 0, m - 1)
                     for n, m in zip((height, width), values.shape))
    grid = np.meshgrid(rows, columns, indexing="ij")
    sample = lambda x: ndimage.map_coordinates(x.astype(np.float32), grid, order=1, mode="nearest")
    weight, total = sample(known), sample(np.where(known, values, 0))
    nearest = known[np.ix_(np.rint(rows).astype(int), np.rint(columns).astype(int))]
    return np.where(nearest, total / np.maximum(weight, 0.1), np.float32(np.nan)).astype(np.float32)

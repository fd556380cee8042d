"""One view's prior depth, and what all priors do with their maps."""

import numpy as np

from ..datasets.types import View


def inside(view: View) -> np.ndarray:
    """Return the pixels that the view's mask calls the object, [H, W] bool; all of them where it has none."""
    return view.alpha > 0.5


def masked(values: np.ndarray, view: View) -> np.ndarray:
    """Return ``values`` [H, W] as float32, NaN outside the view's mask and where they are not finite."""
    with np.errstate(over="ignore"):
        values = values.astype(np.float32)
    return np.where(inside(view) & np.isfinite(values), values, np.float32(np.nan))

"""One view's prior depth, and what all priors do with their maps."""

import numpy as np


def inside(view) -> np.ndarray:
    """[H, W] bool: the pixels of a `View` that its mask calls the object; all of them where it has none."""
    return view.alpha > 0.5


def outlined(values: np.ndarray, view) -> np.ndarray:
    """``values`` [H, W] as float32, NaN outside the view's mask and where they are not finite."""
    with np.errstate(over="ignore"):
        values = values.astype(np.float32)
    return np.where(inside(view) & np.isfinite(values), values, np.float32(np.nan))

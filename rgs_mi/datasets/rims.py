"""Masks drawn too large have a rim, in which a photograph shows what lies behind the object: how wide it is, and masks
without it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage

from .types import View

_REACH = 8  # pixels to either side of the masks' borders that are looked at
_VIEWS = 16  # that tell as much as all
_SIGMA = 0.8  # pixels, of derivatives
_HALF = 0.25  # pixels: with it what is left has, over all directions, the area of what had been grown by whole ones
_LEAST = 1.0  # pixels: within exact borders, too, edges are seen by up to 0.6, where the object changes towards them
_CLEAR = 2.0  # times as strong as beside the object must an edge be


def rim(views: Sequence[View]) -> int:
    """Return how many pixels the masks of ``views`` are too large by: how far within their borders photographs change most
    from what lies behind to the object, in the mean over views; 0 where there are no masks, where it is less than a pixel, which
    exact masks may seem to have, and where photographs do not tell, as those with much detail behind the object."""
    masked = [view for view in views if view.masked]
    profiles = [profile for view in masked[:: -(-len(masked) // _VIEWS) or 1] if (profile := _profile(view)) is not None]
    return _width(np.mean(profiles, 0)) if profiles else 0


def _width(change):
    """The width of a rim in whole pixels, by `_profile`."""
    beside = np.median(change[: _REACH // 2])
    peaks = [
        k
        for k in range(_REACH // 2, 2 * _REACH - 1)
        if change[k - 1] < change[k] >= change[k + 1] and change[k] > _CLEAR * beside
    ]
    if not peaks:
        return 0
    before, at, after = change[peaks[0] - 1 : peaks[0] + 2]
    vertex = 0.5 * (before - after) / (before - 2 * at + after)
    within = peaks[0] + vertex - _REACH + 0.5
    return round(within) if within >= _LEAST else 0


def without_rim(view: View, pixels: int | None) -> View:
    """Return ``view`` with a mask whose border lies so many ``pixels`` farther within; as it is where that leaves nothing,
    where it has no mask, and for None."""
    if not pixels or not view.masked:
        return view
    whole = np.pad(view.alpha > 0.5, 1, "edge")  # an object that the frame cuts off goes on beyond it
    inside = _distance(whole)[1:-1, 1:-1] - pixels
    alpha = np.minimum(view.alpha, np.clip(inside + _HALF, 0, 1))
    if not alpha.any():
        return view
    out = view.pixels.copy()
    out[..., 3] = np.rint(255 * alpha) if out.dtype == np.uint8 else alpha
    return replace(view, pixels=out)


def _profile(view):
    """[2 `_REACH`]: mean size of the derivative of pixels' values across the mask's border, by distance from it in steps of a
    pixel, from beside the object inwards; None where the mask has no border, or the photograph is too small."""
    mask = view.alpha > 0.5
    if mask.all() or not mask.any():
        return None
    lines = [np.flatnonzero(mask.any(axis)) for axis in (1, 0)]
    window = tuple(slice(max(line[0] - 2 * _REACH, 0), line[-1] + 2 * _REACH) for line in lines)
    mask, pixels = mask[window], view.pixels[window]
    if min(mask.shape) < _REACH:
        return None
    distance = np.where(mask, _distance(mask) - 0.5, 0.5 - _distance(~mask))
    down, right = (np.asarray(part)[..., None] for part in np.gradient(ndimage.gaussian_filter(distance, 1)))
    image = pixels[..., :3].astype(np.float32) / (255 if pixels.dtype == np.uint8 else 1)
    derivative = lambda axis: ndimage.gaussian_filter1d(image, _SIGMA, axis, order=1)
    across = np.sqrt(np.square(derivative(0) * down + derivative(1) * right).sum(-1))
    near: np.ndarray = np.abs(distance) < _REACH
    near[:3] = near[-3:] = near[:, :3] = near[:, -3:] = False  # where derivatives do not see all around
    place = np.floor(distance[near]).astype(int) + _REACH
    count, total = np.bincount(place, minlength=2 * _REACH), np.bincount(place, across[near], 2 * _REACH)
    return total / count if count.all() else None


def _distance(mask) -> np.ndarray:
    """[H, W]: pixels from where a ``mask`` is set to the nearest one where it is not, 0 there."""
    return np.asarray(ndimage.distance_transform_edt(mask))

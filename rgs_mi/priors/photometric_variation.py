"""What a point's colour says of its surface as one walks round it: a mirror shows something else to every photograph, what is
matte the same to all. It is known before anything is fitted (MaterialRefGS proposes photometric variation as a prior)."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ..core.color import srgb_decode
from ..datasets.types import View

_SRGB_TO_LINEAR = srgb_decode(np.arange(256) / 255).astype(np.float32)
_OPAQUE = 0.99  # alpha from which a pixel shows nothing of what is behind
_ENOUGH = 6  # photographs that tell how much a colour varies
_DARK = 0.2  # linear radiance beside which a spread counts: of what is black a lamp's faint reflection is all that there is
_HALF = 0.13  # variation at which a surface is as likely a metal as not; of the suite's it is 0.07 and 0.25 in the median
_METALLIC, _DOUBT = (0.05, 0.9), 0.4  # bounds of metallic, and what it is where photographs do not tell
_CHUNK = 5_000_000  # colours at a time: memory
_SIGMA = 1.4826  # standard deviations of a normal distribution in its median absolute deviation


class Appearance(NamedTuple):
    """How points look: ``color`` [N, 3], linear, their mean over the photographs that see them; ``lasting`` [N, 3], the lower
    quartile of these; ``variation`` [N], how much their luminance varies from one to the next, relative to itself. The latter two
    are NaN where fewer than six photographs see the point."""

    color: np.ndarray
    lasting: np.ndarray
    variation: np.ndarray

    @classmethod
    def of(cls, color: np.ndarray) -> "Appearance":
        """Return that of points of which no more than their ``color`` is known."""
        return cls(color, np.full_like(color, np.nan), np.full_like(color[:, 0], np.nan))

    @property
    def metallic(self) -> np.ndarray:
        """[N] what the BSDF's metallic may be, in (0, 1)."""
        squared = self.variation**2
        return np.where(np.isnan(squared), _DOUBT, np.clip(squared / (squared + _HALF**2), *_METALLIC))

    @property
    def diffuse(self) -> np.ndarray:
        """[N, 3] what of the colour may be diffuse radiance: what all photographs show, of what is no metal; else half of it."""
        return np.where(np.isnan(self.lasting), 0.5 * self.color, (1 - self.metallic[:, None]) * self.lasting)


def appearance(
    positions: np.ndarray,
    views: Sequence[View],
    sees: Callable[[int, np.ndarray, np.ndarray, np.ndarray], np.ndarray | bool],
) -> Appearance:
    """Return how ``positions`` [N, 3], world space, look in the ``views`` that see them: the callback ``sees(index of a view,
    z-depths, columns, rows)`` says which do. The mean of points that no view sees is that of all the others, or grey."""
    chunks = np.array_split(positions, -(-len(positions) * len(views) // _CHUNK) or 1)
    total, weight, lasting, variation = (np.concatenate(v) for v in zip(*(_observed(c, views, sees) for c in chunks)))
    known = weight > 0
    fill = total[known].sum(0) / weight[known].sum() if known.any() else np.full(3, 0.5, np.float32)
    color = np.where(known[:, None], total / np.maximum(weight, 1e-12)[:, None], fill)
    return Appearance._make(v.astype(np.float32) for v in (color, lasting, variation))


def _observed(positions, views, sees):
    """Of ``positions``: the sums of their colors and of their weights, and `Appearance`'s lasting and variation."""
    count = len(positions)
    total, weight = np.zeros((count, 3), np.float32), np.zeros(count, np.float32)
    colors = np.full((len(views), count, 3), np.nan, np.float32)
    for index, view in enumerate(views):
        pixel, z = view.camera.project(positions)
        width, height = view.camera.size
        seen = np.flatnonzero((z > 0) & (pixel >= 0).all(1) & (pixel[:, 0] < width) & (pixel[:, 1] < height))
        column, row = pixel[seen].astype(np.int64).T
        rgb, alpha = np.split(view.pixels[row, column], [3], 1)
        if rgb.dtype == np.uint8:
            rgb, alpha = _SRGB_TO_LINEAR[rgb], alpha / np.float32(255)
        alpha = np.where(sees(index, z[seen], column, row), alpha[:, 0], 0)
        total[seen] += rgb * alpha[:, None]
        weight[seen] += alpha
        opaque = alpha > _OPAQUE
        colors[index, seen[opaque]] = rgb[opaque]
    luminance, number = colors.mean(2), np.isfinite(colors[..., 0]).sum(0)
    median = _quantile(luminance, number, 0.5)
    spread = _SIGMA * _quantile(np.abs(luminance - median), number, 0.5)
    lasting = np.stack([_quantile(colors[..., k], number, 0.25) for k in range(3)], -1)
    enough = number >= _ENOUGH
    return total, weight, np.where(enough[:, None], lasting, np.nan), np.where(enough, spread / (median + _DARK), np.nan)


def _quantile(values, number, part):
    """[N] the quantile of each column of ``values`` [V, N], of which ``number`` [N] are not NaN."""
    rank = np.round(part * np.maximum(number - 1, 0)).astype(np.intp)
    return np.take_along_axis(np.sort(values, 0), rank[None], 0)[0]

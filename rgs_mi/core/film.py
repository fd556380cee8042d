"""From samples to pixels: a regular grid of samples in each pixel, weighed by the film's reconstruction filter.

    pixel_p = Σ_s w(x_s − x_p) sample_s,    w separable, Σ_s w(x_s − x_p) = 1                                  (24)

Photographs are no point samples: a film, or a lens, has blurred them, and what is to look like them must be blurred as much.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .arrays import as_float
from .camera import Camera

#: Standard deviation, in pixels, of the Gaussian that Mitsuba's films have by default
GAUSSIAN = 0.5
_NEGLIGIBLE = 1e-2  # weights below this part of the greatest are left out


@dataclass(frozen=True)
class Film:
    """A film of ``side`` × ``side`` samples a pixel, on a regular grid. ``weights``: along each axis, those that samples have in
    a pixel, from ``margin`` pixels before it to as many behind; by default all of a pixel's own have the same."""

    side: int = 1
    weights: tuple[float, ...] = (1.0,)

    @classmethod
    def of(cls, rfilter: "mi.ReconstructionFilter", spp: int) -> "Film":
        """Return the film of ``spp`` samples a pixel, rounded up to a square, that are filtered by ``rfilter``."""
        side = int(np.ceil(np.sqrt(spp)))
        margin = int(np.ceil(max(rfilter.radius() - 0.5, 0)))
        offset = (np.arange((2 * margin + 1) * side) + 0.5) / side - margin - 0.5
        weights = rfilter.eval(as_float(offset)).numpy().astype(np.float64)
        rows = weights.reshape(2 * margin + 1, side)
        while len(rows) > 1 and abs(rows[[0, -1]]).max() < _NEGLIGIBLE * abs(rows).max():
            rows = rows[1:-1]
        return cls(side, tuple((rows / rows.sum()).ravel().tolist()))

    @classmethod
    @functools.lru_cache(maxsize=64)  # each step asks
    def gaussian(cls, stddev: float | None, spp: int = 1) -> "Film":
        """Return the film of ``spp`` samples a pixel, rounded up to a square, with a Gaussian of ``stddev`` pixels; 0,
        None: means."""
        return cls.of(mi.load_dict(rfilter(stddev)), spp)

    @property
    def margin(self) -> int:
        """How many pixels beyond a picture its samples reach."""
        return (len(self.weights) // self.side - 1) // 2

    def samples(self, camera: Camera) -> Camera:
        """Return the camera whose pixels are the samples of those of ``camera``, those of the margin among them."""
        width, height = (n + 2 * self.margin for n in camera.size)
        return camera.cropped(-self.margin, -self.margin, width, height).subdivided(self.side**2)[0]

    def develop(self, values: "Sequence[mi.Float]", size: tuple[int, int]) -> "list[mi.Float]":
        """Return the pixels, (24), of pictures of ``size`` (width, height), row-major, each from those of the ``values`` that its
        `samples` have, differentiably. What has width 1 stays as it is."""
        if self.weights == (1.0,):
            return [*values]
        (width, height), line = size, self.samples_along(size[0])
        x, y = _places(width, self.samples_along(height))
        rows = self._weighed(values, y * line + x * self.side, 1)
        x, y = _places(width, height)
        return self._weighed(rows, y * (self.side * width) + x, width)

    def _weighed(self, values, first, apart):
        """Sums of the `weights` times as many of each of ``values``, so far ``apart``, from those at ``first`` on."""
        dr.eval(values)  # together: what they come from is computed once
        weighed = lambda value: sum(w * dr.gather(mi.Float, value, first + k * apart) for k, w in enumerate(self.weights))
        return [value if dr.width(value) == 1 else weighed(value) for value in values]

    def samples_along(self, pixels: int) -> int:
        """Return how many samples lie along so many ``pixels``, those of the margins among them."""
        return self.side * (pixels + 2 * self.margin)

    def spread(self, pixels: "mi.Float", size: tuple[int, int]) -> "mi.Float":
        """Return for each of the `samples` of a picture of ``size`` (width, height) the value of the pixel that it lies in, or,
        in the margin, beside; ``pixels`` are row-major."""
        if self.weights == (1.0,):
            return pixels
        places = _places(*(self.samples_along(n) for n in size))
        x, y = (dr.clip(mi.Int32(v // self.side) - self.margin, 0, n - 1) for v, n in zip(places, size))
        return dr.gather(mi.Float, pixels, mi.UInt32(y * size[0] + x))


def rfilter(stddev: float | None) -> dict:
    """Return, for ``mi.load_dict``, the reconstruction filter that is a Gaussian of ``stddev`` pixels; 0, None: a box of one
    pixel."""
    return {"type": "gaussian", "stddev": stddev} if stddev else {"type": "box"}


def _places(width, height):
    """(x, y) of a grid's points, row-major."""
    index = dr.arange(mi.UInt32, width * height)
    return index % width, index // width

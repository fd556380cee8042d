"""Lens distortion, taken out of photographs once: what follows knows only pinholes.

A point at (x, y) = (X/Z, Y/Z) in camera space is seen where a pinhole would see (Brown 1966; OpenCV and COLMAP)

    x' = x R + 2 p1 x y + p2 (r² + 2 x²)
    y' = y R + p1 (r² + 2 y²) + 2 p2 x y        R = (1 + k1 r² + k2 r⁴ + …) / (1 + m1 r² + m2 r⁴ + …),  r² = x² + y²

so a pixel of the undistorted photograph, whose pinhole has the same focal length, principal point and size, takes the
colour at (x', y'): no inverse is needed.
"""

import hashlib
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ..core.caches import cached_arrays
from ..core.camera import Camera
from ..core.color import srgb_decode, srgb_encode
from ..core.runtime import cache_folder

_VERSION = 1  # of everything that decides what is in the pixels: a cached photograph of another version is not read
_SRGB_TO_LINEAR = srgb_decode(np.arange(256) / 255).astype(np.float32)


@dataclass(frozen=True)
class Distortion:
    """The coefficients of a lens: ``radial`` k1, k2 … and ``denominator`` m1, m2 … of even powers of r, ``tangential`` p1,
    p2. It is false where all are zero."""

    radial: tuple[float, ...] = ()
    denominator: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)

    def __bool__(self) -> bool:
        return any((*self.radial, *self.denominator, *self.tangential))

    def apply(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Take pinhole coordinates (x, y), of any shape, to distorted ones; NaN where the lens shows nothing."""
        p1, p2 = self.tangential
        r2 = x**2 + y**2
        factor = np.where(r2 < self._reach(np.sqrt(r2.max())) ** 2, self._factor(r2), np.nan)
        return (x * factor + 2 * p1 * x * y + p2 * (r2 + 2 * x**2), y * factor + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y)

    def _factor(self, r2):
        top, bottom = (np.polyval((*reversed(k), 1.0), r2) for k in (self.radial, self.denominator))
        return top / np.where(bottom > 0, bottom, np.nan)

    def _reach(self, farthest: float) -> float:
        """The radius up to which r R(r²) grows. Beyond it a polynomial runs back: it would show the image again."""
        r = np.linspace(0, farthest * 1.01, 4096)
        growing = np.diff(r * self._factor(r**2)) > 0  # False for NaN
        return np.inf if growing.all() else float(r[growing.argmin()])


def undistorted(pixels: np.ndarray, camera: Camera, distortion: Distortion, name: str) -> np.ndarray:
    """Return `View.pixels` as the pinhole ``camera`` sees them, [H, W, 4] of the same type.

    Bilinear, in linear light, weighted with alpha. Where the photograph shows nothing alpha is 0. The result is kept in
    `cache_folder` and found again by the pixels, the camera, the coefficients and the view's ``name``.
    """
    digest = hashlib.sha256(
        repr((_VERSION, name, pixels.dtype, pixels.shape, camera.focal, camera.principal, distortion)).encode()
    )
    digest.update(np.ascontiguousarray(pixels).data)
    path = cache_folder("undistorted") / f"{digest.hexdigest()[:24]}.npz"

    def check(arrays):
        if (arrays["pixels"].shape, arrays["pixels"].dtype) != (pixels.shape, pixels.dtype):
            raise ValueError("its shape or type is wrong")

    return cached_arrays(path, check, lambda: {"pixels": _resample(pixels, camera, distortion)})["pixels"]


def cropped_to_valid(pixels: np.ndarray, camera: Camera) -> tuple[np.ndarray, Camera]:
    """Return the window of a photograph that has alpha everywhere, and its camera: cut row by row and column by column, each
    time the side that lacks most."""
    lacks = pixels[..., 3] == 0
    top, left, bottom, right = 0, 0, *lacks.shape
    while (window := lacks[top:bottom, left:right]).any():
        worst = int(np.argmax([window[0].mean(), window[-1].mean(), window[:, 0].mean(), window[:, -1].mean()]))
        top, bottom, left, right = top + (worst == 0), bottom - (worst == 1), left + (worst == 2), right - (worst == 3)
    return pixels[top:bottom, left:right], camera.cropped(left, top, right - left, bottom - top)


def _resample(pixels, camera, distortion):
    height, width = pixels.shape[:2]
    x, y = camera.image_plane()
    with np.errstate(over="ignore", invalid="ignore"):
        x, y = distortion.apply(x, y)
        column, row = x * camera.focal[0] + camera.principal[0], y * camera.focal[1] + camera.principal[1]
        valid = (column >= 0) & (column <= width) & (row >= 0) & (row <= height)
    grid = [np.where(valid, a - 0.5, 0) for a in (row, column)]  # centres are at half integers
    sample = lambda plane: np.where(valid, ndimage.map_coordinates(plane, grid, order=1, mode="nearest"), 0)

    sdr = pixels.dtype == np.uint8
    alpha = pixels[..., 3] / np.float32(255) if sdr else pixels[..., 3]
    result = np.zeros(pixels.shape, np.float32)
    result[..., 3] = coverage = sample(alpha)
    for c in range(3):
        linear = _SRGB_TO_LINEAR[pixels[..., c]] if sdr else pixels[..., c]
        result[..., c] = sample(linear * alpha) / np.where(coverage > 0, coverage, 1)
    if not sdr:
        return result
    result[..., :3] = srgb_encode(np.clip(result[..., :3], 0, 1))
    return np.rint(255 * result).astype(np.uint8)

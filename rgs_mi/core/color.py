"""Between linear light and display values: the sRGB curve, and images over a background."""

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt


def srgb_encode(linear: np.ndarray) -> np.ndarray:
    """Take linear light, of any shape, to display values by the piecewise curve of IEC 61966-2-1."""
    linear = np.asarray(linear)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


def srgb(x: "mi.Color3f") -> "mi.Color3f":
    """Return `srgb_encode` of Dr.Jit's ``x``, differentiable: continued above one; negative values count as zero."""
    x = dr.maximum(x, 0)
    return dr.select(x <= 0.0031308, 12.92 * x, 1.055 * dr.power(dr.maximum(x, 0.0031308), 1 / 2.4) - 0.055)


def srgb_decode(encoded: np.ndarray) -> np.ndarray:
    """Take display values, of any shape, to linear light: the inverse of `srgb_encode`."""
    encoded = np.asarray(encoded)
    return np.where(encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0.04045) + 0.055) / 1.055) ** 2.4)


def display(view_pixels: np.ndarray, background: npt.ArrayLike) -> np.ndarray:
    """Return an image as people look at it: [H, W, 3] float32 in [0, 1].

    ``view_pixels`` is `View.pixels` [H, W, 4]; float32 (linear) ones are clipped to [0, 1] and encoded first.
    ``background`` (a number or [3], display values) shows where alpha is below one. The blend is made in display space,
    as NeRF and its data sets' published scores have it, although light would ask for linear space.
    """
    if view_pixels.dtype == np.uint8:
        pixels = view_pixels.astype(np.float32) / np.float32(255)
        rgb, alpha = pixels[..., :3], pixels[..., 3:]
    else:
        rgb = srgb_encode(np.clip(view_pixels[..., :3], 0, 1))
        alpha = np.clip(view_pixels[..., 3:], 0, 1)
    return (rgb * alpha + np.asarray(background, np.float32) * (1 - alpha)).astype(np.float32)


def to_8bit(image: np.ndarray) -> np.ndarray:
    """Round display values in [0, 1], of any shape, to uint8; those that are uint8 stay."""
    return image if image.dtype == np.uint8 else (np.clip(np.nan_to_num(image), 0, 1) * 255 + 0.5).astype(np.uint8)


#: How radiance beyond white is shown: cut off, or Reinhard's x / (1 + x) (Reinhard et al. 2002, eq. 3), which has none.
TONES = ("clip", "reinhard")


def exposed(radiance: np.ndarray, stops: float = 0.0, tone: str = "clip") -> np.ndarray:
    """Take linear radiance, of any shape, to display values in [0, 1]: exposed by ``stops``, then by one of `TONES`, then
    sRGB."""
    x = np.maximum(np.asarray(radiance) * np.float32(2.0**stops), 0)
    return srgb_encode(x / (1 + x) if tone == "reinhard" else np.minimum(x, 1))


def tone_map(radiance: np.ndarray) -> np.ndarray:
    """Take linear radiance, of any shape, to display values: Reinhard's curve (Reinhard et al. 2002, eq. 4), white at the
    99.5th percentile, then sRGB."""
    white = max(float(np.percentile(radiance, 99.5)), 1.0)
    x = np.maximum(radiance, 0)
    return srgb_encode(np.clip(x * (1 + x / white**2) / (1 + x), 0, 1))

"""Photographs as the textures of a mesh are fitted to them."""

from dataclasses import dataclass

import numpy as np

from ...core.camera import Camera
from ...core.color import srgb_decode

SATURATED = 0.98  # linear values from which photographs are white: a brighter radiance is no error
_OPAQUE = 0.999  # least alpha of the object's pixels


@dataclass(frozen=True)
class Photograph:
    """What one camera took: ``pixels`` [H, W, 4], those of a `View`, or some of them [N, 4], with a ``gain`` [3] (None: 1)."""

    camera: Camera
    pixels: np.ndarray
    gain: np.ndarray | None = None

    @property
    def radiance(self) -> np.ndarray:
        """Linear values in [0, 1], [H, W, 3] or [N, 3] float32."""
        if self.pixels.dtype == np.uint8:
            return srgb_decode(self.pixels[..., :3].astype(np.float32) / 255)
        return np.clip(self.pixels[..., :3], 0, 1).astype(np.float32)

    @property
    def object(self) -> np.ndarray:
        """Which pixels show nothing but the object, [H, W] or [N] bool."""
        alpha = self.pixels[..., 3]
        return alpha > _OPAQUE * (255 if alpha.dtype == np.uint8 else 1)

    @property
    def exposure(self) -> np.ndarray:
        """What radiance is multiplied with in it, [3]."""
        return np.ones(3) if self.gain is None else self.gain

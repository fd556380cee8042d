"""From what a pass measured to what a window shows: NumPy alone, so that no choice of a map compiles anything."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from ..core.camera import Camera
from ..core.color import display as over_background
from ..core.color import exposed, srgb_encode
from ..datasets.types import View
from ..evaluation.metrics import normal_colors
from ..evaluation.pictures import ERROR_RANGE, ramp

#: Channels of a pass, [H, W, channels], premultiplied by coverage: their place in the splatter's row of a pixel.
GBUFFER = {
    "radiance": slice(0, 3),
    "normal": slice(3, 6),
    "base_color": slice(6, 9),
    "roughness": slice(9, 10),
    "metallic": slice(10, 11),
    "depth": slice(11, 12),
    "alpha": slice(12, 13),
}
SHADED = ("color", "diffuse", "specular")

#: name -> what has to be measured for it, beside alpha. The error is that against the photograph of the nearest view.
MAPS = {
    "picture": "color",
    "diffuse": "diffuse",
    "specular": "specular",
    "normals": "normal",
    "depth": "depth",
    "base color": "base_color",
    "roughness": "roughness",
    "metallic": "metallic",
    "alpha": "alpha",
    "error": "color",
}
_GREY = {"white": 1.0, "black": 0.0, "light": 1.0}


@dataclass(frozen=True)
class Shown:
    """How values become colours: ``stops`` and ``tone`` of radiance, the grey behind the object, and the z ``depths``, world
    units, from light to dark."""

    stops: float
    tone: str
    background: str
    depths: tuple[float, float]


def display(name: str, measured: Mapping[str, np.ndarray], shown: Shown) -> np.ndarray:
    """Return the map ``name`` of `MAPS` but the error, display values [H, W, 3] in [0, 1], of the means ``measured`` of
    passes."""
    values, alpha = measured[MAPS[name]], np.clip(measured["alpha"], 0, 1)
    over = _GREY[shown.background]
    if "behind" in measured:
        return exposed(values + measured["behind"], shown.stops, shown.tone)
    if name == "alpha":
        return np.repeat(alpha, 3, -1)
    if name == "normals":
        length = np.linalg.norm(values, axis=-1, keepdims=True)
        colors = normal_colors(values * (alpha / np.maximum(length, 1e-9)), alpha[..., 0])
        return colors - (1 - alpha) * (1 - over)
    if name in ("picture", "diffuse", "specular"):
        mean = exposed(values / np.maximum(alpha, 1e-6), shown.stops, shown.tone)
    else:
        mean = np.broadcast_to(_VALUES[name](values / np.maximum(alpha, 1e-6), shown), (*alpha.shape[:2], 3))
    return mean * alpha + over * (1 - alpha)


def _nearness(depth, shown):
    near, far = shown.depths
    return np.clip((far - depth) / max(far - near, 1e-9), 0.05, 0.95)


_VALUES: dict[str, Callable] = {
    "base color": lambda values, _: srgb_encode(np.clip(values, 0, 1)),
    "roughness": lambda values, _: values,
    "metallic": lambda values, _: values,
    "depth": _nearness,
}


def photograph(view: View, camera: Camera, background: str) -> np.ndarray:
    """Return the photograph of ``view`` in the pixels of a ``camera`` that stands in the same place, [H, W, 3] display values;
    what it does not show is grey."""
    from PIL import Image

    own, fx, fy = view.camera, *(a / b for a, b in zip(view.camera.focal, camera.focal))
    at = (fx, 0, own.principal[0] - fx * camera.principal[0], 0, fy, own.principal[1] - fy * camera.principal[1])
    pixels = over_background(view.pixels, _GREY[background])
    channels = np.concatenate([pixels, np.ones_like(pixels[..., :1])], -1)
    planes = [
        Image.fromarray(np.ascontiguousarray(channels[..., k])).transform(
            camera.size, Image.Transform.AFFINE, at, Image.Resampling.BILINEAR
        )
        for k in range(4)
    ]
    seen = np.stack([np.asarray(plane) for plane in planes], -1)
    return seen[..., :3] + 0.5 * (1 - seen[..., 3:])


def error(picture: np.ndarray, photograph: np.ndarray) -> np.ndarray:
    """Return the mean absolute difference of display values [H, W, 3] as colours of `ramp`."""
    return ramp(np.abs(picture - photograph).mean(-1) / ERROR_RANGE)


def wiped(picture: np.ndarray, photograph: np.ndarray, part: float) -> np.ndarray:
    """Return ``picture`` [H, W, 3] with that ``part`` of its width, from the left, of the ``photograph``."""
    column = round(part * picture.shape[1])
    return np.concatenate([photograph[:, :column], picture[:, column:]], 1)

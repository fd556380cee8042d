"""How good a fit is: held-out views rendered, compared with their photographs, and timed."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import as_float
from ..core.camera import Camera
from ..core.color import display
from ..core.film import Film
from ..datasets.types import View
from ..fit import losses
from ..shading import deferred
from ..shading.lighting import Lighting
from ..splat.tiles import TILE
from ..surfels.surfels import Surfels
from . import lpips, metrics

_MOST_SAMPLES = 1 << 19  # of a rendering that is in memory at once
#: Scores of one view; the mean over views has the same names.
SCORES = ("psnr", "ssim", "lpips", "lpips_alex", "normal_mae_deg", "normal_ssim", "normal_lpips")


@dataclass
class Rendering:
    """A rendered view as NumPy arrays, float32.

    image:  [H, W, 3] display values in [0, 1] over the background, which are compared with the photograph
    alpha:  [H, W, 1] coverage
    maps:   name -> [H, W, channels], premultiplied by coverage: color, diffuse, specular (linear radiance), sh_normal
            (world space, unit length before), base_color, roughness, metallic, depth
    """

    image: np.ndarray
    alpha: np.ndarray
    maps: dict[str, np.ndarray]


def render_view(
    surfels: Surfels,
    lighting: Lighting | None,
    camera: Camera,
    background: float,
    film: Film = Film(),
    gain: np.ndarray | None = None,
) -> Rendering:
    """Render ``surfels`` under ``lighting`` (None: diffuse only) over the display-space grey level ``background``, on a
    ``film``: linear radiance and all maps are weighted means over its samples, as those of 'rgs_deferred'. The image, but no map,
    is exposed with ``gain`` [3]."""
    with dr.suspend_grad():
        bands = [_means(surfels, lighting, band, film) for band in _bands(camera, film)]
        means = {name: np.concatenate([band[name] for band in bands]) for name in bands[0]}
        alpha = means.pop("alpha")
        length = np.linalg.norm(means["sh_normal"], axis=-1, keepdims=True)
        means["sh_normal"] *= alpha / np.where(length > 0, length, 1)
        exposed = means["color"] if gain is None else means["color"] * gain
        color = mi.Color3f(*(as_float(exposed[..., k]) for k in range(3)))
        shown = losses.display(color, as_float(alpha), background).numpy().T.reshape(*alpha.shape[:2], 3)
    return Rendering(np.clip(shown, 0, 1), alpha, means)


def _bands(camera, film):
    """The camera's picture in bands of `_MOST_SAMPLES` at most, or nearly so: what a band needs lies in memory at once."""
    width, height = camera.size
    rows = max(TILE[1], _MOST_SAMPLES // (width * film.side**2) // TILE[1] * TILE[1])
    return [camera.cropped(0, y, width, min(rows, height - y)) for y in range(0, height, rows)]


def _means(surfels, lighting, camera, film):
    """Maps of what ``camera`` sees, [H, W, channels], as the ``film`` develops them."""
    (width, height), image = camera.size, deferred.render(surfels, film.samples(camera), lighting)
    m = image.gbuffer.all
    length = dr.norm(m.normal)
    maps = {
        "color": image.color,
        "diffuse": image.diffuse,
        "specular": image.specular,
        "sh_normal": dr.select(length > 0, m.normal * (m.alpha / length), 0),
        "base_color": m.base_color,
        "roughness": m.roughness,
        "metallic": m.metallic,
        "depth": m.depth,
        "alpha": m.alpha,
    }
    channels = {k: [v] if isinstance(v, mi.Float) else [*v] for k, v in maps.items()}
    dr.eval(channels)
    pixels = {k: film.develop(values, camera.size) for k, values in channels.items()}
    return {k: np.stack([v.numpy().reshape(height, width) for v in values], -1) for k, values in pixels.items()}


def ground_truth(view: View, background: float) -> np.ndarray:
    """Return the photograph of ``view`` as `Rendering.image` has it, [H, W, 3]."""
    return display(view.pixels, background)


def score(view: View, rendering: Rendering, background: float) -> dict[str, float | None]:
    """Return the `SCORES` of one view. ``lpips`` and ``normal_lpips`` are with VGG16, as in the papers that build on 3DGS.

    Scores of normals are None where the view has none, and those of LPIPS where its weights are not installed or the view is
    too small for it. Normals are compared as images (`metrics.normal_colors`) that are white where the view's are unknown.
    Raises: UserError where the weights are damaged.
    """
    distance = lpips.distance if lpips.installed() else lambda *_: float("nan")
    pair = rendering.image, ground_truth(view, background)
    scores = dict.fromkeys(SCORES) | {
        "psnr": metrics.psnr(*pair),
        "ssim": metrics.ssim(*pair),
        "lpips": _finite(distance(*pair, "vgg")),
        "lpips_alex": _finite(distance(*pair, "alex")),
    }
    if view.normal is not None:
        pair = _normal_images(view.normal, view.alpha, rendering)
        scores |= {
            "normal_mae_deg": _finite(metrics.normal_mae_deg(rendering.maps["sh_normal"], view.normal, view.alpha)),
            "normal_ssim": metrics.ssim(*pair),
            "normal_lpips": _finite(distance(*pair, "vgg")),
        }
    return scores


def _normal_images(normal, alpha, rendering):
    """The normals of the rendering and a view's, [H, W, 3] each."""
    unknown = (np.linalg.norm(normal, axis=-1) < 0.5) & (alpha > 0)
    alphas = np.where(unknown, 0, [rendering.alpha[..., 0], alpha])
    normals = np.where(unknown[..., None], 0, [rendering.maps["sh_normal"], normal * alpha[..., None]])
    return metrics.normal_colors(normals[0], alphas[0]), metrics.normal_colors(normals[1], alphas[1])


def mean_scores(scores: list[dict[str, float | None]]) -> dict[str, float | None]:
    """Return the mean of each score over the views that have it, None where none has."""
    known = {name: [value for s in scores if (value := s[name]) is not None] for name in SCORES}
    return {name: float(np.mean(values)) if values else None for name, values in known.items()}


def _finite(value):
    return value if np.isfinite(value) else None


def frames_per_second(
    surfels: Surfels, lighting: Lighting | None, cameras: Sequence[Camera], film: Film = Film(), seconds: float = 1.0
) -> float:
    """Return the median of frames per second over renderings of ``cameras`` in turn, for some ``seconds`` and three at least,
    with the samples of a ``film``: G-buffer and shading, kernels compiled and the environment filtered beforehand."""
    spent = []
    with dr.suspend_grad():
        while len(spent) < 4 or sum(spent) < seconds:
            dr.sync_thread()
            start = time.perf_counter()
            for band in _bands(cameras[len(spent) % len(cameras)], film):
                dr.eval(deferred.render(surfels, film.samples(band), lighting).color)
            dr.sync_thread()
            spent.append(time.perf_counter() - start)
    return float(1 / np.median(spent[1:]))

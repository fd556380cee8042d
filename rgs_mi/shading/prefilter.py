"""The environment filtered once per roughness level: a fixed linear operator on its texels.

The map is latitude-longitude, and a filter that only depends on the angle between directions commutes with turning the
map about its axis. So along longitude it is a circular convolution, and in Fourier space the operator falls apart into one
small real matrix per longitudinal frequency m:

    P̂_m = M_m L̂_m,   M_m[i, j] = ∫∫ K(γ(θ_i, θ, Δφ)) hat_j(θ) sinθ cos(mΔφ) dθ dΔφ · sinc²           (5)

with K the principled BSDF's lobe (`tables.lobe`), γ the angle between the directions, and hats because Mitsuba's
`envmap` interpolates bilinearly. Rows are normalized: a constant environment stays constant. The poles are
exact, and the adjoint is the transpose of (5). The southern hemisphere mirrors the northern, so in sums and differences of
rows that mirror each other M_m falls apart once more, into two of a quarter of its size.
"""

import functools
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import fft

from ..core.arrays import aligned, as_float
from .tables import lobe

#: Roughness of each level and the most rows of its map; None: as the environment. Level 0 is the mirror: no filter.
#: After them comes the diffuse lobe's.
LEVELS = ((0.0, None), (0.1, 128), (0.2, 128), (0.3, 64), (0.4, 64), (0.55, 32), (0.7, 32), (0.85, 16), (1.0, 16))
_DIFFUSE_ROWS = 16
_NEGLIGIBLE = 1e-5  # rows where the lobe is below this part of its peak are left out
_NODES_PER_LOBE = 2  # quadrature nodes per GGX width α = roughness² of a lobe


def _kernel_matrix(kernel_at, width, rows, columns, out_rows):
    """[M, out_rows, rows] of (5) for K = ``kernel_at`` (angles in radians), ``width`` wide; M: frequencies of the output."""
    frequencies = min(columns, 2 * out_rows) // 2 + 1
    nodes = max(2, int(np.ceil(np.pi / (rows - 1) / width * _NODES_PER_LOBE)))  # per texel, in both directions
    fine = (rows - 1) * nodes + 1
    theta = np.linspace(0, np.pi, fine)
    samples = columns * nodes
    delta = 2 * np.pi * np.arange(samples // 2 + 1) / samples  # the kernel is even in Δφ
    # the lobe against its angle, dense where it is narrow, and so against its cosine
    angles = np.pi / 2 * np.linspace(0, 1, 4096) ** 2
    table = kernel_at(angles)
    cosines, values = np.cos(angles[::-1]), table[::-1]
    hat = np.maximum(0, 1 - np.abs(np.arange(fine)[:, None] / nodes - np.arange(rows)))  # [fine, rows]
    hat = (hat * np.sin(theta)[:, None]).astype(np.float32)
    theta_out = np.linspace(0, np.pi, out_rows)
    fold = _fold(samples // 2 + 1, columns, frequencies)
    matrix = np.empty((frequencies, out_rows, rows), np.float32)
    reach = angles[np.flatnonzero(table > _NEGLIGIBLE * table[0])[-1]]
    for i, t in enumerate(theta_out[: (out_rows + 1) // 2]):
        near = np.flatnonzero(np.abs(theta - t) <= reach)
        cosine = np.cos(t) * np.cos(theta[near, None]) + np.sin(t) * np.sin(theta[near, None]) * np.cos(delta)
        kernel = np.interp(cosine, cosines, values, left=0.0)
        spectrum = np.asarray(fft.dct(kernel.astype(np.float32), type=1, axis=1))  # cosine series: K is even in Δφ
        matrix[:, i] = (spectrum @ fold).T @ hat[near]
        matrix[:, out_rows - 1 - i] = matrix[:, i, ::-1]  # the southern hemisphere mirrors the northern
    return matrix / matrix[0].sum(1)[None, :, None]


def _fold(count, columns, frequencies):
    """[count, frequencies]: takes the cosine series of a kernel to the Fourier coefficients of its samples at ``columns``
    texels. A lobe narrower than a texel has frequencies above theirs, which appear as lower ones. A coarser map, made for a
    lobe wider than its texels, just leaves the higher ones out."""
    f, half = np.arange(count), columns // 2
    hat = np.sinc(f / columns) ** 2
    if frequencies <= half:
        return np.diag(hat)[:, :frequencies].astype(np.float32)
    alias = np.minimum(f % columns, -f % columns)
    twice = (alias == 0) & (f > 0) | (alias == half)  # a pair of frequencies that meet in one
    return ((alias[:, None] == np.arange(frequencies)) * np.where(twice, 2 * hat, hat)[:, None]).astype(np.float32)


def _mirrored(x, axis=1):
    """Sums and differences of the rows of ``x``, along ``axis``, that mirror each other at the equator, over √2; the row in the
    middle of an odd number of them is a sum. Orthogonal: `_unmirrored` is its inverse and its adjoint."""
    x = np.moveaxis(x, axis, 0)
    half = len(x) // 2
    north, south, root = x[:half], x[::-1][:half], np.float32(0.5**0.5)
    parts = np.concatenate([(north + south) * root, x[half : len(x) - half]]), (north - south) * root
    return tuple(np.moveaxis(part, 0, axis) for part in parts)


def _unmirrored(sums, differences):
    """[M, rows, C] that have these `_mirrored` parts."""
    half, root = differences.shape[1], np.float32(0.5**0.5)
    north, south = (sums[:, :half] + differences) * root, (sums[:, :half] - differences) * root
    return np.concatenate([north, sums[:, half:], south[:, ::-1]], axis=1)


def _floats(x):
    """[M, rows, 2 C] real and imaginary parts of ``x`` [M, rows, C]."""
    return np.ascontiguousarray(x, np.complex64).view(np.float32)


@dataclass(frozen=True)
class Prefilter:
    """The operator (5) for environments of ``size`` (rows, columns). ``maps`` are the (rows, columns) of each level's map,
    ``matrices`` the M_m of each level but the first, between the sums, and between the differences, of `_mirrored` rows: pairs
    of [frequencies, rows of the map / 2, rows / 2]."""

    size: tuple[int, int]
    maps: tuple[tuple[int, int], ...]
    matrices: tuple[tuple[np.ndarray, np.ndarray], ...]

    @property
    def offsets(self) -> np.ndarray:
        """The first texel of each level in the concatenated output, [levels]."""
        return np.concatenate([[0], np.cumsum([r * c for r, c in self.maps])[:-1]]).astype(np.uint32)

    @property
    def texels(self) -> int:
        """Texels of all levels together."""
        return sum(r * c for r, c in self.maps)

    def apply(self, texels: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Filter ``texels`` [rows, columns, 3] float32: return the maps of all levels, [texels, 3], in ``out`` where given."""
        rows, columns = self.size
        parts = [
            _floats(part) for part in _mirrored(np.asarray(fft.rfft(texels.transpose(1, 0, 2), axis=0)))
        ]  # [M, rows / 2, 6]
        out = np.empty((self.texels, 3), np.float32) if out is None else out
        out[: rows * columns] = texels.reshape(-1, 3)
        for (r, c), pair, offset in zip(self.maps[1:], self.matrices, self.offsets[1:]):
            m = pair[0].shape[0]
            product = _unmirrored(*(matrix @ part[:m] for matrix, part in zip(pair, parts)))
            level = product.view(np.complex64) * self._phase(m, c)[:, None, None] * np.float32(c / columns)
            out[offset : offset + r * c].reshape(r, c, 3)[:] = np.asarray(fft.irfft(level, n=c, axis=0)).transpose(1, 0, 2)
        return out

    def transpose(self, adjoint: np.ndarray) -> np.ndarray:
        """Take the ``adjoint`` [texels, 3] of the maps to that of the environment, [rows, columns, 3]: the transpose of
        `apply`."""
        rows, columns = self.size
        first = rows * columns
        parts = [np.zeros((columns // 2 + 1, n, 6), np.float32) for n in (rows - rows // 2, rows // 2)]
        for (r, c), pair, offset in zip(self.maps[1:], self.matrices, self.offsets[1:]):
            m = pair[0].shape[0]
            level = adjoint[offset : offset + r * c].reshape(r, c, 3).transpose(1, 0, 2)
            level = np.asarray(fft.rfft(level, axis=0))[:m] * self._phase(m, c).conj()[:, None, None]
            if c % 2 == 0 and m == c // 2 + 1 and c < columns:
                level[-1] *= 0.5  # irfft reads the highest frequency of a short map once, of a long one twice
            for total, matrix, part in zip(parts, pair, _mirrored(level)):
                total[:m] += matrix.transpose(0, 2, 1) @ _floats(part)
        spectrum = _unmirrored(*parts).view(np.complex64)
        grad = np.asarray(fft.irfft(spectrum, n=columns, axis=0)).transpose(1, 0, 2)
        return grad + adjoint[:first].reshape(rows, columns, 3)

    def _phase(self, m, c):
        """Texel centers lie half a texel from Δφ = 0, and texels of a coarser map are wider."""
        shift = np.pi / c - np.pi / self.size[1]
        return np.exp(1j * np.arange(m) * shift).astype(np.complex64)


@functools.lru_cache(maxsize=4)
def prefilter(rows: int, columns: int, variant: str) -> Prefilter:
    """Return the operator for an environment of ``rows`` × ``columns`` texels, which takes some seconds the first time;
    ``variant``, the active one, keys the cache."""
    maps, matrices = [(rows, columns)], []
    lobes = [(functools.partial(lobe, roughness), roughness**2, level_rows) for roughness, level_rows in LEVELS[1:]]
    for kernel_at, width, level_rows in [*lobes, (np.cos, 1.0, _DIFFUSE_ROWS)]:
        out_rows = min(level_rows or rows, rows)
        out_columns = columns if out_rows == rows else 2 * out_rows
        maps.append((out_rows, out_columns))
        halves = (
            _mirrored(half, axis=2)[k]
            for k, half in enumerate(_mirrored(_kernel_matrix(kernel_at, width, rows, columns, out_rows)))
        )
        matrices.append(tuple(np.ascontiguousarray(half) for half in halves))
    return Prefilter((rows, columns), tuple(maps), tuple(matrices))


class _Apply(dr.CustomOp):
    """`Prefilter.apply` on Dr.Jit arrays: texels [rows · columns · 3] to [texels · 4] (padded for packet gathers)."""

    def eval(self, texels, operator):
        self.operator = operator
        return self._filter(texels)

    def forward(self):
        self.set_grad_out(self._filter(self.grad_in("texels")))

    def backward(self):
        self.set_grad_in("texels", as_float(self.operator.transpose(self.grad_out().numpy().reshape(-1, 4)[:, :3])))

    def _filter(self, texels):
        padded = aligned(self.operator.texels, 4)
        self.operator.apply(texels.numpy().reshape(*self.operator.size, 3), padded[:, :3])
        return mi.Float(padded.ravel())

    def name(self):
        return "rgs_mi.shading.Prefilter"


def apply(texels: "mi.Float", operator: Prefilter) -> "mi.Float":
    """Return the filtered maps of all levels, of width operator.texels · 4; differentiable in ``texels``, the rows · columns
    · 3 values of an environment."""
    return dr.custom(_Apply, texels, operator)

"""Gaussians as splat viewers hold them: display colours in spherical harmonics, nothing to be lit.

The real spherical harmonics Y_k are those of 3DGS, with the Condon–Shortley phase, k = l² + l + m: a splat seen along the unit
direction d, from the camera to its center, has the colour ½ + Σ_k h_k Y_k(d), which viewers clip to [0, 1].
"""

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

from ..surfels.ply import THICKNESS

DEGREE = 3
COEFFICIENTS = (DEGREE + 1) ** 2


@dataclass(frozen=True)
class Splats:
    """N splats, arrays of float32.

    centers    [N, 3], world space
    rotations  [N, 4], unit quaternions (x, y, z, w), whose third axis is the normal
    scales     [N, 2], standard deviations along the first two axes
    opacities  [N], in (0, 1)
    harmonics  [N, 16, 3], the h_k of the module, of display sRGB
    origin     (x, y, z), where the origin of their world lies in that of the capture (`Dataset.origin`)
    """

    centers: np.ndarray
    rotations: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    harmonics: np.ndarray
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __len__(self) -> int:
        return len(self.centers)

    @property
    def thick_scales(self) -> np.ndarray:
        """[N, 3] with the tiny third that ellipsoids need."""
        return np.column_stack([self.scales, THICKNESS * self.scales.min(1)])

    def colors(self, direction: np.ndarray) -> np.ndarray:
        """Return the display colours [N, 3], not clipped, that are seen along one unit ``direction`` [3]."""
        return 0.5 + np.einsum("k,nkc->nc", sh_basis(direction[None])[0], self.harmonics)

    def rotated(self, rotation: np.ndarray) -> "Splats":
        """Return the same splats in a world that ``rotation`` [3, 3] takes this one to."""
        turn = Rotation.from_matrix(rotation)
        as_float = lambda values: np.ascontiguousarray(values, np.float32)
        x, y, z = map(float, rotation @ self.origin)
        return replace(
            self,
            centers=as_float(turn.apply(self.centers)),
            rotations=as_float((turn * Rotation.from_quat(self.rotations)).as_quat()),
            harmonics=as_float(np.einsum("jk,nkc->njc", sh_rotation(rotation), self.harmonics)),
            origin=(x, y, z),
        )


def fibonacci_sphere(count: int) -> np.ndarray:
    """Return ``count`` unit directions [count, 3], spread evenly: a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    z, longitude = 1 - 2 * k / count, np.pi * (3 - np.sqrt(5)) * k
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(longitude), radius * np.sin(longitude), z], 1)


def sh_basis(directions: np.ndarray) -> np.ndarray:
    """Return Y_k, [K, 16] float64, of unit ``directions`` [K, 3]."""
    basis = dr.sh_eval(mi.Vector3d(np.ascontiguousarray(np.transpose(directions), np.float64)), DEGREE)
    return np.stack([np.broadcast_to(np.array(Y), len(directions)) for Y in basis], 1)


def sh_rotation(rotation: np.ndarray) -> np.ndarray:
    """Return the matrix [16, 16] that takes coefficients to those of the function turned by ``rotation`` [3, 3] R,
    f'(d) = f(Rᵀ d). Harmonics of a degree stay among themselves, so that a fit to a few directions is exact."""
    directions = fibonacci_sphere(4 * COEFFICIENTS)
    return np.linalg.lstsq(sh_basis(directions), sh_basis(directions @ rotation), rcond=None)[0]

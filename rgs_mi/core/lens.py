"""Lens distortion that a camera still has: Brown's model (1966), as OpenCV and COLMAP write it.

A point at (x, y) = (X/Z, Y/Z) in camera space is seen where a pinhole would see

    x' = x R + 2 p1 x y + p2 (r² + 2 x²)
    y' = y R + p1 (r² + 2 y²) + 2 p2 x y        R = 1 + k1 r² + k2 r⁴,  r² = x² + y²                (11)

Photographs of strong lenses are undistorted when they are read (`datasets.distortion`): this is what calibration left over.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

NEWTON = 3  # steps of `Lens.undistort`; each squares the error, which is some percent at first


@dataclass(frozen=True)
class Lens:
    """The coefficients k1, k2, p1, p2 of (11), Python floats or Dr.Jit values of width 1, and the radius ``reach`` in x/z units
    up to which they hold. Beyond it, where polynomials would run back into the picture, a point moves in proportion to its
    radius. All methods take NumPy arrays or Dr.Jit ones."""

    k1: Any = 0.0
    k2: Any = 0.0
    p1: Any = 0.0
    p2: Any = 0.0
    reach: Any = 1.0

    @property
    def coefficients(self) -> tuple:
        """The numbers (k1, k2, p1, p2)."""
        return self.k1, self.k2, self.p1, self.p2

    def distort(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Return (x', y') of (11)."""
        x, y, part = self._within(x, y)
        r2 = x * x + y * y
        factor = 1 + r2 * (self.k1 + r2 * self.k2)
        return (
            (x * factor + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)) / part,
            (y * factor + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y) / part,
        )

    def jacobian(self, x: Any, y: Any) -> tuple[Any, Any, Any]:
        """Return ∂x'/∂x, ∂x'/∂y = ∂y'/∂x and ∂y'/∂y, at a point beyond ``reach`` those of the nearest within."""
        x, y, _ = self._within(x, y)
        r2 = x * x + y * y
        factor, slope = 1 + r2 * (self.k1 + r2 * self.k2), 2 * self.k1 + 4 * r2 * self.k2
        return (
            factor + x * x * slope + 2 * self.p1 * y + 6 * self.p2 * x,
            x * y * slope + 2 * self.p1 * x + 2 * self.p2 * y,
            factor + y * y * slope + 6 * self.p1 * y + 2 * self.p2 * x,
        )

    def undistort(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Return the (x, y) that `distort` takes to (x', y') = (``x``, ``y``), by Newton's method. Its last step alone is
        differentiable, which is the derivative of the implicit function."""
        import drjit as dr

        plain = Lens(*map(dr.detach, self.coefficients), reach=self.reach)
        goal = [dr.detach(v) for v in (x, y)]
        u, v = goal
        for _ in range(NEWTON - 1):
            u, v = _newton(plain, plain, u, v, *goal)
        return _newton(self, plain, u, v, x, y)

    def _within(self, x, y):
        """The point on the same radius within ``reach``, and its part of the way there."""
        library = np
        if not isinstance(x, np.ndarray):
            import drjit as library
        part = self.reach / library.sqrt(library.maximum(x * x + y * y, self.reach * self.reach))
        return x * part, y * part, part


def _newton(lens, plain, u, v, x, y):
    """One step from (u, v) to what ``lens`` takes to (x, y), with the derivatives of ``plain``."""
    a, b, c = plain.jacobian(u, v)
    found_x, found_y = lens.distort(u, v)
    dx, dy, inverse = x - found_x, y - found_y, 1 / (a * c - b * b)
    return u + (c * dx - b * dy) * inverse, v + (a * dy - b * dx) * inverse

"""The box around the object of a capture without masks: what lies in it reflects the environment; what lies beyond are its
surroundings, which keep the radiance that they were photographed with."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from .camera import Camera, focus_point

if TYPE_CHECKING:
    import mitsuba as mi

_SIZE = 0.5  # half the box's edges at most, in distances of the nearest camera from what all look at
_OUTLIERS = 1.0  # percent of the points that may lie outside, on either side
_MARGIN = 0.1  # room beside the others, over the longest edge
_FEW = 100  # points: fewer say nothing


@dataclass(frozen=True)
class BoundingBox:
    """An axis-aligned box in world space; ``min`` and ``max`` are its corners (x, y, z)."""

    min: tuple[float, float, float]
    max: tuple[float, float, float]

    @classmethod
    def of(cls, numbers: Iterable[float | str]) -> "BoundingBox":
        """Make a box of six numbers: x, y, z of the lower corner, then of the upper.

        Raises: ValueError where they make no box.
        """
        values = tuple(map(float, numbers))
        if len(values) != 6 or not all(a < b for a, b in zip(values[:3], values[3:])) or not np.isfinite(values).all():
            raise ValueError("a box is six numbers, x y z of its lower corner and x y z of its upper")
        x_min, y_min, z_min, x_max, y_max, z_max = values
        return cls((x_min, y_min, z_min), (x_max, y_max, z_max))

    @classmethod
    def seen_by(cls, cameras: Sequence[Camera], points: np.ndarray | None = None) -> "BoundingBox":
        """Return the box of those of ``points`` [N, 3], on surfaces, that lie in a cube about the `focus_point` of ``cameras``,
        which leaves them outside; without points, or where these are few, the cube."""
        center, _ = focus_point(cameras)
        half = _SIZE * max(min(np.linalg.norm(c.origin - center) for c in cameras), 1e-3)
        lower, upper = center - half, center + half
        if points is not None:
            inside = points[((points > lower) & (points < upper)).all(1)]
            if len(inside) >= _FEW:
                least, most = np.percentile(inside, [_OUTLIERS, 100 - _OUTLIERS], axis=0)
                room = _MARGIN * (most - least).max()
                lower, upper = np.maximum(lower, least - room), np.minimum(upper, most + room)
        return cls.of([*lower, *upper])

    @property
    def corners(self) -> tuple[float, float, float, float, float, float]:
        """The six numbers that `of` takes."""
        return (*self.min, *self.max)

    def moved(self, shift: npt.ArrayLike) -> "BoundingBox":
        """Return the box moved by ``shift`` [3]."""
        return self.of((np.reshape(self.corners, (2, 3)) + shift).ravel())

    @property
    def center(self) -> np.ndarray:
        """The middle of the box, [3]."""
        return (np.array(self.min) + self.max) / 2

    @property
    def radius(self) -> float:
        """Half the longest edge, in world units."""
        return float(np.subtract(self.max, self.min).max() / 2)

    def contains(self, point: "mi.Point3f") -> "mi.Bool":
        """Whether each world-space ``point`` lies in the box, its surface included."""
        import drjit as dr
        import mitsuba as mi

        min, max = (mi.Point3f(*(dr.opaque(mi.Float, v) for v in corner)) for corner in (self.min, self.max))
        return dr.all((point >= min) & (point <= max))

    def __str__(self) -> str:
        """The `corners` as a scene file has them."""
        return " ".join(f"{v:.9g}" for v in self.corners)

"""The box around the object of a capture without masks: what lies in it reflects the environment; what lies beyond are its
surroundings, which keep the radiance that they were photographed with."""

from dataclasses import dataclass

import numpy as np

from .camera import looked_at

_SIZE = 0.5  # half the box's edges, in distances of the nearest camera from what all look at


@dataclass(frozen=True)
class BoundingBox:
    """World-space corners, ``min`` and ``max`` (x, y, z)."""

    min: tuple[float, float, float]
    max: tuple[float, float, float]

    @classmethod
    def of(cls, numbers) -> "BoundingBox":
        """From six numbers: x, y, z of the lower corner, then of the upper. Raises: ValueError where they make no box."""
        numbers = tuple(map(float, numbers))
        if len(numbers) != 6 or not all(a < b for a, b in zip(numbers[:3], numbers[3:])) or not np.isfinite(numbers).all():
            raise ValueError("a box is six numbers, x y z of its lower corner and x y z of its upper")
        return cls(numbers[:3], numbers[3:])

    @classmethod
    def seen_by(cls, cameras) -> "BoundingBox":
        """A cube about the point that all ``cameras`` look at, which leaves them outside."""
        center, _ = looked_at(cameras)
        half = _SIZE * max(min(np.linalg.norm(c.origin - center) for c in cameras), 1e-3)
        return cls(tuple(map(float, center - half)), tuple(map(float, center + half)))

    @property
    def center(self) -> np.ndarray:
        """[3]"""
        return (np.array(self.min) + self.max) / 2

    @property
    def radius(self) -> float:
        """Half the longest edge."""
        return float(np.subtract(self.max, self.min).max() / 2)

    def contains(self, point):
        """Whether each ``mi.Point3f`` lies in it, ``mi.Bool``."""
        import drjit as dr
        import mitsuba as mi

        min, max = (mi.Point3f(*(dr.opaque(mi.Float, v) for v in corner)) for corner in (self.min, self.max))
        return dr.all((point >= min) & (point <= max))

    def __str__(self):
        return " ".join(f"{v:.9g}" for v in (*self.min, *self.max))

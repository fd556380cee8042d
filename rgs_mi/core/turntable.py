"""An object on a turntable. Lamps and camera stand still while it turns: seen from the object, lamps go about the table's axis
with the camera (docs/method.md §3)."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .camera import Camera, opaque

if TYPE_CHECKING:
    import mitsuba as mi


@dataclass(frozen=True)
class Turntable:
    """The axis of a turntable, in the world of the object, and the rings of cameras around it.

    axis   unit vector (x, y, z) along the axis
    point  (x, y, z) on the axis, which the cameras look at
    rings  (elevation, turn) of each height that the camera had, in degrees: how high it stands over the plane through
           ``point`` across the axis, and by how much more than its azimuth lamps are turned about the axis, which is not zero
           where someone has moved the camera among the lamps. No rings are one ring without a turn
    """

    axis: tuple[float, float, float]
    point: tuple[float, float, float]
    rings: tuple[tuple[float, float], ...] = ()

    @classmethod
    def of(cls, numbers: Iterable[float | str]) -> "Turntable":
        """Make a turntable of at least six numbers: x, y, z of the axis, then of the point, then elevation and turn of each ring.

        Raises: ValueError where they make none.
        """
        values = tuple(map(float, numbers))
        length = float(np.linalg.norm(values[:3]))
        if len(values) < 6 or len(values) % 2 or not np.isfinite(values).all() or length < 1e-9:
            raise ValueError(
                "a turntable is six numbers, x y z of its axis and x y z of a point on it, and two of each ring of cameras, its "
                "elevation and its lamps' turn"
            )
        x, y, z, *point = values[:6]
        return cls(
            (x / length, y / length, z / length), (point[0], point[1], point[2]), tuple(zip(values[6::2], values[7::2]))
        )

    def __str__(self) -> str:
        """The numbers that `of` takes."""
        return " ".join(f"{v:.9g}" for v in (*self.axis, *self.point, *(v for ring in self.rings for v in ring)))

    def elevation(self, camera: Camera) -> float:
        """Return how high ``camera`` stands, in degrees."""
        away = camera.origin - np.array(self.point)
        return float(np.degrees(np.arcsin(np.clip(away @ self.axis / max(np.linalg.norm(away), 1e-12), -1, 1))))

    def ring(self, camera: Camera) -> int | None:
        """Return which of the rings the ``camera`` is nearest to; None where there are none."""
        if not self.rings:
            return None
        return int(np.argmin([abs(self.elevation(camera) - elevation) for elevation, _ in self.rings]))

    def frame(self) -> np.ndarray:
        """Return [3, 3], whose rows are the direction of azimuth 0, that of 90 degrees, and the axis, unit vectors."""
        axis = np.array(self.axis)
        side = np.cross(axis, np.eye(3)[np.argmin(abs(axis))])
        side /= np.linalg.norm(side)
        return np.stack([side, np.cross(axis, side), axis])

    def to_lamps(self, camera: Camera, width: int = 1, turn: "mi.Float | None" = None) -> "mi.Matrix3f":
        """Return the rotation that takes world-space directions to where the lamps see them when ``camera`` sees the object:
        with φ the camera's azimuth about the axis a and ψ the ``turn`` of its ring in radians (None: as `rings` say),

            R_a(−φ − ψ) = a aᵀ + (1 − a aᵀ) cos(φ + ψ) − [a]ₓ sin(φ + ψ)                                            (13)

        differentiable in what is learned of the camera, whose gradients are added up over the ``width`` of what the kernel
        works on, and in ``turn``.
        """
        import drjit as dr
        import mitsuba as mi

        scalar = lambda v: dr.opaque(mi.Float, float(v))
        side, across, axis = (mi.Vector3f(*map(scalar, row)) for row in self.frame())
        away = opaque(camera, width).origin - mi.Point3f(*map(scalar, self.point))
        x, y = dr.dot(away, side), dr.dot(away, across)
        scale = dr.rcp(dr.maximum(dr.sqrt(dr.square(x) + dr.square(y)), 1e-12))
        if turn is None:
            ring = self.ring(camera)
            turn = scalar(0.0 if ring is None else np.radians(self.rings[ring][1]))
        sine, cosine = dr.sincos(turn)
        c, s = scale * (x * cosine - y * sine), scale * (y * cosine + x * sine)
        return _rotation(axis, c, -s)

    def turned(self, angle: "mi.Float") -> "mi.Matrix3f":
        """Return (13) for cameras at azimuths ``angle``, in radians."""
        import drjit as dr
        import mitsuba as mi

        sine, cosine = dr.sincos(angle)
        return _rotation(mi.Vector3f(*(dr.opaque(mi.Float, v) for v in self.axis)), cosine, -sine)


def _rotation(axis, c, s):
    """The rotation about a unit vector by the angle of this cosine and sine."""
    import mitsuba as mi

    x, y, z = axis
    d = 1 - c
    return mi.Matrix3f(
        [
            [c + x * x * d, x * y * d - z * s, x * z * d + y * s],
            [x * y * d + z * s, c + y * y * d, y * z * d - x * s],
            [x * z * d - y * s, y * z * d + x * s, c + z * z * d],
        ]
    )

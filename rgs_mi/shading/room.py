"""A room that is near: walls around the object on which the environment is painted (docs/method.md §3).

The environment is what a point among them, the center, sees. From elsewhere the same spot of a wall lies in another direction:
light that comes to x along −ω has left a wall at x + ω/u, which the map has in direction

    ω' = (ω + u q) / s,   u = max_a κ_a |ω_a| / (1 − κ_a |q|_a),   s = |ω + u q|,   q = x − center                      (14)

with κ_a the inverse distance from the center to the wall that lies ahead along the axis a, |q|_a how far q lies towards it, and s
how much farther than x the center is from that spot. It is the parallax correction of cube maps (Lagarde and Zanuttini 2012),
written in inverse distances, which are 0 of light at infinity.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

SIDES = ("-x", "+x", "-y", "+y", "-z", "+z")
_LEAST = 0.05  # of 1 − κ|q|: what lies beyond a wall is taken to lie a little before it


@dataclass(frozen=True)
class Room:
    """Six walls across the axes of the environment's frame.

    center    (x, y, z) in world space, from which the environment is seen
    nearness  one over the distances from there to the walls `SIDES`, of world units, of width 6; differentiable
    """

    center: tuple[float, float, float]
    nearness: "mi.Float"

    @classmethod
    def of(cls, numbers: Iterable[float | str]) -> "Room":
        """Make a room of nine numbers: x, y, z of the center, then the distances to the walls `SIDES`, 'inf' where there is none.

        Raises: ValueError where they make none.
        """
        values = tuple(map(float, numbers))
        if len(values) != 9 or not np.isfinite(values[:3]).all() or not all(v > 0 for v in values[3:]):
            raise ValueError(
                "a room is nine numbers, x y z of its center, and the distances of six walls from there, above 0"
            )
        x, y, z, *distances = values
        return cls((x, y, z), mi.Float([1 / d for d in distances]))

    @property
    def distances(self) -> list[float]:
        """From the center to the walls `SIDES`, in world units."""
        return [1 / v if v > 0 else float("inf") for v in self.nearness.numpy().astype(float)]

    def __str__(self) -> str:
        """The numbers that `of` takes."""
        return " ".join(f"{v:.9g}" for v in (*self.center, *self.distances))

    def from_center(self, point: "mi.Point3f") -> "mi.Vector3f":
        """Return the vectors from the center to world-space ``point``, in world space."""
        return mi.Vector3f(point - mi.Point3f(*(dr.opaque(mi.Float, v) for v in self.center)))

    def seen(self, direction: "mi.Vector3f", q: "mi.Vector3f") -> "tuple[mi.Vector3f, mi.Float, mi.Float]":
        """Return ω' of (14), s, and the density dω'/dω = 1 / (s³ (1 − κ|q|)) of directions at the center over those at q; all in
        the environment's frame, ``q`` relative to the center."""
        u, left = self._nearest(direction, q)
        moved = direction + u * q
        s = dr.norm(moved)
        return moved / s, s, dr.rcp(s * s * s * left)

    def seen_from(self, direction: "mi.Vector3f", q: "mi.Vector3f") -> "mi.Vector3f":
        """Return ω of (14): where ``q`` sees what the center sees along ``direction``."""
        u, _ = self._nearest(direction, dr.zeros(type(q)))
        return dr.normalize(direction - u * q)

    def _nearest(self, direction, q):
        """u of (14), and 1 − κ|q| of the wall that is met."""
        u, left = mi.Float(0), mi.Float(1)
        for a in range(3):
            ahead = direction[a] > 0
            index = dr.select(ahead, mi.UInt32(2 * a + 1), mi.UInt32(2 * a))
            kappa = dr.gather(mi.Float, self.nearness, index, mode=dr.ReduceMode.Expand)
            room = dr.maximum(1 - kappa * dr.select(ahead, q[a], -q[a]), _LEAST)
            inverse = kappa * dr.abs(direction[a]) / room
            nearer = inverse > u
            u, left = dr.select(nearer, inverse, u), dr.select(nearer, room, left)
        return u, left

"""What an object stands on: a plane that goes on beyond it, told by points that photographs agree on."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..core.bounding_box import BoundingBox
from ..core.camera import Camera

_TRIED, _REFINED = 500, 5  # planes through a point each; least squares after that
_NEAR = 2.5  # half edges of the box from its center: what is farther away says nothing
_THIN, _ALIGNED = 0.015, 0.9  # half edges of the box that a point of the plane is off it at most; cosine of its normal
_WIDER, _TURNED = 2, 0.8  # the same for least squares: so many times as far, and this cosine
_PART = 0.04  # of the points nearby that a ground has at least


class Plane(NamedTuple):
    """The points p with p · ``normal`` = ``offset``, in world space; the unit ``normal`` points up."""

    normal: np.ndarray
    offset: float

    def height(self, points: np.ndarray) -> np.ndarray:
        """How far [N] ``points`` [N, 3] lie above it, in world units."""
        return points @ self.normal - self.offset


def ground(
    positions: np.ndarray, normals: np.ndarray, box: BoundingBox, cameras: Sequence[Camera], rng: np.random.Generator
) -> Plane | None:
    """Return the plane that the object in the ``box`` stands on, where one is seen: of those through the box, with all
    ``cameras`` above, the one that most of the ``positions`` [N, 3] near it lie on, by their unit ``normals`` [N, 3], too
    (Fischler and Bolles 1981), then by least squares."""
    center, reach = box.center, box.radius
    near = np.linalg.norm(positions - center, axis=1) < _NEAR * reach
    points, normals = positions[near].astype(np.float64), normals[near].astype(np.float64)
    eyes = np.array([camera.origin for camera in cameras])

    def on(plane, times, cosine):
        return (abs(plane.height(points)) < times * _THIN * reach) & (normals @ plane.normal > cosine)

    best, most = None, _PART * len(points)
    for i in rng.integers(len(points), size=_TRIED if len(points) else 0):
        plane = Plane(normals[i], float(points[i] @ normals[i]))
        if (plane.height(eyes) <= 0).any() or abs(plane.height(center)) > reach:
            continue
        if (count := on(plane, 1, _ALIGNED).sum()) > most:
            best, most = plane, count
    for _ in range(_REFINED if best else 0):
        there = points[on(best, _WIDER, _TURNED)]
        middle = there.mean(0)
        normal = np.linalg.svd(there - middle, full_matrices=False)[2][2]
        normal *= np.sign(normal @ best.normal)
        best = Plane(normal, float(normal @ middle))
    return best

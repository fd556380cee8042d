"""Which similarity takes one set of points, or of cameras, to another."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .camera import Camera


class Similarity(NamedTuple):
    """The map x → ``scale`` ``rotation`` x + ``translation``, with a rotation [3, 3] and a translation [3]."""

    scale: float
    rotation: np.ndarray
    translation: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return where points [N, 3] go."""
        return self.scale * points @ self.rotation.T + self.translation


def similarity(source: np.ndarray, target: np.ndarray) -> Similarity:
    """Return the similarity that takes the points ``source`` [N, 3] to ``target`` [N, 3] in least squares (Umeyama 1991).

    Raises: ValueError for fewer than three points, and where those of ``source`` are all the same.
    """
    source, target = np.asarray(source, float), np.asarray(target, float)
    if len(source) < 3 or source.shape != target.shape or np.ptp(source, axis=0).max() == 0:
        raise ValueError("a similarity needs three points or more that differ")
    centers = source.mean(0), target.mean(0)
    a, b = source - centers[0], target - centers[1]
    u, size, vh = np.linalg.svd(b.T @ a)
    sign = np.array([1, 1, np.sign(np.linalg.det(u @ vh))])  # a rotation, never a mirror image
    rotation, scale = (u * sign) @ vh, float((size * sign).sum() / (a**2).sum())
    return Similarity(scale, rotation, centers[1] - scale * rotation @ centers[0])


class PoseErrors(NamedTuple):
    """How far cameras are from the true ones, [C] each: ``rotation`` in degrees, and ``position`` in units of the distance
    that was given."""

    rotation: np.ndarray
    position: np.ndarray


def pose_errors(cameras: Sequence[Camera], truth: Sequence[Camera], distance: float) -> PoseErrors:
    """Return the errors of ``cameras`` against the ``truth``, one for one, after the similarity of their positions;
    ``distance``, in the true world, is what errors of position are divided by."""
    origins = np.stack([c.origin for c in cameras])
    aligned = similarity(origins, np.stack([c.origin for c in truth]))
    position = np.linalg.norm(aligned(origins) - [c.origin for c in truth], axis=1) / distance
    trace = np.array([np.trace(c.rotation @ aligned.rotation.T @ t.rotation.T) for c, t in zip(cameras, truth)])
    return PoseErrors(np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1))), position)

"""Two reconstructions of one scene in one frame: they differ by a similarity, a rotation, a scale and a translation."""

from dataclasses import dataclass

import numpy as np

from .camera import Camera


@dataclass(frozen=True)
class Similarity:
    """The map x -> ``scale`` ``rotation`` x + ``translation``: ``rotation`` [3, 3] is proper, ``translation`` is [3]."""

    scale: float
    rotation: np.ndarray
    translation: np.ndarray

    def points(self, points: np.ndarray) -> np.ndarray:
        """Return ``points`` [..., 3] in the other frame."""
        return self.scale * points @ self.rotation.T + self.translation

    def pose(self, to_world: np.ndarray) -> np.ndarray:
        """Return a rigid camera-to-world matrix [4, 4] with the other frame for the world: still rigid."""
        moved = np.eye(4)
        moved[:3, :3] = self.rotation @ to_world[:3, :3]
        moved[:3, 3] = self.points(to_world[:3, 3])
        return moved


def similarity(source: np.ndarray, target: np.ndarray) -> Similarity:
    """Return the similarity that takes the points ``source`` [N, 3] nearest to ``target`` [N, 3] in least squares (Umeyama
    1991).

    Where all points lie on a line, the turn about it is arbitrary.
    Raises: ValueError for other shapes, and where the points of ``source`` are all one.
    """
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3 or not len(source):
        raise ValueError(f"points of shapes {source.shape} and {target.shape}: both must be [N, 3]")
    centers = source.mean(0), target.mean(0)
    a, b = source - centers[0], target - centers[1]
    spread = (a**2).sum()
    if not spread > 0:
        raise ValueError("all points of the source are one")
    u, stretch, v = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ v)) or 1.0])  # a mirror image is no solution
    rotation = (u * signs) @ v
    scale = float((stretch * signs).sum() / spread)
    return Similarity(scale, rotation, centers[1] - scale * rotation @ centers[0])


def pose_errors(cameras: list[Camera], references: list[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Return how far ``cameras`` are from ``references``, the same photographs' in another frame, after the `similarity` of
    their positions: angles of rotation in degrees [N], and distances [N] in units of the references' world.

    Raises: ValueError as `similarity` does.
    """
    positions = [np.stack([camera.origin for camera in some]) for some in (cameras, references)]
    aligned = similarity(*positions)
    turns = np.stack(
        [aligned.pose(a.to_world)[:3, :3] @ b.to_world[:3, :3].T for a, b in zip(cameras, references, strict=True)]
    )
    # of the skew part: an arc cosine knows no angle below 1e-8
    sine = np.linalg.norm(turns - turns.transpose(0, 2, 1), axis=(1, 2)) / np.sqrt(8)
    angles = np.degrees(np.arctan2(sine, (np.trace(turns, axis1=1, axis2=2) - 1) / 2))
    return angles, np.linalg.norm(aligned.points(positions[0]) - positions[1], axis=1)

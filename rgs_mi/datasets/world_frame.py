"""The world of a capture: where up is, where the middle is, and how long a unit, which a reconstruction leaves open; and where
its origin is, which single precision must not be far from."""

from dataclasses import replace

import numpy as np

from ..core.alignment import Similarity
from ..core.camera import Camera, focus_point
from .types import Dataset

DISTANCE = 4.0  # of the cameras from the origin, their median: as in NeRF Synthetic
_FAR = 100  # distances of the cameras from what they look at: there single precision is a hundredth of a pixel
_NOWHERE = 1e-9  # of the way to the origin: cameras that are all in one place do not say how far away anything is
_TRUST = 0.01  # in where a camera's own up points, against that its right is level


def world_frame(cameras: list[Camera]) -> Similarity:
    """Return the map from the world of ``cameras`` to one with z up, the point that they look at (`focus_point`) at the
    origin, and half of them within `DISTANCE` of it.

    Up is where photographs are level: people hold a camera by its horizon, so that its right axis is across the vertical
    whether it looks up or down, and its own up tells which of the two directions that leaves, and all there is to tell where
    all cameras look the same way.
    """
    axes = np.stack([camera.to_world[:3, :3] for camera in cameras])
    right, own = axes[:, :, 0], -axes[:, :, 1].mean(0)
    up = np.linalg.solve(right.T @ right / len(right) + _TRUST * np.eye(3), own)
    length = np.linalg.norm(up)
    up = up / length if length > 1e-9 else np.array([0.0, 0.0, 1.0])
    center, _ = focus_point(cameras)
    away = np.stack([camera.origin for camera in cameras]) - center
    # The first camera is where the azimuth begins: any direction would do, and this one is the same for the same photographs.
    x = np.cross(np.eye(3)[np.abs(up).argmin()], up) if _level(away[0], up) < 1e-6 else away[0] - (away[0] @ up) * up
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(up, x), up])
    scale = DISTANCE / max(float(np.median(np.linalg.norm(away, axis=1))), 1e-9)
    return Similarity(scale, rotation, -scale * rotation @ center)


def recentred(dataset: Dataset) -> Dataset:
    """Return ``dataset`` in a world whose origin is near what the cameras look at and has a short name in the old one, a
    multiple of a power of ten (`Dataset.origin`); the same where it is near already, as in most captures, or where nothing
    tells a distance, as with a single camera.

    What comes after it is single precision: it has steps of a hundredth of the cameras' distance where that is a hundred
    thousandth of the way to the origin.
    """
    cameras = [view.camera for view in (*dataset.train, *dataset.test)]
    center, _ = focus_point(cameras)
    distance = max(float(np.linalg.norm(camera.origin - center)) for camera in cameras)
    if dataset.points is not None and len(dataset.points):
        distance = max(distance, float(np.median(np.linalg.norm(dataset.points - center, axis=1))))
    away = float(np.linalg.norm(center))
    if not _NOWHERE * away < distance < away / _FAR:
        return dataset
    unit = 10.0 ** np.floor(np.log10(distance))
    origin = np.round(center / unit) * unit
    shift = Similarity(1.0, np.eye(3), -origin)

    def moved(views):
        return [replace(v, camera=replace(v.camera, to_world=shift.pose(v.camera.to_world))) for v in views]

    points = None if dataset.points is None else dataset.points - origin
    there = tuple((origin + dataset.origin).tolist())
    return replace(dataset, train=moved(dataset.train), test=moved(dataset.test), points=points, origin=there)


def _level(vector, up):
    """How long a vector is across ``up``, of its length."""
    return np.linalg.norm(vector - (vector @ up) * up) / max(np.linalg.norm(vector), 1e-12)

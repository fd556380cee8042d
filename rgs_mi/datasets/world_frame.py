"""The world of a reconstruction, which motion alone leaves open: where up is, where the middle is, and how long a unit."""

import numpy as np

from ..core.alignment import Similarity
from ..core.camera import Camera, focus_point

DISTANCE = 4.0  # of the cameras from the origin, their median: as in NeRF Synthetic
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


def _level(vector, up):
    """How long a vector is across ``up``, of its length."""
    return np.linalg.norm(vector - (vector @ up) * up) / max(np.linalg.norm(vector), 1e-12)

"""A mirror ball on a turned stand: bands of other roughness, a lacquered belt between gold lines, enamel dots.

The ball is one sphere that curves divide: bands around a tilted axis. Heights along the axis are in radii.
"""

import functools

import numpy as np

from .meshes import Mesh, between, divide, lathe, rounded, unit

RADIUS, CENTER = 0.72, np.array([0.0, 0.0, 0.25])
AXIS = unit(np.array([0.45, -0.20, 0.85]))
BELT, LINE = (-0.20, 0.14), 0.035  # the lacquered belt and the width of the lines beside it
BANDS = {"gloss": (0.30, 0.42), "sheen": (0.50, 0.62), "satin": (0.70, 0.82)}  # rougher and rougher
DOTS, DOT_HEIGHT, DOT_SIZE = 9, -0.50, 0.17  # their number, height and angular radius (radians)


def _height(p):
    """[N] height along the axis, in radii."""
    return (p - CENTER) @ AXIS / RADIUS


def _dots(p):
    """[N] < 0 inside the nearest dot."""
    x = unit(np.cross(AXIS, [0, 1.0, 0]))
    y = np.cross(AXIS, x)
    a = 2 * np.pi * np.arange(DOTS)[:, None] / DOTS
    middles = DOT_HEIGHT * AXIS + np.sqrt(1 - DOT_HEIGHT**2) * (np.cos(a) * x + np.sin(a) * y)
    return np.cos(DOT_SIZE) - (unit(p - CENTER) @ middles.T).max(1)


@functools.cache
def _ball() -> dict[str, Mesh]:
    t = np.linspace(0, np.pi, 257)
    sphere = lathe(RADIUS * np.stack([np.sin(t), np.cos(t)], -1), CENTER, [0, 0, 1], sides=384)
    lines = (BELT[0] - LINE, BELT[0]), (BELT[1], BELT[1] + LINE)
    regions = [
        ("belt", between(_height, *BELT)),
        *(("lines", between(_height, *line)) for line in lines),
        *((name, between(_height, *band)) for name, band in BANDS.items()),
        ("dots", (_dots,)),
    ]
    return {
        name: Mesh(m.vertices, m.faces, unit(m.vertices - CENTER).astype(np.float32))
        for name, m in divide(sphere, regions, rest="mirror").items()
    }


def stand() -> Mesh:
    """A turned foot with a cup for the ball."""
    corners = [
        [0, -0.50],
        [0.20, -0.475],
        [0.26, -0.40],
        [0.31, -0.44],
        [0.23, -0.58],
        [0.15, -0.66],
        [0.18, -0.76],
        [0.40, -0.80],
        [0.44, -0.83],
        [0.44, -0.88],
        [0, -0.88],
    ]
    cuts = [0, 0.02, 0.03, 0.03, 0.05, 0.05, 0.04, 0.02, 0.02, 0.015, 0]
    return lathe(rounded(corners, cuts), np.zeros(3), [0, 0, 1], sides=192)


PARTS = {**{name: lambda name=name: _ball()[name] for name in ("mirror", "belt", "lines", "dots", *BANDS)}, "stand": stand}

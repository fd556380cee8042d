"""A round teapot: porcelain with painted petals and gold lines, gold handle and knob. The spout points to x, z is up."""

import functools

import numpy as np

from . import implicit
from .meshes import Mesh, between, divide, lathe, rounded

CENTER, HALF = np.array([0, 0, -0.09]), (0.57, 0.57, 0.45)  # the belly
STEP = 0.011
SPOUT = [[0.38, 0, -0.24], [0.86, 0, -0.24], [0.66, 0, 0.16], [0.96, 0, 0.30]]
HANDLE = [[-0.40, 0, 0.16], [-1.06, 0, 0.46], [-1.12, 0, -0.34], [-0.46, 0, -0.27]]
LINES = ((0.085, 0.105), (-0.345, -0.325))  # heights of the gold lines around the belly


def _belly(p):
    r, z = np.hypot(p[:, 0], p[:, 1]), p[:, 2]
    belly = implicit.intersection(implicit.ellipsoid(p - CENTER, HALF), -0.50 - z, 0.06)
    foot = implicit.intersection(np.abs(r - 0.27) - 0.05, np.abs(z + 0.50) - 0.06, 0.04)
    neck = implicit.intersection(r - 0.285, np.abs(z - 0.27) - 0.085, 0.03)
    return implicit.union(implicit.union(belly, foot, 0.06), neck, 0.06)


def _handle(p):
    return implicit.swept(p * [1, 0.8, 1], HANDLE, [0.046])


def _field(p):
    spout = implicit.swept(p, SPOUT, [0.155, -0.22, 0.125])
    solid = implicit.union(implicit.union(_belly(p), spout, 0.14), _handle(p), 0.10)
    lip = np.array([0.83, 0, 0.56])  # the spout's mouth: a plane, and a channel behind it
    solid = implicit.intersection(solid, (p - [0.935, 0, 0.285]) @ lip, 0.02)
    channel = implicit.capsule(p, SPOUT[-1], [0.855, 0, 0.222], 0.036)
    return implicit.difference(solid, channel, 0.02)


# ---- Where the materials meet: fields < 0 inside ----


def _on_belly(p):
    return _belly(p) - 0.012


def _turns(p):
    """[N] position around the belly; the ornament repeats at whole numbers."""
    return np.arctan2(p[:, 1], p[:, 0]) * 6 / np.pi


def _leaf(p, tip: float):
    """Leaves that stand on the lower line, their tips at a height."""
    return p[:, 2] - (LINES[1][1] + (tip - LINES[1][1]) * np.abs(np.cos(np.pi * _turns(p))))


def _garland(p):
    return -(p[:, 2] - LINES[0][0] + 0.13 * np.abs(np.sin(np.pi * _turns(p))))


def _dots(p):
    return np.hypot(0.29 * ((_turns(p) % 1) - 0.5), p[:, 2] - 0.140) - 0.022


@functools.cache
def _pot() -> dict[str, Mesh]:
    mesh = implicit.surface(_field, [-1.05, -0.62, -0.6], [1.05, 0.62, 0.45], STEP)
    height = lambda p: p[:, 2]
    below = lambda p: height(p) - LINES[0][0]
    regions = [
        ("handle", (lambda p: 0.035 - _belly(p), lambda p: p[:, 0] + 0.2)),
        *(("lines", (_on_belly, *between(height, *line))) for line in LINES),
        ("body", (_on_belly, lambda p: _leaf(p, -0.19))),
        ("paint", (_on_belly, lambda p: _leaf(p, -0.05), lambda p: LINES[1][1] - height(p))),
        ("paint", (_on_belly, _garland, below)),
        ("paint", (_on_belly, _dots)),
    ]
    return divide(mesh, regions, rest="body")


@functools.cache
def _lid() -> dict[str, Mesh]:
    r = np.linspace(0, 0.255, 60)
    dome = np.stack([r, 0.475 - 0.075 * (r / 0.255) ** 2 - 0.025 * (r / 0.255) ** 6], -1)
    corners = [[0.256, 0.374], [0.300, 0.366], [0.300, 0.345], [0.27, 0.335], [0, 0.335]]
    mesh = lathe(np.vstack([dome, rounded(corners, [0, 0.011, 0.010, 0.01, 0])]), np.zeros(3), [0, 0, 1], sides=256)
    radius = lambda p: np.hypot(p[:, 0], p[:, 1])
    return divide(mesh, [("lid_line", (*between(radius, 0.225, 0.243), lambda p: 0.36 - p[:, 2]))], rest="lid")


def knob() -> Mesh:
    """A turned knob in the middle of the lid."""
    corners = [
        [0, 0.665],
        [0.05, 0.662],
        [0.088, 0.625],
        [0.080, 0.575],
        [0.040, 0.545],
        [0.036, 0.515],
        [0.075, 0.482],
        [0.085, 0.46],
        [0, 0.46],
    ]
    return lathe(rounded(corners, [0, 0.025, 0.028, 0.028, 0.02, 0.016, 0.018, 0.006, 0]), np.zeros(3), [0, 0, 1], sides=128)


PARTS = {
    **{name: lambda name=name: _pot()[name] for name in ("body", "paint", "lines", "handle")},
    **{name: lambda name=name: _lid()[name] for name in ("lid", "lid_line")},
    "knob": knob,
}

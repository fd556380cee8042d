"""A cup of coffee on a saucer with a spoon and a biscuit, on a small round table top.

The cup's handle points to x. Heights are z in the world; what is turned stands on the z axis.
"""

import functools

import numpy as np

from . import implicit
from .meshes import Mesh, between, divide, grid, lathe, rounded

TABLE, FLOOR, RIM, COFFEE = -0.30, -0.235, 0.36, 0.265  # the table's top, the cup's bottom, its rim, the coffee
WALL = 0.034  # thickness of the cup
STEP = 0.0095
UP = (0, 0, 1)


def _radius(p):
    """[N] distance from the z axis."""
    return np.hypot(p[:, 0], p[:, 1])


def _angle(p):
    return np.arctan2(p[:, 1], p[:, 0])


# ---- The table ----


def _star(p):
    """[N] < 0 on the rays of a star around the saucer."""
    return np.maximum(0.3 * (0.1 - np.cos(12 * _angle(p))), np.maximum(0.30 - _radius(p), _radius(p) - 0.72))


@functools.cache
def _table() -> dict[str, Mesh]:
    wood = [[r, TABLE] for r in np.linspace(0, 0.81, 70)]
    edge = [[0.82, TABLE], [0.875, TABLE], [0.895, TABLE - 0.035], [0.86, TABLE - 0.085], [0, TABLE - 0.085]]
    profile = np.vstack([wood, rounded(edge, [0, 0.02, 0.025, 0.02, 0])])
    regions = [
        ("table_edge", (lambda p: 0.85 - _radius(p),)),
        ("table_edge", (lambda p: p[:, 2] - TABLE + 0.02,)),
        ("inlay", (_star,)),
        ("inlay", between(_radius, 0.761, 0.789)),
    ]
    return divide(lathe(profile, np.zeros(3), UP, sides=288), regions, rest="table")


# ---- The china ----


@functools.cache
def _saucer() -> dict[str, Mesh]:
    corners = [
        [0, 0.030],
        [0.20, 0.030],
        [0.235, 0.048],
        [0.27, 0.042],
        [0.40, 0.062],
        [0.615, 0.125],
        [0.63, 0.113],
        [0.42, 0.035],
        [0.27, 0.012],
        [0.26, 0],
        [0.23, 0],
        [0.22, 0.01],
        [0, 0.01],
    ]
    cuts = [0, 0.012, 0.014, 0.014, 0.06, 0.007, 0.007, 0.06, 0.01, 0.006, 0.006, 0.006, 0]
    mesh = lathe(rounded(corners, cuts) + [0, TABLE], np.zeros(3), UP, sides=216)
    return divide(mesh, [("saucer_line", between(_radius, 0.573, 0.597))], rest="saucer")


def _profile(z):
    """Outer radius of the cup at heights z, and how much longer its side is than high."""
    scale, k = RIM - FLOOR, 2.2
    t = np.clip((z - FLOOR) / scale, -0.2, 1.2)
    slope = 0.20 * k / (1 - np.exp(-k)) * np.exp(-k * t) / scale
    return 0.21 + 0.20 * (1 - np.exp(-k * t)) / (1 - np.exp(-k)), np.hypot(1, slope)


def _cup_field(p):
    r, z = _radius(p), p[:, 2]
    outer, length = _profile(z)
    bowl = implicit.intersection((r - outer) / length, FLOOR - z, 0.10)
    foot = implicit.intersection(np.abs(r - 0.185) - 0.026, np.abs(z - FLOOR) - 0.045, 0.035)
    control = [[0.34, 0, 0.235], [0.74, 0, 0.36], [0.70, 0, -0.14], [0.30, 0, -0.085]]
    handle = implicit.swept(p * [1, 0.7, 1], control, [0.036, -0.03, 0.03])
    solid = implicit.union(implicit.union(bowl, foot, 0.03), handle, 0.09)
    hollow = implicit.intersection((r - outer + WALL) / length, FLOOR + WALL - z, 0.12)
    return implicit.intersection(implicit.difference(solid, hollow, 0.02), z - RIM, 0.02)


@functools.cache
def _cup() -> dict[str, Mesh]:
    mesh = implicit.surface(_cup_field, [-0.47, -0.47, TABLE - 0.02], [0.75, 0.47, RIM + 0.04], STEP)
    height = lambda p: p[:, 2]
    inside = lambda p: _radius(p) - _profile(p[:, 2])[0] + WALL / 2
    regions = [
        ("cup_foot", between(height, -1, FLOOR - 0.022)),
        ("cup_inside", (inside,)),
        ("cup_line", between(height, RIM - 0.055, RIM - 0.030)),
    ]
    return divide(mesh, regions, rest="cup")


# ---- The coffee ----


def _swirl(p):
    """[N] < 0 on a swirl of foam."""
    r, a = _radius(p) / 0.35, _angle(p)
    return 0.25 + 1.2 * np.abs(r - 0.45) - np.cos(2 * a - 9 * r)


def _foam(p):
    """[N] < 0 on the foam along the wall."""
    r, a = _radius(p) / 0.35, _angle(p)
    return 0.87 + 0.035 * np.sin(7 * a) + 0.02 * np.sin(13 * a + 1) - r


@functools.cache
def _coffee() -> dict[str, Mesh]:
    edge = _profile(np.array([COFFEE]))[0][0] - WALL
    r = np.append(np.linspace(0, edge - 0.03, 60), edge - 0.03 * (1 - np.sin(np.linspace(0, np.pi / 2, 12)[1:])))
    rise = 0.012 * np.clip((r - edge + 0.03) / 0.03, 0, 1) ** 2
    rim = [[edge, 0.012], [edge + 0.014, 0.012], [edge + 0.014, -0.03], [0, -0.03]]
    profile = np.vstack([np.stack([r, rise], -1)[:-1], rounded(rim, 0.007)]) + [0, COFFEE]
    return divide(lathe(profile, np.zeros(3), UP, sides=192), [("crema", (_swirl,)), ("crema", (_foam,))], rest="coffee")


# ---- Beside the cup ----


def spoon() -> Mesh:
    """A tea spoon across the saucer: a flat tube that widens into a hollow bowl."""
    t = 0.5 * (1 - np.cos(np.linspace(0, np.pi, 301)))[:, None]
    a = 2 * np.pi * (np.arange(49) % 48)[None] / 48
    bowl = np.maximum(1 - ((t - 0.16) / 0.16) ** 2, 0)  # 1 in its middle, 0 at its ends
    rise = lambda low, high: 0.5 - 0.5 * np.cos(np.pi * np.clip((t - low) / (high - low), 0, 1))
    end = np.sqrt(np.maximum(1 - (np.maximum(t - 0.97, 0) / 0.03) ** 2, 0))  # the handle's round end
    width = ((0.080 * np.sqrt(bowl)) ** 4 + ((0.011 + 0.019 * rise(0.45, 1)) * rise(0.1, 0.3) * end) ** 4) ** 0.25
    thick = np.minimum(0.010, 0.4 * width)
    y = width * np.cos(a)
    z = thick * np.sin(a) - 0.026 * bowl**1.5 + 0.026 * np.sqrt(bowl) * (y / 0.080) ** 2
    z = z + 0.035 * np.sin(np.pi * np.clip((t - 0.28) / 0.72, 0, 1)) ** 2
    return grid(np.stack([-0.50 + 1.06 * t + 0 * a, y - 0.435, z + TABLE + 0.125], -1))


def _biscuit_field(p):
    q = p - [0.0, 0.42, TABLE + 0.096]
    c, s = np.cos(0.28), np.sin(0.28)  # it leans on the saucer
    q = np.stack([q[:, 0], q[:, 1] * c + q[:, 2] * s, q[:, 2] * c - q[:, 1] * s], -1)
    r, a = _radius(q), _angle(q)
    slab = implicit.intersection(0.9 * (r - 0.140 - 0.006 * np.cos(16 * a)), np.abs(q[:, 2]) - 0.022, 0.03)
    holes = np.cos(2 * np.pi * q[:, 0] / 0.07) + np.cos(2 * np.pi * q[:, 1] / 0.07)
    return slab + 0.006 * np.exp(-(((2 - holes) / 0.5) ** 2))


def biscuit() -> Mesh:
    return implicit.surface(_biscuit_field, [-0.2, 0.2, TABLE - 0.05], [0.2, 0.62, TABLE + 0.25], 0.006)


def _piece(whole, name: str):
    return lambda: whole()[name]


PARTS = {
    **{
        name: _piece(whole, name)
        for whole, names in (
            (_table, ("table", "inlay", "table_edge")),
            (_saucer, ("saucer", "saucer_line")),
            (_cup, ("cup", "cup_inside", "cup_line", "cup_foot")),
            (_coffee, ("coffee", "crema")),
        )
        for name in names
    },
    "spoon": spoon,
    "biscuit": biscuit,
}

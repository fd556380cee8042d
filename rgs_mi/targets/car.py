"""A small coupe: lacquered body, dark glass, chrome trims, spoked rims on rubber tyres. It drives towards x, z is up.

The body is one solid; curves on it bound the windows, lamps, doors and trims. All fields are negative inside.
"""

import functools

import numpy as np

from . import implicit
from .meshes import Mesh, between, divide, join, lathe, mirrored, rounded, tube

STEP = 0.0105
AXLES, HUB = (0.585, -0.575), -0.165  # x of the axles, z of their middles
TYRE, RIM, TRACK, WELL = 0.150, 0.106, 0.335, 0.167  # radii of tyre and rim, |y| of the wheels, radius of their houses
SILL = -0.215  # z of the underside


def _step(x, start, end):
    """0 before start, 1 after end."""
    t = np.clip((x - start) / (end - start), 0, 1)
    return t**3 * (t * (6 * t - 15) + 10)


def _bump(x, middle, width):
    return np.exp(-(((x - middle) / width) ** 2))


# ---- The body ----


def _nose(p):
    return (p[:, 0] - 0.955 + 0.55 * p[:, 1] ** 2 + 0.6 * (p[:, 2] + 0.11) ** 2) / 1.1


def _tail(p):
    return (-p[:, 0] - 0.925 + 0.40 * p[:, 1] ** 2 + 0.7 * (p[:, 2] + 0.02) ** 2 - 0.10 * (p[:, 2] + 0.02)) / 1.1


def _lower(p):
    """The body below the windows."""
    x, y, z = p[:, 0], np.abs(p[:, 1]), p[:, 2]
    hips = (0.018 * _bump(x, AXLES[0], 0.22) + 0.024 * _bump(x, AXLES[1], 0.24)) * _bump(z, -0.03, 0.12)
    half = 0.385 + hips - 0.35 * (z + 0.08) ** 2 - 0.055 * (x / 0.95) ** 4
    top = 0.075 - 0.105 * _step(x, 0.20, 1.05) - 0.035 * _step(-x, 0.45, 1.0)
    top = top - 0.22 * y**2 + 0.036 * _bump(x, 0.59, 0.25) * _bump(y, 0.31, 0.085)
    solid = implicit.intersection(y - half, z - top, 0.12)
    solid = implicit.intersection(solid, implicit.intersection(_nose(p), _tail(p), 0.1), 0.12)
    return implicit.intersection(solid, SILL - z, 0.05)


def _windscreen(p):
    return 0.50 * (p[:, 0] - 0.40) + 0.866 * (p[:, 2] - 0.05) + 0.45 * p[:, 1] ** 2


def _backlight(p):
    return -0.40 * (p[:, 0] + 0.74) + 0.917 * (p[:, 2] - 0.05) + 0.35 * p[:, 1] ** 2


def _flank(p):
    return (np.abs(p[:, 1]) - 0.355 + 0.42 * (p[:, 2] - 0.06) + 0.10 * (p[:, 0] + 0.1) ** 2) / 1.085


def _roof(p):
    return p[:, 2] - 0.268 + 0.30 * (p[:, 0] + 0.12) ** 2 + 0.35 * p[:, 1] ** 2


def _cabin(p):
    solid = implicit.intersection(implicit.intersection(_windscreen(p), _backlight(p), 0.10), _roof(p), 0.10)
    return implicit.intersection(implicit.intersection(solid, _flank(p), 0.07), -0.05 - p[:, 2], 0.02)


def _axle_distance(p):
    """[N] distance from the nearest axle's line."""
    return np.minimum.reduce([np.hypot(p[:, 0] - x, p[:, 2] - HUB) for x in AXLES])


def _field(p):
    house = implicit.intersection(_axle_distance(p) - WELL, 0.20 - np.abs(p[:, 1]), 0.04)
    return implicit.difference(implicit.union(_lower(p), _cabin(p), 0.05), house, 0.024)


# ---- What is drawn on it ----


def _x(p):
    return p[:, 0]


def _y(p):
    return np.abs(p[:, 1])


def _z(p):
    return p[:, 2]


def _side_window(p):
    """The outline of the side windows, seen from the side."""
    q = p * [1, 0, 1]
    ends = implicit.intersection(_windscreen(q) + 0.075, _backlight(q) + 0.075, 0.06)
    return implicit.intersection(ends, implicit.intersection(0.098 - _z(p), _roof(q) + 0.050, 0.04), 0.05)


def _front_window(p):
    """The outline of the windscreen, seen from the front."""
    heights = implicit.intersection(0.088 - _z(p), _z(p) - 0.232, 0.03)
    return implicit.intersection(_flank(p * [0, 1, 1]) + 0.045, heights, 0.04)


def _rear_window(p):
    heights = implicit.intersection(0.105 - _z(p), _z(p) - 0.228, 0.03)
    return implicit.intersection(_flank(p * [0, 1, 1]) + 0.055, heights, 0.04)


def _wider(field, width: float):
    return lambda p: field(p) - width


def _ellipse(y, z, half_y, half_z, frame=0.0):
    """An ellipse on each side, seen along x, and a frame around it."""
    return lambda p: np.hypot((_y(p) - y) / (half_y + frame), (_z(p) - z) / (half_z + frame)) - 1


def _plate(half_y: float, low: float, high: float, corner: float = 0.03):
    """A rounded rectangle, seen along x."""
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    return lambda p: implicit.box(np.stack([_y(p), _z(p) - middle], -1), [half_y, half], corner)


@functools.cache
def _body() -> dict[str, Mesh]:
    mesh = implicit.surface(_field, [-1, -0.47, -0.27], [1, 0.47, 0.33], STEP)
    front, back, on_side = (lambda p: 0.62 - _x(p)), (lambda p: _x(p) + 0.62), (lambda p: 0.26 - _y(p))
    on_cabin = lambda p: 0.04 - _z(p)
    ahead, behind = (lambda p: -0.035 - _windscreen(p)), (lambda p: -0.035 - _backlight(p))
    ahead_of = lambda p: 0.76 - _x(p) - 0.4 * (_y(p) - 0.262)
    grille, headlamp, taillamp = _plate(0.20, -0.165, -0.085), (0.262, -0.064, 0.070, 0.034), (0.25, -0.015, 0.090, 0.030)
    door = (on_side, *between(_z, SILL + 0.05, 0.06))
    doors = [("seams", (*between(_x, x - 0.003, x + 0.003), *door)) for x in (0.30, -0.22)]
    slats = [("trim", (front, grille, *between(_z, z - 0.005, z + 0.005))) for z in (-0.145, -0.125, -0.105)]
    regions = [
        ("glass", (_side_window, on_side, lambda p: -0.145 - _x(p))),
        ("glass", (_side_window, on_side, lambda p: _x(p) + 0.175)),
        ("glass", (_front_window, ahead, on_cabin)),
        ("glass", (_rear_window, behind, on_cabin)),
        ("trim", (_wider(_side_window, 0.011), on_side)),
        ("seams", (_wider(_front_window, 0.007), ahead, on_cabin)),
        ("seams", (_wider(_rear_window, 0.007), behind, on_cabin)),
        ("headlamps", (_ellipse(*headlamp), ahead_of)),
        ("trim", (_ellipse(*headlamp, frame=0.010), _wider(ahead_of, 0.010))),
        ("taillamps", (_ellipse(*taillamp), back)),
        ("trim", (_ellipse(*taillamp, frame=0.009), back)),
        *slats,
        ("underside", (front, grille)),
        ("trim", (front, _wider(grille, 0.010))),
        ("underside", (lambda p: _axle_distance(p) - WELL - 0.003,)),
        ("underside", (lambda p: _z(p) - SILL - 0.012,)),
        ("trim", (lambda p: _axle_distance(p) - WELL - 0.011, on_side)),
        ("trim", (lambda p: _z(p) - SILL - 0.030, on_side)),
        *doors,
    ]
    return divide(mesh, regions, rest="paint")


# ---- Wheels ----


def _at_wheels(mesh: Mesh) -> Mesh:
    """Four copies of what stands for the left wheels, its middle at the origin, y outward."""
    left = join(*(mesh.moved([x, TRACK, HUB]) for x in AXLES))
    return join(left, mirrored(left))


def tyres() -> Mesh:
    corners = [
        [RIM - 0.01, 0.045],
        [RIM + 0.004, 0.052],
        [TYRE - 0.012, 0.052],
        [TYRE, 0.034],
        [TYRE, -0.034],
        [TYRE - 0.012, -0.052],
        [RIM + 0.004, -0.052],
        [RIM - 0.01, -0.045],
    ]
    ring = rounded([*corners, corners[0]], [0, 0.008, 0.014, 0.016, 0.016, 0.014, 0.008, 0.008, 0])
    return _at_wheels(lathe(ring, np.zeros(3), [0, 1, 0], sides=72))


def _rim_field(p):
    r, y = np.hypot(p[:, 0], p[:, 2]), p[:, 1]
    a = np.arctan2(p[:, 2], p[:, 0])
    a = (a + np.pi / 5) % (2 * np.pi / 5) - np.pi / 5  # five spokes
    u, v = r * np.cos(a), r * np.sin(a)
    face = 0.034 + 0.016 * (r / RIM) ** 2 - 0.012 * _bump(r, 0.0, 0.02)
    slab = implicit.intersection(y - face, face - 0.020 - y, 0.012)
    spoke = implicit.intersection(implicit.intersection(slab, np.abs(v) - 0.014, 0.012), np.maximum(r - RIM, -u), 0.01)
    hub = implicit.intersection(slab, r - 0.034, 0.012)
    ring = implicit.intersection(np.abs(r - RIM + 0.006) - 0.012, np.abs(y) - 0.056, 0.018)
    return implicit.union(implicit.union(spoke, hub, 0.02), ring, 0.016)


def rims() -> Mesh:
    """Five spokes each."""
    half = RIM + 0.022
    return _at_wheels(implicit.surface(_rim_field, [-half, -0.07, -half], [half, 0.07, half], 0.006))


def brakes() -> Mesh:
    """Dark discs behind the spokes, and the axles."""
    corners = [[0, 0.005], [0.098, 0.005], [0.098, -0.03], [0.03, -0.04], [0.03, -0.16], [0, -0.16]]
    profile = rounded(corners, 0.004)
    return _at_wheels(lathe(profile, np.zeros(3), [0, 1, 0], sides=64))


# ---- What sticks out ----


def _spindle(curve, up, width: float, height: float) -> Mesh:
    """A tube with round ends."""
    t = np.linspace(-1, 1, len(curve))
    size = (1 - t**8) ** 0.5
    return tube(np.asarray(curve, float), up, width * size, height * size, sides=24)


def _across(x, half: float, bend: float, z: float) -> np.ndarray:
    """A curve from side to side that bends with the nose or the tail."""
    y = half * np.sin(np.linspace(-np.pi / 2, np.pi / 2, 121))
    return np.stack([x - bend * y**2, y, z + 0 * y], -1)


def bumpers() -> Mesh:
    """Chrome bars in front and behind, and the doors' handles."""
    front, rear = _across(0.955, 0.33, 0.60, -0.185), _across(-0.925, 0.33, -0.45, -0.135)
    t = np.linspace(-0.045, 0.045, 41)
    handle = _spindle(np.stack([t - 0.13, 0.397 + 0 * t - 3 * t**2, 0.015 + 0 * t], -1), [0, 0, 1], 0.010, 0.008)
    return join(_spindle(front, [0, 0, 1], 0.020, 0.018), _spindle(rear, [0, 0, 1], 0.018, 0.018), handle, mirrored(handle))


MIRROR = np.array([0.245, 0.405, 0.115])


@functools.cache
def _mirrors() -> dict[str, Mesh]:
    def field(p):
        shell = implicit.ellipsoid(p - MIRROR, (0.050, 0.052, 0.033))
        shell = implicit.intersection(shell, MIRROR[0] - 0.012 - p[:, 0], 0.012)
        return implicit.union(shell, implicit.capsule(p, MIRROR, MIRROR + [0.03, -0.11, -0.035], 0.012), 0.02)

    mesh = implicit.surface(field, MIRROR - [0.06, 0.15, 0.07], MIRROR + [0.07, 0.07, 0.06], 0.005)
    face = lambda p: np.hypot((p[:, 1] - MIRROR[1]) / 0.042, (p[:, 2] - MIRROR[2]) / 0.024) - 1
    parts = divide(mesh, [("mirror_glass", (face, lambda p: p[:, 0] - MIRROR[0] + 0.006))], rest="mirrors")
    return {name: join(part, mirrored(part)) for name, part in parts.items()}


def exhausts() -> Mesh:
    corners = [[0, -0.03], [0.017, -0.03], [0.019, 0.02], [0.024, 0.02], [0.025, -0.10], [0, -0.10]]
    pipe = lathe(rounded(corners, 0.0025), np.array([-0.88, 0.20, -0.195]), [-1, 0, 0], sides=48)
    return join(pipe, mirrored(pipe))


PARTS = {
    **{
        name: lambda name=name: _body()[name]
        for name in ("paint", "glass", "trim", "seams", "headlamps", "taillamps", "underside")
    },
    **{name: lambda name=name: _mirrors()[name] for name in ("mirrors", "mirror_glass")},
    "tyres": tyres,
    "rims": rims,
    "brakes": brakes,
    "bumpers": bumpers,
    "exhausts": exhausts,
}

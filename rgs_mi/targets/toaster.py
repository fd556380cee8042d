"""A chrome toaster with coloured end caps, a lever, a dial, buttons and two slices of toast. Long in x, the lever at +x."""

import functools

import numpy as np

from . import implicit
from .meshes import Mesh, divide, join, lathe, rounded

CENTER, HALF = np.array([0, 0, -0.07]), np.array([0.69, 0.39, 0.42])  # the housing
SLOT, SLOT_HALF = 0.155, (0.46, 0.078)  # the slots' distance from the middle, half length, half width
CAP = 0.53  # |x| where the end caps begin
TRACK = np.array([0.70, 0, 0.0]), np.array([0.07, 0.024, 0.24])  # the lever's slit: middle and half extents
STEP = 0.0105


def _folded(p):
    """Points relative to the slot at y > 0, those at y < 0 mirrored onto it: there are two of every slot and slice."""
    return np.stack([p[:, 0], np.abs(p[:, 1]) - SLOT, p[:, 2]], -1)


# ---- The housing ----


def _slots(p):
    return implicit.box(_folded(p) - [0, 0, 0.36], [*SLOT_HALF, 0.45], 0.05)


def _track(p):
    return implicit.box(p - TRACK[0], TRACK[1], 0.02)


def _housing(p):
    q = p - CENTER
    shell = implicit.box(q, HALF, 0.16) - 0.03 * (1 - (q[:, 2] / HALF[2]) ** 2)
    shell += 0.012 * np.exp(-(((np.abs(p[:, 0]) - CAP) / 0.014) ** 2))  # a groove where the caps begin
    return implicit.difference(implicit.difference(shell, _slots(p), 0.03), _track(p), 0.016)


@functools.cache
def _shell() -> dict[str, Mesh]:
    mesh = implicit.surface(_housing, -np.array([0.8, 0.5, 0.6]), [0.8, 0.5, 0.45], STEP)
    regions = [
        ("hollows", (lambda p: _slots(p) - 0.003,)),
        ("hollows", (lambda p: _track(p) - 0.003,)),
        ("caps", (lambda p: CAP - np.abs(p[:, 0]),)),
    ]
    return divide(mesh, regions, rest="body")


def base() -> Mesh:
    """A plinth with four feet."""
    plinth = implicit.surface(
        lambda p: implicit.box(p - [0, 0, -0.485], [0.665, 0.365, 0.05], 0.045), [-0.7, -0.4, -0.56], [0.7, 0.4, -0.4], 0.02
    )
    profile = rounded([[0, -0.50], [0.07, -0.50], [0.055, -0.58], [0, -0.58]], [0, 0.01, 0.02, 0])
    feet = [lathe(profile, np.array([x, y, 0.0]), [0, 0, 1], sides=64) for x in (-0.5, 0.5) for y in (-0.24, 0.24)]
    return join(plinth, *feet)


# ---- The slices ----


def _outline(p):
    """[N] field of a slice seen from its face."""
    x, z = p[:, 0], p[:, 2]
    loaf = implicit.box(np.stack([x, 0 * x, z - 0.30], -1), [0.315, 1, 0.28], 0.07)
    return implicit.union(loaf, implicit.ellipsoid(np.stack([x, 0 * x, z - 0.565], -1), [0.365, 1, 0.165]), 0.07)


def _slice_field(p):
    q = _folded(p)
    crumbs = np.sin(61 * q[:, 0] + 3 * np.sin(23 * q[:, 2])) * np.sin(53 * q[:, 2] + 3 * np.sin(29 * q[:, 0]))
    return implicit.intersection(_outline(p), np.abs(q[:, 1]) - 0.046 - 0.0015 * crumbs, 0.035)


def _blotches(p):
    """[N] < 0 where the toast is darker; they differ from face to face."""
    x, z, s = p[:, 0], p[:, 2], 3 * np.sign(p[:, 1]) + np.sign(_folded(p)[:, 1])
    waves = np.sin(17 * x + s + 2 * np.sin(11 * z)) + np.sin(19 * z + 2 * s + 2 * np.sin(13 * x))
    return -0.5 - waves - 0.6 * np.sin(41 * x - 37 * z)


@functools.cache
def _slices() -> dict[str, Mesh]:
    mesh = implicit.surface(_slice_field, [-0.42, -0.24, -0.02], [0.42, 0.24, 0.78], STEP)
    inner = lambda p: _outline(p) + 0.035
    return divide(mesh, [("browned", (lambda p: _outline(p) + 0.070, _blotches)), ("crumb", (inner,))], rest="crust")


# ---- What one touches ----


def lever() -> Mesh:
    """A handle on an arm that comes out of the slit."""
    arm = lambda p: implicit.capsule(p * [1, 1, 0.6], [0.62, 0, 0.078], [0.80, 0, 0.078], 0.014)
    grip = lambda p: implicit.box(p - [0.82, 0, 0.13], [0.045, 0.105, 0.034], 0.032)
    return implicit.surface(lambda p: implicit.union(arm(p), grip(p), 0.02), [0.58, -0.13, 0.08], [0.89, 0.13, 0.18], 0.006)


def dial() -> Mesh:
    profile = rounded(
        [[0, 0.085], [0.062, 0.085], [0.070, 0.03], [0.092, 0.022], [0.092, -0.06], [0, -0.06]],
        [0, 0.016, 0.010, 0.010, 0.01, 0],
    )
    return lathe(profile, np.array([0.70, 0.19, -0.25]), [1, 0, 0], sides=96)


def pointer() -> Mesh:
    """The mark on the dial."""
    start = np.array([0.785, 0.19, -0.25])
    mark = lambda p: implicit.capsule(p, start, start + [0, 0.032, 0.038], 0.009)
    return implicit.surface(mark, start - 0.03, start + [0.03, 0.06, 0.07], 0.003)


def buttons() -> Mesh:
    profile = rounded([[0, 0.048], [0.034, 0.044], [0.040, 0.02], [0.040, -0.06], [0, -0.06]], [0, 0.01, 0.008, 0.005, 0])
    return join(*(lathe(profile, np.array([0.70, -0.19, z]), [1, 0, 0], sides=64) for z in (-0.30, -0.19, -0.08)))


PARTS = {
    **{name: lambda name=name: _shell()[name] for name in ("body", "caps", "hollows")},
    **{name: lambda name=name: _slices()[name] for name in ("crust", "crumb", "browned")},
    "base": base,
    "lever": lever,
    "dial": dial,
    "pointer": pointer,
    "buttons": buttons,
}

"""A kitchen in the morning: a window to a garden, shelves of jars, a fridge and a door, a cooker under copper pans."""

import numpy as np

from .paint import box, dice, mix, noise, pick, room, rows, tiles, where

KITCHEN = (2.6, 2.2), -0.95, 1.65  # half sizes, floor, ceiling


def _garden(u, v):
    """What is outside a window by day: sky, a hedge, a lawn."""
    sky = mix([2.2, 3.0, 4.2], [5.0, 5.2, 5.2], np.clip(noise(1.2 * u, 2.0 * v, 3) * 2.4 - 0.75, 0, 1))
    hedge = mix([0.10, 0.22, 0.05], [0.75, 1.15, 0.35], noise(9 * u, 9 * v, 4) ** 1.5)
    return where(v < 0.30 + 0.5 * noise(1.7 * u, 0 * u, 5), where(v < 0.02, [0.55, 0.95, 0.25], hedge), sky)


def _sink(u, v):
    """A wide window over a sink, tiles, a row of drawers below the worktop."""
    color = tiles(u, v, 0.20, 0.10, [0.62, 0.70, 0.66], [0.30, 0.30, 0.28])
    color = where(box(u, v, (0, 0.72), (1.36, 0.66)), [0.85, 0.83, 0.78], color)
    for center in (-0.66, 0.66):
        glass = box(u, v, (center, 0.72), (0.60, 0.58)) & (np.abs(v - 0.86) > 0.022)
        color = where(glass, _garden(u, v), color)
    pots = (np.abs(u / 0.34 % 1 - 0.5) < 0.25) & (np.abs(u) < 1.2)
    plant = pots & (v > 0.18) & (v < 0.26 + 0.22 * noise(14 * u, 14 * v, 8))
    color = where(plant, [0.06, 0.20, 0.05], where(pots & (v > 0.06) & (v < 0.18), [0.50, 0.17, 0.08], color))
    return where(v < -0.10, _cupboards(u, v + 0.10, 0.55, 0.28, [0.50, 0.47, 0.40]), color)


def _cupboards(u, v, width, height, color):
    """Doors with panels and bright handles; the top board at v = 0."""
    column, x = rows(u, width)
    row, y = rows(v, height)
    tone = np.asarray(color) * (0.9 + 0.2 * dice(column, row))[..., None]
    edge = np.minimum(np.minimum(x, 1 - x) * width, np.minimum(y, 1 - y) * height)
    tone = where((edge > 0.05) & (edge < 0.062), tone * 0.45, tone)
    tone = where(edge < 0.008, [0.03, 0.03, 0.03], tone)
    handle = (np.abs(x - 0.5) * width < 0.07) & (np.abs(y - 0.80) * height < 0.010)
    return where((v > -0.05) & (v < 0), [0.16, 0.13, 0.12], where(handle, [1.6, 1.5, 1.3], tone))


def _jars(u, v):
    """Three lit shelves with jars and plates above tiles."""
    color = tiles(u, v, 0.10, 0.10, [0.66, 0.62, 0.52], [0.34, 0.32, 0.28], 2)
    row, y = rows(v - 0.05, 0.42)
    jar, x = rows(u + 0.05 * row, 0.17)
    tall, dim = 0.35 + 0.40 * dice(jar, row), (row >= 0) & (row < 3) & (np.abs(u) < 1.9)
    content = pick(dice(jar, row, 3 + 0 * row))
    shade = (0.35 + 1.1 * np.sqrt(np.maximum(1 - (2 * x - 1) ** 2 / 0.75, 0)))[..., None]
    color = where(dim, color * (0.45 + 0.8 * y[..., None]), color)
    color = where(dim & (np.abs(x - 0.5) < 0.42) & (y > 0.07) & (y < tall), content * shade, color)
    color = where(dim & (np.abs(x - 0.5) < 0.36) & (y > tall) & (y < tall + 0.08), [0.55, 0.50, 0.42], color)
    color = where(dim & (y < 0.07), [0.46, 0.28, 0.13], color)
    color = where(dim & (y > 0.955), [6.0, 4.9, 3.4], color)
    return where(v < -0.10, _cupboards(u, v + 0.10, 0.60, 0.85, [0.16, 0.24, 0.30]), color)


def _fridge(u, v):
    """A fridge with notes on it, a door to a bright hall, a clock."""
    color = mix([0.62, 0.53, 0.34], [0.52, 0.44, 0.28], (u / 0.16) % 1 > 0.5)
    fridge = box(u, v, (-1.30, 0.10), (0.52, 1.05))
    steel = np.array([0.42, 0.44, 0.46]) * (0.75 + 0.5 * (u + 1.8))[..., None]
    color = where(fridge, where(np.abs(v - 0.28) < 0.012, [0.04, 0.04, 0.04], steel), color)
    i, x = rows(u, 0.17)
    j, y = rows(v, 0.19)
    note = fridge & (dice(i, j) > 0.55) & (np.abs(x - 0.5) < 0.33) & (np.abs(y - 0.5) < 0.36) & (v > 0.33)
    color = where(note, where((y / 0.14) % 1 > 0.35, pick(dice(i, j, 4 + 0 * i)) * 0.5 + 0.45, [0.12, 0.12, 0.14]), color)
    hall = box(u, v, (0.95, 0.10), (0.48, 1.05))
    color = where(box(u, v, (0.95, 0.10), (0.56, 1.13)), [0.85, 0.84, 0.80], color)
    beyond = mix([3.2, 2.6, 1.8], [1.2, 0.85, 0.5], np.clip(0.5 - v, 0, 1))
    beyond = where(box(u, v, (1.05, 0.30), (0.19, 0.26)), pick(np.clip(noise(6 * u, 6 * v, 9), 0, 0.99)) * 1.5, beyond)
    color = where(hall, beyond, color)
    r, a = np.hypot(u + 0.02, v - 0.95), np.arctan2(v - 0.95, u + 0.02)
    hour = (r > 0.19) & (np.abs(a * 6 / np.pi - np.round(a * 6 / np.pi)) < 0.12)
    face = where(hour, [0.03, 0.03, 0.03], [0.95, 0.95, 0.90])
    hand = (np.abs(u + 0.02) < 0.010) & (v > 0.95) & (v < 1.13) | (np.abs(v - 0.95) < 0.012) & (u > -0.02) & (u < 0.11)
    face = where(hand, [0.03, 0.03, 0.03], face)
    return where(r < 0.27, where(r < 0.24, face, [0.55, 0.06, 0.04]), color)


def _oven(u, v):
    """A cooker under a hood with a lamp, copper pans on a rail, cupboards on both sides."""
    color = tiles(u, v, 0.15, 0.15, [0.13, 0.28, 0.36], [0.55, 0.55, 0.52], 5)
    pan, x = rows(u - 0.02, 0.30)
    radius = 0.075 + 0.045 * dice(pan)
    s, t = (x - 0.5) * 0.30, v - 0.42
    copper = mix([0.30, 0.10, 0.04], [1.5, 0.75, 0.42], np.exp(-((s + 0.03) ** 2 + (t - 0.03) ** 2) / 0.003))
    color = where((np.hypot(s, t) < radius) & (np.abs(u) < 1.5), copper, color)
    color = where((np.abs(s) < 0.012) & (t > 0) & (t < 0.22) & (np.abs(u) < 1.5), [0.05, 0.05, 0.05], color)
    color = where((np.abs(v - 0.64) < 0.012) & (np.abs(u) < 1.6), [1.3, 1.2, 1.0], color)
    color = where((v > 0.80) & (np.abs(u) > 0.55), _cupboards(u, v - 1.65, 0.5, 0.85, [0.50, 0.47, 0.40]), color)
    hood = (v > 0.74) & (np.abs(u) < 0.55 - 0.6 * np.maximum(v - 0.84, 0))
    color = where(hood, mix([0.25, 0.25, 0.26], [0.7, 0.7, 0.72], (u + 0.5) / 1.1), color)
    color = where((np.abs(v - 0.765) < 0.02) & (np.abs(u) < 0.48), [9.0, 7.5, 5.0], color)
    color = where(v < -0.10, _cupboards(u, v + 0.10, 0.60, 0.85, [0.16, 0.24, 0.30]), color)
    door = box(u, v, (0, -0.52), (0.28, 0.28))
    return where(door, where(box(u, v, (0, -0.55), (0.22, 0.16)), [1.7, 0.65, 0.16], [0.05, 0.05, 0.05]), color)


def _beams(u, v):
    """A white ceiling with beams, two pendant lamps and spots."""
    color = mix([0.66, 0.65, 0.61], [0.24, 0.13, 0.07], (np.abs(u / 0.9 % 1 - 0.5) > 0.42))
    for x in (-1.0, 1.0):
        r = np.hypot(u - x, v)
        color = where(r < 0.42, where(r < 0.36, [5.0, 4.6, 3.9], [0.04, 0.04, 0.04]), color)
    spot = np.hypot(u % 0.9 - 0.45, v % 1.2 - 0.6)
    return where(spot < 0.07, where(spot < 0.05, [14, 13, 11.5], [0.8, 0.8, 0.8]), color)


def _checks(u, v):
    """A worktop of light wood below the object, and black and white tiles around it."""
    check = (np.floor(u / 0.3) + np.floor(v / 0.3)) % 2
    tile = mix([0.70, 0.69, 0.65], [0.05, 0.05, 0.06], check) * (0.9 + 0.2 * noise(3 * u, 3 * v, 6))[..., None]
    grain = np.sin(70 * v + 9 * noise(2 * u, 6 * v, 7))
    board = mix([0.46, 0.29, 0.15], [0.58, 0.39, 0.22], 0.5 + 0.5 * grain)
    board = where((v / 0.145) % 1 < 0.03, [0.10, 0.06, 0.03], board)
    return where(box(u, v, (0, 0), (1.5, 1.05)), where(box(u, v, (0, 0), (1.46, 1.01)), board, [0.2, 0.12, 0.06]), tile)


def kitchen(d: np.ndarray) -> np.ndarray:
    """Radiance [N, 3] of a kitchen in the morning along unit directions d [N, 3] (z up)."""
    return room(d, *KITCHEN, (_sink, _jars, _fridge, _oven, _beams, _checks))

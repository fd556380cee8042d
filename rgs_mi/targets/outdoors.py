"""Streets: a sunny city with trees, and a shopping street at night. The object stands on the ground in the open."""

import numpy as np

from .paint import dice, mix, noise, pick, rows, where

EYE = 0.5  # height of the object's middle over the ground, in units of the object


def _angles(d):
    """Azimuth [N], and the tangent of the elevation."""
    return np.arctan2(d[:, 1], d[:, 0]), d[:, 2] / np.maximum(np.hypot(d[:, 0], d[:, 1]), 1e-6)


def _ground(d):
    """x and y [N] where downward directions meet the ground."""
    far = EYE / np.maximum(-d[:, 2], 1e-3)
    return d[:, 0] * far, d[:, 1] * far


def _houses(azimuth, slope, count: int, seed: int, low: float, high: float):
    """A ring of houses: number [N], height over the horizon (as a tangent), position across the house (0..1)."""
    # Unequal widths: the houses' borders move by a wave.
    t = azimuth / (2 * np.pi) * count + 0.33 * np.sin(3 * azimuth + seed)
    house, x = rows(t, 1.0)
    house = house % count
    step = (np.abs(x - 0.5) < 0.28) & (dice(house, 2 + seed + 0 * house) > 0.6)  # some have a smaller top
    return house, low + (high - low) * dice(house, seed + 0 * house) + 0.06 * step, x


def _windows(x, slope, house, columns, height):
    """Column and row of a window [N], and whether there is glass."""
    i, s = rows(x * columns, 1.0)
    j, t = rows(slope, height)
    wide = 0.24 + 0.2 * dice(house, 31 + 0 * house)
    return i, j, (np.abs(s - 0.5) < wide) & (np.abs(t - 0.5) < 0.36) & (slope > 0.3 * height)


# ---- By day ----

SUN = np.array([0.38, 0.62, 0.69]) / np.linalg.norm([0.38, 0.62, 0.69])


def _sky(d):
    """Blue with clouds and a sun."""
    z = np.maximum(d[:, 2], 0)
    blue = mix([1.55, 1.75, 1.95], [0.38, 0.72, 1.65], z**0.6)
    u, v = (d[:, k] / (z + 0.18) for k in (0, 1))
    cloud = np.clip(noise(1.1 * u, 1.1 * v, 40) * 3.6 - 1.75, 0, 1) * np.clip(z / 0.15, 0, 1)
    light = mix([1.25, 1.3, 1.4], [3.4, 3.35, 3.2], np.clip(noise(2.3 * u + 5, 2.3 * v, 41) * 2 - 0.5, 0, 1))
    near = d @ SUN
    glow = 1.6 * np.exp((near - 1) / 0.02) + 0.35 * np.exp((near - 1) / 0.15)
    disc = 55 * np.clip((near - 0.9970) / 0.0006, 0, 1)
    return mix(blue, light, cloud) + (glow + disc)[..., None] * np.array([1, 0.94, 0.82])


def _day_house(azimuth, slope, house, x, height, seed):
    """The front of a house by day: stone, glass that mirrors the sky, a cornice; lit from the sun's side."""
    columns = 5 + (6 * dice(house, seed + 1 + 0 * house)).astype(int)
    i, j, glass = _windows(x, slope, house, columns, 0.052)
    stone = mix(pick(dice(house, seed + 3 + 0 * house)), [0.62, 0.56, 0.48], 0.6)
    sunny = 0.45 + 0.75 * np.clip(np.cos(azimuth - np.arctan2(SUN[1], SUN[0]) - np.pi), 0, 1)
    pane = mix([0.10, 0.16, 0.24], [1.1, 1.35, 1.7], dice(house, i, j) ** 2.5)
    color = where(glass, pane, stone * sunny[..., None])
    return where((height - slope < 0.012) | (np.abs(x - 0.5) > 0.492), stone * 0.25, color)


def city(d: np.ndarray) -> np.ndarray:
    """Radiance [N, 3] of a sunny square in a city along unit directions d [N, 3] (z up)."""
    azimuth, slope = _angles(d)
    color = _sky(d)
    for count, seed, low, high, haze in ((21, 50, 0.30, 0.95, 0.30), (15, 60, 0.14, 0.52, 0.0)):
        house, height, x = _houses(azimuth, slope, count, seed, low, high)
        gone = dice(house, seed + 9 + 0 * house) < 0.3 if haze == 0 else False
        front = _day_house(azimuth, slope, house, x, height, seed)
        color = where((slope < height) & ~np.asarray(gone), mix(front, [1.2, 1.4, 1.6], haze), color)
    tree, x = rows(azimuth / (2 * np.pi) * 26, 1.0)
    s, size = (x - 0.5) * 0.24, 0.065 + 0.05 * dice(tree, 71 + 0 * tree)
    leaves = noise(45 * azimuth, 45 * slope, 70)
    crown = np.hypot(s, 0.8 * (slope - 0.17)) + 0.06 * (leaves - 0.5) < size
    there = dice(tree, 72 + 0 * tree) > 0.35
    green = mix([0.03, 0.09, 0.02], [0.45, 0.62, 0.14], np.clip(leaves * 1.5 - 0.35 + (slope - 0.17) * 3, 0, 1))
    color = where(there & (np.abs(s) < 0.007) & (slope < 0.17), [0.09, 0.06, 0.04], color)
    color = where(there & crown, green, color)
    color = where((slope < 0.028) & (np.abs(azimuth * 40 % 1 - 0.5) > 0.2), [0.05, 0.09, 0.04], color)  # a hedge
    return where(d[:, 2] < 0, _square(d), color)


def _square(d):
    """Rings of stones below the object, then slabs and a road with lines and a crossing."""
    x, y = _ground(d)
    i, s = rows(x, 0.62)
    j, t = rows(y, 0.62)
    slab = np.array([0.52, 0.49, 0.44]) * (0.8 + 0.4 * dice(i, j))[..., None]
    slab = where(np.maximum(np.abs(s - 0.5), np.abs(t - 0.5)) > 0.47, [0.20, 0.19, 0.17], slab)
    r, a = np.hypot(x, y), np.arctan2(y, x)
    ring, s = rows(r, 0.11)
    stone, t = rows((a / (2 * np.pi) + 0.5) * (6 * ring + 3), 1.0)
    color = mix([0.24, 0.22, 0.21], [0.62, 0.57, 0.48], ring % 4 == 0) * (0.7 + 0.6 * dice(ring, stone))[..., None]
    joint = (np.minimum(s, 1 - s) * 0.11 < 0.007) | (np.minimum(t, 1 - t) / (6 * ring + 3) * 2 * np.pi * r < 0.007)
    color = where(r < 1.76, where(joint, [0.07, 0.065, 0.06], color), slab)
    road = np.array([0.17, 0.17, 0.18]) * (0.8 + 0.4 * noise(6 * x, 6 * y, 80))[..., None]
    line = (np.abs(y - 3.4) < 0.06) & ((x / 1.2) % 1 < 0.6)
    crossing = (np.abs(x - 1.5) < 0.9) & ((y / 0.5) % 1 < 0.5)
    road = where(line | crossing, [0.95, 0.94, 0.90], road)
    color = where(np.abs(y - 3.4) < 1.4, road, where(np.abs(y - 3.4) < 1.5, [0.75, 0.73, 0.68], color))
    return mix(color, [0.55, 0.55, 0.55], np.clip(r / 40, 0, 1))


# ---- By night ----


def _lamps(azimuth, slope):
    """Street lamps: light [N, 3] to add, and where their poles are."""
    lamp, x = rows(azimuth / (2 * np.pi) * 14, 1.0)
    s, top = (x - 0.5) * 0.449, 0.30 + 0.10 * dice(lamp, 91 + 0 * lamp)
    r = np.hypot(s, (slope - top) * 1.2)
    tint = mix([18, 13, 7], [11, 15, 18], dice(lamp, 92 + 0 * lamp) > 0.7)
    light = tint * ((r < 0.026) + 0.035 * np.exp(-r / 0.05))[..., None]
    return light, (np.abs(s) < 0.004) & (slope < top)


def _night_front(azimuth, slope):
    """Radiance [N, 3] of houses with lit windows, signs and shops, under a sky after sunset."""
    z = np.clip(slope / 2, 0, 1)
    color = mix([0.95, 0.42, 0.40], [0.10, 0.16, 0.42], z**0.45)
    u, v = (2.2 * f(azimuth) / (slope + 0.4) for f in (np.cos, np.sin))
    color = mix(color, color * 0.3 + [0.40, 0.26, 0.30], np.clip(noise(u, v, 150) * 3 - 1.2, 0, 1))
    for count, seed, low, high in ((13, 100, 0.50, 1.20), (9, 110, 0.25, 0.70)):
        house, height, x = _houses(azimuth, slope, count, seed, low, high)
        columns = 3 + (3 * dice(house, seed + 1 + 0 * house)).astype(int)
        i, j, glass = _windows(x, slope, house, columns, 0.13)
        warm = mix([3.6, 2.2, 0.9], [1.6, 2.4, 3.4], dice(house, i, j + 7) > 0.75)
        lit = dice(house, i, j) > 0.5
        pane = where(lit, warm * (0.4 + 0.8 * dice(house, i + 5, j))[..., None], [0.05, 0.07, 0.13])
        wall = pick(dice(house, seed + 3 + 0 * house)) * (0.10 + 0.35 * np.exp(-slope / 0.15))[..., None] + 0.015
        front = where(glass, pane, where(np.abs(x - 0.5) > 0.488, [0.01, 0.01, 0.015], wall))
        # An upright sign on every other house, its colour that of the house.
        tint = pick(dice(house, seed + 5 + 0 * house)) ** 1.3 * 14
        letter, t = rows(slope, 0.10)
        sign = (np.abs(x - 0.18) < 0.055) & (slope > 0.18) & (slope < height - 0.06)
        sign &= dice(house, seed + 6 + 0 * house) > 0.45
        stroke = dice((x * 40).astype(int), (slope * 40).astype(int), letter) > 0.3
        glyph = stroke & (np.abs(x - 0.18) < 0.038) & (np.abs(t - 0.5) < 0.34)
        front = where(sign, where(glyph, tint, tint * 0.06), front)
        color = where(slope < height, front, color)
    shop, x = rows(azimuth / (2 * np.pi) * 20, 1.0)
    glow = mix(pick(dice(shop, 121 + 0 * shop)) * 4, [3.4, 2.9, 2.1], 0.5)
    goods = noise(30 * azimuth, 30 * slope, 120)
    window = (np.abs(x - 0.5) < 0.42) & (slope < 0.12) & (slope > 0.012)
    color = where(slope < 0.15, [0.03, 0.03, 0.035], color)
    color = where(window, glow * (0.25 + 1.3 * goods**2)[..., None], color)
    awning = (slope > 0.12) & (slope < 0.15) & (np.abs(x - 0.5) < 0.46)
    color = where(awning, where((x * 9) % 1 < 0.5, pick(dice(shop, 123 + 0 * shop)) * 0.8, [0.75, 0.72, 0.66]), color)
    light, pole = _lamps(azimuth, slope)
    color = where(pole, [0.02, 0.02, 0.02], color) + light
    for k, span in enumerate((9, 7)):  # strings of coloured bulbs across the street
        _, x = rows(azimuth / (2 * np.pi) * span, 1.0)
        sag = slope - 1.15 - 0.55 * k - 0.9 * (x - 0.5) ** 2
        bulb, t = rows(azimuth / (2 * np.pi) * 120 / (k + 1), 1.0)
        color = where(np.abs(sag) < 0.008, [0.02, 0.02, 0.02], color)
        round_ = np.hypot((t - 0.5) * 0.052 * (k + 1), sag / (1.3 + slope)) < 0.016
        color = where(round_, pick(dice(bulb, 140 + k + 0 * bulb)) * 9 + 1.5, color)
    return color


def night(d: np.ndarray) -> np.ndarray:
    """Radiance [N, 3] of a shopping street after rain, at dusk, along unit directions d [N, 3] (z up)."""
    azimuth, slope = _angles(d)
    above = _night_front(azimuth, np.abs(slope))
    moon = np.arccos(np.clip(d @ (np.array([-0.5, 0.3, 0.81]) / np.linalg.norm([-0.5, 0.3, 0.81])), -1, 1))
    above = where(moon < 0.06, where(noise(30 * d[:, 0], 30 * d[:, 1], 130) > 0.5, [7, 7, 6.6], [5, 5, 4.8]), above)
    # The wet ground mirrors the street between stones.
    x, y = _ground(d)
    i, s = rows(x + 0.17 * (np.floor(y / 0.22) % 2), 0.34)
    j, t = rows(y, 0.22)
    stone = np.array([0.16, 0.15, 0.15]) * (0.5 + dice(i, j))[..., None]
    joint = np.minimum(np.minimum(s, 1 - s) * 0.34, np.minimum(t, 1 - t) * 0.22) < 0.012
    wet = np.clip(noise(0.8 * x, 0.8 * y, 131) * 2.2 - 0.6, 0.05, 1)
    below = where(joint, [0.03, 0.03, 0.035], stone) + 0.30 * np.minimum(above, 12) * wet[..., None]
    return where(d[:, 2] < 0, below, above)

"""A cafe in the evening: the street behind its window, a bar, neon on brick, mirrors, globe lamps."""

import numpy as np

from .paint import box, dice, mix, noise, pick, room, rows, tiles, where

CAFE = (3.4, 2.8), -1.0, 2.0


def _street(u, v):
    """A shop window at dusk: houses with lit windows across the street, lamps, letters on the glass."""
    sky = mix([1.1, 0.75, 0.85], [0.16, 0.28, 0.75], np.clip(v / 1.6, 0, 1))
    house, x = rows(u + 0.2, 0.9)
    height = 0.55 + 0.75 * dice(house)
    i, s = rows(x * 0.9, 0.15)
    j, t = rows(v, 0.21)
    lit = (np.abs(s - 0.5) < 0.30) & (np.abs(t - 0.5) < 0.34)
    glow = mix([0.05, 0.06, 0.09], [3.6, 2.3, 0.9], (dice(house, i, j) > 0.45) * (0.4 + 0.6 * dice(house, i, j + 9)))
    front = where(lit, glow, pick(dice(house, 5 + 0 * house)) * 0.22)
    color = where(v < height, front, sky)
    color = where(v < 0.06, mix([0.10, 0.10, 0.13], [1.2, 0.7, 0.3], noise(4 * u, 14 * v, 2) ** 3), color)
    for k, tint in enumerate(([9, 2.0, 1.0], [9, 7.5, 4.5], [1.2, 6, 2.2], [9, 6.5, 3.0], [2.0, 3.5, 9])):
        r = np.hypot(u - (-1.9 + 0.93 * k), v - (0.20 + 0.13 * ((3 * k) % 4)))
        color = where(r < 0.085, tint, color)
    letter, a = rows(u, 0.22)
    stroke = (np.abs(a - 0.5) < 0.36) & (np.abs(v - 1.42) < 0.13) & (np.abs(u) < 1.5)
    hollow = (np.abs(a - 0.5) < 0.20) & (np.abs(v - 1.42 - 0.04 * (dice(letter) - 0.5)) < 0.07)
    hollow &= dice(letter, 3 + 0 * letter) > 0.2
    color = where(stroke & ~hollow, [5.5, 4.4, 2.2], color)
    frame = (np.abs(u / 1.3 % 1 - 0.5) > 0.47) | (np.abs(v - 1.14) < 0.03) | (v < -0.15) | (v > 1.72)
    return where(frame, mix([0.09, 0.035, 0.022], [0.16, 0.07, 0.04], (v / 0.28) % 1 > 0.1), color)


def _bar(u, v):
    """Bottles on glass shelves before a lit wall, a counter of panels below."""
    back = mix([2.6, 1.75, 0.9], [1.2, 0.6, 0.25], np.clip(np.abs(u) / 2.8, 0, 1))
    row, y = rows(v - 0.02, 0.46)
    bottle, x = rows(u + 0.04 * row, 0.105)
    tall, s = 0.55 + 0.30 * dice(bottle, row), np.abs(x - 0.5)
    shape = (y > 0.05) & (s < np.where(y < 0.6 * tall, 0.38, 0.13)) & (y < tall) & (dice(bottle, row, 6 + 0 * row) > 0.15)
    glass = pick(dice(bottle, row, 1 + 0 * row)) * (0.15 + 1.5 * (s < 0.15) * (y < 0.5 * tall))[..., None]
    color = where(shape, glass, back * (0.6 + 0.7 * y)[..., None])
    color = where(y < 0.05, [0.5, 0.55, 0.5], color)
    color = where((np.abs(u / 1.4 % 1 - 0.5) > 0.475) | (v > 1.40), [0.07, 0.03, 0.02], color)
    panel = mix([0.11, 0.045, 0.025], [0.20, 0.09, 0.05], (np.abs(u / 0.6 % 1 - 0.5) < 0.38) & (np.abs(v + 0.55) < 0.28))
    return where(v < -0.10, where(v > -0.17, [0.9, 0.85, 0.75], panel), color)


def _brick_wall(u, v):
    """Brick with posters and a ring and a wave of neon."""
    color = tiles(u, v + 1, 0.27, 0.085, [0.30, 0.10, 0.06], [0.17, 0.15, 0.14], 3)
    poster, x = rows(u, 0.95)
    inside = (np.abs(x - 0.5) < 0.33) & (np.abs(v - 0.30) < 0.42)
    art = pick(np.clip(noise(3.2 * x + 5 * poster, 3.2 * v, 7) * 1.6 - 0.3, 0, 0.99)) * 0.75
    color = where(inside, where((np.abs(x - 0.5) < 0.30) & (np.abs(v - 0.30) < 0.39), art, [0.6, 0.56, 0.5]), color)
    wave, ring = np.abs(v - 1.28 - 0.16 * np.sin(5 * u)), np.abs(np.hypot(u + 1.7, v - 1.28) - 0.24)
    for gap, tint, span in ((wave, [1.2, 8.5, 7.0], np.abs(u - 0.5) < 1.6), (ring, [9.0, 1.4, 4.2], True)):
        halo = np.exp(-np.minimum(gap, 9) / 0.10) * 0.10 * span
        color = where((gap < 0.022) & span, tint, color + halo[..., None] * np.array(tint))
    return where(v < -0.35, mix([0.08, 0.04, 0.03], [0.13, 0.065, 0.045], (u / 0.2) % 1 > 0.08), color)


def _mirrors(u, v):
    """Wainscot, round mirrors that show a bright room, sconces, a striped paper."""
    color = mix([0.16, 0.23, 0.20], [0.34, 0.40, 0.30], (u / 0.24) % 1 > 0.5)
    for x in (-1.55, 0.0, 1.55):
        r = np.hypot(u - x, v - 0.62)
        view = mix([0.35, 0.22, 0.12], [1.6, 1.2, 0.75], noise(3 * u, 3 * v, 11) ** 2)
        color = where(r < 0.50, where(r < 0.46, view, [0.9, 0.62, 0.22]), color)
    for x in (-0.78, 0.78):
        glow = np.exp(-((u - x) ** 2 + (v - 0.70) ** 2) / 0.12)
        color = color + glow[..., None] * np.array([0.9, 0.6, 0.28])
        color = where(box(u, v, (x, 0.72), (0.085, 0.14)), [8.5, 6.5, 3.8], color)
        color = where(box(u, v, (x, 0.53), (0.03, 0.05)), [0.5, 0.35, 0.12], color)
    panel = (np.abs(u / 0.55 % 1 - 0.5) < 0.38) & (np.abs(v + 0.58) < 0.26)
    return where(v < -0.22, mix([0.16, 0.08, 0.045], [0.24, 0.13, 0.07], panel), color)


def _globes(u, v):
    """A dark ceiling of boards with rows of globe lamps."""
    color = mix([0.11, 0.095, 0.08], [0.20, 0.165, 0.14], (v / 0.19) % 1 > 0.12)
    x, y = u % 1.5 - 0.75, (v + 0.45) % 1.5 - 0.75
    r = np.hypot(x, y)
    color = color + (0.45 * np.exp(-r / 0.45))[..., None] * np.array([1.0, 0.78, 0.52])
    return where(r < 0.38, mix([6.6, 5.7, 4.4], [4.6, 3.8, 2.7], (r / 0.38) ** 2), color)


def _mosaic(u, v):
    """A floor of small tiles with stars, darker towards the walls."""
    i, x = rows(u, 0.36)
    j, y = rows(v, 0.36)
    a, b = np.abs(x - 0.5), np.abs(y - 0.5)
    color = mix([0.62, 0.57, 0.48], [0.10, 0.17, 0.24], np.minimum(a, b) + 0.45 * np.maximum(a, b) < 0.17)
    color = where(a + b > 0.80, [0.45, 0.10, 0.06], color)
    color = where(np.maximum(a, b) > 0.485, [0.08, 0.08, 0.08], color)
    return color * (0.55 + 0.35 * np.exp(-(u**2 + v**2) / 3))[..., None]


def cafe(d: np.ndarray) -> np.ndarray:
    """Radiance [N, 3] of a cafe in the evening along unit directions d [N, 3] (z up)."""
    return room(d, *CAFE, (_street, _bar, _brick_wall, _mirrors, _globes, _mosaic))

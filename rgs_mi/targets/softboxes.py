"""A photographer's studio: softboxes, strips behind honeycombs, charts, coloured light, a sweep of paper."""

import numpy as np

from .paint import PALETTE, box, dice, mix, noise, pick, room, rows, where

BOOTH = (3.0, 3.0), -1.1, 2.2


def _softbox(u, v, center, half, tint, cells):
    """Inside and radiance of a softbox: brighter in its middle, sewn in cells, with a black frame."""
    s, t = (u - center[0]) / half[0], (v - center[1]) / half[1]
    seam = np.maximum(np.abs(s * cells[0] / 2 % 1 - 0.5), np.abs(t * cells[1] / 2 % 1 - 0.5)) > 0.475
    cloth = (0.65 + 0.35 * np.exp(-1.2 * (s**2 + t**2)))[..., None] * np.asarray(tint, float)
    edge = np.maximum(np.abs(s), np.abs(t)) > 0.94
    return np.maximum(np.abs(s), np.abs(t)) < 1, where(edge, [0.02, 0.02, 0.02], where(seam, cloth * 0.72, cloth))


def _wall(u, v, low, high):
    """A painted wall, lit from below."""
    color = mix(low, high, np.clip((v + 1.1) / 3.3, 0, 1) ** 0.7)
    return color * (0.85 + 0.3 * noise(1.5 * u, 1.5 * v, 21))[..., None]


def _stands(u, v, color):
    """Tripods and a rail in front of a wall."""
    pole = (np.abs(u % 1.6 - 0.8) < 0.016 + 0.10 * np.maximum(-0.75 - v, 0)) & (v < 0.9)
    return where(pole | (np.abs(v - 1.72) < 0.02), [0.015, 0.015, 0.016], color)


def _key(u, v):
    """The big window of cloth."""
    color = _stands(u, v, _wall(u, v, [0.45, 0.46, 0.50], [0.18, 0.19, 0.21]))
    inside, light = _softbox(u, v, (0.25, 0.50), (1.25, 0.95), [5.2, 5.1, 4.9], (4, 3))
    return where(inside, light, color)


def _strips(u, v):
    """Two tall strips behind honeycombs, a reflector of gold cloth between them."""
    color = _stands(u, v, _wall(u, v, [0.28, 0.34, 0.44], [0.12, 0.14, 0.19]))
    for x, tint in ((-1.55, [5.0, 6.4, 8.5]), (1.55, [5.0, 6.4, 8.5])):
        inside, light = _softbox(u, v, (x, 0.45), (0.27, 1.30), tint, (4, 20))
        color = where(inside, light, color)
    r = np.hypot(u, (v - 0.15) * 0.8)
    gold = np.array([1.5, 0.95, 0.35]) * (0.7 + 0.5 * np.sin(11 * u + 4 * v) ** 2)[..., None]
    return where(r < 0.62, where(r < 0.58, gold, [0.02, 0.02, 0.02]), color)


def _charts(u, v):
    """Charts of colours and lines on a board, monitors that show pictures, a row of small lamps."""
    color = _wall(u, v, [0.55, 0.48, 0.40], [0.27, 0.23, 0.20])
    i, x = rows(u, 0.24)
    j, y = rows(v - 0.05, 0.24)
    patch = pick(dice(i, j, 13 + 0 * i)) * 1.25
    patch = where(np.maximum(np.abs(x - 0.5), np.abs(y - 0.5)) > 0.42, [0.03, 0.03, 0.03], patch)
    color = where(box(u, v, (-1.2, 0.53), (0.72, 0.48)), patch, color)
    r, a = np.hypot(u - 1.2, v - 0.55), np.arctan2(v - 0.55, u - 1.2)
    star = mix([0.95, 0.95, 0.92], [0.03, 0.03, 0.03], np.cos(24 * a) > 0)
    star = where((r / 0.09) % 1 < 0.12, [0.60, 0.08, 0.05], star)
    color = where(box(u, v, (1.2, 0.55), (0.62, 0.55)), where(r < 0.50, star, [0.85, 0.85, 0.82]), color)
    picture = PALETTE[np.clip(noise(2.5 * u, 2.5 * v, 31) * 12 - 2, 0, 8).astype(int)] * 1.6
    color = where(box(u, v, (0, -0.42), (0.75, 0.30)), [0.02, 0.02, 0.02], color)
    color = where(box(u, v, (0, -0.42), (0.71, 0.26)), picture, color)
    lamp = np.hypot(u % 0.5 - 0.25, v - 1.45)
    return where((lamp < 0.10) & (np.abs(u) < 2), where(lamp < 0.075, [10, 8.4, 6.0], [0.3, 0.3, 0.3]), color)


def _gels(u, v):
    """A white wall under two coloured lights, an umbrella, a door."""
    color = _wall(u, v, [0.42, 0.41, 0.42], [0.24, 0.24, 0.25])
    for x, tint in ((-1.7, [1.5, 0.35, 0.10]), (1.7, [0.10, 0.55, 1.3])):
        spread = np.exp(-(((u - x) / (0.35 + 0.35 * (v + 1.1))) ** 2) * 1.6) * np.exp(-(v + 1.1) / 2.2)
        color = color + spread[..., None] * np.array(tint)
    r, a = np.hypot(u, v - 0.75), np.arctan2(v - 0.75, u)
    rib = np.abs(a * 4 / np.pi - np.round(a * 4 / np.pi)) * r < 0.012
    cloth = mix([5.6, 5.5, 5.2], [3.4, 3.3, 3.2], np.clip(r / 0.7, 0, 1) ** 2)
    color = where(r < 0.72 - 0.05 * np.abs(np.sin(4 * a)), where(rib, [0.2, 0.2, 0.2], cloth), color)
    color = where(box(u, v, (0, -0.65), (0.03, 0.75)), [0.02, 0.02, 0.02], color)
    return where((v < -0.95) & ((u / 0.4) % 1 < 0.5), [0.5, 0.42, 0.05], color)


def _truss(u, v):
    """A black ceiling with a truss, an eight-sided softbox and tubes."""
    color = mix([0.035, 0.035, 0.04], [0.075, 0.075, 0.08], np.abs((u + v) / 0.35 % 1 - 0.5) > 0.3)
    rail = (np.abs(np.abs(v) - 1.25) < 0.05) | (np.abs(np.abs(u) - 1.25) < 0.05)
    color = where(rail, [0.36, 0.37, 0.38], color)
    r, a = np.hypot(u, v), np.arctan2(v, u)
    flat = r * np.cos((a + np.pi / 8) % (np.pi / 4) - np.pi / 8)
    cloth = mix([4.6, 4.5, 4.4], [2.8, 2.8, 2.7], np.clip(flat / 0.9, 0, 1) ** 2)
    rib = np.abs((a + np.pi / 8) % (np.pi / 4) - np.pi / 8) > np.pi / 8 - 0.02 / np.maximum(r, 0.05)
    color = where(flat < 0.90, where((flat > 0.86) | rib, [0.05, 0.05, 0.05], cloth), color)
    for x in (-2.1, 2.1):
        color = where(box(u, v, (x, 0), (0.06, 1.7)) & ((v / 0.57) % 1 > 0.06), [9, 9, 9.5], color)
    return color


def _paper(u, v):
    """A sweep of grey paper with marks of tape on a floor of dark boards."""
    boards = mix([0.07, 0.06, 0.055], [0.12, 0.10, 0.09], dice(np.floor(u / 0.14).astype(int)))
    boards = where((u / 0.14) % 1 < 0.05, [0.02, 0.02, 0.02], boards)
    paper = np.array([0.36, 0.37, 0.39]) * (0.65 + 0.4 * np.exp(-(u**2 + v**2) / 1.6))[..., None]
    r = np.hypot(u, v)
    tape = (np.minimum(np.abs(u), np.abs(v)) < 0.022) & (r > 1.0) & (r < 1.35) | (np.abs(r - 1.15) < 0.012)
    paper = where(tape, [0.75, 0.10, 0.07], paper)
    return where(np.abs(u) < 1.7, paper, boards)


def softboxes(d: np.ndarray) -> np.ndarray:
    """Radiance [N, 3] of a photographer's studio along unit directions d [N, 3] (z up)."""
    return room(d, *BOOTH, (_key, _strips, _charts, _gels, _truss, _paper))

"""The studio: a furnished room with a wide window, shelves of books, coloured panels and softboxes."""

import numpy as np

from .paint import box, dice, mix, pick, room, rows

FLOOR, CEILING, HALF_X, HALF_Y = -1.3, 2.1, 3.6, 3.0  # the room, metres; the object is at the origin


# ---- Walls ----


def _window(u, v):
    """A wall with a wide window: sky, a sun behind haze, hills, mullions."""
    sky = mix([1.1, 1.7, 2.8], [3.4, 3.2, 2.8], np.exp(-np.maximum(v + 0.1, 0) / 0.7))
    sun = np.exp(-((u - 0.9) ** 2 + (v - 1.15) ** 2) / 0.16**2)
    sky = sky + sun[..., None] * np.array([15.0, 11.5, 7.0])
    hills = -0.15 + 0.16 * np.sin(1.7 * u + 1) + 0.07 * np.sin(4.3 * u) + 0.02 * np.sin(17 * u)
    view = np.where((v < hills)[..., None], mix([0.15, 0.45, 0.14], [0.6, 0.9, 0.8], np.clip(v + 0.5, 0, 1)), sky)
    color = mix([0.50, 0.47, 0.42], [0.42, 0.36, 0.30], v < -0.75)
    pane_u, pane_v = np.abs((u / 0.8) % 1 - 0.5), np.abs(((v + 0.45) / 0.75) % 1 - 0.5)
    glass = box(u, v, (0, 0.68), (2.0, 1.12)) & (pane_u < 0.455) & (pane_v < 0.45)
    color = np.where(box(u, v, (0, 0.68), (2.1, 1.22))[..., None], [0.10, 0.09, 0.09], color)
    curtain = (np.abs(u) > 2.2) & (np.abs(u) < 2.75)
    fold = 0.55 + 0.45 * np.sin(38 * u)
    color = np.where(curtain[..., None], np.array([0.75, 0.20, 0.12]) * fold[..., None], color)
    return np.where(glass[..., None], view, color)


def _shelves(u, v):
    """Books on lit shelves."""
    row, y = rows(v - FLOOR, 0.42)
    book, x = rows(u + 0.013 * np.sin(5 * u + row), 0.085)
    tall = 0.45 + 0.45 * dice(row, book)
    color = pick(dice(book, row, 7 + 0 * row)) * (0.45 + 0.5 * dice(row, book, 3 + 0 * row))[..., None]
    label = (y > 0.25) & (y < 0.33) & (dice(book, row, 11 + 0 * row) > 0.4)
    color = np.where(label[..., None], [0.85, 0.75, 0.5], color)
    present = (y > 0.09) & (y < tall) & (x > 0.06) & (x < 0.94) & (dice(book, row, 5 + 0 * row) > 0.12)
    color = np.where(present[..., None], color, [0.09, 0.065, 0.05])
    color = np.where((y < 0.09)[..., None], [0.42, 0.26, 0.14], color)
    strip = (y > 0.93) & (np.abs(u) < 2.5) & (row % 2 == 0)
    color = color * (0.6 + 1.3 * y * (row % 2 == 0))[..., None]
    color = np.where(strip[..., None], [5.0, 3.8, 2.4], color)
    upright = np.abs((u + 0.5) % 1.0 - 0.5) < 0.025
    return np.where(upright[..., None], [0.45, 0.28, 0.15], color)


def _panels(u, v):
    """Coloured panels of many sizes with white joints, and two standing lamp strips."""
    i, x = rows(u, 0.55)
    j, y = rows(v - FLOOR + 0.2 * (i % 2), 0.48)
    fine = dice(i, j) > 0.6
    i2, x2 = rows(u, 0.55 / 4)
    j2, y2 = rows(v - FLOOR + 0.2 * (i % 2), 0.12)
    color = np.where(fine[..., None], pick(dice(i2, j2)), pick(dice(i, j, 2 + 0 * i)))
    joint = np.where(
        fine, np.maximum(np.abs(x2 - 0.5), np.abs(y2 - 0.5)) > 0.43, np.maximum(np.abs(x - 0.5), np.abs(y - 0.5)) > 0.475
    )
    color = np.where(joint[..., None], [0.85, 0.85, 0.85], color * 0.9)
    for center, tint in ((-1.65, [3.5, 5.5, 8.0]), (1.65, [8.0, 5.0, 3.0])):
        color = np.where(box(u, v, (center, 0.35), (0.16, 1.45))[..., None], [0.04, 0.04, 0.04], color)
        color = np.where((box(u, v, (center, 0.35), (0.11, 1.38)) & ((v / 0.23) % 1 > 0.12))[..., None], tint, color)
    return color


def _bricks(u, v):
    """Brick, two framed pictures and a large softbox."""
    row, y = rows(v - FLOOR, 0.105)
    brick, x = rows(u + 0.16 * (row % 2), 0.32)
    tone = 0.55 + 0.6 * dice(row, brick)
    color = np.array([0.42, 0.17, 0.11]) * tone[..., None]
    color = np.where(((y < 0.12) | (x < 0.05))[..., None], [0.48, 0.45, 0.42], color)
    for center, kind in ((-2.3, 0), (2.3, 1)):
        inside = box(u, v, (center, 0.45), (0.62, 0.82))
        color = np.where(inside[..., None], [0.75, 0.58, 0.22], color)
        s, t = u - center, v - 0.45
        angle, r = np.arctan2(t, s), np.hypot(s, t)
        rings = pick(((np.floor(r / 0.09) * 3) % 9 + 0.5) / 9)
        rays = pick(((np.floor(angle / (np.pi / 8)) % 9) + 0.5) / 9)
        color = np.where(box(u, v, (center, 0.45), (0.52, 0.72))[..., None], (rings, rays)[kind] * 1.1, color)
    color = np.where(box(u, v, (0, 0.55), (1.28, 0.98))[..., None], [0.03, 0.03, 0.03], color)
    cloth = 2.4 + 1.6 * np.exp(-(u**2 + (v - 0.55) ** 2) / 0.9)
    cell = np.maximum(np.abs(u % 0.59 - 0.295), np.abs((v - 0.55) % 0.59 - 0.295)) < 0.28
    lit = cell & box(u, v, (0, 0.55), (1.18, 0.88))
    return np.where(lit[..., None], cloth[..., None] * np.array([1.0, 0.97, 0.92]), color)


def _ceiling(u, v):
    """White tiles, two softboxes and a ring lamp."""
    tile = np.maximum(np.abs(u / 0.6 % 1 - 0.5), np.abs(v / 0.6 % 1 - 0.5)) > 0.475
    color = mix([0.62, 0.62, 0.60], [0.30, 0.30, 0.30], tile)
    for x, tint in ((-1.9, [3.6, 3.9, 4.4]), (1.9, [4.6, 4.1, 3.4])):
        frame, cloth = box(u, v, (x, 0), (0.62, 1.55)), box(u, v, (x, 0), (0.6, 1.5))
        cell = np.maximum(np.abs((u - x) / 0.3 % 1 - 0.5), np.abs(v / 0.3 % 1 - 0.5)) < 0.45
        color = np.where(frame[..., None], np.where((cell & cloth)[..., None], tint, 0.05), color)
    r = np.hypot(u, v)
    return np.where((np.abs(r - 0.72) < 0.09)[..., None], [8.0, 7.6, 6.8], color)


def _floor(u, v):
    """Planks, and a checkered round rug with a border below the object."""
    row, y = rows(v, 0.16)
    plank, x = rows(u + 0.7 * dice(row), 1.3)
    grain = 0.8 + 0.12 * np.sin(60 * v + 3 * np.sin(4 * u + row)) + 0.35 * (dice(row, plank) - 0.5)
    color = np.array([0.36, 0.21, 0.11]) * grain[..., None]
    color = np.where(((y < 0.06) | (x < 0.012))[..., None], [0.05, 0.03, 0.02], color)
    check = (np.floor(u / 0.22) + np.floor(v / 0.22)) % 2
    r = np.hypot(u, v)
    rug = mix([0.70, 0.68, 0.62], [0.06, 0.09, 0.20], check)
    rug = np.where((r > 1.55)[..., None], [0.65, 0.12, 0.08], rug)
    return np.where((r < 1.75)[..., None], rug, color)


def studio(d: np.ndarray) -> np.ndarray:
    """Radiance [N, 3] of a furnished studio along unit directions d [N, 3] (z up)."""
    return room(d, (HALF_X, HALF_Y), FLOOR, CEILING, (_window, _shelves, _panels, _bricks, _ceiling, _floor))

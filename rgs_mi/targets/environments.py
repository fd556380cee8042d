"""High-dynamic-range environments painted by code: a room seen from its middle, with crisp detail for mirrors to show.

A painter maps positions on a wall (metres) to linear radiance. Sources are large and a few times brighter than the
room (the sun, small, reaches 20), so that path tracing converges quickly. Random choices come from fixed seeds.
"""

import functools

import numpy as np

from ..errors import UserError

SUPERSAMPLING = 2
FLOOR, CEILING, HALF_X, HALF_Y = -1.3, 2.1, 3.6, 3.0        # the room, metres; the object is at the origin


def directions(height: int, width: int) -> np.ndarray:
    """[height, width, 3] unit directions of the texels of an equirectangular map, in a z-up world.

    Mitsuba's ``envmap`` is y-up; these are its directions after ``<rotate x="1" angle="90"/>``.
    """
    theta = np.pi * (np.arange(height) + 0.5)[:, None] / height
    phi = 2 * np.pi * (np.arange(width) + 0.5)[None] / width
    return np.stack(np.broadcast_arrays(np.sin(phi) * np.sin(theta), np.cos(phi) * np.sin(theta), np.cos(theta)), -1)


def _mix(a, b, t):
    """a where t is 0, b where t is 1; t [N], a and b broadcast against [N, 3]."""
    t = np.asarray(t, float)[..., None]
    return np.asarray(a, float) * (1 - t) + np.asarray(b, float) * t


def _box(u, v, center, half):
    """Whether (u, v) is inside a rectangle."""
    return (np.abs(u - center[0]) < half[0]) & (np.abs(v - center[1]) < half[1])


def _rows(x, size):
    """Cell number and position within the cell (0..1) along x."""
    cell = np.floor(x / size)
    return cell.astype(int), x / size - cell


def _dice(*keys):
    """[N] pseudo-random numbers in [0, 1) from integer keys [N]."""
    h = np.uint32(2166136261)
    for key in keys:
        h = (h ^ np.asarray(key).astype(np.int64).astype(np.uint32)) * np.uint32(16777619)
        h = (h ^ (h >> np.uint32(15))) * np.uint32(2246822519)
        h = h ^ (h >> np.uint32(13))
    return h / 2.0**32


PALETTE = np.array([[.70, .08, .05], [.05, .25, .55], [.85, .55, .08], [.08, .40, .22], [.75, .72, .65],
                    [.35, .10, .40], [.90, .30, .10], [.10, .50, .55], [.12, .12, .14]])


def _pick(numbers):
    """[N, 3] colours of the palette for numbers in [0, 1)."""
    return PALETTE[(numbers * len(PALETTE)).astype(int)]


# ---- Walls of the studio: u is horizontal, v is up, both in metres ----

def _window(u, v):
    """A wall with a wide window: sky, a sun behind haze, hills, mullions."""
    sky = _mix([1.1, 1.7, 2.8], [3.4, 3.2, 2.8], np.exp(-np.maximum(v + 0.1, 0) / 0.7))
    sun = np.exp(-((u - 0.9) ** 2 + (v - 1.15) ** 2) / 0.16**2)
    sky = sky + sun[..., None] * np.array([15.0, 11.5, 7.0])
    hills = -0.15 + 0.16 * np.sin(1.7 * u + 1) + 0.07 * np.sin(4.3 * u) + 0.02 * np.sin(17 * u)
    view = np.where((v < hills)[..., None], _mix([0.15, 0.45, 0.14], [0.6, 0.9, 0.8], np.clip(v + 0.5, 0, 1)), sky)
    color = _mix([0.50, 0.47, 0.42], [0.42, 0.36, 0.30], v < -0.75)
    pane_u, pane_v = np.abs((u / 0.8) % 1 - 0.5), np.abs(((v + 0.45) / 0.75) % 1 - 0.5)
    glass = _box(u, v, (0, 0.68), (2.0, 1.12)) & (pane_u < 0.455) & (pane_v < 0.45)
    color = np.where(_box(u, v, (0, 0.68), (2.1, 1.22))[..., None], [0.10, 0.09, 0.09], color)
    curtain = (np.abs(u) > 2.2) & (np.abs(u) < 2.75)
    fold = 0.55 + 0.45 * np.sin(38 * u)
    color = np.where(curtain[..., None], np.array([0.75, 0.20, 0.12]) * fold[..., None], color)
    return np.where(glass[..., None], view, color)


def _shelves(u, v):
    """Books on lit shelves."""
    row, y = _rows(v - FLOOR, 0.42)
    book, x = _rows(u + 0.013 * np.sin(5 * u + row), 0.085)
    tall = 0.45 + 0.45 * _dice(row, book)
    color = _pick(_dice(book, row, 7 + 0 * row)) * (0.45 + 0.5 * _dice(row, book, 3 + 0 * row))[..., None]
    label = (y > 0.25) & (y < 0.33) & (_dice(book, row, 11 + 0 * row) > 0.4)
    color = np.where(label[..., None], [0.85, 0.75, 0.5], color)
    present = (y > 0.09) & (y < tall) & (x > 0.06) & (x < 0.94) & (_dice(book, row, 5 + 0 * row) > 0.12)
    color = np.where(present[..., None], color, [0.09, 0.065, 0.05])
    color = np.where((y < 0.09)[..., None], [0.42, 0.26, 0.14], color)
    strip = (y > 0.93) & (np.abs(u) < 2.5) & (row % 2 == 0)
    color = color * (0.6 + 1.3 * y * (row % 2 == 0))[..., None]
    color = np.where(strip[..., None], [5.0, 3.8, 2.4], color)
    upright = np.abs((u + 0.5) % 1.0 - 0.5) < 0.025
    return np.where(upright[..., None], [0.45, 0.28, 0.15], color)


def _panels(u, v):
    """Coloured panels of many sizes with white joints, and two standing lamp strips."""
    i, x = _rows(u, 0.55)
    j, y = _rows(v - FLOOR + 0.2 * (i % 2), 0.48)
    fine = _dice(i, j) > 0.6
    i2, x2 = _rows(u, 0.55 / 4)
    j2, y2 = _rows(v - FLOOR + 0.2 * (i % 2), 0.12)
    color = np.where(fine[..., None], _pick(_dice(i2, j2)), _pick(_dice(i, j, 2 + 0 * i)))
    joint = np.where(fine, np.maximum(np.abs(x2 - 0.5), np.abs(y2 - 0.5)) > 0.43,
                     np.maximum(np.abs(x - 0.5), np.abs(y - 0.5)) > 0.475)
    color = np.where(joint[..., None], [0.85, 0.85, 0.85], color * 0.9)
    for center, tint in ((-1.65, [3.5, 5.5, 8.0]), (1.65, [8.0, 5.0, 3.0])):
        color = np.where(_box(u, v, (center, 0.35), (0.16, 1.45))[..., None], [0.04, 0.04, 0.04], color)
        color = np.where((_box(u, v, (center, 0.35), (0.11, 1.38)) & ((v / 0.23) % 1 > 0.12))[..., None], tint, color)
    return color


def _bricks(u, v):
    """Brick, two framed pictures and a large softbox."""
    row, y = _rows(v - FLOOR, 0.105)
    brick, x = _rows(u + 0.16 * (row % 2), 0.32)
    tone = 0.55 + 0.6 * _dice(row, brick)
    color = np.array([0.42, 0.17, 0.11]) * tone[..., None]
    color = np.where(((y < 0.12) | (x < 0.05))[..., None], [0.48, 0.45, 0.42], color)
    for center, kind in ((-2.3, 0), (2.3, 1)):
        inside = _box(u, v, (center, 0.45), (0.62, 0.82))
        color = np.where(inside[..., None], [0.75, 0.58, 0.22], color)
        s, t = u - center, v - 0.45
        angle, r = np.arctan2(t, s), np.hypot(s, t)
        rings = _pick(((np.floor(r / 0.09) * 3) % 9 + 0.5) / 9)
        rays = _pick(((np.floor(angle / (np.pi / 8)) % 9) + 0.5) / 9)
        color = np.where(_box(u, v, (center, 0.45), (0.52, 0.72))[..., None], (rings, rays)[kind] * 1.1, color)
    color = np.where(_box(u, v, (0, 0.55), (1.28, 0.98))[..., None], [0.03, 0.03, 0.03], color)
    cloth = 2.4 + 1.6 * np.exp(-(u**2 + (v - 0.55) ** 2) / 0.9)
    cell = np.maximum(np.abs(u % 0.59 - 0.295), np.abs((v - 0.55) % 0.59 - 0.295)) < 0.28
    lit = cell & _box(u, v, (0, 0.55), (1.18, 0.88))
    return np.where(lit[..., None], cloth[..., None] * np.array([1.0, 0.97, 0.92]), color)


def _ceiling(u, v):
    """White tiles, two softboxes and a ring lamp."""
    tile = np.maximum(np.abs(u / 0.6 % 1 - 0.5), np.abs(v / 0.6 % 1 - 0.5)) > 0.475
    color = _mix([0.62, 0.62, 0.60], [0.30, 0.30, 0.30], tile)
    for x, tint in ((-1.9, [3.6, 3.9, 4.4]), (1.9, [4.6, 4.1, 3.4])):
        frame, cloth = _box(u, v, (x, 0), (0.62, 1.55)), _box(u, v, (x, 0), (0.6, 1.5))
        cell = np.maximum(np.abs((u - x) / 0.3 % 1 - 0.5), np.abs(v / 0.3 % 1 - 0.5)) < 0.45
        color = np.where(frame[..., None], np.where((cell & cloth)[..., None], tint, 0.05), color)
    r = np.hypot(u, v)
    return np.where((np.abs(r - 0.72) < 0.09)[..., None], [8.0, 7.6, 6.8], color)


def _floor(u, v):
    """Planks, and a checkered round rug with a border below the object."""
    row, y = _rows(v, 0.16)
    plank, x = _rows(u + 0.7 * _dice(row), 1.3)
    grain = 0.8 + 0.12 * np.sin(60 * v + 3 * np.sin(4 * u + row)) + 0.35 * (_dice(row, plank) - 0.5)
    color = np.array([0.36, 0.21, 0.11]) * grain[..., None]
    color = np.where(((y < 0.06) | (x < 0.012))[..., None], [0.05, 0.03, 0.02], color)
    check = (np.floor(u / 0.22) + np.floor(v / 0.22)) % 2
    r = np.hypot(u, v)
    rug = _mix([0.70, 0.68, 0.62], [0.06, 0.09, 0.20], check)
    rug = np.where((r > 1.55)[..., None], [0.65, 0.12, 0.08], rug)
    return np.where((r < 1.75)[..., None], rug, color)


def studio(d: np.ndarray) -> np.ndarray:
    """Radiance [N, 3] of a furnished studio along unit directions d [N, 3] (z up)."""
    with np.errstate(divide="ignore"):
        far = np.array([HALF_X, HALF_Y, 0.0]) / np.abs(d)
        far[:, 2] = np.where(d[:, 2] > 0, CEILING, FLOOR) / d[:, 2]
    p, wall = d * far.min(1, keepdims=True), far.argmin(1)
    x, y, z = p.T
    sides = [(wall == 0) & (x > 0), (wall == 0) & (x < 0), (wall == 1) & (y > 0), (wall == 1) & (y < 0),
             (wall == 2) & (z > 0), (wall == 2) & (z < 0)]
    radiance = np.zeros(d.shape)
    for side, painter, u, v in zip(sides, (_window, _shelves, _panels, _bricks, _ceiling, _floor),
                                   (y, y, x, x, x, x), (z, z, z, z, y, y)):
        radiance[side] = painter(u[side], v[side])
    # Corners are darker: a cheap stand-in for the light that bounces between the walls. Lamps keep their own.
    gap = np.stack([HALF_X - np.abs(x), HALF_Y - np.abs(y), np.minimum(CEILING - z, z - FLOOR)], -1)
    corner = np.sort(gap, axis=1)[:, 1]
    shade = 0.35 + 0.65 * (1 - np.exp(-corner / 0.35))
    return radiance * np.where(radiance.max(1) < 1.2, shade, 1.0)[:, None]


ENVIRONMENTS = {"studio": studio}


@functools.cache
def environment(name: str, height: int = 512) -> np.ndarray:
    """[height, 2 * height, 3] float32 linear radiance of an environment in the layout of Mitsuba's ``envmap``.

    Raises: UserError for an unknown name or a height below 2.
    """
    from . import pick

    painter = pick(ENVIRONMENTS, name, "environment")
    if height < 2:
        raise UserError(f"environment '{name}': resolution is {height}, needs at least 2")
    s = SUPERSAMPLING
    fine = painter(directions(s * height, 2 * s * height).reshape(-1, 3))
    return fine.reshape(height, s, 2 * height, s, 3).mean((1, 3)).astype(np.float32)


def constant(radiance: float, height: int) -> np.ndarray:
    """[height, 2 * height, 3] float32 map of one radiance. Raises: UserError for a height below 2."""
    if height < 2:
        raise UserError(f"environment 'constant': rows is {height}, needs at least 2")
    return np.full((height, 2 * height, 3), radiance, np.float32)

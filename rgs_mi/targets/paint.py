"""What environments are painted with: patterns on walls in metres, random numbers from integers, rooms around the origin.

Painters map positions on a wall, u to the side and v upwards (each [N], metres), to linear radiance [N, 3].
"""

import numpy as np


def mix(a, b, t):
    """a where t is 0, b where t is 1; t [N], a and b broadcast against [N, 3]."""
    t = np.asarray(t, float)[..., None]
    return np.asarray(a, float) * (1 - t) + np.asarray(b, float) * t


def box(u, v, center, half):
    """Whether (u, v) is inside a rectangle."""
    return (np.abs(u - center[0]) < half[0]) & (np.abs(v - center[1]) < half[1])


def rows(x, size):
    """Cell number and position within the cell (0..1) along x."""
    cell = np.floor(x / size)
    return cell.astype(int), x / size - cell


def dice(*keys):
    """[N] pseudo-random numbers in [0, 1) from integer keys [N]."""
    h = np.uint32(2166136261)
    for key in keys:
        h = (h ^ np.asarray(key).astype(np.int64).astype(np.uint32)) * np.uint32(16777619)
        h = (h ^ (h >> np.uint32(15))) * np.uint32(2246822519)
        h = h ^ (h >> np.uint32(13))
    return h / 2.0**32


PALETTE = np.array(
    [
        [0.70, 0.08, 0.05],
        [0.05, 0.25, 0.55],
        [0.85, 0.55, 0.08],
        [0.08, 0.40, 0.22],
        [0.75, 0.72, 0.65],
        [0.35, 0.10, 0.40],
        [0.90, 0.30, 0.10],
        [0.10, 0.50, 0.55],
        [0.12, 0.12, 0.14],
    ]
)


def pick(numbers):
    """[N, 3] colours of the palette for numbers in [0, 1)."""
    return PALETTE[(numbers * len(PALETTE)).astype(int)]


def where(condition, a, b):
    """[N, 3]: colour a where a condition [N] holds, else b; colours are [3] or [N, 3]."""
    return np.where(np.asarray(condition)[..., None], a, b)


def noise(u, v, seed: int = 0):
    """[N] smooth random values in [0, 1): five octaves of noise with details from 1 to 1/16 of a unit."""
    total, weight = 0.0, 0.0
    for octave in range(5):
        x, y, w = u * 2**octave, v * 2**octave, 0.5**octave
        i, j = np.floor(x).astype(int), np.floor(y).astype(int)
        s, t = (f * f * (3 - 2 * f) for f in (x - i, y - j))
        at = lambda a, b: dice(i + a, j + b, seed + octave + 0 * i)
        total += w * ((at(0, 0) * (1 - s) + at(1, 0) * s) * (1 - t) + (at(0, 1) * (1 - s) + at(1, 1) * s) * t)
        weight += w
    return total / weight


def tiles(u, v, size_u, size_v, color, joint, seed: int = 0):
    """Tiles, each a little different, in a running bond."""
    row, y = rows(v, size_v)
    column, x = rows(u + 0.5 * size_u * (row % 2), size_u)
    color = np.asarray(color) * (0.82 + 0.36 * dice(row, column, seed + 0 * row))[..., None]
    edge = np.minimum(np.minimum(x, 1 - x) * size_u, np.minimum(y, 1 - y) * size_v)
    return where(edge < 0.006, joint, color)


def room(d, half, floor: float, ceiling: float, painters) -> np.ndarray:
    """Radiance [N, 3] along unit directions d [N, 3] of a room seen from the origin.

    half: (x, y) distances of the walls; floor, ceiling: their z; painters: of the walls at +x, -x, +y, -y (u is the
    other horizontal axis), of the ceiling and of the floor (u is x, v is y). Corners are darker.
    """
    with np.errstate(divide="ignore"):
        far = np.array([*half, 0.0]) / np.abs(d)
        far[:, 2] = np.where(d[:, 2] > 0, ceiling, floor) / d[:, 2]
    p, wall = d * far.min(1, keepdims=True), far.argmin(1)
    x, y, z = p.T
    sides = [
        (wall == 0) & (x > 0),
        (wall == 0) & (x < 0),
        (wall == 1) & (y > 0),
        (wall == 1) & (y < 0),
        (wall == 2) & (z > 0),
        (wall == 2) & (z < 0),
    ]
    radiance = np.zeros(d.shape)
    for side, painter, u, v in zip(sides, painters, (y, y, x, x, x, x), (z, z, z, z, y, y)):
        radiance[side] = painter(u[side], v[side])
    # A cheap stand-in for the light that bounces between the walls. Lamps keep their own.
    gap = np.stack([half[0] - np.abs(x), half[1] - np.abs(y), np.minimum(ceiling - z, z - floor)], -1)
    corner = np.sort(gap, axis=1)[:, 1]
    shade = 0.35 + 0.65 * (1 - np.exp(-corner / 0.35))
    return radiance * np.where(radiance.max(1) < 1.2, shade, 1.0)[:, None]

"""What environments are painted with: patterns on walls in metres, random numbers from integers, rooms around the origin.

Painters map positions on a wall, u to the side and v upwards (each [N], metres), to linear radiance [N, 3].
"""

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

Painter = Callable[[np.ndarray, np.ndarray], np.ndarray]


def mix(a: npt.ArrayLike, b: npt.ArrayLike, t: npt.ArrayLike) -> np.ndarray:
    """Blend two colours: a where t is 0, b where t is 1; t [N], a and b broadcast against [N, 3]."""
    t = np.asarray(t, float)[..., None]
    return np.asarray(a, float) * (1 - t) + np.asarray(b, float) * t


def box(u: np.ndarray, v: np.ndarray, center: tuple[float, float], half: tuple[float, float]) -> np.ndarray:
    """Return whether (u, v) is inside a rectangle of half extents ``half``, [N]."""
    return (np.abs(u - center[0]) < half[0]) & (np.abs(v - center[1]) < half[1])


def rows(x: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Divide a coordinate [N] into cells of ``size``: return the cell's index, and the position in it (0..1)."""
    cell = np.floor(x / size)
    return cell.astype(int), x / size - cell


def dice(*keys: npt.ArrayLike) -> np.ndarray:
    """Return pseudo-random numbers [N] in [0, 1) from integer keys [N]."""
    h = np.uint32(2166136261)
    for key in keys:
        h = (h ^ np.asarray(key).astype(np.int64).astype(np.uint32)) * np.uint32(16777619)
        h = (h ^ (h >> np.uint32(15))) * np.uint32(2246822519)
        h = h ^ (h >> np.uint32(13))
    return np.asarray(h / 2.0**32)


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


def pick(numbers: np.ndarray) -> np.ndarray:
    """Return colours [N, 3] of the palette for ``numbers`` [N] in [0, 1)."""
    return PALETTE[(numbers * len(PALETTE)).astype(int)]


def where(condition: npt.ArrayLike, a: npt.ArrayLike, b: npt.ArrayLike) -> np.ndarray:
    """Return the colour a where a condition [N] holds, else b, as [N, 3]; colours are [3] or [N, 3]."""
    return np.where(np.asarray(condition)[..., None], a, b)


def noise(u: np.ndarray, v: np.ndarray, seed: int = 0) -> np.ndarray:
    """Return smooth random values [N] in [0, 1): five octaves of noise with details from 1 to 1/16 of a unit."""
    total, weight = np.float64(0), 0.0
    for octave in range(5):
        x, y, w = u * 2**octave, v * 2**octave, 0.5**octave
        i, j = np.floor(x).astype(int), np.floor(y).astype(int)
        s, t = (f * f * (3 - 2 * f) for f in (x - i, y - j))
        at = lambda a, b: dice(i + a, j + b, seed + octave + 0 * i)
        total += w * ((at(0, 0) * (1 - s) + at(1, 0) * s) * (1 - t) + (at(0, 1) * (1 - s) + at(1, 1) * s) * t)
        weight += w
    return np.asarray(total / weight)


def tiles(
    u: np.ndarray,
    v: np.ndarray,
    size_u: float,
    size_v: float,
    color: npt.ArrayLike,
    joint: npt.ArrayLike,
    seed: int = 0,
) -> np.ndarray:
    """Paint tiles of ``size_u`` × ``size_v`` in a running bond, each a little different in ``color``, and their ``joint``."""
    row, y = rows(v, size_v)
    column, x = rows(u + 0.5 * size_u * (row % 2), size_u)
    color = np.asarray(color) * (0.82 + 0.36 * dice(row, column, seed + 0 * row))[..., None]
    edge = np.minimum(np.minimum(x, 1 - x) * size_u, np.minimum(y, 1 - y) * size_v)
    return where(edge < 0.006, joint, color)


def room(d: np.ndarray, half: tuple[float, float], floor: float, ceiling: float, painters: Sequence[Painter]) -> np.ndarray:
    """Return the linear radiance [N, 3] along unit directions ``d`` [N, 3] of a room seen from the origin.

    ``half`` are the (x, y) distances of the walls, ``floor`` and ``ceiling`` their z; ``painters`` those of the walls at +x,
    −x, +y, −y (u is the other horizontal axis), of the ceiling and of the floor (u is x, v is y). Corners are darker.
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

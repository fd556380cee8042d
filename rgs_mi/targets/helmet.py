"""A full-face helmet: two-tone shell with a metal stripe, mirror visor, trims, crest, vents, pivots and a lining.

The shell is star-shaped: a point is radius(direction) * direction. Everything else sits on it. A direction is given by
azimuth and elevation in radians; x is forward, z up.
"""

import functools

import numpy as np
import numpy.typing as npt

from .meshes import Mesh, grid, join, lathe, mirrored, tube, unit

COLUMNS = 384  # points around the helmet
ROWS = {"crown": 110, "stripe": 10, "base": 110}  # and from the top to the edge


# ---- The shell ----


def direction(azimuth: npt.ArrayLike, elevation: npt.ArrayLike) -> np.ndarray:
    """Return the unit vectors [..., 3] of directions."""
    azimuth, elevation = np.broadcast_arrays(azimuth, elevation)
    c = np.cos(elevation)
    return np.stack([c * np.cos(azimuth), c * np.sin(azimuth), np.sin(elevation)], -1)


def _bump(d, azimuth, elevation, width):
    """A Gaussian of the given angular width (radians) around a direction."""
    return np.exp(2 * (d @ direction(azimuth, elevation) - 1) / width**2)


def radius(d: np.ndarray) -> np.ndarray:
    """Return the distance [...] of the shell from the origin along unit directions ``d`` [..., 3]: an egg with a chin and a
    tail."""
    axes = np.full(d.shape, 0.65)
    axes[..., 0] = np.where(d[..., 0] > 0, 0.76, 0.83)
    axes[..., 2] = np.where(d[..., 2] > 0, 0.74, 0.92)
    egg = (np.abs(d / axes) ** 2.5).sum(-1) ** (-1 / 2.5)
    return egg + 0.155 * _bump(d, 0, -0.55, 0.45) + 0.04 * _bump(d, np.pi, -0.15, 0.40)


def surface(azimuth: npt.ArrayLike, elevation: npt.ArrayLike, offset: npt.ArrayLike = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return points [..., 3] at a height ``offset`` [...] over the shell, and the shell's unit normals [..., 3] below them."""
    d = direction(azimuth, elevation)
    p = radius(d)[..., None] * d
    f = lambda q: np.linalg.norm(q, axis=-1) - radius(unit(q))
    normal = unit(np.stack([f(p + e) - f(p - e) for e in 1e-4 * np.eye(3)], -1))
    return p + np.asarray(offset)[..., None] * normal, normal


def _azimuths() -> np.ndarray:
    return 2 * np.pi * (np.arange(COLUMNS + 1) % COLUMNS) / COLUMNS


@functools.cache
def edge() -> np.ndarray:
    """Return the elevation [COLUMNS + 1] of the lower edge, where the shell meets a gently curved plane; by bisection."""
    azimuth = _azimuths()
    height = -0.61 - 0.045 * np.cos(azimuth) + 0.03 * np.cos(2 * azimuth)
    low, high = np.full(azimuth.shape, -1.5), np.zeros(azimuth.shape)
    for _ in range(50):
        mid = 0.5 * (low + high)
        d = direction(azimuth, mid)
        above = radius(d) * d[:, 2] > height
        low, high = np.where(above, low, mid), np.where(above, mid, high)
    return 0.5 * (low + high)


@functools.cache
def _shell() -> Mesh:
    """The whole shell. Rows of faces: crown, stripe, base, each spread evenly between curves that sweep to the back."""
    azimuth = _azimuths()
    seam = np.radians(13 + 27 * np.cos(azimuth) + 4 * np.cos(2 * azimuth))
    bounds = [np.full(azimuth.shape, np.pi / 2), seam, seam - np.radians(4.5), edge()]
    t = [np.linspace(0, 1, n, endpoint=False)[:, None] for n in ROWS.values()]
    rows = [a + (b - a) * s for a, b, s in zip(bounds, bounds[1:], t)]
    # Downwards then around would face inward: the columns run clockwise seen from above.
    return grid(surface(azimuth, np.concatenate([*rows, bounds[-1][None]]))[0][:, ::-1])


def _band(name: str) -> Mesh:
    counts = list(ROWS.values())
    k = list(ROWS).index(name)
    # The faces at the pole are half in number: every other row has 2 * COLUMNS.
    ends = np.cumsum([0, *counts]) * 2 * COLUMNS - COLUMNS
    face = np.arange(len(_shell().faces))
    return _shell().select((face >= max(ends[k], 0)) & (face < ends[k + 1]))


def edge_trim() -> Mesh:
    """A roll around the lower edge."""
    curve, normal = surface(_azimuths(), edge(), -0.006)
    return tube(curve, normal, 0.040, 0.034)


def lining() -> Mesh:
    """The inside, seen from below: starts at the edge and closes under the crown."""
    t = np.linspace(0, 1, 100)[:, None]
    elevation = edge() + (np.pi / 2 - edge()) * t
    depth = 0.10 * np.minimum(1, t / 0.15) ** 0.5
    return grid(surface(_azimuths(), elevation, -depth)[0][:, ::-1])


# ---- The visor ----


def _visor_point(rho, psi) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth and elevation at polar coordinates of the visor's opening (rho = 1 is its boundary)."""
    r = rho * (np.abs(np.cos(psi)) ** 4 + np.abs(np.sin(psi)) ** 4) ** -0.25  # a rounded rectangle
    x, y = r * np.cos(psi), r * np.sin(psi)
    return 1.22 * x, np.radians(5) + np.radians(22 - 7 * x**2) * y


def visor() -> Mesh:
    """A mirror, curved a little more than the shell below it."""
    rho, psi = np.linspace(0, 1, 121)[:, None], 2 * np.pi * (np.arange(481) % 480) / 480
    azimuth, elevation = _visor_point(rho, psi)
    height = np.broadcast_to(0.012 + 0.045 * (1 - rho**4), azimuth.shape)
    return grid(surface(azimuth, elevation, height)[0][:, ::-1])


def visor_trim() -> Mesh:
    """A frame around the visor."""
    psi = 2 * np.pi * (np.arange(641) % 640) / 640
    curve, normal = surface(*_visor_point(1.0, psi), 0.010)
    return tube(curve, normal, 0.026, 0.030)


# ---- Ornaments ----


def _spindle(azimuth, elevation, width: float, height: float) -> Mesh:
    """A tube along a curve on the shell, pointed at both ends like a seed."""
    t = np.linspace(-1, 1, len(azimuth))
    size = np.sqrt(np.maximum(1 - t**2, 0))
    curve, normal = surface(azimuth, elevation)
    return tube(curve, normal, width * size, height * size)


def _cosine(start, stop, count: int = 161) -> np.ndarray:
    """Values from start to stop, denser at the ends, where a spindle is round."""
    return start + (stop - start) * 0.5 * (1 - np.cos(np.linspace(0, np.pi, count)))


def _blade(start: float, stop: float, tilt: float, width: float, height: float) -> Mesh:
    """A spindle from the front over the top to the back, angles in degrees, in a plane tilted to the left (radians)."""
    a = _cosine(np.radians(start), np.radians(stop))
    d = np.stack([np.cos(a) * np.cos(tilt), np.full_like(a, np.sin(tilt)), np.sin(a) * np.cos(tilt)], -1)
    return _spindle(np.arctan2(d[:, 1], d[:, 0]), np.arcsin(d[:, 2]), width, height)


def ridge() -> Mesh:
    """The crest: a tall blade along the middle with a lower one on each side."""
    side = _blade(48, 150, 0.20, 0.022, 0.050)
    return join(_blade(40, 172, 0.0, 0.048, 0.130), side, mirrored(side))


def vents() -> Mesh:
    """Three slats on the chin and a scoop on each side of the brow."""
    slats = [
        _spindle(_cosine(-a, a), np.radians(np.full(161, e)), 0.020, 0.026)
        for a, e in ((0.34, -29), (0.28, -34.5), (0.21, -40))
    ]
    cheek = _spindle(_cosine(0.55, 1.05), np.radians(_cosine(-33, -26)), 0.026, 0.032)
    return join(*slats, cheek, mirrored(cheek))


def knobs() -> Mesh:
    """The visor's two pivots: stepped, rounded discs."""
    azimuth, elevation = 1.36, np.radians(5)
    origin, axis = surface(azimuth, elevation, 0.0)
    t = np.linspace(0, np.pi / 2, 24)
    rounded = lambda r, h, k: np.stack([r - k + k * np.sin(t), h - k + k * np.cos(t)], -1)
    # Doubled points keep creases sharp under smooth normals.
    profile = np.vstack(
        [
            [[0, 0.068]],
            rounded(0.046, 0.068, 0.016),
            [[0.046, 0.046], [0.047, 0.044]],
            rounded(0.092, 0.044, 0.020),
            [[0.092, -0.048], [0.091, -0.050], [0, -0.050]],
        ]
    )
    knob = lathe(profile, origin, axis)
    return join(knob, mirrored(knob))


PARTS = {
    **{name: functools.partial(_band, name) for name in ROWS},
    "edge_trim": edge_trim,
    "lining": lining,
    "visor": visor,
    "visor_trim": visor_trim,
    "ridge": ridge,
    "vents": vents,
    "knobs": knobs,
}

"""Points that fill the unit square evenly: the golden ratio's sequence in two dimensions (Roberts 2018)."""

import drjit as dr
import mitsuba as mi

_R2 = (3242174889, 2447445414)  # its increments, in units of 2⁻³²


def points(n: int, seed: "mi.UInt32", pixel: "mi.UInt32", sample: "mi.UInt32", sets: int = 1) -> "list[mi.Point2f]":
    """Return ``sets`` independent points in [0, 1)²: the element ``sample`` of the sequence, shifted by a random offset that
    is the same wherever ``pixel``, below ``n``, is. Each is uniform then, and those of a pixel fill the square evenly."""
    rng = mi.PCG32(size=n, initstate=mi.UInt64(seed))
    offsets = [[rng.next_uint32() for _ in _R2] for _ in range(sets)]
    dr.eval(offsets)
    return [mi.Point2f(*(_unit(dr.gather(mi.UInt32, o, pixel) + sample * g) for o, g in zip(pair, _R2))) for pair in offsets]


def _unit(x):
    """``mi.UInt32`` as numbers in [0, 1)."""
    return mi.Float(x >> 8) * 2**-24

"""Where split-sum looks the filtered environment up, so that a few isotropic lobes make the BSDF's own.

Away from the normal a microfacet lobe is stretched, cut off at the horizon and moved off the mirror direction, and a Fresnel
term that rises within it moves it further. Taps stand for it: lookups with weights w_k that add up to one, along

    d_k = normalize(d_o + a_k n),   at roughness r_k = min(r exp(b_k), 1)                                          (8)

d_o the mirror direction, n the normal. At n·ω_o = 1, where the filter's kernels are the BSDF's lobe itself, d_k = d_o.
(a, b, log w) are tabled against n·ω_o, roughness and φ, the part of what is reflected that Schlick's Fresnel term adds to a
mirror of constant colour. ``taps.npy`` was fitted to `monte_carlo` under random environments by `rgs-mi fit-taps`.
"""

import functools
from importlib import resources

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import as_float
from .tables import cell

FILE = "taps.npy"
#: Rows are quadratic in the cosine; an entry is (a, b, log w, 0).
COUNT, COSINES, ROUGHNESSES, FRACTIONS = SHAPE = (3, 10, 9, 2)


@functools.lru_cache(maxsize=1)
def shipped() -> np.ndarray:
    """Return the table of this package, [*SHAPE, 4] float32."""
    with (resources.files("rgs_mi.shading") / FILE).open("rb") as stream:
        return np.load(stream, allow_pickle=False)


@functools.lru_cache(maxsize=2)
def _entries(variant):
    return as_float(shipped())


def taps(
    cosine: "mi.Float", roughness: "mi.Float", phi: "mi.Float", entries: "mi.Float | None" = None
) -> "list[tuple[mi.Float, mi.Float, mi.Float]]":
    """Return (a_k, r_k, w_k) of (8) for each of `COUNT` taps; ``cosine`` is n·ω_o, ``phi`` that of `split_sum.albedo`, and
    ``entries`` a flat table of `SHAPE` (None: the shipped one)."""
    if entries is None:
        entries = _entries(mi.variant())
    row, column, fy, fx = cell(cosine, roughness, COSINES, ROUGHNESSES)
    first = mi.UInt32(row * ROUGHNESSES + column) * FRACTIONS
    found = []
    for k in range(COUNT):
        fetch = lambda i: dr.gather(mi.Vector4f, entries, first + k * (COSINES * ROUGHNESSES * FRACTIONS) + i)
        along = lambda i: dr.lerp(fetch(i), fetch(i + FRACTIONS), fx)
        a, b, log_w, _ = dr.lerp(
            dr.lerp(along(0), along(ROUGHNESSES * FRACTIONS), fy),
            dr.lerp(along(1), along(ROUGHNESSES * FRACTIONS + 1), fy),
            phi,
        )
        found.append((a, dr.minimum(roughness * dr.exp(b), 1), dr.exp(log_w)))
    total = dr.rcp(sum(w for _, _, w in found))
    return [(a, r, w * total) for a, r, w in found]

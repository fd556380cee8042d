"""What Mitsuba's principled BSDF reflects: numerical integrals of its specular part.

With diffuse lobes off, the principled BSDF is linear in its Fresnel terms. For metallic m and base colour c it reflects

    E = (1 − m) E_dielectric + m (c (E_white − E_black) + E_black)                                 (4)

where the three terms are the directional albedos of its dielectric (base colour 0), of a white metal and of a black
metal (whose Schlick Fresnel term still rises to one at grazing angles), and its diffuse lobe reflects (1 − m) c E_diffuse.
They depend on n·ω_o and roughness alone, the first one on the index of refraction η, too, and are integrals of the plugin
itself; only the choice of sample directions is ours. ``albedos.npy`` holds what `integrated` returned. The plugin's
``specular`` is another scale for η:

    specular = F_0 / 0.08,   F_0 = ((η − 1) / (η + 1))²                                            (22)
"""

import functools
from collections.abc import Sequence
from importlib import resources

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import as_float

COSINES = 48
ROUGHNESSES = 32
_SIDE = 96  # stratified samples along each dimension
SPECULARS = 19
BLACK, WHITE, DIFFUSE = range(SPECULARS, SPECULARS + 3)  # tables after those of `specular_nodes`
FILE = "albedos.npy"
_MOST = 1.8  # √specular: indices of refraction up to 3.07
MIN_ROUGHNESS = 0.032  # the principled BSDF clamps its GGX width α = roughness² at 0.001


def cosine_nodes() -> np.ndarray:
    """Return the values of n·ω_o at the table's rows, [COSINES]: quadratic, since albedos bend near grazing angles."""
    return np.linspace(0, 1, COSINES) ** 2


def roughness_nodes() -> np.ndarray:
    """Return the values of roughness at the table's columns, [ROUGHNESSES]."""
    return np.linspace(0, 1, ROUGHNESSES)


def specular_nodes() -> np.ndarray:
    """Return the values of specular at the tables of dielectrics, [SPECULARS]: quadratic, since what grazing angles reflect bends
    near 0."""
    return np.linspace(0, _MOST, SPECULARS) ** 2


def normal_reflectance(eta: float) -> float:
    """Return F_0 of (22), what the index of refraction ``eta`` reflects at normal incidence."""
    return ((eta - 1) / (eta + 1)) ** 2


def specular_of(eta: float) -> float:
    """Return specular of (22) for the index of refraction ``eta``."""
    return normal_reflectance(eta) / 0.08


def eta_of(specular: float) -> float:
    """Return the index of refraction that has this ``specular`` of (22)."""
    return float(2 / (1 - np.sqrt(0.08 * specular)) - 1)


def cell(
    cosine: "mi.Float", roughness: "mi.Float", rows: int, columns: int
) -> "tuple[mi.Int32, mi.Int32, mi.Float, mi.Float]":
    """Return (row, column, f_row, f_column): the lower corner of the cell that holds ``cosine`` and ``roughness`` in a table
    of ``rows`` × ``columns`` over [0, 1]², rows quadratic in the cosine, and how far into the cell they are, in [0, 1]."""
    y = dr.sqrt(dr.maximum(cosine, 1e-6)) * (rows - 1)
    x = dr.clip(roughness, 0, 1) * (columns - 1)
    row = dr.clip(mi.Int32(dr.detach(y)), 0, rows - 2)
    column = dr.clip(mi.Int32(dr.detach(x)), 0, columns - 2)
    return row, column, y - mi.Float(row), x - mi.Float(column)


def principled(roughness: float, metallic: float, base_color: float, eta: float) -> "mi.BSDF":
    """Return a stock principled BSDF with constant parameters."""
    return mi.load_dict(
        {
            "type": "principled",
            "roughness": max(roughness, MIN_ROUGHNESS),
            "metallic": metallic,
            "eta": eta,
            "base_color": {"type": "rgb", "value": [base_color] * 3},
        }
    )


def interaction(wi: "mi.Vector3f") -> "mi.SurfaceInteraction3f":
    """Return surface interactions whose local frame is the world's, one per incident direction ``wi``."""
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(wi))
    si.t, si.n, si.wi = mi.Float(1), mi.Normal3f(0, 0, 1), wi
    si.sh_frame = mi.Frame3f(si.n)
    return si


@functools.lru_cache(maxsize=2)
def _entries(variant):
    with (resources.files("rgs_mi.shading") / FILE).open("rb") as stream:
        return as_float(np.load(stream, allow_pickle=False))


def albedos(cosine: "mi.Float", roughness: "mi.Float", tables: "Sequence[mi.UInt32 | int]") -> "list[mi.Float]":
    """Return what each of the ``tables`` says of a ``cosine`` = n·ω_o and a ``roughness``: the index of one of `specular_nodes`,
    `BLACK`, `WHITE` or `DIFFUSE`."""
    entries, plane = _entries(mi.variant()), COSINES * ROUGHNESSES
    row, column, fy, fx = cell(cosine, roughness, COSINES, ROUGHNESSES)
    index = mi.UInt32(row * ROUGHNESSES + column)
    values = []
    for k in tables:
        fetch = lambda i: dr.gather(mi.Float, entries, i + k * plane)
        along = lambda i: dr.lerp(fetch(i), fetch(i + 1), fx)
        values.append(dr.lerp(along(index), along(index + ROUGHNESSES), fy))
    return values


def dielectric(cosine: "mi.Float", roughness: "mi.Float", specular: "mi.Float") -> "mi.Float":
    """Return E_dielectric of (4) for ``specular`` of (22), in which it is differentiable, too."""
    position = dr.sqrt(specular) / _MOST * (SPECULARS - 1)
    below = dr.clip(mi.Int32(dr.detach(position)), 0, SPECULARS - 2)
    lower, upper = albedos(cosine, roughness, [mi.UInt32(below), mi.UInt32(below + 1)])
    return dr.lerp(lower, upper, position - mi.Float(below))


def integrated(speculars: np.ndarray) -> np.ndarray:
    """Return E_dielectric of (4) for each of ``speculars``, E_black, E_white and E_diffuse, [len + 3, COSINES, ROUGHNESSES]
    float32."""
    materials = [*((0, 0, eta_of(s)) for s in speculars), (1, 0, 1.5), (1, 1, 1.5)]
    mu = np.maximum(cosine_nodes(), 1e-3)
    n = _SIDE * _SIDE
    k = dr.arange(mi.UInt32, len(mu) * n)
    jitter = mi.PCG32(size=len(mu) * n)
    sample = (
        mi.Point2f(mi.Float(k % _SIDE) + jitter.next_float32(), mi.Float((k // _SIDE) % _SIDE) + jitter.next_float32())
        / _SIDE
    )
    dr.eval(sample)
    wi = dr.gather(mi.Vector3f, mi.Vector3f(mi.Float(np.sqrt(1 - mu**2)), 0, mi.Float(mu)), k // n)
    si, everywhere = interaction(wi), mi.warp.square_to_cosine_hemisphere(sample)
    tables = np.zeros((len(materials) + 1, COSINES, ROUGHNESSES), np.float32)
    for column, roughness in enumerate(roughness_nodes()):
        alpha = dr.opaque(mi.Float, max(roughness, MIN_ROUGHNESS) ** 2)
        h, _ = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, alpha, True).sample(wi, sample)
        wo = mi.reflect(wi, h)
        pdf = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, alpha, True).pdf(wi, h) / (4 * dr.dot(wo, h))
        valid = (wo.z > 0) & (pdf > 0)
        for table, (metallic, base_color, eta) in zip(tables, materials):
            value = principled(float(roughness), metallic, base_color, eta).eval(mi.BSDFContext(), si, wo).x
            table[:, column] = dr.block_sum(dr.select(valid, value / pdf, 0), n).numpy() / n
        white, black = (principled(float(roughness), 0, c, 1.5).eval(mi.BSDFContext(), si, everywhere).x for c in (1, 0))
        value = (white - black) / mi.warp.square_to_cosine_hemisphere_pdf(everywhere)
        tables[-1, :, column] = dr.block_sum(value, n).numpy() / n
    return tables


def lobe(roughness: float, angles: np.ndarray) -> np.ndarray:
    """Return BSDF times cosine of a white metal seen along its normal, at ``angles`` (radians, [N]) from the normal: the
    shape of the split sum's filter kernel, not normalized."""
    wo = mi.Vector3f(mi.Float(np.sin(angles)), 0, mi.Float(np.cos(angles)))
    wi = mi.Vector3f(dr.zeros(mi.Float, len(angles)), 0, 1)
    return principled(roughness, 1, 1, 1.5).eval(mi.BSDFContext(), interaction(wi), wo).x.numpy().astype(np.float64)

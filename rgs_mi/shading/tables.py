"""What Mitsuba's principled BSDF reflects: numerical integrals of its specular part.

With diffuse lobes off, the principled BSDF is linear in its Fresnel terms. For metallic m and base colour c it reflects

    E = (1 − m) E_dielectric + m (c (E_white − E_black) + E_black)                                 (4)

where the three terms are the directional albedos of its dielectric (base colour 0), of a white metal and of a black
metal (whose Schlick Fresnel term still rises to one at grazing angles), and its diffuse lobe reflects (1 − m) c E_diffuse.
They depend on n·ω_o and roughness alone and are integrated here by evaluating the plugin itself; only the choice of sample
directions is ours.
"""

import functools

import drjit as dr
import mitsuba as mi
import numpy as np

COSINES = 48
ROUGHNESSES = 32
_SIDE = 96  # stratified samples along each dimension
MIN_ROUGHNESS = 0.032  # the principled BSDF clamps its GGX width α = roughness² at 0.001


def cosine_nodes() -> np.ndarray:
    """Return the values of n·ω_o at the table's rows, [COSINES]: quadratic, since albedos bend near grazing angles."""
    return np.linspace(0, 1, COSINES) ** 2


def roughness_nodes() -> np.ndarray:
    """Return the values of roughness at the table's columns, [ROUGHNESSES]."""
    return np.linspace(0, 1, ROUGHNESSES)


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


@functools.lru_cache(maxsize=4)
def albedo_table(eta: float, variant: str) -> np.ndarray:
    """Return (E_dielectric, E_black, E_white) of (4) and E_diffuse, [COSINES, ROUGHNESSES, 4] float32, for the index of
    refraction ``eta``; ``variant``, the active one, keys the cache."""
    mu = np.maximum(cosine_nodes(), 1e-3)
    wi = mi.Vector3f(mi.Float(np.sqrt(1 - mu**2)), 0, mi.Float(mu))
    n = _SIDE * _SIDE
    k = dr.arange(mi.UInt32, len(mu) * n)
    jitter = mi.PCG32(size=len(mu) * n)
    sample = (
        mi.Point2f(mi.Float(k % _SIDE) + jitter.next_float32(), mi.Float((k // _SIDE) % _SIDE) + jitter.next_float32())
        / _SIDE
    )
    dr.eval(sample)
    wi = dr.gather(mi.Vector3f, wi, k // n)
    si = interaction(wi)
    table = np.zeros((COSINES, ROUGHNESSES, 4), np.float32)
    everywhere = mi.warp.square_to_cosine_hemisphere(sample)
    for column, roughness in enumerate(roughness_nodes()):
        alpha = dr.opaque(mi.Float, max(roughness, MIN_ROUGHNESS) ** 2)
        h, _ = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, alpha, True).sample(wi, sample)
        wo = mi.reflect(wi, h)
        pdf = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, alpha, True).pdf(wi, h) / (4 * dr.dot(wo, h))
        valid = (wo.z > 0) & (pdf > 0)
        for row, (metallic, base_color) in enumerate([(0, 0), (1, 0), (1, 1)]):
            value = principled(float(roughness), metallic, base_color, eta).eval(mi.BSDFContext(), si, wo).x
            table[:, column, row] = dr.block_sum(dr.select(valid, value / pdf, 0), n).numpy() / n
        white, black = (principled(float(roughness), 0, c, eta).eval(mi.BSDFContext(), si, everywhere).x for c in (1, 0))
        value = (white - black) / mi.warp.square_to_cosine_hemisphere_pdf(everywhere)
        table[:, column, 3] = dr.block_sum(value, n).numpy() / n
    return table


def lobe(roughness: float, angles: np.ndarray) -> np.ndarray:
    """Return BSDF times cosine of a white metal seen along its normal, at ``angles`` (radians, [N]) from the normal: the
    shape of the split sum's filter kernel, not normalized."""
    wo = mi.Vector3f(mi.Float(np.sin(angles)), 0, mi.Float(np.cos(angles)))
    wi = mi.Vector3f(dr.zeros(mi.Float, len(angles)), 0, 1)
    return principled(roughness, 1, 1, 1.5).eval(mi.BSDFContext(), interaction(wi), wo).x.numpy().astype(np.float64)

"""The split-sum estimator of the specular integral: filtered environment × directional albedo, free of noise.

    C_s ≈ P(d_o; roughness) · E(n·ω_o, roughness; metallic, base colour)

with P the environment averaged over the BSDF's lobe (`prefilter.py`) and E its albedo (equation (4) of `tables.py`).
"""

import drjit as dr
import mitsuba as mi

from . import tables

DEFAULT_ETA = 1.5  # the principled BSDF's default, specular = 0.5


def albedo(cosine, roughness, metallic, base_color, eta=DEFAULT_ETA):
    """E of (4), ``mi.Color3f``: what the specular lobes reflect of a constant environment."""
    table = tables.albedo_table(eta, mi.variant())
    entries = mi.Float(table.transpose(2, 0, 1).ravel())
    plane = tables.COSINES * tables.ROUGHNESSES
    y = dr.sqrt(dr.maximum(cosine, 1e-6)) * (tables.COSINES - 1)  # rows are quadratic in the cosine
    x = dr.clip(roughness, 0, 1) * (tables.ROUGHNESSES - 1)
    row = dr.clip(mi.Int32(dr.detach(y)), 0, tables.COSINES - 2)
    column = dr.clip(mi.Int32(dr.detach(x)), 0, tables.ROUGHNESSES - 2)
    fy, fx = y - mi.Float(row), x - mi.Float(column)
    index = mi.UInt32(row * tables.ROUGHNESSES + column)
    fetch = lambda i: mi.Vector3f(*[dr.gather(mi.Float, entries, i + k * plane) for k in range(3)])
    value = dr.lerp(dr.lerp(fetch(index), fetch(index + 1), fx),
                    dr.lerp(fetch(index + tables.ROUGHNESSES), fetch(index + tables.ROUGHNESSES + 1), fx), fy)
    dielectric, black, white = value
    return (1 - metallic) * dielectric + metallic * (base_color * (white - black) + black)

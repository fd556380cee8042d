"""The split-sum estimator of the specular integral: filtered environment × directional albedo, free of noise.

    C_s ≈ Σ_k w_k P(d_k; r_k) · E(n·ω_o, roughness; metallic, base colour)

with P the environment averaged over the BSDF's lobe seen along the normal (`prefilter.py`), a few of which make the lobe
seen from elsewhere ((8) of `taps.py`), and E its albedo ((4) of `tables.py`).
"""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from . import tables
from .environment import FilteredEnvironment, IncidentRadiance
from .surface import Surface
from .taps import taps

DEFAULT_ETA = 1.5  # the principled BSDF's default, specular = 0.5


@dataclass
class SplitSum:
    """The split-sum estimator, with a filtered ``environment``, an index of refraction ``eta``, and a table of `taps`
    (None: the shipped one)."""

    environment: FilteredEnvironment
    eta: float = DEFAULT_ETA
    entries: "mi.Float | None" = None

    def specular(self, surface: Surface, incident_radiance: IncidentRadiance | None = None) -> "mi.Color3f":
        """Return C_s, the linear radiance that the specular lobes of a `Surface` reflect towards its ``view``, differentiable
        in all of its fields.

        ``incident_radiance``: callback that returns incident radiance after occlusion; None means the unoccluded environment.
        """
        normal, view, roughness, metallic, base_color, point = surface
        cosine = surface.cosine
        reflected = 2 * cosine * normal - view
        E, phi = albedo(cosine, roughness, metallic, base_color, self.eta)
        incoming = mi.Color3f(0)
        for a, r, w in taps(cosine, roughness, phi, self.entries):
            incoming += w * self.environment.eval(dr.normalize(reflected + a * normal), r, point)
        if incident_radiance is not None:
            incoming = incident_radiance(incoming, reflected, None)
        return incoming * E

    def diffuse(
        self,
        surface: Surface,
        incident_radiance: IncidentRadiance | None = None,
        irradiance_visibility: "mi.Color3f | float" = 1,
    ) -> "mi.Color3f":
        """Return C_d of the diffuse lobe, as `specular` does C_s. It receives the part ``irradiance_visibility`` of the light
        ((9) of `indirect.py`); ``incident_radiance`` is not called, since that lobe has no one direction."""
        E = _table(surface.cosine, surface.roughness, (3,), self.eta)[0]
        received = self.environment.eval_diffuse(surface.normal, surface.point) * irradiance_visibility
        return received * E * (1 - surface.metallic) * surface.base_color

    def for_secondary_bounce(self) -> "SplitSum":
        """Return the estimator of what a reflected ray meets: this one."""
        return self


def albedo(
    cosine: "mi.Float", roughness: "mi.Float", metallic: "mi.Float", base_color: "mi.Color3f", eta: float
) -> "tuple[mi.Color3f, mi.Float]":
    """Return E of (4), what the specular lobes reflect of a constant environment, and φ, the part of it that Schlick's
    Fresnel term adds to a mirror of the constant colour F_0; ``cosine`` is n·ω_o, ``eta`` the index of refraction."""
    dielectric, black, white = _table(cosine, roughness, (0, 1, 2), eta)
    E = (1 - metallic) * dielectric + metallic * (base_color * (white - black) + black)
    mean = lambda color: (color.x + color.y + color.z) / 3  # dr.mean() would take that of all lanes
    F_0 = dr.lerp(((eta - 1) / (eta + 1)) ** 2, mean(base_color), metallic)
    return E, dr.clip(1 - F_0 * white / mean(E), 0, 1)


def _table(cosine, roughness, columns, eta):
    """The entries ``columns`` of `tables.albedo_table`, interpolated, a list of ``mi.Float``."""
    table = tables.albedo_table(eta, mi.variant())
    entries = mi.Float(table.transpose(2, 0, 1).ravel())
    plane = tables.COSINES * tables.ROUGHNESSES
    row, column, fy, fx = tables.cell(cosine, roughness, tables.COSINES, tables.ROUGHNESSES)
    index = mi.UInt32(row * tables.ROUGHNESSES + column)
    values = []
    for k in columns:
        fetch = lambda i: dr.gather(mi.Float, entries, i + k * plane)
        values.append(
            dr.lerp(
                dr.lerp(fetch(index), fetch(index + 1), fx),
                dr.lerp(fetch(index + tables.ROUGHNESSES), fetch(index + tables.ROUGHNESSES + 1), fx),
                fy,
            )
        )
    return values

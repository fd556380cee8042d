"""The split-sum estimator of the specular integral: filtered environment × directional albedo, free of noise.

    C_s ≈ Σ_k w_k P(d_k; r_k) · E(n·ω_o, roughness; metallic, base colour)

with P the environment averaged over the BSDF's lobe seen along the normal (`prefilter.py`), a few of which make the lobe
seen from elsewhere ((8) of `taps.py`), and E its albedo ((4) of `tables.py`).
"""

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from . import tables
from .environment import FilteredEnvironment, IncidentRadiance
from .surface import Surface
from .taps import taps

DEFAULT_ETA = 1.5  # the principled BSDF's default, specular = 0.5


@dataclass
class SplitSum:
    """The split-sum estimator, with a filtered ``environment``, an index of refraction ``eta``, in whose place a fit has
    ``learned_specular``, (22) of `tables.py`, of width 1, and a table of `taps` (None: the shipped one)."""

    environment: FilteredEnvironment
    eta: float = DEFAULT_ETA
    entries: "mi.Float | None" = None
    learned_specular: "mi.Float | None" = None

    def learned(self) -> list:
        """Return the arrays that a fit changes: those of the environment, and specular where it is learned."""
        return [*self.environment.learned(), *([] if self.learned_specular is None else [self.learned_specular])]

    def with_learned(self, arrays: list) -> "SplitSum":
        """Return the same estimator with other ``arrays`` in place of `learned`."""
        known = self.learned_specular is not None
        specular = arrays[len(self.environment.learned())] if known else None
        return replace(self, environment=self.environment.with_learned(arrays), learned_specular=specular)

    def specular(self, surface: Surface, incident_radiance: IncidentRadiance | None = None) -> "mi.Color3f":
        """Return C_s, the linear radiance that the specular lobes of a `Surface` reflect towards its ``view``, differentiable
        in all of its fields.

        ``incident_radiance``: callback that returns incident radiance after occlusion; None means the unoccluded environment.
        """
        normal, view, roughness, metallic, base_color, point = surface
        cosine = surface.cosine
        reflected = 2 * cosine * normal - view
        E, phi = albedo(cosine, roughness, metallic, base_color, self._specular(dr.width(cosine)))
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
        (E,) = tables.albedos(surface.cosine, surface.roughness, (tables.DIFFUSE,))
        received = self.environment.eval_diffuse(surface.normal, surface.point) * irradiance_visibility
        return received * E * (1 - surface.metallic) * surface.base_color

    def _specular(self, width):
        """(22). What is learned is ``width`` times the same: kernels then add its gradient up as they go."""
        if self.learned_specular is None:
            return dr.opaque(mi.Float, tables.specular_of(self.eta))
        return dr.gather(mi.Float, self.learned_specular, dr.full(mi.UInt32, 0, width), mode=dr.ReduceMode.Expand)

    def for_secondary_bounce(self) -> "SplitSum":
        """Return the estimator of what a reflected ray meets: this one."""
        return self


def albedo(
    cosine: "mi.Float", roughness: "mi.Float", metallic: "mi.Float", base_color: "mi.Color3f", specular: "mi.Float"
) -> "tuple[mi.Color3f, mi.Float]":
    """Return E of (4), what the specular lobes reflect of a constant environment, and φ, the part of it that Schlick's
    Fresnel term adds to a mirror of the constant colour F_0; ``cosine`` is n·ω_o, ``specular`` that of (22). Differentiable in
    all of them."""
    dielectric = tables.dielectric(cosine, roughness, specular)
    black, white = tables.albedos(cosine, roughness, (tables.BLACK, tables.WHITE))
    E = (1 - metallic) * dielectric + metallic * (base_color * (white - black) + black)
    mean = lambda color: (color.x + color.y + color.z) / 3  # dr.mean() would take that of all lanes
    F_0 = dr.lerp(0.08 * specular, mean(base_color), metallic)
    return E, dr.clip(1 - F_0 * white / mean(E), 0, 1)

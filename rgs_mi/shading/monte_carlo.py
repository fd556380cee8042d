"""The Monte Carlo estimator of the reflected radiance: Mitsuba's own principled BSDF and emitter, sampled.

    C = ∫ f(ω_i, ω_o) L(ω_i) |n·ω_i| dω_i ≈ 1/S Σ_s [ g(ω_s^b) + g(ω_s^l) ],   g = f L |n·ω_i| / (p_b + p_l)      (7)

with one sample ω^b of the BSDF's lobe and one ω^l of the emitter in each of S: the balance heuristic (Veach 1997), written
out. f is the specular or the diffuse part of the BSDF, which the plugin's linearity (4) tells apart:

    f_specular = (1 − m) f(0, 0) + m f(1, c),   f_diffuse = (1 − m) (f(0, c) − f(0, 0))   for f(metallic, base colour).

Derivatives are those of (7) itself with random numbers held: ω^b moves with normal and roughness, and everything in g
follows, the densities too. Sampling by the lobe that moves keeps near-mirrors quiet, whose f has derivatives as large as its
lobe is narrow, and since p_b + p_l depends on a sample only through its direction, both parts stay unbiased.
"""

import contextlib
import functools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from .environment import FilteredEnvironment, IncidentRadiance
from .sequence import points
from .surface import Surface

SAMPLES = 16  # per pixel, unless someone says otherwise
_WAVEFRONT = 1 << 22  # samples at a time
_OTHER, _DEEPER, _DIFFUSE = 0x9E3779B9, 0x85EBCA6B, 0xC2B2AE35  # what makes of a seed another


@dataclass
class MonteCarlo:
    """The estimator (7).

    environment  radiance, unfiltered
    emitter      Mitsuba's, whose sampling is used; it may be of a few steps ago, which costs variance and no bias
    eta          index of refraction
    samples      S of (7)
    seed         of the random numbers
    paired       whether the derivatives are those of another, independent estimate than the value, as losses need that are
                 not linear in it
    """

    environment: FilteredEnvironment
    emitter: "mi.Emitter"
    eta: float
    samples: int
    seed: "mi.UInt32"
    paired: bool = False

    def learned(self) -> list:
        """Return the arrays that a fit changes: those of the environment."""
        return self.environment.learned()

    def with_learned(self, arrays: list) -> "MonteCarlo":
        """Return the same estimator with other ``arrays`` in place of `learned`."""
        return replace(self, environment=self.environment.with_learned(arrays))

    def specular(self, surface: Surface, incident_radiance: IncidentRadiance | None = None) -> "mi.Color3f":
        """Return C_s of (7); see `SplitSum.specular`."""
        return self._integral(SpecularLobe, surface, incident_radiance)

    def diffuse(
        self,
        surface: Surface,
        incident_radiance: IncidentRadiance | None = None,
        irradiance_visibility: "mi.Color3f | float | None" = None,
    ) -> "mi.Color3f":
        """Return C_d of (7), to which ``incident_radiance`` applies, too; ``irradiance_visibility`` is not needed."""
        other = replace(self, seed=self.seed ^ _DIFFUSE)
        return other._integral(DiffuseLobe, surface, incident_radiance)

    def for_secondary_bounce(self) -> "MonteCarlo":
        """Return the estimator of what a reflected ray meets: one sample is enough of what few rays see."""
        return replace(self, samples=1, seed=self.seed ^ _DEEPER, paired=False)

    def _integral(self, lobe, surface, incident_radiance):
        if self.paired:
            derivatives = replace(self, paired=False)._integral(lobe, surface, incident_radiance)
            with dr.suspend_grad():
                value = replace(self, paired=False, seed=self.seed ^ _OTHER)._integral(lobe, surface, incident_radiance)
            return dr.replace_grad(value, derivatives)
        n = dr.width(surface.normal)
        each = max(1, min(self.samples, _WAVEFRONT // n))
        total = dr.zeros(mi.Color3f, n)
        for first in range(0, self.samples, each):
            total += self._sum(lobe, first, min(each, self.samples - first), surface, incident_radiance)
        return total / self.samples

    def _sum(self, lobe, first, count, surface, incident_radiance):
        """The sum of the samples ``first`` to ``first + count`` of (7)."""
        n = dr.width(surface.normal)
        index = dr.arange(mi.UInt32, n * count)
        pixel, sample = index // count, index % count + dr.opaque(mi.UInt32, first)
        dr.eval(*surface)
        normal, view, roughness, metallic, base_color, *point = _spread([v for v in surface if v is not None], count)
        point = point[0] if point else None
        material = lobe(roughness, metallic, base_color, self.eta)
        si = _interaction(normal, view)
        of_light, of_lobe = points(n, self.seed, pixel, sample, sets=2)
        lit = self.environment.environment.seen_from(self.emitter.sample_direction(si, of_light)[0].d, point)
        bounced = si.to_world(material.sample(si, mi.Float(0.5), of_lobe))
        total = mi.Color3f(0)
        for direction in (dr.detach(lit), bounced):
            local = si.to_local(direction)
            light = self.environment.eval(direction, point=point)
            if incident_radiance is not None:
                light = incident_radiance(light, direction, pixel)
            density = material.pdf(si, local) + self._emitter_pdf(si, direction, point)
            g = material.eval(si, local) * light / density
            total += dr.select((density > 0) & (local.z > 0), g, 0)
        dr.eval(total)  # all channels in one kernel
        return mi.Color3f(*(dr.block_sum(c, count) for c in total))

    def _emitter_pdf(self, si, direction, point):
        ds = dr.zeros(mi.DirectionSample3f, dr.width(direction))
        local, _, density = self.environment.environment.seen(direction, point)
        ds.d = self.environment.environment.to_world(local)
        return self.emitter.pdf_direction(si, ds) * density


@functools.lru_cache(maxsize=4)
def _materials(eta: float, variant: str):
    """Principled BSDFs that are black (a dielectric), metallic, and plastic, and the textures of the latter two: their
    roughness and their base colour, one entry per surface."""
    roughness, color = mi.load_dict({"type": "wavefront"}), mi.load_dict({"type": "wavefront", "channels": 3})
    bsdf = lambda metallic, base_color: mi.load_dict(
        {"type": "principled", "eta": eta, "metallic": metallic, "base_color": base_color, "roughness": roughness}
    )
    return bsdf(0.0, {"type": "rgb", "value": 0.0}), bsdf(1.0, color), bsdf(0.0, color), roughness, color


class _Lobe:
    """Part of a principled BSDF, one material per surface interaction, as Mitsuba's BSDFs have it in local coordinates:
    `eval` returns f |n·ω_i|, `sample` directions from uniform numbers, and `pdf` their density."""

    def __init__(self, roughness: "mi.Float", metallic: "mi.Float", base_color: "mi.Color3f", eta: float):
        self.roughness, self.metallic, self.base_color, self.eta = roughness, metallic, base_color, eta
        self.context = mi.BSDFContext()

    @contextlib.contextmanager
    def plugins(self) -> Iterator[list]:
        """Give Mitsuba's BSDFs, black, metallic and plastic, these materials for as long as the context lasts: others find
        constants in them, which any kernel takes."""
        *bsdfs, roughness, color = _materials(self.eta, mi.variant())
        before = roughness.values, color.values
        roughness.values, color.values = self.roughness, self.base_color
        try:
            yield bsdfs
        finally:
            roughness.values, color.values = before


class SpecularLobe(_Lobe):
    """The specular part, of which the metal's lobe is sampled; the dielectric's is as wide."""

    def eval(self, si: "mi.SurfaceInteraction3f", local: "mi.Vector3f") -> "mi.Color3f":
        with self.plugins() as (black, metal, _):
            return dr.lerp(black.eval(self.context, si, local), metal.eval(self.context, si, local), self.metallic)

    def pdf(self, si: "mi.SurfaceInteraction3f", local: "mi.Vector3f") -> "mi.Float":
        with self.plugins() as (_, metal, _):
            return metal.pdf(self.context, si, local)

    def sample(self, si: "mi.SurfaceInteraction3f", choice: "mi.Float", point: "mi.Point2f") -> "mi.Vector3f":
        with self.plugins() as (_, metal, _):
            return metal.sample(self.context, si, choice, point)[0].wo


class DiffuseLobe(_Lobe):
    """The diffuse part, of which cosine-weighted directions are sampled."""

    def eval(self, si: "mi.SurfaceInteraction3f", local: "mi.Vector3f") -> "mi.Color3f":
        with self.plugins() as (black, _, plastic):
            return (1 - self.metallic) * (plastic.eval(self.context, si, local) - black.eval(self.context, si, local))

    def pdf(self, si: "mi.SurfaceInteraction3f", local: "mi.Vector3f") -> "mi.Float":
        return mi.warp.square_to_cosine_hemisphere_pdf(local)

    def sample(self, si: "mi.SurfaceInteraction3f", choice: "mi.Float", point: "mi.Point2f") -> "mi.Vector3f":
        return mi.warp.square_to_cosine_hemisphere(point)


class WholeLobe(_Lobe):
    """Both parts together: the principled BSDF itself, a mixture of metal and plastic."""

    def eval(self, si: "mi.SurfaceInteraction3f", local: "mi.Vector3f") -> "mi.Color3f":
        with self.plugins() as (_, metal, plastic):
            return dr.lerp(plastic.eval(self.context, si, local), metal.eval(self.context, si, local), self.metallic)

    def pdf(self, si: "mi.SurfaceInteraction3f", local: "mi.Vector3f") -> "mi.Float":
        with self.plugins() as (_, metal, plastic):
            return dr.lerp(plastic.pdf(self.context, si, local), metal.pdf(self.context, si, local), self.metallic)

    def sample(self, si: "mi.SurfaceInteraction3f", choice: "mi.Float", point: "mi.Point2f") -> "mi.Vector3f":
        of_metal = choice < self.metallic
        choice = dr.select(of_metal, choice / self.metallic, (choice - self.metallic) / (1 - self.metallic))
        with self.plugins() as (_, metal, plastic):
            return dr.select(
                of_metal,
                metal.sample(self.context, si, choice, point)[0].wo,
                plastic.sample(self.context, si, choice, point)[0].wo,
            )


def _spread(surface, count):
    """A ``surface``'s fields with each entry ``count`` times in a row. Single numbers, the same for all, stay as they are."""
    columns = [c for v in surface for c in (v if dr.depth_v(v) > 1 else [v])]
    wide = [c for c in columns if dr.width(c) > 1]
    spread = iter(dr.custom(_Spread, wide, count) if wide else [])
    columns = iter([next(spread) if dr.width(c) > 1 else c for c in columns])
    return [type(v)(*(next(columns) for _ in v)) if dr.depth_v(v) > 1 else next(columns) for v in surface]


class _Spread(dr.CustomOp):
    """All at once: in the derivative they share one kernel, and a gather's own would compile their number into it."""

    def eval(self, values, count):
        self.count = count
        return self._repeat(values)

    def forward(self):
        self.set_grad_out(self._repeat(self.grad_in("values")))

    def backward(self):
        gradients = self.grad_out()
        dr.eval(gradients)
        self.set_grad_in("values", [dr.block_sum(g, self.count) for g in gradients])

    def _repeat(self, values):
        index = dr.arange(mi.UInt32, max(dr.width(v) for v in values) * self.count) // self.count
        return [dr.gather(mi.Float, v, index) for v in values]

    def name(self):
        return "rgs_mi.shading.Spread"


def _interaction(normal, view):
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(normal))
    si.t, si.n, si.sh_frame = mi.Float(1), mi.Normal3f(normal), mi.Frame3f(normal)
    si.wi = si.to_local(view)
    return si

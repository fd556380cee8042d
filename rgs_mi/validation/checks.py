"""Sampler, BSDF and tables by themselves: the sampler draws from its density (χ²), the BSDF is reciprocal, and in a white
furnace neither estimator makes energy, nor loses more than the BSDF itself."""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..shading.environment import Environment
from ..shading.monte_carlo import MonteCarlo, SpecularLobe
from ..shading.split_sum import DEFAULT_ETA, SplitSum
from ..shading.surface import Surface
from ..shading.tables import interaction, principled


@dataclass
class Check:
    """A ``value`` that must not exceed its ``bound``."""

    name: str
    value: float
    bound: float

    @property
    def passed(self) -> bool:
        """Whether the value is within its bound."""
        return self.value <= self.bound


def checks(roughness: Sequence[float] = (0.1, 0.3, 0.7), samples: int = 1 << 18) -> list[Check]:
    """Check sampler, BSDF and tables for every ``roughness``, the white furnace with so many ``samples`` per direction."""
    found = []
    for r in roughness:
        found.append(Check(f"χ² of the sampler, roughness {r:g}: 1 − p", 1 - _chi2(r), 1 - 1e-3))
        found.append(Check(f"reciprocity, roughness {r:g}: relative difference", _reciprocity(r), 1e-3))
        for metallic, color in ((1.0, 0.95), (0.0, 0.0), (0.0, 0.8)):
            own, ours = _furnace(r, metallic, color, samples)
            kind = f"{'metal' if metallic else 'dielectric'} {color:g}, roughness {r:g}"
            for name, value in ours.items():
                difference = float(abs(value - own).max())
                # at grazing angles the BSDF's own diffuse and specular lobes together can reflect more than comes in
                most = max(1.0, float(own.max())) + 2e-3
                found.append(Check(f"white furnace, {kind}, {name}: energy", float(value.max()), most))
                found.append(Check(f"white furnace, {kind}, {name}: off the BSDF's own", difference, 0.01))
    return found


def _surface(cosines, roughness, metallic, color):
    """A `Surface` with normal z seen under ``cosines``."""
    n = len(cosines)
    constant = lambda v: dr.opaque(mi.Float, v, n)
    view = mi.Vector3f(mi.Float(np.sqrt(1 - cosines**2)), 0, mi.Float(cosines))
    return Surface(
        mi.Vector3f(constant(0), constant(0), constant(1)),
        view,
        constant(roughness),
        constant(metallic),
        mi.Color3f(*3 * (constant(color),)),
    )


def _furnace(roughness, metallic, color, samples):
    """(what the BSDF's own sampling reflects of radiance 1, [cosines]; the same of both estimators, by name)."""
    cosines = np.array([0.2, 0.5, 0.8, 0.98])
    surface = _surface(cosines, roughness, metallic, color)
    white = Environment(mi.TensorXf(np.ones((16, 32, 3), np.float32)), np.eye(3))
    monte_carlo = MonteCarlo(white.unfiltered(), white.emitter(), DEFAULT_ETA, samples, dr.opaque(mi.UInt32, 1))
    ours = {}
    with dr.suspend_grad():
        for name, estimator in (("monte_carlo", monte_carlo), ("split_sum", SplitSum(white.filtered(), DEFAULT_ETA))):
            ours[name] = (estimator.specular(surface) + estimator.diffuse(surface)).x.numpy()
        bsdf = principled(roughness, metallic, color, DEFAULT_ETA)
        index = dr.arange(mi.UInt32, len(cosines) * samples) // samples
        rng = mi.PCG32(size=dr.width(index))
        points = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
        sample, weight = bsdf.sample(mi.BSDFContext(), interaction(dr.gather(mi.Vector3f, surface.view, index)), *points)
        own = dr.block_sum(dr.select(sample.pdf > 0, weight.x, 0), samples).numpy() / samples
    return own, ours


def _chi2(roughness) -> float:
    """p-value of the lobe's sampler against its density, for a view at 60°."""

    def wavefront(n):
        lobe = SpecularLobe(mi.Float(roughness), mi.Float(1), mi.Color3f(1), DEFAULT_ETA)
        return lobe, interaction(mi.Vector3f(0.75**0.5, 0, 0.5) + dr.zeros(mi.Vector3f, n))

    def draw(points):
        lobe, si = wavefront(dr.width(points))
        local = lobe.sample(si, mi.Float(0.5), points)
        return local, dr.select(local.z > 0, mi.Float(1), 0)  # below the horizon nothing is reflected

    def density(local):
        lobe, si = wavefront(dr.width(local))
        return lobe.pdf(si, local)

    test = mi.chi2.ChiSquareTest(
        mi.chi2.SphericalDomain(), draw, density, sample_dim=2, sample_count=1 << 20, res=101, ires=32
    )
    test._dump_tables = lambda: None  # it would leave a file in the current folder
    with contextlib.redirect_stdout(None):
        test.run(0.01, 1)
    return float(np.array(test.p_value).ravel()[0])


def _reciprocity(roughness) -> float:
    """Largest |f(a, b) − f(b, a)| over the largest f, for pairs of directions."""
    rng = np.random.default_rng(0)
    a, b = (
        mi.Vector3f(*(mi.Float(c) for c in (v / np.linalg.norm(v, axis=0))))
        for v in (np.abs(rng.normal(size=(3, 4096))) + [[0], [0], [0.05]] for _ in range(2))
    )
    bsdf = principled(roughness, 1, 0.8, DEFAULT_ETA)
    f = lambda wi, wo: (bsdf.eval(mi.BSDFContext(), interaction(wi), wo).x / wo.z).numpy()
    forth, back = f(a, b), f(b, a)
    return float(np.abs(forth - back).max() / forth.max())

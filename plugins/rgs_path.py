"""
Path tracer that meets surfels (:monosp:`rgs_path`)
---------------------------------------------------

Mitsuba's :monosp:`path`, in scenes where shapes of type :monosp:`surfels` stand among others: a reconstructed object lies on
a table, shows in a mirror, throws a shadow and receives some. Any BSDF and emitter may be in the scene.

.. pluginparameters::

 * - max_depth
   - |int|
   - Longest path depth, 1 for what shines itself, 2 for direct light; −1 for no limit (Default: −1)

 * - rr_depth
   - |int|
   - Path depth from which on Russian roulette ends paths (Default: 5)

 * - diffuse
   - |string|
   - ``radiance``: surfels send their own radiance, as it was photographed, whatever lights them; ``lit``: their base colour
     reflects light as that of a principled BSDF (Default: ``radiance``)

 * - box
   - |string|
   - Six numbers, lower and upper corner: only surfels in this box are in the scene, which takes an object out of the
     surroundings that it was photographed in (Default: none, all)

 * - hide_emitters
   - |bool|
   - Whether emitters are invisible to the camera (Default: |false|)

A ray meets surfels front to back, and ends on them with the probability of their coverage, on a principled BSDF of their
mean normal and material, as :monosp:`rgs_deferred` shades a pixel (`rgs_mi.surfels.ray_tracing`). Rays that leave surfels
start above their neighbours, by two standard deviations of a typical one: what touches an object that closely throws no
shadow on it.
Of surfels that lie in exactly one plane a ray meets only the first. Renders pictures: nothing is differentiated, fits use
:monosp:`rgs_deferred`.
"""

import drjit as dr
import mitsuba as mi

from rgs_mi.core.errors import UserError
from rgs_mi.shading.monte_carlo import SpecularLobe, WholeLobe
from rgs_mi.surfels.ray_tracing import SurfelRayTracer

from .surfels import box_of, surfels_in

DIFFUSE = ("radiance", "lit")
_NO_LIMIT = 0xFFFFFFFF
_SHADOW = 1 - 1e-4  # of the way to a light, so as not to meet it


class SurfelPathIntegrator(mi.SamplingIntegrator):
    """This is the integrator that the module describes."""

    def __init__(self, props: "mi.Properties") -> None:
        super().__init__(props)  # takes hide_emitters
        if not mi.is_rgb:
            raise UserError(f"rgs_path: variant '{mi.variant()}' is not supported: use llvm_ad_rgb or cuda_ad_rgb")
        max_depth, self.rr_depth = props.get("max_depth", -1), props.get("rr_depth", 5)
        if max_depth < -1 or self.rr_depth < 1:
            raise UserError(f"rgs_path: max_depth {max_depth}, rr_depth {self.rr_depth}: need at least -1, and 1")
        self.max_depth = max_depth if max_depth >= 0 else _NO_LIMIT
        self.box = box_of(props)
        self.diffuse = props.get("diffuse", "radiance")
        if self.diffuse not in DIFFUSE:
            raise UserError(f"rgs_path: unknown diffuse '{self.diffuse}': choose one of {', '.join(DIFFUSE)}")

    @dr.syntax
    def sample(
        self,
        scene: "mi.Scene",
        sampler: "mi.Sampler",
        ray: "mi.RayDifferential3f",
        medium: "mi.Medium | None" = None,
        active: "mi.Bool | bool" = True,
    ) -> "tuple[mi.Color3f, mi.Bool, list[mi.Float]]":
        """Return the linear radiance along ``ray``, whether it meets something, and no AOVs."""
        surfels, eta = surfels_in(scene)
        surfel_rays, lit = SurfelRayTracer(surfels, self.box), self.diffuse == "lit"
        lobe_of = WholeLobe if lit else SpecularLobe
        context = mi.BSDFContext()
        hides = self.hide_emitters

        ray = mi.Ray3f(ray)
        L, β, η, depth = mi.Color3f(0), mi.Color3f(1), mi.Float(1), mi.UInt32(0)
        seen = mi.Bool(not hides and scene.environment() is not None)
        prev_si, prev_pdf, prev_delta = dr.zeros(mi.Interaction3f), mi.Float(1), mi.Bool(True)
        left_surfel, active = mi.Bool(False), mi.Bool(active)

        while dr.hint(active, mode="evaluated" if _apart() else None):
            # ---- What the ray meets: a surfel, or a shape behind those that it passed ----
            pi = _traced(scene.ray_intersect_preliminary(ray, active=active))
            maxt = dr.select(pi.is_valid(), pi.t, dr.largest(mi.Float))
            maxt = dr.minimum(maxt, ray.maxt)
            hit = _traced(surfel_rays.intersect(ray, maxt, left_surfel, sampler.next_1d(active), active))
            on_surfel = active & hit.found
            active_shape = active & ~on_surfel
            si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active_shape)

            # ---- Emission ----
            ds = mi.DirectionSample3f(scene, si, prev_si)
            emitter_pdf = scene.pdf_emitter_direction(prev_si, ds, active_shape & ~prev_delta)
            shown = active_shape & ~((depth == 0) & hides)
            L += dr.select(shown, β * _mis(prev_pdf, emitter_pdf) * ds.emitter.eval(si, shown), 0)
            seen |= on_surfel | (active_shape & si.is_valid())

            si[on_surfel] = _interaction(ray, hit)
            if dr.hint(not lit, mode="scalar"):
                L += dr.select(on_surfel, β * surfel_rays.radiance(hit.index, ray.d, on_surfel), 0)
            active &= (on_surfel | si.is_valid()) & (depth + 1 < self.max_depth)
            on_surfel &= active
            active_shape &= active

            # ---- Emitter sampling ----
            lobe = lobe_of(hit.roughness, hit.metallic, hit.base_color, eta)
            bsdf = si.bsdf(ray)
            active_em = active & (on_surfel | mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth))
            ds, weight = scene.sample_emitter_direction(si, sampler.next_2d(), False, active_em)
            active_em &= ds.pdf != 0
            shadow = si.spawn_ray_to(ds.p)
            shadow.o = dr.select(on_surfel, surfel_rays.above(si.p, si.n), shadow.o)
            shadow.d = ds.d
            shadow.maxt = ds.dist * _SHADOW
            active_em &= ~_traced(scene.ray_test(shadow, active_em))
            visible = _traced(surfel_rays.transmittance(shadow, shadow.maxt, on_surfel, active_em))
            wo = si.to_local(ds.d)
            value, pdf = bsdf.eval_pdf(context, si, wo, active_em & ~on_surfel)
            value = dr.select(on_surfel, lobe.eval(si, wo), value)
            pdf = dr.select(on_surfel, lobe.pdf(si, wo), pdf)
            mis = dr.select(ds.delta, 1, _mis(ds.pdf, pdf))
            L += dr.select(active_em, β * visible * mis * value * weight, 0)

            # ---- BSDF sampling ----
            choice, point = sampler.next_1d(), sampler.next_2d()
            bs, value = bsdf.sample(context, si, choice, point, active_shape)
            wo = dr.select(on_surfel, lobe.sample(si, choice, point), bs.wo)
            pdf = dr.select(on_surfel, lobe.pdf(si, wo), bs.pdf)
            value = dr.select(on_surfel, lobe.eval(si, wo) / pdf, value)
            delta = ~on_surfel & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            β *= dr.select((pdf > 0) & ~(on_surfel & (wo.z <= 0)), value, 0)
            η *= dr.select(on_surfel, 1, bs.eta)
            direction = si.to_world(wo)
            ray = si.spawn_ray(direction)
            ray.o = dr.select(on_surfel, surfel_rays.above(si.p, si.n), ray.o)
            prev_si, prev_pdf, prev_delta, left_surfel = mi.Interaction3f(si), pdf, delta, on_surfel

            # ---- Stopping ----
            depth[si.is_valid()] += 1
            most = dr.max(β)
            survival = dr.minimum(most * η**2, 0.95)
            roulette = depth >= self.rr_depth
            β[roulette] *= dr.rcp(survival)
            active &= (most > 0) & (~roulette | (sampler.next_1d() < survival))

        return dr.select(seen, L, 0), seen, []

    def to_string(self) -> str:
        return f"SurfelPathIntegrator[diffuse = {self.diffuse}]"


def _apart():
    """Whether rays through the scene and rays through its surfels, which are a scene of their own, need kernels of their own:
    OptiX knows one scene in each, and lets rays through another meet nothing."""
    return dr.backend_v(mi.Float) == dr.JitBackend.CUDA


def _traced(found):
    """What a ray tracer ``found``, with the end of a kernel where that needs one."""
    if _apart():
        dr.eval(found)
    return found


def _interaction(ray, hit):
    """The surface of surfels that a ray met."""
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.t, si.p, si.n = hit.t, ray(hit.t), mi.Normal3f(hit.normal)
    si.sh_frame = mi.Frame3f(si.n)
    si.wi = si.to_local(-ray.d)
    si.wavelengths = ray.wavelengths
    si.time = ray.time
    return si


def _mis(pdf, other):
    """The balance heuristic (Veach 1997)."""
    return dr.select(pdf > 0, pdf / (pdf + other), 0)


mi.register_integrator("rgs_path", SurfelPathIntegrator)

"""The objective of a fit: what a rendered view costs, term by term (docs/method.md §4)."""

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.bounding_box import BoundingBox
from ..core.camera import Camera, opaque
from ..core.film import Film
from ..datasets.photographs import Photograph
from ..settings.settings import Settings
from ..shading import deferred
from ..shading.lighting import Lighting
from ..splat.gbuffer import GBuffer
from ..splat.tiles import Cutoffs
from ..surfels.surfels import CHANNELS, SurfelColumns
from . import losses
from .reflection_guided import reflective_mask

CUTOFFS = Cutoffs(transmittance_min=1e-2)  # of a step: what the last hundredth of the light shows costs a third of all hits


@dataclass
class ViewLoss:
    """The losses of a view: weighted ``terms`` by the names that curves have for them, of width 1 each; what the ``photometric``
    one is the mean of, of each sample's pixel, not differentiated; the mean squared ``error`` in display values, of width 1; and
    ``reflective`` [H, W] bool, β̂ of the view, None where nothing asks for it."""

    terms: "dict[str, mi.Float]"
    photometric: "mi.Float"
    error: "mi.Float"
    reflective: np.ndarray | None


@dataclass(frozen=True)
class Objective:
    """The objective under ``settings``, of an object of radius ``extent`` in world units, in a scene that reflects in
    ``box`` (None: everywhere)."""

    settings: Settings
    extent: float
    box: BoundingBox | None = None

    @property
    def full(self) -> bool:
        """Whether a loss wants the maps that only regularizers read (see `render_gbuffer`)."""
        w = self.settings.weights
        return max(w.distortion, w.delta_normal) > 0

    def __call__(
        self,
        image: deferred.Image,
        photo: Photograph,
        masked: bool,
        consistency: float,
        step: int,
        gain: "mi.Color3f | None" = None,
        film: Film = Film(),
    ) -> ViewLoss:
        """Return the losses of ``image``, a rendering of the view of ``photo``, which has a mask where ``masked``: of the samples
        of which a ``film`` makes its pixels.

        ``consistency`` is the weight of depth-normal consistency by now; ``step`` decides which quarter of the pixels
        minimum variation looks at; ``gain`` is the photograph's exposure, by which linear radiance is multiplied.
        """
        w, maps, size = self.settings.weights, image.gbuffer.all, photo.camera.size
        prior = None if photo.prior is None else film.spread(photo.prior, size)
        samples = replace(photo, camera=film.samples(photo.camera), prior=prior)
        color, alpha = losses.completed(image.color, maps.alpha, CUTOFFS.transmittance_min)
        *color, alpha = film.develop([*color, alpha], size)
        color = losses.evaluated_adjoint(mi.Color3f(*color) if gain is None else mi.Color3f(*color) * gain)
        rendered = losses.display(color, alpha, photo.behind)
        photometric = losses.photometric(rendered, photo.color, size, w.dssim)
        terms = {"photometric": dr.mean(photometric)}
        if w.mask > 0 and masked:
            terms["mask"] = w.mask * losses.mask(alpha, photo.alpha)
        if w.delta_normal > 0:
            terms["delta_normal"] = w.delta_normal * losses.delta_normal(image.gbuffer)
        if w.distortion > 0:
            terms["distortion"] = w.distortion * losses.distortion(maps, self.extent)
        weight = dr.opaque(mi.Float, consistency)
        terms["consistency"] = weight * losses.depth_normal_consistency(image.gbuffer, samples.camera)
        # These are means over the whole photograph, of which tiles give an estimate
        terms = {name: photo.of_image * term for name, term in terms.items()}
        error = dr.mean(dr.mean(dr.square(dr.detach(rendered) - photo.color))) * photo.of_image
        regional, reflective = self._regional(image.gbuffer, samples, step)
        terms = {f"loss.{name}": term for name, term in (terms | regional).items()}
        return ViewLoss(terms, film.spread(dr.detach(photometric), size), error, reflective)

    def _regional(self, gbuffer, photo, step):
        """Losses that are normalized by regions of their own: RGS's L_normal and L_depth, and minimum variation; and β̂."""
        w, maps, terms, mask = self.settings.weights, gbuffer.all, {}, None
        if max(w.normal, w.minimum_variation) > 0 or self.settings.density.guided:
            mask = self.reflective_mask(gbuffer, photo.camera)
            if w.normal > 0:
                terms["normal"] = w.normal * losses.normal_smoothness(gbuffer, mask, w.crease)
            if w.minimum_variation > 0:
                corner = divmod(step % 4, 2)
                terms["minimum_variation"] = w.minimum_variation * losses.minimum_variation(gbuffer, mask, corner)
        if w.depth > 0 and photo.prior is not None:
            covered = maps.alpha > 0.5
            depth = maps.depth / dr.select(covered, maps.alpha, 1)
            terms["depth"] = w.depth * losses.pearson_depth(depth, photo.prior, covered, photo.inverse)
        return terms, mask

    def residual(self, surfels: SurfelColumns, lighting: Lighting, camera: Camera) -> "mi.Float":
        """Return the weighted part of the ``surfels``' diffuse radiance, as ``camera`` sees them, that is not what their base
        color reflects under ``lighting``; of width 1. It has gradients in the base color alone, on which nothing depends that
        photographs show of what is no metal."""
        surfels = surfels.with_columns(
            {name: dr.detach(surfels.all_columns(name)) for name in CHANNELS if name != "base_color"}
        )
        lighting = lighting.with_learned([dr.detach(v) for v in lighting.learned()])
        center = surfels.column(mi.Point3f, "centers")
        view = dr.normalize(opaque(camera, len(surfels)).origin - center)
        scales, opacity = surfels.column(mi.Vector2f, "scales"), surfels.column(mi.Float, "opacities")
        cosine = dr.dot(surfels.frames()[2], view)
        shown = opacity * scales.x * scales.y * (dr.abs(cosine) if surfels.two_sided else dr.maximum(cosine, 0))
        if self.box is not None:
            shown = dr.select(self.box.contains(center), shown, 0)
        lit = lighting.seen_by(camera, len(surfels)).lit_radiance(surfels, view)
        return dr.opaque(mi.Float, self.settings.weights.residual) * losses.residual(surfels.radiance(-view), lit, shown)

    def reflective_mask(self, gbuffer: GBuffer, camera: Camera) -> np.ndarray:
        """Return β̂ of a view, [H, W] bool: which pixels are reflective."""
        width, height = gbuffer.size
        alpha = dr.select(deferred.within(gbuffer, camera, self.box), gbuffer.all.alpha, 0)
        roughness, alpha = (dr.detach(v).numpy().reshape(height, width) for v in (gbuffer.all.roughness, alpha))
        return reflective_mask(roughness / np.maximum(alpha, 1e-6), alpha, self.settings.reflective)

    def environment(self, log_radiance: "mi.TensorXf") -> "mi.Float | None":
        """Return the weighted total variation of the environment, whose logarithm of radiance is ``log_radiance``
        [rows, columns, 3]; of width 1, None where it has no weight."""
        weight = self.settings.weights.environment_tv
        if weight == 0:
            return None
        return dr.opaque(mi.Float, weight) * losses.environment_total_variation(log_radiance)

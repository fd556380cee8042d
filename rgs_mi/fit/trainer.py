"""The fit: views → render → loss → gradient → step → density, under a budget."""

import time
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import as_float
from ..datasets.photographs import Photographs
from ..shading import deferred
from ..shading.deferred import Shading
from ..shading.indirect import Indirect
from ..shading.monte_carlo import MonteCarlo
from ..shading.split_sum import SplitSum
from ..surfels.proxies import Proxies
from ..surfels.surfels import CHANNELS, Surfels
from . import losses
from .curves import Curves
from .density import Gradients, densify
from .model import ENVIRONMENT, SHADER, Model
from .reflection_guided import boxes, guided, picture, reflective_mask

#: Rate of each parameter: the field of `LearningRates` that it obeys.
_RATES = {
    "centers": "centers",
    "rotations": "rotations",
    "log_scales": "scales",
    "logit_opacities": "opacities",
    "sh_dc": "sh_dc",
    "sh_rest": "sh_rest",
    "logit_base_color": "base_color",
    "logit_roughness": "roughness",
    "logit_metallic": "metallic",
    "delta_normal": "delta_normal",
    "curvature": "curvature",
    ENVIRONMENT: "environment",
    SHADER: "shader",
}
_NORMALS, _HELD = ("rotations", "delta_normal", "curvature"), 0.1  # the part of their rates that they have at first
_REBUILD = 50  # steps from one tree of what reflected rays meet, and one table to sample the light by, to the next
# A mirror ball, its radius r 3/8 of the picture, turns what its middle reflects by 2/r a pixel: π r/2 rows are told apart
_ROWS_A_PIXEL, _MOST_ROWS = 3 * np.pi / 16, 512
_DIVERGED = 10  # steps in a row without a finite error


class Fit:
    """A fit in progress: the model, how far it is, and one method a step.

    ``settings``: `Settings`. ``extent``: radius of the object in world units. ``shading``: how the scene is.
    ``priors``: a `DepthPrior` for each training view, or None. ``elapsed``: seconds spent so far,
    earlier sessions included; ``curves``: what its steps measured.
    """

    def __init__(self, dataset, model: Model, settings, extent: float, shading=Shading(), priors=None):
        self.dataset, self.model, self.settings, self.extent = dataset, model, settings, extent
        never = settings.specular_start >= 1
        self.shading = replace(shading, specular="none", diffuse="radiance") if never else shading
        self.priors = priors
        self.step_number, self.views_used, self.elapsed = 0, 0, 0.0
        self.gradients = Gradients(len(model))
        self.photographs = None
        # What reflected rays meet; the surfels' share of diffuse light; what samples the light
        self.proxies = self.irradiance_visibility = self.emitter = None
        self._reflective = {}  # (camera, boxes) of what was reflective when a view was last seen
        self.psnr, self.failures = 0.0, 0
        self.curves = Curves()

    def state(self) -> tuple[dict, dict]:
        """(arrays, meta) for a checkpoint: with `resume` the fit goes on as if it had not been interrupted."""
        arrays = self.model.state() | {
            "gradient_sum": self.gradients.sum.numpy(),
            "gradient_count": self.gradients.count.numpy(),
        }
        return arrays, {
            "step": self.step_number,
            "views_used": self.views_used,
            "elapsed": self.elapsed,
            "extent": self.extent,
            "curves": self.curves.rows,
        }

    @classmethod
    def resume(cls, dataset, settings, arrays: dict, meta: dict, **others) -> "Fit":
        """The fit whose `state` this was. ``others``: ``shading``, ``priors``."""
        fit = cls(dataset, Model.from_state(arrays), settings, meta["extent"], **others)
        fit.step_number, fit.views_used, fit.elapsed = meta["step"], meta["views_used"], meta["elapsed"]
        fit.gradients.sum, fit.gradients.count = (as_float(arrays[f"gradient_{k}"]) for k in ("sum", "count"))
        fit.curves = Curves(meta.get("curves", ()))  # checkpoints of version 0.1.0 have none
        return fit

    @property
    def progress(self) -> float:
        """Fraction of the budget that is spent, in [0, 1]."""
        if self.settings.iterations is not None:
            return min(1.0, self.step_number / self.settings.iterations)
        return min(1.0, self.elapsed / (60 * self.settings.minutes))

    @property
    def stage(self):
        return next((s for s in self.settings.stages if self.progress < s.until), self.settings.stages[-1])

    @property
    def pixels(self) -> int:
        """Width of the photographs by now."""
        return max(self.dataset.train[0].camera.size[0] // self.stage.downscale, 1)

    @property
    def sh_order(self) -> int:
        """Spherical harmonics in use: one more band in each of equal parts of what follows ``sh_start``."""
        s = self.settings
        if s.sh_order == 0 or self.progress < s.sh_start:
            return 0
        return min(s.sh_order, 1 + int((self.progress - s.sh_start) / (1 - s.sh_start + 1e-9) * s.sh_order))

    @property
    def _reflects(self):
        """Whether reflections are shaded by now; without them nothing would be lit."""
        begun = self._lit or self.progress >= self.settings.specular_start
        return self.shading.specular != "none" and begun

    @property
    def _lit(self):
        """Whether the light makes the diffuse radiance, too."""
        return self.shading.diffuse == "lit"

    @property
    def _sees_itself(self):
        """Whether the object is reflected in itself by now."""
        s = self.settings
        return self._reflects and s.indirect != "none" and self.progress >= s.indirect_start

    @property
    def _shades_itself(self):
        """Whether surfels know by now how much of the light comes to them; where light is sampled there is no need."""
        return self._sees_itself and self._lit and not self._samples_light

    @property
    def begun(self) -> tuple[Shading, str]:
        """How the model is shaded by now: the `Shading` and ``indirect`` of a scene that renders the same."""
        specular = "none" if not self._reflects else "monte_carlo" if self._samples_light else "split_sum"
        return replace(self.shading, specular=specular), self.settings.indirect if self._sees_itself else "none"

    def lighting(self, surfels, training=False) -> deferred.Lighting | None:
        """How the model's ``surfels`` are shaded: None where nothing specular is, or not yet. ``training``: as a step has
        it, with what reflected rays meet, and the light's sampling, of some steps ago."""
        if not self._reflects:
            return None
        indirect = None
        if self._sees_itself:
            proxies, visibility = (self.proxies, self.irradiance_visibility) if training else (self._proxies(surfels), None)
            indirect = Indirect(self.settings.indirect, proxies, surfels, visibility)
        lighting = deferred.Lighting(self._estimator(training), self.model.shader(), indirect, self._lit, self.shading.box)
        return lighting.with_irradiance_visibility() if self._shades_itself and not training else lighting

    def _estimator(self, training):
        """Of the specular integral, by now."""
        environment, s = self.model.environment(), self.settings
        if not self._samples_light:
            return SplitSum(environment.filtered(), self.shading.eta)
        emitter = self.emitter if training else environment.emitter()
        samples, seed = (s.monte_carlo_samples, self.step_number) if training else (self.shading.samples, 0)
        return MonteCarlo(
            environment.unfiltered(), emitter, self.shading.eta, samples, dr.opaque(mi.UInt32, seed), paired=training
        )

    @property
    def _samples_light(self):
        """Whether the specular integral is sampled by now."""
        return self.shading.specular == "monte_carlo" and self.progress >= self.settings.monte_carlo_start

    def _refresh(self, surfels):
        """Rebuild what is used for many steps."""
        if self.step_number % _REBUILD == 0 or self.proxies is None:
            self.proxies = self._proxies(surfels) if self._sees_itself else None
            self.irradiance_visibility = None
            if self._shades_itself:
                self.irradiance_visibility = (
                    self.lighting(surfels, training=True)
                    .with_irradiance_visibility(self.step_number)
                    .indirect.irradiance_visibility
                )
        if self.step_number % _REBUILD == 0 or self.emitter is None:
            self.emitter = self.model.environment().emitter() if self._samples_light else None

    def _proxies(self, surfels):
        return Proxies(surfels, box=self.shading.box)

    def step(self) -> bool:
        """One step of the optimiser on the next few views, and density control when it is due. Returns whether ``curves``
        has another row."""
        start, pixels = time.monotonic(), self.pixels
        stage, s = self.stage, self.settings
        if self.photographs is None or self.photographs.downscale != stage.downscale:
            self.photographs = Photographs(self.dataset.train, stage.downscale, s.background, self.priors)
        self._refine_environment()
        self._set_rates()
        views = self._next_views(stage.views)
        surfels = self.model.surfels(self.sh_order)
        self._refresh(surfels)
        lighting = self.lighting(surfels, training=True)
        # The views share what lies before them: their gradients meet in leaves there, and go the rest of the way once.
        shared = [*(getattr(surfels, name) for name in CHANNELS), *(lighting.learned() if lighting else [])]
        leaves = [type(v)(dr.detach(v)) for v in shared]
        dr.eval(leaves)
        dr.enable_grad(leaves)
        surfels = Surfels(*leaves[: len(CHANNELS)], surfels.two_sided)
        lighting = lighting and lighting.with_learned(leaves[len(CHANNELS) :], surfels)
        measured = [self._view(i, surfels, lighting, 1 / len(views)) for i in views]
        for value, leaf in zip(shared, leaves):
            gradient = dr.grad(leaf)
            dr.set_grad(value, dr.select(dr.isfinite(gradient), gradient, 0))  # one overflow must not end a fit
            dr.enqueue(dr.ADMode.Backward, value)
        dr.traverse(dr.ADMode.Backward)
        if lighting and s.weights.environment_tv > 0:
            measured.append({"loss.environment_tv": self._smooth_light()})
        self.model.optimizer.step()
        dr.eval(measured)
        mean = {name: np.mean([float(m[name][0]) for m in measured if name in m]) for m in measured for name in m}
        self._judge(mean.pop("error"))
        self.step_number += 1
        self._control_density()
        seconds = time.monotonic() - start
        self.elapsed += seconds
        state = {"step": self.step_number, "seconds": self.elapsed, "surfels": len(self.model), "pixels": pixels}
        return self.curves.add(self.progress, state, {"psnr": self.psnr, "ms": 1e3 * seconds} | mean)

    def _judge(self, error):
        """Note the step's mean squared error. One that is not a number is an overflow in some pixel; when it stays, the fit
        has diverged, and its PSNR says so."""
        self.failures = 0 if np.isfinite(error) else self.failures + 1
        if self.failures == 0:
            self.psnr = -10 * np.log10(max(error, 1e-10))
        elif self.failures >= _DIVERGED:
            self.psnr = float("nan")

    def _view(self, i, surfels, lighting, weight):
        """Accumulate the gradients of one view's loss; returns its parts and the mean squared ``error``."""
        photo = self.photographs[i]
        w, size = self.settings.weights, photo.camera.size
        offset = dr.zeros(mi.Vector2f, len(self.model))
        dr.enable_grad(offset)
        image = deferred.render(surfels, photo.camera, lighting, offset, full=max(w.distortion, w.delta_normal) > 0)
        maps = image.gbuffer.all
        rendered = losses.display(image.color, maps.alpha, self.settings.background)
        parts = {"loss.photometric": losses.photometric(rendered, photo.color, size, w.dssim)}
        if w.mask > 0 and self.dataset.train[i].masked:
            parts["loss.mask"] = w.mask * losses.mask(maps.alpha, photo.alpha)
        if w.delta_normal > 0:
            parts["loss.delta_normal"] = w.delta_normal * losses.delta_normal(image.gbuffer)
        if w.distortion > 0:
            parts["loss.distortion"] = w.distortion * losses.distortion(maps, self.extent)
        consistency = dr.opaque(mi.Float, self._scheduled(w.consistency))
        parts["loss.consistency"] = consistency * losses.depth_normal_consistency(image.gbuffer, photo.camera)
        part_of_image = size[0] * size[1] / (photo.size[0] * photo.size[1])  # these are means over the whole photograph
        parts = {name: part_of_image * part for name, part in parts.items()} | self._regional(i, image.gbuffer, photo)
        error = dr.mean(dr.mean(dr.square(dr.detach(rendered) - photo.color))) * part_of_image
        dr.backward(sum(parts.values()) * weight)
        self.gradients.add(dr.grad(offset) / weight, image.gbuffer.seen, photo.size)
        return dr.detach(parts) | {"error": error}

    def _smooth_light(self):
        """Accumulate the gradient of the environment's own loss, which is returned."""
        loss = dr.opaque(mi.Float, self.settings.weights.environment_tv) * losses.environment_total_variation(
            self.model[ENVIRONMENT]
        )
        dr.backward(loss)
        return dr.detach(loss)

    def _regional(self, i, gbuffer, photo):
        """Losses of view ``i`` that are normalised by regions of their own: RGS's L_normal and L_depth, and minimum variation.
        Notes what is reflective for density control."""
        w, maps, parts = self.settings.weights, gbuffer.all, {}
        if max(w.normal, w.minimum_variation) > 0 or self.settings.density.guided:
            mask = self._reflective_mask(gbuffer, photo.camera)
            if self.settings.density.guided:
                self._reflective[i] = photo.camera, boxes(mask)
            if w.normal > 0:
                parts["loss.normal"] = w.normal * losses.normal_smoothness(gbuffer, mask, w.crease)
            if w.minimum_variation > 0:
                parts["loss.minimum_variation"] = w.minimum_variation * losses.minimum_variation(
                    gbuffer, mask, divmod(self.step_number % 4, 2)
                )
        if w.depth > 0 and photo.prior is not None:
            covered = maps.alpha > 0.5
            depth = maps.depth / dr.select(covered, maps.alpha, 1)
            parts["loss.depth"] = w.depth * losses.pearson_depth(depth, photo.prior, covered, photo.inverse)
        return parts

    def _next_views(self, count):
        """Views of the next step: random orders of all, one after another, that depend on seed and position alone."""
        n = len(self.dataset.train)
        chosen = []
        for k in range(self.views_used, self.views_used + count):
            order = np.random.default_rng((self.settings.seed, k // n)).permutation(n)
            chosen.append(int(order[k % n]))
        self.views_used += count
        return chosen

    def _refine_environment(self):
        """Double the rows of an environment that is learned, up to `_MOST_ROWS`, while photographs tell more apart."""
        if self.progress < self.settings.refine_start or not any(self.settings.learning_rates.environment):
            return
        rows = self.model[ENVIRONMENT].shape[0]
        while 2 * rows <= _MOST_ROWS and np.sqrt(2) * rows < _ROWS_A_PIXEL * self.pixels:
            self.model.refine_environment()
            rows *= 2

    def _scheduled(self, pair):
        """The value of a (first, last) pair at this point of the fit: geometrically between them, linearly from or to 0."""
        first, last = pair
        if min(first, last) <= 0:
            return first + (last - first) * self.progress
        return first * (last / first) ** self.progress

    def _set_rates(self):
        rate = {}
        for name in self.model.optimizer.keys():
            rate[name] = self._scheduled(getattr(self.settings.learning_rates, _RATES[name]))
        rate["centers"] *= self.extent
        # A light that has no shape yet would turn normals that the hull has right. Two-sided surfels began at random.
        if self.progress < self.settings.normals_start and not self.model.two_sided:
            rate |= {name: _HELD * rate[name] for name in _NORMALS}
        # Adam's steps are as long as its rates, however little there is to gain: what is right trembles to the last
        if self.progress > 1 - self.settings.cooldown:
            rate = {name: value * (1 - self.progress) / self.settings.cooldown for name, value in rate.items()}
        self.model.optimizer.set_learning_rate(rate)

    def _control_density(self):
        d = self.settings.density
        if self.step_number % d.refine_every:
            return
        if d.start <= self.progress < d.stop:
            # The budget opens gradually: what is spent early goes where the coarse images, not the fine ones, need it.
            opened = (self.progress - d.start) / (d.stop - d.start)
            first, last = self.settings.initialization.surfels, self.settings.max_surfels
            budget = int(first + opened * (last - first))
            rng = np.random.default_rng((self.settings.seed, self.step_number))
            densify(self.model, self.gradients, self._reach(), d, rng, budget, self._guided())
            self.proxies = None
        self.gradients = Gradients(len(self.model))

    def _reach(self):
        """What is large for a surfel: the object, or the distance from it in the surroundings."""
        if self.shading.box is None:
            return self.extent
        away = np.linalg.norm(self.model.numpy("centers") - self.shading.box.center, axis=1)
        return np.maximum(self.extent, away)

    def _guided(self):
        """[N] which surfels get half the threshold of density control; None: no one does."""
        if not self._reflective:
            return None
        return guided(self.model.numpy("centers"), *zip(*self._reflective.values()))

    def guided_picture(self):
        """What reflection-guided density control sees: `guided.picture` of a training view; None where it is off or has not
        begun."""
        flags = self._guided()
        if flags is None:
            return None
        camera, found = next(reversed(self._reflective.values()))
        with dr.suspend_grad():
            surfels = self.model.surfels(self.sh_order)
            image = deferred.render(surfels, camera, self.lighting(surfels))
            shown = losses.display(image.color, image.gbuffer.all.alpha, self.settings.background)
        width, height = camera.size
        shown = np.clip(shown.numpy().T.reshape(height, width, 3), 0, 1)
        mask = self._reflective_mask(image.gbuffer, camera)
        return picture(shown, mask, found, camera, self.model.numpy("centers")[flags])

    def _reflective_mask(self, gbuffer, camera):
        """β̂ of a view, [H, W] bool."""
        width, height = gbuffer.size
        alpha = dr.select(deferred.within(gbuffer, camera, self.shading.box), gbuffer.all.alpha, 0)
        roughness, alpha = (dr.detach(v).numpy().reshape(height, width) for v in (gbuffer.all.roughness, alpha))
        return reflective_mask(roughness / np.maximum(alpha, 1e-6), alpha, self.settings.reflective)

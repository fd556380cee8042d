"""The fit: views → render → loss → gradient → step → density, under a budget."""

import time
from collections import deque
from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core import memory
from ..core.arrays import as_float
from ..core.film import Film
from ..core.runtime import release_memory
from ..datasets.photographs import Photographs, tiling
from ..datasets.types import Dataset, DepthPrior
from ..settings.settings import Settings, Stage
from ..shading import deferred
from ..shading.lighting import Lighting, Shading, lighting_of
from ..shading.tables import eta_of
from ..surfels.proxies import Proxies
from ..surfels.surfels import SurfelColumns
from . import light_maps, losses, reflection_guided
from .cameras import Cameras, mean_rows
from .curves import Curves
from .density import DensityControl, Statistics
from .model import ENVIRONMENT, Model
from .objective import CUTOFFS, Objective
from .plan import COST, LAST, LEAST_STEPS, OFTEN, STEPS
from .ranks import Ranks
from .schedule import Schedule
from .turns import Turns

_REBUILD = 50  # steps from one tree of what reflected rays meet, and one table to sample the light by, to the next
_HIDE = 4  # such trees from one time that it is asked what surfels hide of the light to the next
_PACE = 31  # steps whose median says how long one takes
_DIVERGED = 10  # steps in a row without a finite error
_KEPT = 3 << 29  # bytes that Dr.Jit may keep of arrays that steps have freed: others seldom are as large as these were


@dataclass
class _Level:
    """The level of the pyramid that a fit is at: its ``stage``, the ``steps`` there, and the ``seconds`` of the last ones."""

    stage: Stage
    steps: int = 0
    seconds: deque[float] = field(default_factory=lambda: deque(maxlen=_PACE))

    def note(self, seconds: float) -> None:
        self.steps += 1
        self.seconds.append(seconds)

    def meta(self) -> dict:
        """What a checkpoint keeps."""
        return {"downscale": self.stage.downscale, "spp": self.stage.spp, "steps": self.steps, "seconds": list(self.seconds)}


class Fit:
    """A fit in progress: the model, how far it is, and one method a step.

    ``extent``: radius of the object in world units. ``shading``: how the scene is shaded. ``priors``: a `DepthPrior` for
    each training view, or None. ``elapsed``: seconds spent so far, earlier sessions included; ``psnr``: of the last step's
    views, NaN once the fit has diverged; ``cameras``: what is learned of cameras and exposures, or None; ``turns``: what is
    learned of a turntable's lamps, or None; ``curves``: what its steps measured. ``ranks``: the processes that make the fit
    together, all of which must call `step`; by default there is one.
    """

    def __init__(
        self,
        dataset: Dataset,
        model: Model,
        settings: Settings,
        extent: float,
        shading: Shading = Shading(),
        priors: list[DepthPrior] | None = None,
        ranks: Ranks = Ranks(),
    ) -> None:
        self.ranks = ranks
        self.dataset, self.model, self.settings, self.extent, self.priors = dataset, model, settings, extent, priors
        self.schedule = Schedule.of(settings, shading)
        self.objective = Objective(settings, extent, shading.box)
        self.density = DensityControl(settings.density, extent, shading.box, len(model))
        self.cameras = Cameras.of(dataset, settings, extent)
        self.turns = Turns.of(shading.turntable)
        self.curves = Curves()
        self.photographs: Photographs | None = None  # of the stage that has begun
        self.step_number, self.views_used, self.elapsed = 0, 0, 0.0
        self.psnr, self._failures = 0.0, 0
        self._level: _Level | None = None
        self._held = memory.held()  # when freed arrays were last given back
        # Of some steps ago: what reflected rays meet, what surfels hide of the light, and what samples the light
        self.proxies: Proxies | None = None
        self.irradiance_visibility: mi.Color3f | None = None
        self.emitter: mi.Emitter | None = None
        self._light = light_maps.LightMaps()

    # ---- State ----

    def state(self) -> tuple[dict, dict]:
        """(arrays, meta) for a checkpoint: with `resume` the fit goes on as if it had not been interrupted."""
        arrays = self.density.statistics.state()
        meta = {"step": self.step_number, "views_used": self.views_used, "elapsed": self.elapsed, "extent": self.extent}
        meta["level"] = self._level and self._level.meta()
        for learned in (self.cameras, self.turns, self._light):
            arrays |= learned.state() if learned else {}
        return self.model.state() | arrays, meta | {"curves": self.curves.rows}

    @classmethod
    def resume(cls, dataset: Dataset, settings: Settings, arrays: dict, meta: dict, **others) -> "Fit":
        """The fit whose `state` this was. ``others``: ``shading``, ``priors``, ``ranks``."""
        fit = cls(dataset, Model.from_state(arrays), settings, float(meta["extent"]), **others)
        fit.step_number, fit.views_used, fit.elapsed = int(meta["step"]), int(meta["views_used"]), float(meta["elapsed"])
        fit.density.statistics.restore(arrays)
        for learned in (fit.cameras, fit.turns, fit._light):
            if learned:
                learned.restore(arrays)
        fit.curves = Curves(meta["curves"])
        if level := meta["level"]:
            known = level["downscale"], level.get("spp", 1)
            stage = next((s for s in settings.stages or () if (s.downscale, s.spp) == known), None)
            fit._level = stage and _Level(stage, level["steps"], deque(level["seconds"], _PACE))
        return fit

    @property
    def progress(self) -> float:
        """The part of the budget that is spent, in [0, 1]."""
        return self.schedule.progress(self.step_number, self.elapsed)

    @property
    def pixels(self) -> int:
        """Width of the images in use by now."""
        return max(self.dataset.train[0].camera.size[0] // self.stage.downscale, 1)

    @property
    def stage(self) -> Stage:
        """The level of the pyramid in use: that of the schedule; in a fit that minutes bound, level by level, each after
        `STEPS` of the one before, and if there is time for `LEAST_STEPS` or, at full resolution, for every view `OFTEN`; in its
        last part (`LAST`), for every view once."""
        planned, now, s = self.schedule.stage(self.progress), self._level, self.settings
        if now is None or s.iterations or s.minutes is None or planned.downscale >= now.stage.downscale:
            return planned
        if self.photographs is None or not now.seconds:
            return now.stage
        finer = max((stage for stage in s.stages or () if stage.downscale < now.stage.downscale), key=lambda x: x.downscale)
        scale, full = now.stage.downscale / finer.downscale, finer.downscale == 1
        width, height = self.photographs.window
        tiles = [np.prod(tiling((round(width * f), round(height * f)))) for f in (1, scale)]  # of a view, now and then
        pixels = scale**2 * tiles[0] / tiles[1]  # of a view in a step, over those now
        seconds = pixels**COST * finer.views / now.stage.views * np.median(now.seconds)
        once = len(self.dataset.train) * tiles[1] / finer.views  # steps that see every view
        least = once if self.progress > 1 - LAST else OFTEN * once if full else LEAST_STEPS
        affordable = 60 * s.minutes - self.elapsed > least * seconds
        return finer if affordable and now.steps >= STEPS[full] else now.stage

    @property
    def film(self) -> Film:
        """What makes the pixels of the photographs in use of a step's samples; that of all pixels is the photographs' own."""
        return Film.gaussian(self.settings.rfilter if self.stage.downscale == 1 else 0.0, self.stage.spp)

    @property
    def sh_order(self) -> int:
        """The order of spherical harmonics in use by now."""
        return self.schedule.sh_order(self.progress)

    @property
    def shading(self) -> Shading:
        """How the model is shaded by now: that of a scene that renders the same."""
        shading = self._shading
        specular = self.model.specular()
        return shading if specular is None else replace(shading, eta=eta_of(float(specular[0])))

    @property
    def _shading(self):
        """`shading` but for what a step reads of the model itself."""
        shading = self.schedule.shading(self.progress)
        return replace(shading, turntable=self.turns.table) if self.turns else shading

    @property
    def _shading_of_steps(self):
        """`_shading` as the steps that are due have it."""
        shading = self._shading
        return replace(shading, diffuse="lit") if self.schedule.relights(self.progress) else shading

    # ---- Lighting ----

    def lighting(self, surfels: SurfelColumns, training: bool = False) -> Lighting | None:
        """How the model's ``surfels`` are shaded by now; None where nothing is specular. ``training``: as a step has it,
        with what reflected rays meet, and the light's sampling, of some steps ago."""
        shading = self._shading_of_steps if training else self.shading
        if shading.specular == "none":
            return None
        shader, sampled = self.model.shader(), shading.specular == "monte_carlo"
        if not training:
            learned = self.model.environment()
            environment = learned.unfiltered() if sampled else learned.filtered()
            return lighting_of(shading, surfels, environment, learned.emitter() if sampled else None, shader)
        return lighting_of(
            replace(shading, samples=self.settings.monte_carlo_samples),
            surfels,
            self._light.see(self.model, not sampled),
            self.emitter,
            shader,
            seed=self.step_number,
            proxies=self.proxies,
            irradiance_visibility=self.irradiance_visibility,
            paired=True,
            learned_specular=self.model.specular(),
        )

    def _refresh(self, surfels):
        """Rebuild what serves many steps."""
        shading, due = self._shading_of_steps, self.step_number % _REBUILD == 0
        sampled = shading.specular == "monte_carlo"
        if due or self.emitter is None:
            self.emitter = self.model.environment().emitter() if sampled else None
        if sampled:
            self.irradiance_visibility = None  # its rays say by themselves what is hidden
        if due or self.proxies is None:
            others = self.step_number % (_HIDE * _REBUILD) == 0
            self.proxies = None
            if shading.indirect != "none":
                self.proxies = Proxies(surfels, box=shading.box)
            if others or self.irradiance_visibility is None:
                self.irradiance_visibility = self._hidden(surfels)

    def _hidden(self, surfels):
        """What ``surfels`` hide of the light; None where nothing asks."""
        self.irradiance_visibility = None
        explained = self.schedule.explains(self.progress) or self._shading_of_steps.diffuse == "lit"
        lighting = self.lighting(surfels, training=True) if self.proxies and explained else None
        if lighting is None:
            return None
        lighting = lighting if lighting.lit else lighting.with_irradiance_visibility(self.step_number)
        return lighting.indirect and lighting.indirect.irradiance_visibility

    # ---- One step ----

    def step(self) -> bool:
        """One step of the optimizer on the next few views, and density control when it is due. Returns whether ``curves``
        has another row."""
        start, pixels, progress = time.monotonic(), self.pixels, self.progress
        stage = self.stage
        if self.photographs is None or self.photographs.downscale != stage.downscale:
            s = self.settings
            self.photographs = Photographs(
                self.dataset.train, stage.downscale, s.background, self.priors, s.mask_tolerance, s.mask_rim
            )
        if self._level is None or stage != self._level.stage:
            self._level = _Level(stage)
            self._release_memory()
        self._follow_schedule()
        views = self._next_views(stage.views * self.ranks.size)[self.ranks.rank :: self.ranks.size]
        surfels = self.model.scene(self.sh_order)
        self._refresh(surfels)
        lighting = self.lighting(surfels, training=True)
        measured, reached, moved = self._backward(views, lighting)
        if reached and (loss := self.objective.environment(self.model[ENVIRONMENT])) is not None:
            dr.backward(loss * light_maps.STEPS)
            measured.append({"loss.environment_tv": dr.detach(loss)})
        self.model.step(*moved)
        dr.eval(measured)
        mean = {name: np.mean([float(m[name][0]) for m in measured if name in m]) for m in measured for name in m}
        self._judge(mean.pop("error"))
        if self.cameras:
            found = self.ranks.gather(self.cameras.gradients())
            gradients = {name: mean_rows([rows[name] for rows in found]) for name in self.cameras.rows}
            self.cameras.step(gradients, self.schedule.camera_rates(progress, stage.downscale * self.cameras.pixel))
        if self.turns:
            self.turns.step(mean_rows(self.ranks.gather(self.turns.gradients())), self.schedule.turn_rate(progress))
        self.step_number += 1
        self._control_density()
        if memory.held() > self._held + _KEPT:
            self._release_memory()
        seconds = self.ranks.same(time.monotonic() - start)
        self.elapsed += seconds
        self._level.note(seconds)
        state = {"step": self.step_number, "seconds": self.elapsed, "surfels": len(self.model), "pixels": pixels}
        return self.curves.add(self.progress, state, {"psnr": self.psnr, "ms": 1e3 * seconds} | mean)

    def _release_memory(self):
        release_memory()
        self._held = memory.held()

    def _follow_schedule(self):
        """Bring rates, and rows of the environment, to where they should be by now."""
        height = self.schedule.envmap_height(self.progress, self.model[ENVIRONMENT].shape[0], self.pixels)
        while self.model[ENVIRONMENT].shape[0] < height:
            self.model.refine_environment()
        rates = self.schedule.learning_rates(self.model.names(), self.progress, self.extent, self.model.two_sided)
        longer = np.sqrt(self.ranks.size)  # what more views agree on has less noise (Adam: Malladi et al. 2022)
        self.model.set_rates({name: longer * rate for name, rate in rates.items()})

    def _next_views(self, count):
        """Views of the next step: random orders of all, one after another, that depend on seed and position alone."""
        n = len(self.dataset.train)
        chosen = []
        for k in range(self.views_used, self.views_used + count):
            order = np.random.default_rng((self.settings.seed, k // n)).permutation(n)
            chosen.append(int(order[k % n]))
        self.views_used += count
        return chosen

    def _backward(self, views, lighting):
        """Gradients of the mean loss of ``views``; returns what each of them measured, their mean squared ``error`` in all
        processes, whether the gradients of the last steps have reached the environment, and what `Model.step` is to move."""
        # The views share what lies before the light: their gradients meet in leaves there, and go the rest of the way once.
        shared = lighting.learned() if lighting else []
        leaves = [type(v)(dr.detach(v)) for v in shared]
        dr.eval(leaves)
        dr.enable_grad(leaves)
        lighting = lighting and lighting.with_learned(leaves)
        statistics = Statistics(len(self.model))
        measured = [self._view(i, lighting, 1 / len(views), statistics) for i in views]
        error = dr.mean([m.pop("error") for m in measured])
        index, gradient = self.model.gradients(every=self.ranks.size > 1)
        gradients = [dr.grad(leaf) for leaf in leaves]
        gradients = [dr.select(dr.isfinite(g), g, 0) for g in gradients]  # one overflow must not end a fit
        light = None
        if lighting:  # whose maps come first of what it learns
            del shared[0]
            light = self._light.gather(self.step_number, gradients.pop(0))
        sums = statistics.sums()
        gradient, *means, error, light = self.ranks.mean([gradient, *gradients, *sums, error, light])
        gradients, sums = means[: -len(sums)], means[-len(sums) :]
        self.density.statistics.merge([mean * self.ranks.size for mean in sums])
        measured.append({"error": error})
        if light is not None:
            self._light.pass_on(self.model, light)
        for value, own in zip(shared, gradients):
            dr.set_grad(value, own)
            dr.enqueue(dr.ADMode.Backward, value)
        dr.traverse(dr.ADMode.Backward)
        return measured, light is not None, (index, gradient)

    def _view(self, i, lighting, weight, statistics):
        """Accumulate the gradients of view ``i``, and density control's ``statistics``; returns its loss's terms and the mean
        squared ``error``."""
        assert self.photographs is not None
        turn, film, gain, terms = self.views_used // len(self.dataset.train) + i, self.film, None, {}
        photo = self.photographs.tile(i, turn, film.side**2)
        if self.cameras:
            started = self.schedule.learns_cameras(self.progress)
            seen = self.cameras.see(i, photo.camera, self.settings.weights, started)
            photo, gain, terms = replace(photo, camera=seen.camera), seen.gain, {"loss.cameras": seen.prior}
        if self.turns and lighting:
            lighting = replace(lighting, turn=self.turns.see(photo.camera))
        camera = film.samples(photo.camera)
        index = self.model.in_view(camera, CUTOFFS)
        surfels = self.model.take(index, self.sh_order, once=True)
        means2d_offset = dr.zeros(mi.Vector2f, len(surfels))
        dr.enable_grad(means2d_offset)
        contribution = dr.zeros(mi.Vector2f, len(surfels)) if self.density.weighs else None
        dr.enable_grad(contribution)
        image = deferred.render(surfels, camera, lighting, means2d_offset, CUTOFFS, self.objective.full, contribution)
        consistency = self.schedule.value(self.settings.weights.consistency, self.progress)
        loss = self.objective(image, photo, self.dataset.train[i].masked, consistency, self.step_number, gain, film)
        terms |= loss.terms
        if lighting and self.schedule.explains(self.progress):
            terms["loss.residual"] = self.objective.residual(surfels, lighting, self.dataset.train[i].camera)
        total = sum(terms.values()) * weight
        if (weighed := image.gbuffer.all.contribution) is not None:
            total += dr.mean(weighed.x + weighed.y * loss.photometric)
        dr.backward(total)
        gradient = dr.grad(means2d_offset) * (photo.part / weight)  # as if all of the window had been seen
        found = mi.Vector2f(0) if contribution is None else dr.grad(contribution)
        size = tuple(film.side * n for n in photo.size)  # of which the gradient is
        statistics.add(index, gradient, found, image.gbuffer.seen, size)
        if loss.reflective is not None:
            self.density.note_reflective(i, camera, loss.reflective)
        return dr.detach(terms) | {"error": loss.error}

    def _judge(self, error):
        """Note the step's mean squared error. One that is not a number is an overflow in some pixel; when it stays, the fit
        has diverged, and its PSNR says so."""
        self._failures = 0 if np.isfinite(error) else self._failures + 1
        if self._failures == 0:
            self.psnr = -10 * np.log10(max(error, 1e-10))
        elif self._failures >= _DIVERGED:
            self.psnr = float("nan")

    def _control_density(self):
        if not self.schedule.refines(self.step_number):
            return
        if (budget := self.schedule.surfel_budget(self.progress)) is not None:
            self.proxies = None
        self.density.share(self.ranks)
        parents = self.density.refine(self.model, np.random.default_rng((self.settings.seed, self.step_number)), budget)
        if parents is not None and self.irradiance_visibility is not None:
            parents = mi.UInt32(as_float(parents))
            self.irradiance_visibility = dr.gather(mi.Color3f, self.irradiance_visibility, parents)
            dr.eval(self.irradiance_visibility)

    # ---- Pictures ----

    def guided_picture(self) -> np.ndarray | None:
        """What reflection-guided density control sees: `reflection_guided.picture` of a training view; None where it is off
        or has not begun."""
        flags = self.density.guided(self.model)
        if flags is None:
            return None
        camera, found = next(reversed(self.density.reflective.values()))
        with dr.suspend_grad():
            surfels = self.model.surfels(self.sh_order)
            image = deferred.render(surfels, camera, self.lighting(surfels))
            shown = losses.display(image.color, image.gbuffer.all.alpha, self.settings.background)
        width, height = camera.size
        shown = np.clip(shown.numpy().T.reshape(height, width, 3), 0, 1)
        mask = self.objective.reflective_mask(image.gbuffer, camera)
        return reflection_guided.picture(shown, mask, found, camera, self.model.numpy("centers")[flags])

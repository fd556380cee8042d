"""The fit: views → render → loss → gradient → step → density, under a budget."""

import time
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from . import losses
from .aligned import lanes
from .color import display
from .density import Gradients, densify
from .model import ENVIRONMENT, Model
from .shading import deferred
from .shading.split_sum import DEFAULT_ETA
from .surfel import CHANNELS, Surfels

#: Rate of each parameter: the field of `Rates` that it obeys.
_RATES = {"centers": "centers", "rotations": "rotations", "log_scales": "scales", "logit_opacities": "opacities",
          "sh_dc": "sh_dc", "sh_rest": "sh_rest", "logit_base_color": "base_color", "logit_roughness": "roughness",
          "logit_metallic": "metallic", "delta_normal": "delta_normal", ENVIRONMENT: "environment"}
_DIVERGED = 10  # steps in a row without a finite error
_CROP_MARGIN = 8  # pixels of background around the object that training looks at


class Photographs:
    """The training photographs of one pyramid level as the losses want them: display space, over the background, and
    cropped to windows of one size that hold the object in every view (one size, since each needs its own kernels)."""

    def __init__(self, views, downscale, background):
        self.views, self.downscale, self.background = views, downscale, background
        self._images = {}
        self._windows = _windows(views, downscale)

    def __getitem__(self, i):
        """(camera, colour ``mi.Color3f``, coverage ``mi.Float``, the whole photograph's size at this level) of view ``i``,
        a lane a pixel."""
        view, (x, y, width, height) = self.views[i], self._windows[i]
        if i not in self._images:
            color = display(view.pixels, 0.0)
            alpha = view.pixels[..., 3:].astype(np.float32) / (255 if view.pixels.dtype == np.uint8 else 1)
            whole = _shrink(np.concatenate([color, alpha], 2), self.downscale)
            window = whole[y:y + height, x:x + width].transpose(2, 0, 1).reshape(4, -1)
            self._images[i] = np.ascontiguousarray(window).astype(np.float16), whole.shape[1::-1]
        planes, size = self._images[i]
        planes = [lanes(plane) for plane in planes]
        color = mi.Color3f(*planes[:3]) + self.background * (1 - planes[3])
        return view.camera.resized(*size).cropped(x, y, width, height), color, planes[3], size


def _windows(views, downscale):
    """One (x, y, width, height) a view, in pixels of the level: around the mask, of one size where photographs are."""
    sizes = [tuple(max(n // downscale, 1) if n >= downscale else n for n in v.camera.size) for v in views]
    if len(set(sizes)) > 1 or not all(v.masked for v in views):
        return [(0, 0, *size) for size in sizes]
    boxes = []
    for view in views:
        rows, columns = (np.flatnonzero((view.pixels[..., 3] > 0).any(axis)) for axis in (1, 0))
        boxes.append([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1])
    boxes = np.array(boxes) / downscale
    wanted = (boxes[:, 2:] - boxes[:, :2]).max(0) + 2 * _CROP_MARGIN
    size = np.minimum(np.ceil(wanted / 8) * 8, sizes[0]).astype(int)
    corners = np.clip(np.round((boxes[:, :2] + boxes[:, 2:] - size) / 2), 0, sizes[0] - size).astype(int)
    return [(int(x), int(y), int(size[0]), int(size[1])) for x, y in corners]


def _shrink(image, factor):
    """Mean over factor × factor blocks; the last rows and columns that fill no block are left out."""
    height, width = (max(n // factor, 1) * factor if n >= factor else n for n in image.shape[:2])
    if factor == 1 or min(image.shape[:2]) < factor:
        return image
    return image[:height, :width].reshape(height // factor, factor, width // factor, factor, -1).mean((1, 3))


class Fit:
    """A fit in progress: the model, how far it is, and one method a step.

    ``settings``: `Settings`. ``extent``: radius of the object in world units. ``specular``, ``eta``: how the scene is
    shaded (see `FitScene`). ``elapsed``: seconds spent so far, earlier sessions included.
    """

    def __init__(self, dataset, model: Model, settings, extent: float, specular="split_sum", eta=DEFAULT_ETA):
        self.dataset, self.model, self.settings, self.extent = dataset, model, settings, extent
        self.specular, self.eta = specular, eta
        self.step_number, self.views_used, self.elapsed = 0, 0, 0.0
        self.gradients = Gradients(len(model))
        self.photographs = None
        self.psnr, self.failures = 0.0, 0

    def state(self) -> tuple[dict, dict]:
        """(arrays, meta) for a checkpoint: with `resume` the fit goes on as if it had not been interrupted."""
        arrays = self.model.state() | {"gradient_sum": self.gradients.sum.numpy(),
                                       "gradient_count": self.gradients.count.numpy()}
        return arrays, {"step": self.step_number, "views_used": self.views_used, "elapsed": self.elapsed,
                        "extent": self.extent}

    @classmethod
    def resume(cls, dataset, settings, arrays: dict, meta: dict, **shading) -> "Fit":
        """The fit whose `state` this was. ``shading``: ``specular`` and ``eta``."""
        fit = cls(dataset, Model.from_state(arrays), settings, meta["extent"], **shading)
        fit.step_number, fit.views_used, fit.elapsed = meta["step"], meta["views_used"], meta["elapsed"]
        fit.gradients.sum, fit.gradients.count = (lanes(arrays[f"gradient_{k}"]) for k in ("sum", "count"))
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
    def sh_order(self) -> int:
        """Spherical harmonics in use: one more band in each of equal parts of what follows ``sh_start``."""
        s = self.settings
        if s.sh_order == 0 or self.progress < s.sh_start:
            return 0
        return min(s.sh_order, 1 + int((self.progress - s.sh_start) / (1 - s.sh_start + 1e-9) * s.sh_order))

    def filtered(self):
        """The model's environment as shading takes it: None where nothing specular is shaded."""
        return None if self.specular == "none" else self.model.environment().filtered()

    def step(self):
        """One step of the optimiser on the next few views, and density control when it is due."""
        start = time.monotonic()
        stage, s = self.stage, self.settings
        if self.photographs is None or self.photographs.downscale != stage.downscale:
            self.photographs = Photographs(self.dataset.train, stage.downscale, s.background)
        self._set_rates()
        views = self._next_views(stage.views)
        filtered = self.filtered()
        surfels = self.model.surfels(self.sh_order)
        # The views share what lies before them: their gradients meet in leaves there, and go the rest of the way once.
        shared = [*(getattr(surfels, name) for name in CHANNELS), *([filtered.texels] if filtered else [])]
        leaves = [type(v)(dr.detach(v)) for v in shared]
        dr.eval(leaves)
        dr.enable_grad(leaves)
        surfels = Surfels(*leaves[:len(CHANNELS)], surfels.two_sided)
        filtered = filtered and replace(filtered, texels=leaves[-1])
        errors = [self._view(i, surfels, filtered, 1 / len(views)) for i in views]
        for value, leaf in zip(shared, leaves):
            gradient = dr.grad(leaf)
            dr.set_grad(value, dr.select(dr.isfinite(gradient), gradient, 0))  # one overflow must not end a fit
            dr.enqueue(dr.ADMode.Backward, value)
        dr.traverse(dr.ADMode.Backward)
        self.model.optimizer.step()
        self._judge(np.mean([float(e[0]) for e in errors]))
        self.step_number += 1
        self._control_density()
        self.elapsed += time.monotonic() - start

    def _judge(self, error):
        """Note the step's mean squared error. One that is not a number is an overflow in some pixel; when it stays, the fit
        has diverged, and its PSNR says so."""
        self.failures = 0 if np.isfinite(error) else self.failures + 1
        if self.failures == 0:
            self.psnr = -10 * np.log10(max(error, 1e-10))
        elif self.failures >= _DIVERGED:
            self.psnr = float("nan")

    def _view(self, i, surfels, filtered, weight):
        """Accumulate the gradients of one view's loss; returns its mean squared error."""
        camera, target, alpha, whole = self.photographs[i]
        w = self.settings.weights
        offset = dr.zeros(mi.Vector2f, len(self.model))
        dr.enable_grad(offset)
        image = deferred.render(surfels, camera, filtered, offset, self.eta)
        maps = image.gbuffer.all
        rendered = losses.display(image.color, maps.alpha, self.settings.background)
        loss = losses.photometric(rendered, target, camera.size, w.dssim)
        if w.mask > 0 and self.dataset.train[i].masked:
            loss += w.mask * losses.mask(maps.alpha, alpha)
        consistency = dr.opaque(mi.Float, self._scheduled(w.consistency))
        loss += consistency * losses.depth_normal_consistency(image.gbuffer, camera)
        if w.smoothness > 0:
            loss += w.smoothness * losses.normal_smoothness(image.gbuffer)
        share = camera.size[0] * camera.size[1] / (whole[0] * whole[1])  # losses are means over the whole photograph
        error = dr.mean(dr.mean(dr.square(dr.detach(rendered) - target))) * share
        dr.backward(loss * (weight * share))
        self.gradients.add(dr.grad(offset) / weight, image.gbuffer.seen, whole)
        return error

    def _next_views(self, count):
        """Views of the next step: random orders of all, one after another, that depend on seed and position alone."""
        n = len(self.dataset.train)
        chosen = []
        for k in range(self.views_used, self.views_used + count):
            order = np.random.default_rng((self.settings.seed, k // n)).permutation(n)
            chosen.append(int(order[k % n]))
        self.views_used += count
        return chosen

    def _scheduled(self, pair):
        """The value of a (first, last) pair at this point of the fit."""
        first, last = pair
        return first * (last / first) ** self.progress

    def _set_rates(self):
        rate = {}
        for name, field in _RATES.items():
            rate[name] = self._scheduled(getattr(self.settings.rates, field))
        rate["centers"] *= self.extent
        self.model.optimizer.set_learning_rate(rate)

    def _control_density(self):
        d = self.settings.density
        if self.step_number % d.interval:
            return
        if d.start <= self.progress < d.stop:
            # The budget opens gradually: what is spent early goes where the coarse images, not the fine ones, need it.
            opened = (self.progress - d.start) / (d.stop - d.start)
            budget = int(self.settings.start.surfels + opened * (d.max_surfels - self.settings.start.surfels))
            rng = np.random.default_rng((self.settings.seed, self.step_number))
            densify(self.model, self.gradients, self.extent, d, rng, budget)
        self.gradients = Gradients(len(self.model))

"""Splats that are fitted to pictures as viewers will show them: display colours, nothing to be lit (`splat.ellipses`)."""

import functools
from collections.abc import Sequence
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from ..core.bounding_box import BoundingBox
from ..datasets.types import Dataset, View
from ..settings.settings import Density, Initialization, LearningRates, Settings, Stage
from ..shading.lighting import Shading
from ..splat.ellipses import CUTOFFS, DILATIONS, project_ellipses, render_ellipses
from ..surfels.surfels import SH_0, Surfels
from . import losses
from .model import Model
from .plan import planned
from .trainer import Fit

_CUTOFFS = replace(CUTOFFS, transmittance_min=1e-2)  # of a step
#: Viewers hold the mean colour from 0 to 1, and all other coefficients from −1 to 1, in eight bits.
_MOST, _OFTEN = {"sh_dc": 0.5 / SH_0, "sh_rest": 1.0}, 10  # steps from one time that they are clipped to the next


class SplatFit(Fit):
    """A fit of the surfels of ``model``, whose radiance are display values, to pictures ``views``, which has ``minutes`` for
    up to ``most`` of them. Of ``extent`` and ``box`` see `Objective`."""

    def __init__(
        self,
        views: Sequence[View],
        model: Model,
        minutes: float,
        most: int,
        extent: float,
        box: BoundingBox | None = None,
    ) -> None:
        settings = Settings(
            minutes=minutes,
            specular_start=1,
            sh_order=3,
            sh_start=0,
            initialization=Initialization(surfels=len(model)),
            density=Density(max_surfels=most, grow_by="loss"),
            learning_rates=LearningRates(rotations=(5e-3, 5e-4), sh_rest=(3e-2, 2e-3), environment=(0, 0)),
        )
        dataset = Dataset(list(views), [])
        super().__init__(dataset, model, planned(settings, dataset), extent, Shading(box=box))

    def step(self) -> bool:
        """One step, as of any fit, of splats that viewers can hold."""
        recorded = super().step()
        if self.step_number % _OFTEN == 0:
            self.model.rows.clip(_MOST)
        return recorded

    def splats(self) -> Surfels:
        """Return the splats as they are by now, with display values as their diffuse radiance."""
        self.model.rows.catch_up()
        self.model.rows.clip(_MOST)
        return self.model.surfels(3)

    @property
    def stage(self) -> Stage:
        """The level of the pyramid in use."""
        return self.schedule.stage(self.progress)

    def _view(self, i, lighting, weight, statistics):
        assert self.photographs is not None
        photo = self.photographs.tile(i, self.views_used // len(self.dataset.train) + i)
        whole = self.dataset.train[i].camera.resized(*photo.size)
        projected = functools.partial(project_ellipses, whole=whole)
        index = self.model.in_view(photo.camera, _CUTOFFS, projected)
        surfels = self.model.take(index, self.sh_order, once=True)
        offset, contribution = (dr.zeros(mi.Vector2f, len(surfels)) for _ in range(2))
        dr.enable_grad(offset, contribution)
        dilation = DILATIONS[self.step_number % len(DILATIONS)]  # what is right in all viewers is so at other sizes, too
        picture = render_ellipses(surfels, photo.camera, dilation, offset, _CUTOFFS, contribution, whole)
        color, alpha = losses.completed(picture.color, picture.alpha, _CUTOFFS.transmittance_min)
        shown = losses.evaluated_adjoint(color + (1 - alpha) * photo.behind)
        w, size = self.settings.weights, photo.camera.size
        photometric = losses.photometric(shown, photo.color, size, w.dssim)
        terms = {"loss.photometric": photo.of_image * dr.mean(photometric)}
        if self.dataset.train[i].masked:
            terms["loss.mask"] = photo.of_image * w.mask * losses.mask(alpha, photo.alpha)
        assert (weighed := picture.contribution) is not None
        dr.backward(sum(terms.values()) * weight + dr.mean(weighed.x + weighed.y * dr.detach(photometric)))
        statistics.add(index, dr.grad(offset) * (photo.part / weight), dr.grad(contribution), picture.seen, photo.size)
        return dr.detach(terms) | {"error": photo.of_image * dr.mean(dr.mean(dr.square(dr.detach(shown) - photo.color)))}

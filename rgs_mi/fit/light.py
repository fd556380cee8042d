"""Where the light stands: still to the object, or to a camera that goes round it, since it is the object that turns."""

import sys
from collections.abc import Callable
from dataclasses import replace

import drjit as dr
import numpy as np

from ..core.errors import UserError
from ..core.progress import Progress
from ..core.turntable import Turntable
from ..datasets.photographs import Photographs
from ..datasets.types import Dataset, View
from ..priors.turntable import background_stands_still, rings
from ..settings.settings import Settings, Stage
from ..shading import deferred
from . import losses
from .trainer import Fit

_STEPS, _HELD_OUT = 400, 8  # of each of two fits that are compared; every so many photographs judge them
_CLEAR = 0.3  # dB between them that tell


def turntable_of(settings: Settings, dataset: Dataset) -> Turntable | None:
    """Return the turntable on which the object of ``dataset`` turns; None where ``settings`` say that the light is the world's.

    Raises: UserError where they say turntable, and cameras do not stand on rings about one axis.
    """
    if settings.light != "turntable":
        return None
    table = rings([view.camera for view in dataset.train])
    if table is None:
        raise UserError(
            f"{dataset.root}: its cameras do not stand on rings about one axis, as a turntable's do: light=world"
        )
    return table


def decided(settings: Settings, dataset: Dataset) -> tuple[Settings, str]:
    """Return ``settings`` whose `light` is what poses and backgrounds of ``dataset`` tell, 'auto' where these leave it open; and
    what was seen, in a line, '' where there is nothing to tell."""
    if settings.light != "auto":
        return settings, ""
    world, table = replace(settings, light="world"), rings([view.camera for view in dataset.train])
    if table is None or settings.specular_start >= 1:
        return world, ""
    circles = f"cameras stand on {len(table.rings)} ring{'s' * (len(table.rings) > 1)} about one axis"
    still = background_stands_still(dataset.train, table)
    if still is False:
        return world, f"{circles}, and the background turns with the object: the light is the world's"
    if not all(view.masked for view in dataset.train):
        if still:
            circles += ", and the background stands still: this looks like a turntable, of which photographs need masks"
            return world, circles
        return world, f"{circles}, and photographs have no masks: taken for a camera that goes round"
    if still:
        return replace(settings, light="turntable"), f"{circles}, and the background stands still: this is a turntable"
    return settings, f"{circles}: this looks like a turntable"


def tried(fit_of: Callable[[Dataset, Settings], Fit], dataset: Dataset, settings: Settings, quiet: bool) -> Settings:
    """Return ``settings`` with the `light` by which a short fit, as ``fit_of`` starts one, comes nearer to photographs that are
    held out of it; 'world' where it makes no difference, of which it tells."""
    assert settings.stages, "`plan.planned` gives them"
    held_out = dataset.train[::_HELD_OUT]
    shown = replace(dataset, train=[view for k, view in enumerate(dataset.train) if k % _HELD_OUT])
    short = replace(
        settings,
        iterations=_STEPS,
        minutes=None,
        stages=(Stage(1.0, settings.stages[0].downscale, 1),),
        cameras="fixed",
        weights=replace(settings.weights, depth=0),
    )
    scores = {}
    with Progress(quiet=quiet, label="world or turntable") as progress:
        for k, light in enumerate(("world", "turntable")):
            fit = fit_of(shown, replace(short, light=light))
            while fit.progress < 1:
                fit.step()
                progress.update((k + fit.progress) / 2)
            scores[light] = _score(fit, held_out)
            dr.flush_malloc_cache()
    better = max(scores, key=lambda light: scores[light])
    difference = scores["turntable"] - scores["world"]
    clear = abs(difference) >= _CLEAR
    if not quiet:
        found = f"a turntable's light is {difference:+.1f} dB nearer to photographs that were held out than the world's"
        print(found if clear else f"{found}, which decides nothing: light=world (--set light=turntable)", file=sys.stderr)
    return replace(settings, light=better if clear else "world")


def _score(fit: Fit, views: list[View]) -> float:
    """The mean PSNR of ``views`` at the resolution of the fit."""
    photographs = Photographs(views, fit.stage.downscale, fit.settings.background)
    errors = []
    with dr.suspend_grad():
        surfels = fit.model.surfels(fit.sh_order)
        lighting = fit.lighting(surfels)
        for k in range(len(views)):
            photograph = photographs.tile(k)
            image = deferred.render(surfels, photograph.camera, lighting)
            shown = losses.display(image.color, image.gbuffer.all.alpha, photograph.behind)
            errors.append(float(dr.mean(dr.mean(dr.square(shown - photograph.color)))[0]))
    return float(np.mean(-10 * np.log10(np.maximum(errors, 1e-10))))

"""Where the light stands: still to the object, or to a camera that goes round it, since it is the object that turns."""

import sys
from collections.abc import Callable, Sequence
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.errors import UserError
from ..core.progress import Progress
from ..core.runtime import release_memory
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
_SHOWN, _COARSE, _FINE = 4, 10, 2  # photographs that tell how a ring's lamps are turned; degrees from one turn to the next


def turntable_of(settings: Settings, dataset: Dataset) -> Turntable | None:
    """Return the turntable on which the object of ``dataset`` turns; None where ``settings`` say that the light is the world's.

    Raises: UserError where they say turntable, and cameras do not stand on rings about one axis, or on others than have turns.
    """
    if settings.light != "turntable":
        return None
    table = rings([view.camera for view in dataset.train])
    if table is None:
        raise UserError(
            f"{dataset.root}: its cameras do not stand on rings about one axis, as a turntable's do: light=world"
        )
    if settings.turns is None:
        return table
    if len(settings.turns) != len(table.rings):
        heights = ", ".join(f"{elevation:.0f}" for elevation, _ in table.rings)
        raise UserError(f"settings: turns has {len(settings.turns)} numbers: give one for each ring, at {heights} degrees")
    return replace(table, rings=tuple((elevation, turn) for (elevation, _), turn in zip(table.rings, settings.turns)))


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
    held_out = dataset.train[::_HELD_OUT]
    shown = replace(dataset, train=[view for k, view in enumerate(dataset.train) if k % _HELD_OUT])
    scores = {}
    with Progress(quiet=quiet, label="world or turntable") as progress:
        for k, light in enumerate(("world", "turntable")):
            fit = fit_of(shown, short(settings, light))
            while fit.progress < 1:
                fit.step()
                progress.update((k + fit.progress) / 2)
            (scores[light],) = _scores(fit, held_out)
            release_memory()
    better = max(scores, key=lambda light: scores[light])
    difference = scores["turntable"] - scores["world"]
    clear = abs(difference) >= _CLEAR
    if not quiet:
        found = f"a turntable's light is {difference:+.1f} dB nearer to photographs that were held out than the world's"
        print(found if clear else f"{found}, which decides nothing: light=world (--set light=turntable)", file=sys.stderr)
    return replace(settings, light=better if clear else "world")


def ring_turns(fit_of: Callable[[Dataset, Settings], Fit], dataset: Dataset, settings: Settings, quiet: bool) -> Settings:
    """Return ``settings``, of an object on a turntable, with the `turns` of its rings' lamps: a short fit to the ring of the most
    photographs sees some of each other ring under lamps that are turned all around; where no turn makes those clearly better,
    there is none."""
    table = turntable_of(settings, dataset)
    if settings.turns is not None or table is None or len(table.rings) < 2 or settings.specular_start >= 1:
        return settings
    ring = [table.ring(view.camera) for view in dataset.train]
    count = len(table.rings)
    members = [[view for view, own in zip(dataset.train, ring) if own == k] for k in range(count)]
    first = max(range(count), key=lambda k: len(members[k]))
    turns = [0.0] * count
    with Progress(quiet=quiet, label="lamps of the rings") as progress:
        fit = fit_of(replace(dataset, train=members[first]), short(settings, "turntable"))
        while fit.progress < 1:
            fit.step()
            progress.update(0.8 * fit.progress)
        others = [k for k in range(count) if k != first]
        for done, k in enumerate(others):
            few = members[k][:: max(1, len(members[k]) // _SHOWN)]
            around = list(range(-180, 180, _COARSE))
            best = around[int(np.argmax(_scores(fit, few, around)))]
            near = list(range(best - _COARSE, best + _COARSE + 1, _FINE))
            still, *scores = _scores(fit, few, [0, *near])
            turns[k] = float(near[np.argmax(scores)]) if max(scores) > still + _CLEAR else 0.0
            progress.update(0.8 + 0.2 * (done + 1) / len(others))
    release_memory()
    if any(turns) and not quiet:
        listing = ", ".join(f"{turn:+.0f}" for turn in turns)
        print(f"the camera was moved among the lamps: rings, from the lowest, see them turned by {listing} degrees")
    return replace(settings, turns=tuple(turn - turns[0] for turn in turns))


def short(settings: Settings, light: str) -> Settings:
    """Return the settings of a fit that is to tell which ``light`` it is."""
    assert settings.stages, "`plan.planned` gives them"
    return replace(
        settings,
        iterations=_STEPS,
        minutes=None,
        stages=(Stage(1.0, settings.stages[0].downscale, 1),),
        cameras="fixed",
        weights=replace(settings.weights, depth=0),
        light=light,
        turns=None,
    )


def _scores(fit: Fit, views: list[View], turns: Sequence[float | None] = (None,)) -> list[float]:
    """The mean PSNR of ``views`` at the resolution of the fit, for each of ``turns`` of their lamps, degrees (None: its own)."""
    photographs = Photographs(views, fit.stage.downscale, fit.settings.background, rim=fit.settings.mask_rim)
    shown = [photographs.tile(k) for k in range(len(views))]
    scores = []
    with dr.suspend_grad():
        surfels = fit.model.surfels(fit.sh_order)
        lighting = fit.lighting(surfels)
        assert lighting is not None, "something is specular"
        for turn in turns:
            turned = replace(lighting, turn=None if turn is None else dr.opaque(mi.Float, float(np.radians(turn))))
            errors = []
            for photograph in shown:
                image = deferred.render(surfels, photograph.camera, turned)
                color = losses.display(image.color, image.gbuffer.all.alpha, photograph.behind)
                errors.append(float(dr.mean(dr.mean(dr.square(color - photograph.color)))[0]))
            scores.append(float(np.mean(-10 * np.log10(np.maximum(errors, 1e-10)))))
    return scores

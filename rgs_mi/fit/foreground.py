"""What of photographs without masks is the object: where they show what lies in the box, above the ground.

Mirrors have no depth that photographs agree on but that of what they mirror, so that a fit from points of agreement builds what
is seen in a mirror behind it, and never has its normals. Where a mirror ends they agree, though: the surroundings are hidden
there. So a short fit without reflections, wrong as it is within the object, has its silhouettes, and these a visual hull.
"""

import sys
from collections.abc import Callable
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage
from skimage.measure import label

from ..core.bounding_box import BoundingBox
from ..core.errors import UserError
from ..core.progress import Progress
from ..core.runtime import release_memory
from ..datasets.types import Dataset, View
from ..priors import hull
from ..priors.ground import Plane, ground
from ..priors.initialization import Points, around_hull
from ..settings.settings import Settings
from ..shading import deferred
from ..surfels.surfels import SH_0, SurfelColumns
from .light import short
from .trainer import Fit

_STEPS = 200  # of the short fit
_CLEAR_OF_GROUND = 0.03  # half edges of the box
_HOLE = 0.02  # of a silhouette: what is smaller is none
_DEEP, _MIRRORED = 8, 0.2  # steps below the hull; so large a part of the points within it that lie there are of a mirror
_SOLID, _ALIKE = 0.9, 0.6  # coverage; of what hull or silhouettes cover by so much both do, in the mean: less is no object
_WRONG = 20  # in so many silhouettes one may be wrong at any point: a hull of fewer is bitten into, one of more too large
_POSITIONS, _NORMALS = 2, 5  # steps that a hull of such silhouettes is smoothed over, and its normals again
_LEAST = 0.25  # of the points, at least, that start on the hull
_MARGIN = 0.05  # of the box beside the hull, over its longest edge


def found(
    fit_of: Callable[[Points, Settings], Fit],
    dataset: Dataset,
    points: Points,
    settings: Settings,
    box: BoundingBox,
    quiet: bool,
) -> tuple[Points, BoundingBox] | None:
    """Return where surfels start if those of the object start on a visual hull, and the box around that: of ``points``, which
    photographs without masks agree on, those that lie beside it stay. ``fit_of`` starts a fit from points. None where nothing
    in the ``box`` has silhouettes that belong together, and where what has them does not mirror. It tells of it."""
    assert points.normals is not None, "points on surfaces"
    rng = np.random.default_rng((settings.seed, 3))
    below = ground(points.positions, points.normals, box, [view.camera for view in dataset.train], rng)
    with Progress(quiet=quiet, label="looking for the object") as progress:
        fit = fit_of(points, _trial(settings))
        while fit.progress < 1:
            fit.step()
            progress.update(0.8 * fit.progress)
        views = silhouettes(fit, box, below)
        del fit
        release_memory()
        progress.update(0.9)
        field = _hull(views)
        progress.update(1)
    mirrors = field and _mirrors(field, points.positions)
    if not quiet:
        what = "no one object" if field is None else "an object that mirrors" if mirrors else "an object"
        where = "on its hull" if mirrors else "where they agree on a depth"
        print(
            f"photographs show {what}: surfels start {where} (--set initialization.foreground=… changes it)", file=sys.stderr
        )
    if field is None or not mirrors:
        return None
    return around_hull(points, dataset.train, field, _NORMALS, _LEAST, rng), _box_of(field)


def _trial(settings):
    """The settings of the short fit, at half the resolution at which others begin: what its silhouettes are off by is smoothed
    away, and half a minute of a finer one brings no more."""
    coarse = short(settings, settings.light)
    assert coarse.stages, "`short` gives one"
    stage = replace(coarse.stages[0], downscale=2 * coarse.stages[0].downscale)
    return replace(coarse, iterations=_STEPS, stages=(stage,), exposure="fixed", room=None, specular_start=1)


def silhouettes(fit: Fit, box: BoundingBox, below: Plane | None) -> list[View]:
    """Return the training views of a ``fit`` at twice its resolution, with masks of what they show of the ``box``, but for what
    lies ``below``; small holes are filled."""
    factor = max(1, fit.stage.downscale // 2)
    views, surfels = [], _marked(fit, box, below)
    for view in fit.dataset.train:
        width, height = view.camera.size
        camera = view.camera.resized(max(1, width // factor), max(1, height // factor))
        with dr.suspend_grad():
            shown = np.array(deferred.render(surfels, camera, None).diffuse.x).reshape(camera.size[::-1])
        inside = shown > 0.5
        pixels = np.zeros((*shown.shape, 4), np.float32)
        pixels[..., 3] = np.where(_holes(inside), 1, np.clip(shown, 0, 1))
        views.append(replace(view, camera=camera, pixels=pixels, masked=True, normal=None))
    return views


def _holes(inside):
    """Where a silhouette has a hole that is too small to be one."""
    pieces = np.asarray(label(~inside, connectivity=1))
    size = np.bincount(pieces.ravel())
    return (size < _HOLE * inside.sum())[pieces] & ~inside


def _marked(fit, box, below) -> SurfelColumns:
    """The surfels of a ``fit``, white those of the object, black all others."""
    surfels = fit.model.surfels(0).split()
    center = surfels.column(mi.Point3f, "centers")
    inside = box.contains(center)
    if below is not None:
        height = dr.dot(center, mi.Vector3f(*map(float, below.normal))) - float(below.offset)
        inside &= height > _CLEAR_OF_GROUND * box.radius
    return surfels.with_columns({"sh": [dr.select(inside, 0.5, -0.5) / SH_0] * 3})


def _hull(views) -> hull.SignedField | None:
    """The largest piece of the visual hull of ``views``; None where these have none, or another object each."""
    try:
        field = hull.visual_hull(views, outvoted=len(views) // _WRONG)
        field = hull.largest_piece(replace(field, values=ndimage.gaussian_filter(field.values, _POSITIONS)))
    except UserError:
        return None
    if field.values.max() <= 0:
        return None
    vertices, faces, _ = hull.surface(field)
    depths = hull.depth_maps(vertices, faces, [view.camera for view in views])
    pairs = [(np.isfinite(depth), view.alpha > _SOLID) for depth, view in zip(depths, views)]
    alike = np.mean([(one & other).sum() / max((one | other).sum(), 1) for one, other in pairs])
    return field if alike >= _ALIKE else None


def _mirrors(field, positions) -> bool:
    """Whether much of what photographs agree on within a hull lies deep below it, as what a mirror shows does."""
    depth = field.depth(positions) / field.step
    within = depth > 0
    return bool(within.any()) and float((depth[within] > _DEEP).mean()) > _MIRRORED


def _box_of(field: hull.SignedField) -> BoundingBox:
    """The box around a hull."""
    inside = np.argwhere(field.values > 0)
    lower, upper = field.lower + field.step * inside.min(0), field.lower + field.step * inside.max(0)
    room = _MARGIN * (upper - lower).max()
    return BoundingBox.of([*(lower - room), *(upper + room)])

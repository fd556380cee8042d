"""Splats that are fitted to what a run looks like. What `rgs-mi export --to splat --refine` calls."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
from scipy.spatial import KDTree

from ..core.camera import Camera
from ..core.color import to_8bit
from ..core.interrupt import GracefulInterrupt
from ..core.progress import Progress
from ..datasets.types import View
from ..export.render import sensor_dict, smooth_path, straight
from ..export.splats import DEGREE, Splats
from ..fit.model import Model, logit
from ..fit.splats import SplatFit
from ..plugins import deferred_of
from ..priors.initialization import spacing_of
from .fit_line import FitLine

_VIEWS, _NEIGHBORS, _PLACES = 300, 5, 9  # pictures; cameras that one has beside it; places from it to one of these
_LONGEST, _SPP = 800, 4  # pixels along a picture's longer side, at most; samples a pixel
_SPLATS = 90_000  # at most, or as many as there are surfels
_WITHIN, _FAINT, _SCALE = 15_000, 0.1, 0.8  # splats that begin anywhere in the object, their opacity, their size over gaps
_CLEARER = 0.5  # opacity of what hides these, over what it was


def refine(
    splats: Splats, scene: "mi.Scene", path: Path, cameras: Sequence[Camera], minutes: float, quiet: bool = False
) -> Splats:
    """Return ``splats``, which were baked of the ``scene`` in the file ``path``, after a fit of so many ``minutes`` to pictures
    of it that are taken between ``cameras``, or until someone interrupts it."""
    box = deferred_of(scene, path).box
    extent = float(np.linalg.norm(splats.centers - splats.centers.mean(0), axis=1).max()) if box is None else box.radius
    views = pictures(scene, cameras, quiet)
    fit = SplatFit(views, _begun(splats), minutes, max(_SPLATS, len(splats)), extent, box)
    with Progress(60 * minutes, quiet, "refining") as progress, GracefulInterrupt() as interrupt:
        line = FitLine(fit, progress)
        while fit.progress < 1 and interrupt.signal is None:
            fit.step()
            line.update()
    found = fit.splats().numpy()
    return replace(
        splats,
        centers=found["centers"],
        rotations=found["rotations"] / np.linalg.norm(found["rotations"], axis=1, keepdims=True),
        scales=found["scales"],
        opacities=found["opacities"][:, 0],
        harmonics=found["sh"].reshape(-1, *splats.harmonics.shape[1:]),
    )


def pictures(scene: "mi.Scene", cameras: Sequence[Camera], quiet: bool = False) -> list[View]:
    """Return `_VIEWS` renderings of the ``scene``, as its first sensor's film has them, each from a place between two of
    ``cameras`` that are neighbours."""
    views = []
    with Progress(None, quiet, "rendering") as progress:
        for k, camera in enumerate(_between([_smaller(camera) for camera in cameras])):
            image = straight(np.array(mi.render(scene, sensor=mi.load_dict(sensor_dict(camera, scene)), spp=_SPP)))
            views.append(View(f"{k:03}", camera, to_8bit(image), True, None, Path()))
            progress.update((k + 1) / _VIEWS)
    masked = all(view.alpha.any() for view in views)
    return [replace(view, masked=masked) for view in views]


def _smaller(camera):
    """The pinhole of a ``camera``, with `_LONGEST` pixels along its longer side at most."""
    scale = min(1, _LONGEST / max(camera.size))
    return replace(camera.resized(*(max(1, round(scale * n)) for n in camera.size)), lens=None)


def _between(cameras):
    """`_VIEWS` cameras, each somewhere between two neighbours among ``cameras``."""
    origins, rng, between = np.array([camera.origin for camera in cameras]), np.random.default_rng(0), []
    near = KDTree(origins).query(origins, min(_NEIGHBORS + 1, len(cameras)))[1].reshape(len(cameras), -1)
    for _ in range(_VIEWS):
        one = cameras[k := rng.integers(len(cameras))]
        other = cameras[rng.choice(near[k])].resized(*one.size)
        between.append(smooth_path([one, other], _PLACES)[rng.integers(_PLACES)])
    return between


def _begun(splats):
    """The model that the fit begins with: ``splats``, not as opaque as they are, and faint ones all over the object, where what
    bulges has the images of what it mirrors."""
    low, high = np.percentile(splats.centers, (0.5, 99.5), axis=0)
    within = np.random.default_rng(0).uniform(low, high, (_WITHIN, 3))
    centers, n = np.concatenate([splats.centers, within]), len(splats)
    spacing = np.concatenate([np.ones(n), spacing_of(within)])
    grey, no_light = np.full((len(centers), 3), 0.5), np.zeros((2, 4, 3))
    model = Model.start(centers, None, grey, spacing, no_light, np.eye(3), DEGREE, scale=_SCALE, opacity=_FAINT)
    own = {
        "rotations": splats.rotations,
        "log_scales": np.log(splats.scales),
        "logit_opacities": logit(_CLEARER * splats.opacities)[:, None],
        "sh_dc": splats.harmonics[:, 0],
        "sh_rest": splats.harmonics[:, 1:].reshape(n, -1),
    }
    for name, value in own.items():
        model.set(name, np.concatenate([value, model.numpy(name)[n:]]))
    return model

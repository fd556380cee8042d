"""Depth priors: what is known of a photograph's depth before anything is fitted, one interface for all of them.

hull    the visual hull of the masks (`hull.py`): no network, and no reflection misleads it
stereo  depths that the photographs agree on (`stereo.py`), unknown elsewhere
files   maps of any estimator, one a photograph (`files.py`)
vggt    the foundation model (`vggt.py`), where its package and weights are
none
"""

import hashlib
import inspect
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from ..core.caches import cached_arrays
from ..core.errors import UserError
from ..datasets.images import resize
from ..datasets.types import DepthPrior, View
from . import files, hull, stereo, vggt

__all__ = ["NAMES", "DepthPrior", "depth_priors"]

_VERSION = 3  # of everything that decides what is in the maps: a cached prior of another version is not read


def _hull(views: Sequence[View], resolution: int | None = None) -> list[DepthPrior]:
    """z-depths of the visual hull, ``resolution`` steps along its longest side (None: as many as `hull.visual_hull` takes);
    NaN beside it. Needs a JIT variant."""
    return _depths(hull.visual_hull(views, resolution), views)


def _stereo(views: Sequence[View]) -> list[DepthPrior]:
    """z-depths that the photographs agree on, NaN elsewhere. Needs a JIT variant."""
    mesh = hull.surface(hull.visual_hull(views))[:2] if any(view.masked for view in views) else None
    known = lambda m: np.where(m.likeness > 0, m.depth, np.nan)
    maps = stereo.verified(stereo.depth_maps(views, mesh))
    return [
        DepthPrior(resize(known(m), *v.pixels.shape[:2]), confidence=resize(m.likeness, *v.pixels.shape[:2]))
        for m, v in zip(maps, views)
    ]


def _depths(field, views):
    vertices, faces, _ = hull.surface(field)
    return [DepthPrior(depth) for depth in hull.depth_maps(vertices, faces, [view.camera for view in views])]


_PRIORS: dict[str, Callable[..., list[DepthPrior]]] = {
    "hull": _hull,
    "stereo": _stereo,
    "files": files.load,
    "vggt": vggt.estimate,
}
NAMES = (*_PRIORS, "none")


def depth_priors(
    name: str, views: Sequence[View], *, cache: str | Path | None = None, **options: object
) -> list[DepthPrior] | None:
    """Return the prior called ``name`` of each of ``views``, in their order; None for ``none`` (docs/method.md §5).

    Args:
      name: one of `NAMES`
      cache: folder where results are kept, or None. A result is found again by the photographs' pixels, the options, the
        hull's cameras and VGGT's weights, wherever the files lie. What `files` reads is not kept a second time
      options: hull: resolution; files: folder, inverse, suffix (`files.load`); vggt: weights, batch, overlap,
        background (`vggt.estimate`); none takes any

    Raises: UserError for a name or an option that is not there, and as the prior itself does.
    """
    if name == "none":
        return None
    if name not in _PRIORS:
        raise UserError(f"prior '{name}' is unknown: choose one of {', '.join(NAMES)}")
    try:
        call = inspect.signature(_PRIORS[name]).bind(views, **options)
    except TypeError as error:
        known = ", ".join(list(inspect.signature(_PRIORS[name]).parameters)[1:])
        raise UserError(f"prior '{name}': {error}: its options are {known}") from error
    call.apply_defaults()
    options = dict(list(call.arguments.items())[1:])
    if cache is None or name == "files":
        return _PRIORS[name](views, **options)
    path = Path(cache) / f"{name}-{_key(name, views, options)[:24]}.npz"
    compute = lambda: _arrays(_PRIORS[name](views, **options))
    return _priors(cached_arrays(path, lambda arrays: _check(arrays, views), compute))


# ---- The cache ----


def _key(name, views, options) -> str:
    """A hash of all that the result depends on."""
    if name == "vggt":
        options = options | {"weights": vggt.fingerprint(options["weights"])}
    digest = hashlib.sha256(json.dumps([_VERSION, name, options], sort_keys=True, default=str).encode())
    for view in views:
        digest.update(f"{view.pixels.dtype} {view.pixels.shape} {view.masked}".encode())
        digest.update(np.ascontiguousarray(view.pixels).data)
        if name in ("hull", "stereo"):
            camera = view.camera
            digest.update(np.concatenate([camera.to_world.ravel(), camera.focal, camera.principal, camera.size]).tobytes())
    return digest.hexdigest()


def _check(arrays, views):
    """Raises: ValueError or KeyError where these are not the `_arrays` of priors of ``views``."""
    for i, view in enumerate(views):
        for array in (arrays[f"values_{i}"], arrays.get(f"confidence_{i}")):
            if array is not None and (array.shape != view.pixels.shape[:2] or array.dtype != np.float32):
                raise ValueError("a map has the wrong shape")
    if arrays["inverse"].shape != (len(views),):
        raise ValueError("another number of maps")


def _arrays(priors) -> dict[str, np.ndarray]:
    """What is kept of ``priors``."""
    arrays = {"inverse": np.array([prior.inverse for prior in priors])}
    for i, prior in enumerate(priors):
        arrays[f"values_{i}"] = prior.values
        if prior.confidence is not None:
            arrays[f"confidence_{i}"] = prior.confidence
    return arrays


def _priors(arrays) -> list[DepthPrior]:
    """The priors that `_arrays` were made of."""
    return [
        DepthPrior(arrays[f"values_{i}"], bool(inverse), arrays.get(f"confidence_{i}"))
        for i, inverse in enumerate(arrays["inverse"])
    ]

"""What a fit does of itself where settings leave it open: how many surfels, and how far up the pyramid, for these photographs in
this time."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..datasets.rims import rim
from ..datasets.types import Dataset, View
from ..settings.settings import Settings, Stage

_SURFELS, _A_MINUTE, _MOST = 50_000, 5_000, 150_000  # surfels at least, and a minute, and at most by minutes alone
_PHOTOGRAPHED, _UNMASKED = 15_000, 40_000  # a minute at most, of photographs, and of those without masks
_MOST_UNMASKED = 400_000  # more need time that each is then seen too rarely in, and memory
_FIRST = 25_000  # surfels to start with, at least
_COARSEST, _FINEST_FROM = 220, 0.2  # side of a square of as many pixels, about; the part of the fit before full resolution
_SAMPLED_FROM, _SPP = 0.85, 4  # the part of a fit before steps take more samples of a pixel, and how many they take then
STEPS = 500, 1000  # of a level before the next: of one below half resolution, and of that
LAST = 0.25  # of the fit: there half as fine is not fine enough, if every view can be seen once more
LEAST_STEPS = 250  # that there must be time for at the next, up to half resolution
OFTEN = 6  # times that there must be time to see every view at full resolution
COST = 0.65  # a step on so many times as many pixels takes that to this power as long: surfels cost, too
_OPEN = (
    "max_surfels",
    "surfels",
    "stages",
    "mask_rim",
    "rfilter",
    "box",
    "turns",
)  # settings that a fit decides on where they are not given


def planned(settings: Settings, dataset: Dataset) -> Settings:
    """Return ``settings`` with numbers where they leave open what suits the photographs of ``dataset``:

    - `density.max_surfels`: 50 000, or 5000 a minute up to 150 000; of photographs, which have relief, as many as one shows
      pixels of the object, in the mean, if that is more; but 15 000 a minute at most, and 40 000, up to 400 000, where they
      have no masks;
    - `initialization.surfels`: half of these, or three quarters where photographs have no masks; 25 000 at least;
    - `mask_rim`: of photographs, as far within their masks as the object begins (`rims.rim`);
    - `stages`: halves of halves down to the pixels of a square of some 220; from 20 % of the fit on all pixels, from 10 % on
      half of them along a side, and so on; where a film has filtered them, from 85 % on with four samples a pixel;
    - `rfilter`: that of the data set.
    """
    density, first, minutes = settings.density, settings.initialization.surfels, settings.minutes or 0
    bare = dataset.photographed and not any(view.masked for view in dataset.train)
    if (most := density.max_surfels) is None:
        limit = min(_UNMASKED * minutes, _MOST_UNMASKED) if bare else _PHOTOGRAPHED * minutes
        shown = np.mean([_foreground(view) for view in dataset.train]) if dataset.photographed else 0
        most = int(max(_SURFELS, min(_A_MINUTE * minutes, _MOST), min(limit, shown)))
    if first is None:
        first = min(max(_FIRST, most * 3 // 4 if bare else most // 2), most)
    edge = settings.mask_rim
    if edge is None:
        edge = rim(dataset.train) if dataset.photographed else 0
    rfilter = dataset.rfilter if settings.rfilter is None else settings.rfilter
    stages = settings.stages or _stages(int(np.prod(dataset.train[0].camera.size)), rfilter > 0)
    return replace(
        settings,
        density=replace(density, max_surfels=most),
        initialization=replace(settings.initialization, surfels=first),
        stages=stages,
        mask_rim=edge,
        rfilter=rfilter,
    )


def told(settings: Settings, dataset: Dataset) -> str:
    """Return what the fit takes ``dataset`` for, and the settings that follow from it, in a line."""
    width, height = dataset.train[0].camera.size
    masked = sum(view.masked for view in dataset.train)
    masks = "with masks" if masked == len(dataset.train) else f"{masked} of them with masks" if masked else "without masks"
    kind = "photographs" if dataset.photographed else "images of known cameras"
    chosen = (
        {
            "cameras": settings.cameras,
            "exposure": settings.exposure,
            "light": settings.light,
            "density.max_surfels": settings.density.max_surfels,
        }
        | {name: value for name in ("mask_rim", "rfilter") if (value := getattr(settings, name))}
        | ({} if settings.box is None else {"box": "[" + ", ".join(f"{v:.7g}" for v in settings.box) + "]"})
    )
    return (
        f"{len(dataset.train)} {kind} of {width} x {height} pixels, {masks}, and {len(dataset.test)} held out: "
        + ", ".join(f"{name}={value}" for name, value in chosen.items())
        + " (--set changes it)"
    )


def agree(asked: Mapping, saved: Mapping) -> bool:
    """Return whether the settings ``saved`` with a fit, nested dicts, are those ``asked`` for, but for what they leave open."""

    def same(own, there):
        if isinstance(own, Mapping) and isinstance(there, Mapping):
            return own.keys() == there.keys() and all(
                same(own[name], there[name]) or own[name] == "auto" or (name in _OPEN and own[name] is None) for name in own
            )
        return own == there

    return same(asked, saved)


def _foreground(view: View) -> float:
    """How many pixels of a photograph show the object: all, where it has no mask."""
    return float(view.alpha.sum()) if view.masked else float(np.prod(view.camera.size))


def _stages(pixels: int, filtered: bool) -> tuple[Stage, ...]:
    """The pyramid of photographs of so many ``pixels``, which a film has ``filtered`` or not."""
    halvings = max(1, round(np.log2(np.sqrt(pixels) / _COARSEST)))
    coarse = (Stage(_FINEST_FROM / 2 ** (k - 1), 2**k, 1) for k in range(halvings, 0, -1))
    full = (Stage(_SAMPLED_FROM, 1, 1), Stage(1.0, 1, 1, _SPP)) if filtered else (Stage(1.0, 1, 1),)
    return *coarse, *full

"""What to photograph better, in plain words, as far as cameras and photographs tell."""

from collections.abc import Mapping, Sequence

import numpy as np

from ..core.camera import Camera
from ..datasets.masks import Silhouette
from ..datasets.sources import Source

_MANY = 40  # photographs
_GAP, _ABOVE, _HEIGHTS = 45, 30, 15  # degrees: of azimuth; of elevation, and its range
_FROM_ABOVE, _LEFT_OUT, _CUT_OFF, _SMALL = 0.15, 0.1, 0.2, 0.08  # fractions: of photographs, and of the picture
_BLURRED = 0.35  # of the median sharpness
_STOPS = 0.5
_ODD_ERROR, _LARGE_ERROR = 1.8, 1.5  # times the median; pixels
_NAMED = 6  # photographs named in a line


def advice(
    cameras: Mapping[str, Camera],
    sources: Sequence[Source],
    errors: Mapping[str, float],
    silhouettes: Mapping[str, Silhouette],
) -> list[str]:
    """Return what to do better, a sentence or two each, what matters most first; nothing where all is well.

    Args:
      cameras:     name -> camera of each photograph that has a place, z up, the object at the origin
      sources:     all photographs, in the order in which they were taken
      errors:      name -> mean reprojection error in pixels
      silhouettes: name -> that of its mask, of photographs that have one
    """
    lines = [*_amount(cameras, sources), *_around(cameras), *_above(cameras), *_sharp(sources), *_errors(errors)]
    return [*lines, *_exposure(sources), *_masks(cameras, silhouettes)]


def blurred(sources: Sequence[Source]) -> list[Source]:
    """Return those that are much less sharp than the median."""
    limit = _BLURRED * np.median([source.sharpness for source in sources])
    return [source for source in sources if source.sharpness < limit]


def directions(cameras: Mapping[str, Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Return azimuths in [0, 360) and elevations of cameras as seen from the origin, in degrees, [N] each."""
    x, y, z = np.stack([camera.origin for camera in cameras.values()]).T
    return np.degrees(np.arctan2(y, x)) % 360, np.degrees(np.arctan2(z, np.hypot(x, y)))


def largest_gap(cameras: Mapping[str, Camera]) -> tuple[float, float, str, str]:
    """Return the azimuth in degrees where the widest part of the way around without a camera begins, how wide it is, and the
    names of the photographs before and after it."""
    azimuths, names = directions(cameras)[0], list(cameras)
    order = np.argsort(azimuths)
    widths = np.diff(np.append(azimuths[order], azimuths[order[0]] + 360))
    k = int(widths.argmax())
    return float(azimuths[order[k]]), float(widths[k]), names[order[k]], names[order[(k + 1) % len(order)]]


def _amount(cameras, sources):
    if len(cameras) < _MANY:
        yield f"{len(cameras)} photographs are few for a shiny object: 60 to 100 tell its reflections from its own colour."
    lost = len(sources) - len(cameras)
    if lost > _LEFT_OUT * len(sources):
        yield (
            f"{lost} of {len(sources)} photographs have no place among the others: take smaller steps, two thirds of a picture "
            "in common from one to the next, and leave textured, matt things around the object in it."
        )


def _around(cameras):
    _, width, before, after = largest_gap(cameras)
    if width > _GAP:
        yield (
            f"{width:.0f} degrees of the way around have no photograph, between {before} and {after}: what is seen only from "
            "there is guessed. Go on around the object, if you can."
        )


def _above(cameras):
    elevations = directions(cameras)[1]
    spread = np.ptp(elevations)
    if spread < _HEIGHTS:
        yield (
            f"All cameras are at one height, within {spread:.0f} degrees: walk a second ring, higher or lower, so that "
            "reflections move up and down, too."
        )
    elif (above := (elevations > _ABOVE).mean()) < _FROM_ABOVE:
        yield (
            f"Few photographs ({round(above * len(elevations))} of {len(elevations)}) look down on the object by more than "
            f"{_ABOVE} degrees: add a ring from higher up, at about 45 degrees."
        )


def _sharp(sources):
    if found := blurred(sources):
        yield (
            f"Much less sharp than the others: {_listed(source.name for source in found)}. Move slowly, or stand still for "
            "each picture, with more light or a shorter exposure; leave blurred ones out."
        )


def _errors(errors):
    known = {name: error for name, error in errors.items() if np.isfinite(error)}
    median = np.median(list(known.values()))
    if median > _LARGE_ERROR:
        yield (
            f"Points are {median:.1f} pixels off in the median: the lens may have zoomed or focused, or things moved. Lock "
            "focus and zoom, and keep everything still."
        )
    elif odd := [name for name, error in known.items() if error > max(_ODD_ERROR * median, 1.0)]:
        yield f"These do not fit the others as well: {_listed(odd)}. They may be blurred, or something moved: look at them."


def _exposure(sources):
    stops = [source.exposure for source in sources if source.exposure is not None]
    if len(stops) > 1 and np.ptp(stops) > _STOPS:
        yield (
            f"The exposure changed by {np.ptp(stops):.1f} stops: lock it, and the white balance, since a fit has one light for "
            "all photographs."
        )


def _masks(cameras, silhouettes):
    if not silhouettes:
        yield (
            "There are no masks: with them a fit starts on the visual hull, which is worth more than anything else "
            "(--masks, --mask-command)."
        )
        return
    empty = [name for name, found in silhouettes.items() if found.coverage == 0]
    if empty:
        yield f"Masks with nothing in them, whose photographs will not be used: {_listed(empty)}."
    cut = [name for name, found in silhouettes.items() if found.cut_off]
    if len(cut) > _CUT_OFF * len(cameras):
        yield (
            f"The border cuts the object off in {len(cut)} of {len(cameras)} photographs: step back, since a silhouette that "
            "leaves the picture does not tell what lies beyond."
        )
    if np.median([found.coverage for found in silhouettes.values()]) < _SMALL:
        yield "The object is small in the pictures: go nearer, so that its pixels are many."


def _listed(names):
    names = list(names)
    return ", ".join(names[:_NAMED]) + (f" and {len(names) - _NAMED} more" if len(names) > _NAMED else "")

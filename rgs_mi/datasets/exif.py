"""What a photograph's EXIF says that a fit can use: its focal length, and how it was exposed."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..core.inputs import opened

ORIENTATION = 0x0112
_EXIF, _FOCAL_35MM, _EXPOSURE, _APERTURE, _ISO = 0x8769, 0xA405, 0x829A, 0x829D, 0x8827


def exposure_value(exif: Any) -> float | None:
    """Return the exposure value at ISO 100, in stops, log2(N² / t · 100 / ISO), that Pillow's ``exif`` tells; None where it
    says nothing. One more stop is half as bright a photograph."""
    tags = exif.get_ifd(_EXIF)
    iso = tags.get(_ISO)
    try:
        seconds, aperture = float(tags[_EXPOSURE]), float(tags.get(_APERTURE, 1.0))
        value = np.log2(aperture**2 / seconds * 100 / float(iso[0] if isinstance(iso, tuple) else iso or 100))
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None
    return float(value) if np.isfinite(value) else None


def kept(exif: Any) -> bytes:
    """Return EXIF that holds the focal length, in millimetres of a 35 mm film, and the exposure of ``exif``, and nothing else."""
    from PIL import Image

    tags, out = exif.get_ifd(_EXIF), Image.Exif()
    if isinstance(focal := tags.get(_FOCAL_35MM), int) and focal > 0:
        out.get_ifd(_EXIF)[_FOCAL_35MM] = focal
    if exposure_value(exif) is not None:
        out.get_ifd(_EXIF).update({tag: tags[tag] for tag in (_EXPOSURE, _APERTURE, _ISO) if tag in tags})
    return out.tobytes()


def log_gains(paths: Sequence[Path]) -> np.ndarray:
    """Return the natural logarithms of how bright the photographs ``paths`` were exposed, [N], less their mean; zero where not
    all of them tell."""
    from PIL import Image

    values = []
    for path in paths:
        try:
            with opened(path) as stream, Image.open(stream, formats=("PNG", "JPEG")) as image:
                values.append(exposure_value(image.getexif()))
        except Exception:  # what is no PNG or JPEG, or damaged in its EXIF alone, tells nothing
            values.append(None)
        if values[-1] is None:
            return np.zeros(len(paths))
    stops = np.array(values, float)
    return -np.log(2) * (stops - stops.mean()) if len(stops) else stops


def orientation(path: Path) -> int:
    """Return how the EXIF of a JPEG says that it lies: 1 upright, or where it does not tell; the others are turned or mirrored.
    PNGs are not asked: Pillow would decode all of one."""
    from PIL import Image

    try:
        with opened(path) as stream, Image.open(stream, formats=("JPEG",)) as image:
            return int(image.getexif().get(ORIENTATION, 1)) or 1
    except Exception:  # as in `log_gains`
        return 1

"""Pages that are one file each: they open from disk, without network, with style, script and pictures inside.

What a page says is in ``templates/``, which Jinja2 fills in, and which escapes every text that is put in. This module has
what templates cannot do: pictures as data URIs, and links.
"""

import base64
import functools
import io
from dataclasses import dataclass
from urllib.parse import quote

import numpy as np
from PIL import Image

from ..core.color import to_8bit
from ..evaluation.pictures import RAMP
from . import figures

_QUALITY = 90  # of JPEG


@dataclass(frozen=True)
class Picture:
    """A picture in a page: ``source`` is its data URI, ``width`` and ``height`` are its pixels on the page, ``alt`` says in
    words what it shows."""

    source: str
    width: int
    height: int
    alt: str


def render(template: str, **data: object) -> bytes:
    """Fill ``templates/TEMPLATE`` with ``data`` and return the page in UTF-8.

    Raises: jinja2.UndefinedError where the template wants more.
    """
    return _environment().get_template(template).render(data).encode()


@functools.cache
def _environment():
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("rgs_mi", "report/templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    ramp = ", ".join(f"rgb({r:.0f} {g:.0f} {b:.0f})" for r, g, b in 255 * RAMP)
    environment.globals |= {"text": figures.text, "label": figures.label, "heading": figures.heading}
    environment.globals |= {"href": href, "ramp": ramp}
    return environment


def href(path: str) -> str:
    """Return the address of the file ``path`` relative to the page, never one of another kind, whatever the file is
    called."""
    return "./" + quote(path)


# ---- Pictures ----


def jpeg(image: np.ndarray, alt: str, stored: int, width: int | None = None) -> Picture:
    """Encode ``image`` [H, W, 3], display values in [0, 1] or uint8, as a JPEG at most ``stored`` pixels wide, which takes
    ``width`` pixels of the page (None: as many as it has)."""
    pixels, stream = Image.fromarray(to_8bit(image)), io.BytesIO()
    if pixels.width > stored:
        pixels = pixels.resize((stored, max(round(stored * pixels.height / pixels.width), 1)), Image.Resampling.LANCZOS)
    pixels.save(stream, "JPEG", quality=_QUALITY, subsampling=0, optimize=True)
    width = width or pixels.width
    return Picture(_data_uri("jpeg", stream), width, round(width * pixels.height / pixels.width), alt)


def png(image: np.ndarray, alt: str, zoom: int = 1) -> Picture:
    """Encode ``image`` [H, W, 3], display values in [0, 1] or uint8, as a PNG; each of its pixels is ``zoom`` wide on
    the page."""
    stream = io.BytesIO()
    Image.fromarray(to_8bit(image)).save(stream, "PNG", optimize=True)
    return Picture(_data_uri("png", stream), zoom * image.shape[1], zoom * image.shape[0], alt)


def hdr(radiance: np.ndarray, alt: str) -> Picture:
    """Encode linear ``radiance`` [H, W, 3], packed as `rgbe`, for the control that shows it at an exposure."""
    packed = png(rgbe(radiance), alt)
    return Picture(packed.source, radiance.shape[1], radiance.shape[0], alt)


def rgbe(radiance: np.ndarray) -> np.ndarray:
    """Pack linear radiance [H, W, 3] as [2H, W, 3] uint8: above m, below e in all channels, for m 2^(e − 136) (Ward
    1991)."""
    light = np.maximum(np.nan_to_num(radiance), 0)
    exponent = np.clip(np.frexp(light.max(-1, keepdims=True))[1], -127, 127)
    mantissa = np.clip(np.round(np.ldexp(light, 8 - exponent)), 0, 255)
    return np.concatenate([mantissa, (exponent + 128).repeat(3, -1)]).astype(np.uint8)


def _data_uri(kind, stream):
    return f"data:image/{kind};base64,{base64.b64encode(stream.getvalue()).decode()}"

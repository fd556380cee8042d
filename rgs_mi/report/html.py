"""Self-contained HTML: figures, tables, curves and pictures in one file that opens from disk, without network.

Functions return HTML; text that they are given is escaped, unless it is `Html`. How things look is in ``page.css``, what
moves in ``page.js``.
"""

import base64
import io
import math
from html import escape
from importlib import resources

import numpy as np
from PIL import Image

from ..core.color import to_8bit
from ..evaluation.pictures import RAMP

_QUALITY = 90  # of JPEG
_WIDTH, _HEIGHT, _LEFT, _TOP, _BOTTOM = 480, 260, 52, 34, 36  # pixels of a plot and its margins
_LEGEND, _INKS = 112, 6  # pixels beside a plot; colours of curves (page.css)


class Html(str):
    """Text that is HTML already."""


def page(title: str, *parts: str) -> str:
    """An HTML document of ``parts``, HTML each."""
    style, script = (resources.files(__package__).joinpath(name).read_text("utf-8") for name in ("page.css", "page.js"))
    return (
        f"<!doctype html><html lang='en'><head><meta charset='utf-8'><meta name='viewport' content='width=device-width'>"
        f"<title>{escape(title)}</title><link rel='icon' href='data:,'><style>{style}</style></head>"
        f"<body><h1>{escape(title)}</h1>{''.join(parts)}<script type='module'>{script}</script></body></html>\n"
    )


def heading(text: str, level: int = 2) -> str:
    return f"<h{level}>{escape(text)}</h{level}>"


def paragraph(text: str, kind: str = "") -> str:
    """``kind``: 'soft' for what matters less."""
    return f"<p class='{kind}'>{_text(text)}</p>"


def link(text: str, address: str) -> Html:
    return Html(f"<a href='{escape(address, quote=True)}'>{escape(text)}</a>")


def group(kind: str, *parts: str) -> str:
    """``parts`` beside each other: 'plots', 'panels', or a 'view' with its panels."""
    return f"<div class='{kind}'>{''.join(parts)}</div>"


# ---- Figures ----


def tiles(figures: dict) -> str:
    """``figures`` {label: value} that come first."""
    items = (f"<li><span>{escape(name)}</span><b>{_text(value)}</b></li>" for name, value in figures.items())
    return f"<ul class='tiles'>{''.join(items)}</ul>"


def table(header, rows, bad=(), mean=None) -> str:
    """``rows`` of strings under ``header``; those whose numbers are in ``bad`` stand out; below them the row ``mean``."""
    cells = lambda row, tag: "".join(f"<{tag}>{_text(cell)}</{tag}>" for cell in row)
    body = "".join(f"<tr class='{'bad' if k in bad else ''}'>{cells(row, 'td')}</tr>" for k, row in enumerate(rows))
    last = f"<tr class='mean'>{cells(mean, 'td')}</tr>" if mean else ""
    return f"<div class='table' tabindex='0'><table><tr>{cells(header, 'th')}</tr>{body}{last}</table></div>"


def preformatted(text: str, kind: str = "") -> str:
    """``kind``: 'wrap' for long lines, 'columns' for many short ones."""
    return f"<pre class='{kind}' tabindex='0'>{_text(text)}</pre>"


def _text(value):
    return value if isinstance(value, Html) else escape(str(value))


# ---- Pictures ----


def figure(image: np.ndarray, caption: str, zoom: int = 1) -> str:
    """``image`` [H, W, 3], display values in [0, 1], each pixel shown ``zoom`` wide, and stored without loss."""
    return (
        f"<figure><img alt='{escape(caption, quote=True)}' width='{zoom * image.shape[1]}' style='image-rendering: "
        f"pixelated' src='{_png(image)}'><figcaption>{escape(caption)}</figcaption></figure>"
    )


def picture(image: np.ndarray, caption: str, alt: str, most: int, note: str = "") -> str:
    """``image`` [H, W, 3], display values or uint8, as wide as there is room, at most ``most`` pixels of it. ``note``: HTML
    after the caption."""
    return f"<figure>{thumbnail(image, alt, most)}<figcaption>{escape(caption)} {note}</figcaption></figure>"


def thumbnail(image: np.ndarray, alt: str, most: int, shown: int | None = None) -> Html:
    """The picture alone, ``shown`` so wide (None: as the style has it)."""
    address, (width, height) = _jpeg(image, most)
    if shown:
        width, height = shown, round(shown * height / width)
    return Html(f"<img alt='{escape(alt, quote=True)}' width='{width}' height='{height}' src='{address}'>")


def compare(left: np.ndarray, right: np.ndarray, names, alt: str, most: int) -> str:
    """Two pictures [H, W, 3] of one size, called ``names``, on one another: a slider says how much is seen of which."""
    images = [thumbnail(image, f"{alt}: {name}", most) for image, name in zip((left, right), names)]
    label = escape(f"{names[0]} to the left, {names[1]} to the right of the line: {alt}", quote=True)
    return (
        f"<figure><div class='compare'>{''.join(images)}<input type='range' min='0' max='100' step='0.5' value='50' "
        f"aria-label='{label}'></div><figcaption class='sides'><span>{escape(names[0])}</span>"
        f"<span>{escape(names[1])}</span></figcaption></figure>"
    )


def exposure(radiance: np.ndarray, caption: str, stops: float = 8.0) -> str:
    """Linear ``radiance`` [H, W, 3] under a slider of its exposure, from −``stops`` to ``stops`` (EV)."""
    words = escape(caption, quote=True)
    return (
        f"<figure class='exposure'><canvas width='{radiance.shape[1]}' height='{radiance.shape[0]}' role='img' "
        f"aria-label='{words}'></canvas><img hidden alt='' src='{_png(rgbe(radiance))}'><label>exposure"
        f"<input type='range' min='{-stops:g}' max='{stops:g}' step='0.1' value='0'><output></output></label>"
        f"<figcaption>{words}</figcaption></figure>"
    )


def rgbe(radiance: np.ndarray) -> np.ndarray:
    """[H, W, 3] linear radiance as [2H, W, 3] uint8: above m, below e in all channels, for m 2^(e − 136) (Ward 1991)."""
    light = np.maximum(np.nan_to_num(radiance), 0)
    exponent = np.clip(np.frexp(light.max(-1, keepdims=True))[1], -127, 127)
    mantissa = np.clip(np.round(np.ldexp(light, 8 - exponent)), 0, 255)
    return np.concatenate([mantissa, (exponent + 128).repeat(3, -1)]).astype(np.uint8)


def scale(low: str, high: str) -> str:
    """The legend of `pictures.ramp`."""
    stops = ", ".join(f"rgb({r:.0f} {g:.0f} {b:.0f})" for r, g, b in 255 * RAMP)
    bar = f"<i style='background: linear-gradient(90deg, {stops})'></i>"
    return f"<span class='scale'>{escape(low)}{bar}{escape(high)}</span>"


def _png(image):
    stream = io.BytesIO()
    Image.fromarray(to_8bit(image)).save(stream, "PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(stream.getvalue()).decode()}"


def _jpeg(image, most):
    """(address, size) of an image that is at most ``most`` pixels wide."""
    image, stream = Image.fromarray(to_8bit(image)), io.BytesIO()
    if image.width > most:
        image = image.resize((most, max(round(most * image.height / image.width), 1)), Image.LANCZOS)
    image.save(stream, "JPEG", quality=_QUALITY, subsampling=0, optimize=True)
    return f"data:image/jpeg;base64,{base64.b64encode(stream.getvalue()).decode()}", image.size


# ---- Curves ----


def curves(
    series: dict,
    x_label: str,
    y_label: str,
    lines: dict | None = None,
    marks: dict | None = None,
    low: float | None = 0.0,
    log: bool = False,
) -> str:
    """A plot of ``series`` {name: (x, y)} as SVG, with horizontal ``lines`` {name: y} and vertical ``marks`` {name: x}.

    x from zero; y from ``low`` (None: from the least), or in decades where ``log``. What is not finite, or has no logarithm,
    is left out.
    """
    lines, marks = lines or {}, marks or {}
    value = (lambda y: math.log10(y) if y > 0 else math.nan) if log else float
    drawn = {name: [(x, value(y)) for x, y in zip(*xy) if math.isfinite(value(y))] for name, xy in series.items()}
    heights = [y for points in drawn.values() for _, y in points] + [value(y) for y in lines.values()] or [0.0]
    most_x = max([x for points in drawn.values() for x, _ in points], default=0) or 1
    least = min(heights) if log or low is None else low
    span = 1.05 * (max(heights) - least) or 1
    legend = len(series) > 1
    right, bottom = _WIDTH - (_LEGEND if legend else 14), _HEIGHT - _BOTTOM
    at = lambda x, y: (_LEFT + (right - _LEFT) * x / most_x, bottom - (bottom - _TOP) * (y - least) / span)
    parts = []
    for y, words in _decades(least, least + span) if log else _ticks(least, least + span):
        parts += [
            f"<path d='M{_LEFT} {at(0, y)[1]:.1f}H{right}' style='stroke: var(--line)'/>",
            _words(_LEFT - 6, at(0, y)[1] + 4, words, "end"),
        ]
    parts += [_words(at(x, 0)[0], bottom + 16, words, "middle") for x, words in _ticks(0, most_x)]
    parts += [
        f"<path d='M{_LEFT} {bottom}H{right}' style='stroke: var(--soft)'/>",
        _words((_LEFT + right) / 2, _HEIGHT - 4, x_label, "middle"),
        _words(4, 12, y_label, "start"),
    ]
    for name, x in marks.items():
        left = at(x, 0)[0]
        parts += [
            f"<path d='M{left:.1f} {_TOP - 14}V{bottom}' style='stroke: var(--soft)' stroke-dasharray='2 4'/>",
            _words(left + 4, _TOP - 5, name, "start"),
        ]
    for name, y in lines.items():
        height = at(0, value(y))[1]
        parts += [
            f"<path d='M{_LEFT} {height:.1f}H{right}' style='stroke: var(--bound)' stroke-dasharray='5 4'/>",
            _words(_LEFT + 6, height - 5, name, "start", "var(--bound)"),
        ]
    for k, (name, points) in enumerate(drawn.items()):
        ink = f"var(--ink-{k % _INKS})"
        coordinates = " ".join("{:.1f},{:.1f}".format(*at(x, y)) for x, y in points)
        parts.append(
            f"<polyline points='{coordinates}' fill='none' stroke-linejoin='round' stroke-width='1.6' "
            f"style='stroke: {ink}'/>"
        )
        if legend:
            parts.append(_words(right + 8, _TOP + 10 + 16 * k, name, "start", ink))
    words = escape(f"{y_label} over {x_label}", quote=True)
    return f"<svg viewBox='0 0 {_WIDTH} {_HEIGHT}' role='img' aria-label='{words}'>{''.join(parts)}</svg>"


def _words(x, y, words, anchor, ink=None):
    style = f" style='fill: {ink}'" if ink else ""
    return f"<text x='{x:.1f}' y='{y:.1f}' text-anchor='{anchor}'{style}>{escape(words)}</text>"


def _ticks(low, high):
    """Four or so round (value, words) in a range."""
    rough = (high - low) / 4
    power = 10 ** math.floor(math.log10(rough))
    step = power * min((1, 2, 5, 10), key=lambda k: abs(math.log(k * power / rough)))
    values = [k * step for k in range(math.ceil(low / step - 1e-6), math.floor(high / step + 1e-6) + 1)]
    return [(v, _number(v)) for v in values]


def _decades(low, high):
    """Powers of ten as (logarithm, words), all or every few of them; between them 2 and 5 where there is room."""
    steps = (1, 2, 5) if high - low < 2 else (1,)
    found = [(p + math.log10(k), _number(k * 10.0**p)) for p in range(math.floor(low), math.ceil(high) + 1) for k in steps]
    found = [tick for tick in found if low - 1e-9 <= tick[0] <= high]
    return found[:: max(1, math.ceil(len(found) / 6))]


def _number(value):
    return f"{value:,.0f}".replace(",", " ") if abs(value) >= 1000 else f"{value:.4g}"

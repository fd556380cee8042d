"""Self-contained HTML: pictures, tables and curves in one file that opens from disk, without network."""

import base64
import io
from html import escape

import numpy as np
from PIL import Image

from .pictures import to_8bit

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; background: #fff; margin: 2rem auto; max-width: 76rem }
h1 { font-weight: 600; font-size: 1.6rem } h2 { font-weight: 600; font-size: 1.2rem; margin-top: 2.2rem }
table { border-collapse: collapse; font-variant-numeric: tabular-nums } th, td { padding: .15rem .7rem; text-align: right }
th { border-bottom: 1px solid #999; font-weight: 600 } td:first-child, th:first-child { text-align: left }
tr.bad td { background: #fde8e4 } figure { margin: 1rem 0 } figcaption { color: #666 } img { max-width: 100% }
"""
_INKS = ("#1f5fa8", "#c4572b", "#3b8a4b", "#7a4ea3", "#a88a1f", "#555")
_WIDTH, _HEIGHT, _LEFT, _BOTTOM = 520, 260, 56, 36  # pixels of a plot and its margins


def page(title: str, *parts: str) -> str:
    """An HTML document of ``parts``, HTML each."""
    return (f"<!doctype html><html lang='en'><head><meta charset='utf-8'><title>{escape(title)}</title>"
            f"<style>{_STYLE}</style></head><body><h1>{escape(title)}</h1>{''.join(parts)}</body></html>\n")


def heading(text: str) -> str:
    return f"<h2>{escape(text)}</h2>"


def paragraph(text: str) -> str:
    return f"<p>{escape(text)}</p>"


def figure(image: np.ndarray, caption: str, zoom: int = 1) -> str:
    """``image`` [H, W, 3], display values in [0, 1], each pixel shown ``zoom`` wide."""
    stream = io.BytesIO()
    Image.fromarray(to_8bit(image)).save(stream, "PNG", optimize=True)
    data = base64.b64encode(stream.getvalue()).decode()
    return (f"<figure><img alt='{escape(caption, quote=True)}' width='{zoom * image.shape[1]}' style='image-rendering: "
            f"pixelated' src='data:image/png;base64,{data}'><figcaption>{escape(caption)}</figcaption></figure>")


def table(header, rows, bad=()) -> str:
    """``rows`` of strings under ``header``; those whose numbers are in ``bad`` stand out."""
    cells = lambda row, tag: "".join(f"<{tag}>{escape(str(cell))}</{tag}>" for cell in row)
    body = "".join(f"<tr class='{'bad' if k in bad else ''}'>{cells(row, 'td')}</tr>" for k, row in enumerate(rows))
    return f"<table><tr>{cells(header, 'th')}</tr>{body}</table>"


def curves(series: dict, x_label: str, y_label: str, lines: dict | None = None) -> str:
    """A plot of ``series`` {name: (x, y)} from zero, with horizontal ``lines`` {name: y}, as SVG."""
    lines = lines or {}
    most_x = max(max(x) for x, _ in series.values())
    most_y = 1.05 * max([max(y) for _, y in series.values()] + list(lines.values())) or 1
    right, low = _WIDTH - 150, _HEIGHT - _BOTTOM
    at = lambda x, y: (_LEFT + (right - _LEFT) * x / most_x, low - (low - 12) * y / most_y)
    parts = [f"<path d='M{_LEFT} 12V{low}H{right}' fill='none' stroke='#999'/>"]
    text = lambda x, y, words, anchor, ink="#222": (f"<text x='{x:.1f}' y='{y:.1f}' text-anchor='{anchor}' fill='{ink}' "
                                                    f"font-size='12'>{escape(words)}</text>")
    for k in range(5):
        parts.append(text(_LEFT - 6, at(0, most_y * k / 4)[1] + 4, f"{most_y * k / 4:.3g}", "end"))
        parts.append(text(at(most_x * k / 4, 0)[0], low + 16, f"{most_x * k / 4:.3g}", "middle"))
    parts += [text((_LEFT + right) / 2, _HEIGHT - 4, x_label, "middle"), text(_LEFT, 9, y_label, "start")]
    for name, y in lines.items():
        height = at(0, y)[1]
        parts.append(f"<path d='M{_LEFT} {height:.1f}H{right}' stroke='#b33' stroke-dasharray='5 4'/>")
        parts.append(text(right + 8, height + 4, name, "start", "#b33"))
    for k, (name, (xs, ys)) in enumerate(series.items()):
        ink = _INKS[k % len(_INKS)]
        points = " ".join("{:.1f},{:.1f}".format(*at(x, y)) for x, y in zip(xs, ys))
        parts.append(f"<polyline points='{points}' fill='none' stroke='{ink}' stroke-width='2'/>")
        parts.append(text(right + 8, 28 + 16 * k, name, "start", ink))
    return f"<svg width='{_WIDTH}' height='{_HEIGHT}' role='img'>{''.join(parts)}</svg>"

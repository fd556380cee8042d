"""Curves as SVG for a page, by Matplotlib: light of weight, the same for the same numbers, and without addresses."""

import io
import re
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from .figures import number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SIZE = 6.6, 3.5  # inches of 72 pixels
_INKS = "#1f5fa8", "#c4572b", "#35803f", "#7a4ea3", "#97791a", "#666c73"
_SOFT, _LINE, _BOUND = "#626a73", "#d9dde2", "#b33333"
_STYLE: dict[Any, Any] = {
    "font.size": 10,
    "font.sans-serif": ["DejaVu Sans"],  # which Matplotlib brings; the page then has its own
    "svg.fonttype": "none",
    "svg.hashsalt": "rgs_mi",
    "text.color": _SOFT,
    "axes.labelcolor": _SOFT,
    "xtick.labelcolor": _SOFT,
    "ytick.labelcolor": _SOFT,
    "axes.edgecolor": _SOFT,
    "grid.color": _LINE,
    "lines.linewidth": 1.3,
}
_NO_METADATA = dict.fromkeys(("Creator", "Date", "Format", "Type"))


def curves(
    series: dict,
    x_label: str,
    y_label: str,
    lines: dict | None = None,
    marks: dict | None = None,
    low: float | None = 0.0,
    log: bool = False,
) -> str:
    """Plot ``series`` {name: (x, y)} with horizontal ``lines`` {name: y} and vertical ``marks`` {name: x}, and return an SVG
    element.

    The x axis begins at zero, the y axis at ``low`` (None: at the least), or is logarithmic where ``log``. What is not
    finite, or has no logarithm, is left out.
    """
    from matplotlib import rc_context

    with rc_context(_STYLE):
        stream = io.StringIO()
        figure = draw(series, x_label, y_label, lines or {}, marks or {}, low, log)
        figure.savefig(stream, format="svg", transparent=True, metadata=_NO_METADATA)
    # Names of groups would be there twice in a page, and namespaces need not be told in HTML.
    _, _, text = stream.getvalue().partition('viewBox="')
    box, _, text = text.partition('"')
    content = text.partition(">")[2]
    content = re.sub(r' id="[\w.]+_\d+"', "", content)
    return f'<svg viewBox="{box}" role="img" aria-label="{escape(f"{y_label} over {x_label}")}">{content.strip()}'


def draw(series: dict, x_label: str, y_label: str, lines: dict, marks: dict, low: float | None, log: bool) -> "Figure":
    """Return the `matplotlib.figure.Figure` of `curves`."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, NullFormatter

    figure = Figure(_SIZE, layout="constrained")
    axes = figure.add_subplot()
    for (name, (x, y)), ink in zip(series.items(), _INKS * (1 + len(series) // len(_INKS))):
        x, y = np.asarray(x, float), np.asarray(y, float)
        known = np.isfinite(y) & ((y > 0) | (not log))
        axes.plot(x[known], y[known], "o-" if known.sum() == 1 else "-", color=ink, label=name)
    places = np.concatenate([[0.0], *(line.get_xdata() for line in axes.lines)])
    heights = np.concatenate([*(line.get_ydata() for line in axes.lines), [*lines.values()]])
    axes.set_xlim(0, places.max() or 1)
    if log and len(heights):
        axes.set_yscale("log")
        _decades(axes, heights)
        axes.yaxis.set_minor_formatter(NullFormatter())
    elif low is not None:
        axes.set_ylim(low, low + (1.05 * (max(heights, default=low) - low) or 1))
    for name, y in lines.items():
        axes.axhline(y, color=_BOUND, linestyle="--", linewidth=0.9)
        axes.annotate(name, (0, y), (4, 3), xycoords=axes.get_yaxis_transform(), textcoords="offset points", color=_BOUND)
    for name, x in marks.items():
        axes.axvline(x, color=_SOFT, linestyle=":", linewidth=0.9)
        axes.annotate(name, (x, 1), (3, 2), xycoords=axes.get_xaxis_transform(), textcoords="offset points")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: number(value)))
    axes.grid(axis="y", linewidth=0.8)
    axes.tick_params(which="both", length=0)
    axes.spines[["left", "top", "right"]].set_visible(False)
    axes.set_xlabel(x_label)
    axes.set_title(y_label, loc="left", fontsize=_STYLE["font.size"], pad=18 if marks else 8)
    if len(series) > 1:
        axes.legend(loc="upper left", bbox_to_anchor=(1, 1), frameon=False, labelcolor="linecolor", handlelength=0.8)
    return figure


def _decades(axes, heights):
    """Marks at powers of ten, and at their double and fivefold where there are few."""
    from matplotlib.ticker import LogLocator

    few = heights.max() < 100 * heights.min()
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if few else (1,), numticks=8))
    axes.yaxis.set_minor_locator(LogLocator(subs=()))

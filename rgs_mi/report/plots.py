"""Curves as SVG for a page, by Matplotlib: light of weight, the same for the same numbers, and without addresses."""

import io
import re
from collections.abc import Callable, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from .figures import number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SIZE, _SIDE = (6.6, 3.5), 4.7  # inches of 72 pixels
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
_LONG = 100_000  # a number that does not fit below a mark
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
    return _svg(lambda: draw(series, x_label, y_label, lines or {}, marks or {}, low, log), f"{y_label} over {x_label}")


def _svg(drawn: "Callable[[], Figure]", words: str) -> str:
    """The figure that a callback draws in this style as an SVG element, which ``words`` tell to those who don't see it."""
    from matplotlib import rc_context

    with rc_context(_STYLE):
        stream = io.StringIO()
        drawn().savefig(stream, format="svg", transparent=True, metadata=_NO_METADATA)
    # Names of groups would be there twice in a page, and namespaces need not be told in HTML.
    _, _, text = stream.getvalue().partition('viewBox="')
    box, _, text = text.partition('"')
    content = text.partition(">")[2]
    content = re.sub(r' id="[\w.]+_\d+"', "", content)
    return f'<svg viewBox="{box}" role="img" aria-label="{escape(words)}">{content.strip()}'


def draw(series: dict, x_label: str, y_label: str, lines: dict, marks: dict, low: float | None, log: bool) -> "Figure":
    """Return the `matplotlib.figure.Figure` of `curves`."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

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
    _plain(axes)
    axes.set_xlabel(x_label)
    axes.set_title(y_label, loc="left", fontsize=_STYLE["font.size"], pad=18 if marks else 8)
    if len(series) > 1:
        axes.legend(loc="upper left", bbox_to_anchor=(1, 1), frameon=False, labelcolor="linecolor", handlelength=0.8)
    return figure


def growth_figure(rows: "dict[str, dict[str, np.ndarray]]") -> "Figure":
    """Return the `matplotlib.figure.Figure` of what `commands.growth` has measured: ``rows`` {name of what grows: {name: its
    values, name of what that costs: [N]}}, a column of plots each, over which costs are doubly logarithmic."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter

    costs = {"step_ms": "ms a step", "start_s": "s until the first step", "memory_mb": "MB of memory"}
    words = {"surfels": "surfels", "side": "pixels of a photograph's side", "views": "photographs"}
    with rc_context(_STYLE):
        figure = Figure((3.1 * len(rows), 2.3 * len(costs)), layout="constrained")
        grid = figure.subplots(len(costs), len(rows), squeeze=False, sharex="col", sharey="row")
        for column, (name, row) in zip(grid.T, rows.items()):
            for axes, (cost, label), ink in zip(column, costs.items(), _INKS):
                axes.loglog(row[name], row[cost], "o-", color=ink, markersize=4)
                axes.set_title(label if name == next(iter(rows)) else "", loc="left", fontsize=_STYLE["font.size"], pad=8)
            column[-1].set_xticks(row[name])
            column[-1].set_xlabel(words[name])
        for axes, (cost, _) in zip(grid[:, 0], costs.items()):
            _decades(axes, np.concatenate([row[cost] for row in rows.values()]))
        for axes in grid.flat:
            _plain(axes)
            axes.minorticks_off()
        for axes, (name, row) in zip(grid[-1], rows.items()):
            if max(row[name]) >= _LONG:
                axes.xaxis.set_major_formatter(EngFormatter())  # 300 k, 1 M
    return figure


def bars(values: Sequence[float], bad: Sequence[bool], x_label: str, y_label: str) -> str:
    """Plot ``values``, one a photograph in their order, as bars from zero, and return an SVG element; those that are ``bad``
    stand out, and what is not finite has no bar."""
    from matplotlib.figure import Figure

    def drawn():
        figure = Figure(_SIZE, layout="constrained")
        axes = figure.add_subplot()
        heights = np.nan_to_num(np.asarray(values, float), posinf=0, neginf=0)
        inks = [_INKS[1] if odd else _INKS[0] for odd in bad]
        axes.bar(np.arange(1, len(heights) + 1), heights, color=inks, width=0.8)
        _plain(axes)
        axes.set_xlim(0, len(heights) + 1)
        axes.set_xlabel(x_label)
        axes.set_title(y_label, loc="left", fontsize=_STYLE["font.size"], pad=8)
        return figure

    return _svg(drawn, f"{y_label}, a bar each")


def cameras(origins: np.ndarray, axes: np.ndarray, points: np.ndarray, gap: tuple[float, float] | None) -> list[str]:
    """Plot where cameras stand, from above and from the side, and return two SVG elements.

    Args:
      origins: [N, 3] positions, in the order of the photographs, z up
      axes:    [N, 3] unit directions of view
      points:  [M, 3] points of the scene
      gap:     azimuth in degrees at which a part of the way around without cameras begins, and how wide it is; None: none
    """
    reach = 1.25 * float(np.abs(origins).max())
    near = points[(np.abs(points) < reach).all(1)]
    around = np.hypot(origins[:, 0], origins[:, 1])
    across = np.einsum("ij,ij->i", axes[:, :2], origins[:, :2]) / np.maximum(around, 1e-9)
    above = lambda: _places(origins[:, :2], axes[:, :2], near[:, :2], gap, reach, "from above: x and y", True)
    side = np.stack([around, origins[:, 2]], 1), np.stack([across, axes[:, 2]], 1)
    cloud = np.stack([np.hypot(near[:, 0], near[:, 1]), near[:, 2]], 1)
    beside = lambda: _places(*side, cloud, None, reach, "from the side: distance from the vertical, and z", False)
    return [_svg(above, "cameras from above"), _svg(beside, "cameras from the side")]


def _places(origins, axes, points, gap, reach, title, numbered):
    from matplotlib.figure import Figure
    from matplotlib.patches import Wedge

    figure = Figure((_SIDE, _SIDE), layout="constrained")
    plot = figure.add_subplot()
    if gap:
        plot.add_patch(Wedge((0, 0), reach, gap[0], sum(gap), color=_BOUND, alpha=0.12, linewidth=0))
    plot.scatter(*points.T, s=1.2, color=_SOFT, alpha=0.35, linewidths=0, rasterized=True)
    plot.plot(*origins.T, color=_LINE, linewidth=0.8, zorder=1)
    plot.quiver(*origins.T, *axes.T, color=_INKS[0], angles="xy", scale_units="xy", scale=7 / reach, width=0.004, zorder=2)
    plot.scatter(*origins.T, s=12, color=_INKS[0], zorder=3)
    for k in range(0, len(origins) if numbered else 0, max(len(origins) // 12, 1)):
        plot.annotate(str(k + 1), origins[k], (4, 4), textcoords="offset points")
    plot.plot(0, 0, "+", color=_BOUND, markersize=9)
    plot.set_aspect("equal")
    plot.set_xlim(-reach if origins[:, 0].min() < 0 or gap else -0.1 * reach, reach)
    low = min(float(origins[:, 1].min()) - 0.15 * reach, -0.35 * reach)
    plot.set_ylim(low if not gap else -reach, reach)
    _plain(plot)
    plot.set_title(title, loc="left", fontsize=_STYLE["font.size"], pad=8)
    return figure


def _plain(axes):
    """Plain numbers at the axes, and lines only where one reads along."""
    from matplotlib.ticker import FuncFormatter

    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: number(value)))
    axes.grid(axis="y", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(which="both", length=0)
    axes.spines[["left", "top", "right"]].set_visible(False)


def _decades(axes, heights):
    """Marks at powers of ten, and at their double and fivefold where there are few."""
    from matplotlib.ticker import LogLocator

    few = heights.max() < 100 * heights.min()
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if few else (1,), numticks=8))
    axes.yaxis.set_minor_locator(LogLocator(subs=()))

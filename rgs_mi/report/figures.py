"""The figures of metrics.json in words: one label, one precision and one unit for each, wherever it is printed.

An angle's sign stands at every value; other units stand at the column's head, or at the value where it is asked for.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """How a number is written: its ``label``, with ``digits`` after the decimal point, of which the tables of the paper have
    ``paper_digits``; ``scale`` is what a value is multiplied by to be in ``unit``."""

    label: str
    digits: int
    paper_digits: int
    unit: str = ""
    scale: float = 1.0


#: Name in metrics.json -> how it is written.
FIGURES = {
    "psnr": Figure("PSNR", 2, 2, "dB"),
    "psnr_unaligned": Figure("PSNR, unaligned", 2, 2, "dB"),
    "ssim": Figure("SSIM", 4, 3),
    "lpips": Figure("LPIPS", 4, 3),
    "lpips_alex": Figure("LPIPS (AlexNet)", 4, 3),
    "normal_mae_deg": Figure("normal error", 2, 2, "°"),
    "normal_ssim": Figure("SSIM of normals", 4, 3),
    "normal_lpips": Figure("LPIPS of normals", 4, 3),
    "surfels": Figure("surfels", 0, 0),
    "render_fps": Figure("FPS", 1, 0),
    "train_seconds": Figure("time", 1, 0, "min", 1 / 60),
    "iterations": Figure("steps", 0, 0),
    "peak_rss_mb": Figure("memory", 0, 0, "MB"),
}


def text(name: str, value: float | None, *, unit: bool = False, signed: bool = False, paper: bool = False) -> str:
    """Return the ``value`` of the figure ``name`` in words, '' for None; where asked with its ``unit``, with its sign as a
    difference has it (``signed``), and as precisely as the ``paper`` writes it."""
    if value is None:
        return ""
    figure = FIGURES[name]
    digits = figure.paper_digits if paper else figure.digits
    words = f"{figure.scale * value:{'+' * signed},.{digits}f}".replace(",", " ")
    return words + (figure.unit if figure.unit == "°" else f" {figure.unit}" if unit and figure.unit else "")


def label(name: str) -> str:
    """Return what the figure ``name`` is called where its value stands beside it."""
    return FIGURES[name].label


def heading(name: str) -> str:
    """Return the head of a column of the figure ``name``: its label, and its unit where values do not have it."""
    figure = FIGURES[name]
    return f"{figure.label}, {figure.unit}" if figure.unit not in ("", "°") else figure.label


def number(value: float) -> str:
    """Return a number that is none of `FIGURES` in words: with four digits, or rounded to an integer from 1000 on."""
    return f"{value:,.0f}".replace(",", " ") if abs(value) >= 1000 else f"{value:.4g}"

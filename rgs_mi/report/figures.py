"""Figures of metrics.json in words; the page keeps the numbers beside them: <data data-figure='psnr' value='30.868030'>."""

from html import escape

from .html import Html

#: name in metrics.json -> label, words of a value, unit
FIGURES = {
    "psnr": ("PSNR", "{:.2f}", " dB"),
    "ssim": ("SSIM", "{:.4f}", ""),
    "lpips": ("LPIPS (VGG)", "{:.4f}", ""),
    "lpips_alex": ("LPIPS (AlexNet)", "{:.4f}", ""),
    "normal_mae_deg": ("normal error", "{:.2f}", "°"),
    "normal_ssim": ("SSIM of normals", "{:.4f}", ""),
    "normal_lpips": ("LPIPS of normals", "{:.4f}", ""),
    "surfels": ("surfels", "{:,.0f}", ""),
    "render_fps": ("FPS", "{:.1f}", ""),
    "train_seconds": ("time", "{}", ""),
    "iterations": ("steps", "{:,.0f}", ""),
    "peak_rss_mb": ("memory", "{:,.0f}", " MB"),
}


def cell(name: str, value, key: str | None = None, unit: bool = False) -> Html:
    """The ``value`` of figure ``name``, a dash where it is None; ``key``: what it is called in metrics.json, where that is
    not its name. ``unit``: with it."""
    if value is None:
        return Html("<span class='soft'>–</span>")
    _, form, unit_words = FIGURES[name]
    words = form.format(_clock(value) if name == "train_seconds" else value).replace(",", " ")
    words += unit_words if unit else ""
    return Html(f"<data data-figure='{escape(key or name, quote=True)}' value='{value!r}'>{words}</data>")


def label(name: str) -> str:
    """The head of a column."""
    words, _, unit = FIGURES[name]
    return f"{words},{unit}" if unit.strip() and unit != "°" else f"{words}{unit and ', °'}"


def _clock(seconds):
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes}:{seconds:02} min"

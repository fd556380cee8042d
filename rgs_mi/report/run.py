"""The page of one run."""

from html import escape

import numpy as np
import yaml

from ..core.files import atomic_file
from ..evaluation.evaluate import SCORES
from ..evaluation.pictures import ERROR_RANGE, NORMAL_RANGE
from ..settings.config import to_dict
from ..settings.settings import Settings
from . import html
from .figures import FIGURES, cell, label

REPORT = "report.html"
_TILES = ("psnr", "ssim", "lpips", "normal_mae_deg", "surfels", "render_fps", "train_seconds", "iterations", "peak_rss_mb")
_OF_VIEW = ("psnr", "ssim", "lpips", "normal_mae_deg")  # figures above a view's pictures
_SLIDER, _PANEL, _ENVIRONMENT = 640, 300, 1024  # most pixels of a picture's width
_ENVIRONMENT_WORDS = (
    "The light that was recovered, latitude by longitude: radiance at an exposure, through sRGB's curve; "
    "what is brighter than white is clipped."
)
_NOTES = {"error": html.scale("0", f"{ERROR_RANGE:g}"), "normal error": html.scale("0°", f"{NORMAL_RANGE}°")}


def write(folder, figures: dict, curves, rows, environment: np.ndarray):
    """Write ``FOLDER/report.html``.

    Args:
      figures:     what metrics.json holds
      curves:      the fit's `Curves`
      rows:        view's name -> its `pictures.panels`
      environment: [rows, columns, 3], linear radiance

    Raises: UserError where the disk is full or the folder can't be written.
    """
    parts = [
        *_head(figures),
        html.heading("The fit"),
        *_curves(curves),
        html.heading("Views"),
        *_views(figures, rows),
        html.heading("Environment"),
        html.exposure(_shrunk(environment), _ENVIRONMENT_WORDS),
    ]
    if figures["views"]:
        parts += [html.heading("Figures of the test views"), _table(figures)]
    parts += [
        html.heading("Settings"),
        html.paragraph("As YAML; what differs from the defaults is marked.", "soft"),
        html.preformatted(_settings(figures["settings"]), "columns"),
        html.heading("How it was made"),
        *_made(figures),
    ]
    with atomic_file(folder / REPORT) as stream:
        stream.write(html.page(folder.resolve().name, *parts).encode())


# ---- Figures ----


def _head(figures):
    held_out = figures["test_views"] > 0
    words = f"{figures['train_views']} photographs fitted, {figures['test_views']} held out. "
    words += (
        "Figures are means over the views that were held out."
        if held_out
        else "Nothing was held out to measure on: no figures of quality, and pictures show views that were fitted."
    )
    yield html.paragraph(words, "soft")
    if not figures["finished"]:
        yield html.paragraph("The fit was stopped before its end.")
    known = [name for name in _TILES if figures[name] is not None]
    yield html.tiles({FIGURES[name][0]: cell(name, figures[name], unit=True) for name in known})
    if held_out and figures["lpips"] is None:
        yield html.paragraph(f"LPIPS: {figures['lpips_reason']}", "soft")


def _table(figures):
    names = [name for name in SCORES if figures[name] is not None]
    rows = [
        [view, *(cell(name, scores[name], f"views/{view}/{name}") for name in names)]
        for view, scores in figures["views"].items()
    ]
    return html.table(["view", *map(label, names)], rows, mean=["mean", *(cell(name, figures[name]) for name in names)])


def _made(figures):
    machine = figures["machine"]
    words = ", ".join(f"{name} {version}" for name, version in figures["versions"].items())
    yield html.preformatted(figures["command"], "wrap")
    yield html.paragraph(
        f"{words}. {machine['system']}, {machine['processor']}, {machine['cpus']} processors, variant {machine['variant']}.",
        "soft",
    )
    yield html.paragraph(
        html.Html(
            "Beside this page: "
            + ", ".join(html.link(name, name) for name in ("metrics.json", "curves.csv", "contact_sheet.png", "scene.xml"))
        ),
        "soft",
    )


# ---- Curves ----


def _curves(curves):
    if not curves.rows:
        yield html.paragraph("No steps were recorded.")
        return
    seconds = np.array(curves.column("seconds"))
    time, unit = (seconds / 60, "minutes") if seconds[-1] >= 120 else (seconds, "seconds")
    pixels = curves.column("pixels")
    stages = {f"{pixels[0]} px": 0} | {
        f"{pixels[k]} px": time[k - 1] for k in range(1, len(pixels)) if pixels[k] != pixels[k - 1]
    }
    plot = lambda series, words, **options: html.curves(
        {name: (time, y) for name, y in series.items()}, unit, words, marks=stages, **options
    )
    yield html.group(
        "plots",
        plot(
            {"of a stretch": curves.column("psnr"), "running mean": _running_mean(curves.column("psnr"))},
            "PSNR of training views, dB",
            low=None,
        ),
        plot(
            {name.removeprefix("loss.").replace("_", " "): curves.column(name) for name in curves.losses()},
            "parts of the loss, weighted",
            log=True,
        ),
        plot({"surfels": curves.column("surfels")}, "surfels"),
        plot({"ms": curves.column("ms")}, "milliseconds a step", log=True),
    )
    yield html.paragraph("Means over stretches of the fit. Dotted: where the photographs' width changes.", "soft")


def _running_mean(values, reach=10):
    """Of each value and its neighbours, ``reach`` to either side, that are known."""
    windows = (np.array(values[max(k - reach, 0) : k + reach + 1]) for k in range(len(values)))
    return [float(np.mean(known)) if len(known := window[np.isfinite(window)]) else np.nan for window in windows]


# ---- Pictures ----


def _views(figures, rows):
    for name, panels in rows.items():
        scores = figures["views"].get(name, {})
        words = [f"{FIGURES[k][0]} {cell(k, scores[k], f'views/{name}/{k}', True)}" for k in _OF_VIEW if scores.get(k)]
        yield html.heading(name, 3)
        if words:
            yield html.paragraph(html.Html(" · ".join(words)), "soft")
        sides = "photograph", "rendering"
        slider = html.compare(*(panels[side] for side in sides), sides, f"view {name}", _SLIDER)
        small = [
            html.picture(image, kind, f"{kind} of view {name}", _PANEL, _NOTES.get(kind, ""))
            for kind, image in panels.items()
            if kind not in sides
        ]
        yield html.group("view", slider, html.group("panels", *small))
    yield html.paragraph(
        "error: mean absolute difference of display values; normals in world space; depth: near is light; "
        "diffuse and specular: radiance, clipped.",
        "soft",
    )


def _shrunk(environment):
    """At most `_ENVIRONMENT` texels wide: means over blocks, in linear light."""
    k = -(-environment.shape[1] // _ENVIRONMENT)
    height, width = (n // k for n in environment.shape[:2])
    return environment[: height * k, : width * k].reshape(height, k, width, k, 3).mean((1, 3))


# ---- Settings ----


def _settings(settings: dict) -> html.Html:
    """The settings as YAML, a line each; those that differ from the defaults are marked, with the default beside them."""
    return html.Html("\n".join(_lines(settings, to_dict(Settings()), "")))


def _lines(tree, defaults, indent):
    for key, value in tree.items():
        default = defaults.get(key)
        if isinstance(value, dict) and value:
            yield f"{indent}{escape(key)}:"
            yield from _lines(value, default or {}, indent + "  ")
            continue
        several = isinstance(value, list) and any(isinstance(item, dict) for item in value)
        lines = [f"{key}:", *(f"  - {_inline(item)}" for item in value)] if several else [f"{key}: {_inline(value)}"]
        lines = [escape(line) for line in lines]
        if value != default:
            lines = [f"<mark>{line}</mark>" for line in lines]
            lines[0] += f"  <span class='soft'># default: {escape(_inline(default))}</span>"
        yield from (indent + line for line in lines)


def _inline(value):
    text = yaml.safe_dump(value, default_flow_style=True, width=float("inf"), allow_unicode=True, sort_keys=False)
    return text.removesuffix("...\n").strip()

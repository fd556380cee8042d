"""Several fits side by side: means and differences, tables beside published figures, a picture a scene.

A *row* is a dictionary: ``scene``, ``variant``, ``seed``, ``status`` ('finished', 'failed' or 'missing'), `FIGURES` and
`DETAILS` as metrics.json calls them (None where not known), and the ``error`` or None. ``variants`` gives for each name an
object with a ``label`` and ``against``, the name of the variant that it is compared with.
"""

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ..core.color import to_8bit
from ..core.files import atomic_file
from ..evaluation.evaluate import ground_truth
from ..evaluation.metrics import normal_colors
from ..evaluation.pictures import crop

SCORES = ("psnr", "ssim", "lpips", "normal_mae_deg")  # those of `evaluate.SCORES` that tables have room for
FIGURES = (*SCORES, "surfels", "render_fps", "train_seconds")
DETAILS = ("iterations", "peak_rss_mb", "normal_ssim", "normal_lpips")
_HEADER = ("PSNR", "SSIM", "LPIPS", "normals", "surfels", "FPS", "min")
_PANEL, _GAP, _MARGIN, _TEXT = 260, 8, 24, 20  # pixels of the picture
_INK = (60, 60, 60)


# ---- Means ----


def means(rows, variants) -> dict[str, dict]:
    """For each variant its `FIGURES`, the means over seeds, then over scenes; how many ``scenes``; ``difference``: of the
    `SCORES` to the variant ``against``, over the scenes and seeds that both have, beside it ``difference_by_seed``."""
    runs = {(r["variant"], r["scene"], r["seed"]): r for r in rows if r["status"] == "finished"}
    table = {}
    for variant in dict.fromkeys(r["variant"] for r in rows):
        against = variants[variant].against
        mine = {key[1:]: r for key, r in runs.items() if key[0] == variant}
        pairs = {
            key: {n: r[n] - other[n] for n in SCORES if r[n] is not None and other[n] is not None}
            for key, r in mine.items()
            if variant != against and (other := runs.get((against, *key)))
        }
        seeds = sorted({seed for _, seed in pairs})
        of_seed = {seed: {key: d for key, d in pairs.items() if key[1] == seed} for seed in seeds}
        table[variant] = {
            "scenes": len({scene for scene, _ in mine}),
            **mean(mine, FIGURES),
            "against": against,
            "difference": mean(pairs, SCORES),
            "difference_by_seed": {s: mean(of_seed[s], SCORES) for s in seeds},
        }
    return table


def mean(figures, names) -> dict:
    """Of {(scene, seed): {name: value}}: the mean over scenes of the mean over their seeds; None of nothing."""
    result = {}
    for name in names:
        scenes = {}
        for (scene, _), values in figures.items():
            if values.get(name) is not None:
                scenes.setdefault(scene, []).append(values[name])
        result[name] = float(np.mean([np.mean(values) for values in scenes.values()])) if scenes else None
    return result


# ---- Tables ----

_PLAIN = {
    "psnr": "{:.2f}",
    "ssim": "{:.4f}",
    "lpips": "{:.4f}",
    "normal_mae_deg": "{:.2f}°",
    "surfels": "{:,.0f}",
    "render_fps": "{:.1f}",
    "train_seconds": "{:.1f}",
    "peak_rss_mb": "{:.0f}",
}
_SIGNED = {"psnr": "{:+.2f}", "ssim": "{:+.4f}", "lpips": "{:+.4f}", "normal_mae_deg": "{:+.2f}°"}


def _cell(name, value, format=_PLAIN):
    if value is None:
        return ""
    return format[name].format(value / 60 if name == "train_seconds" else value).replace(",", " ")


def mean_tables(table, variants, published) -> str:
    """What `means` gave as text, a table for each variant that others are compared with; beside it the ``published``
    {variant: {figure: value}}."""
    texts = []
    for against in dict.fromkeys(variants[name].against for name in table):
        names = [name for name in table if variants[name].against == against]
        beside = any(name in published for name in names)
        lines = [
            (
                f"Δ: to {variants[against].label}",
                "scenes",
                *_HEADER,
                "Δ PSNR",
                "Δ SSIM",
                "Δ LPIPS",
                "Δ normals",
                *(("paper: PSNR", "Δ", "SSIM", "normals", "surfels") if beside else ()),
            )
        ]
        for name in names:
            row = table[name]
            lines.append(
                (
                    variants[name].label,
                    str(row["scenes"]),
                    *(_cell(n, row[n]) for n in FIGURES),
                    *(_difference(row, n) for n in SCORES),
                    *(_published(published, name, against) if beside else ()),
                )
            )
        texts.append(text_table(lines))
    return "\n\n".join(texts)


def _difference(row, name):
    """The difference, and in brackets that of each seed where there are several."""
    seeds = [d[name] for d in row["difference_by_seed"].values() if d[name] is not None]
    text = _cell(name, row["difference"][name], _SIGNED)
    return f"{text} ({', '.join(_cell(name, v, _SIGNED) for v in seeds)})" if len(seeds) > 1 else text


def _published(published, variant, against):
    figures, other = published.get(variant, {}), published.get(against, {})
    gain = figures["psnr"] - other["psnr"] if figures and other and variant != against else None
    return [
        _cell("psnr", figures.get("psnr")),
        _cell("psnr", gain, _SIGNED),
        f"{figures['ssim']:.3f}" if figures else "",
        _cell("normal_mae_deg", figures.get("normal_mae_deg")),
        _cell("surfels", figures.get("surfels")),
    ]


def scene_table(rows) -> str:
    """``rows``, [(name, row)], of one scene or one variant as text."""
    lines = [("", "seed", *_HEADER, "MB", "")]
    for name, r in rows:
        note = "" if r["status"] == "finished" else r["error"] or "not yet"
        lines.append(
            (
                name,
                str(r["seed"]),
                *(_cell(n, r[n]) for n in FIGURES),
                _cell("peak_rss_mb", r["peak_rss_mb"]),
                note.replace("|", "\\|"),
            )
        )
    return text_table(lines)


def text_table(lines) -> str:
    """Markdown that reads well as plain text too: the first line is the header, the first column words, others numbers."""
    widths = [max(3, *map(len, column)) for column in zip(*lines)]
    rule = [":" + "-" * (widths[0] - 1), *("-" * (width - 1) + ":" for width in widths[1:])]
    pad = lambda line: [line[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(line[1:], widths[1:]))]
    return "\n".join(f"| {' | '.join(line)} |" for line in map(pad, [lines[0], rule, *lines[1:]]))


# ---- Pictures ----


def picture(path, views, columns, background):
    """Write a picture of a scene: for each of ``views`` a row of images and one of normals. Columns: the truth, then
    ``columns``, [(label, figures of metrics.json, the run's folder)]; ``background``: as it was fitted with."""
    labels = [("truth", ""), *((label, _caption(figures)) for label, figures, _ in columns)]
    rows = [row for view in views for row in _rows(view, [folder / "test" for _, _, folder in columns], background)]
    heights = [round(_PANEL * row[-1].shape[0] / row[-1].shape[1]) for row in rows]
    top, step = _MARGIN + 3 * _TEXT, _PANEL + _GAP
    sheet = Image.new(
        "RGB", (2 * _MARGIN + len(labels) * step - _GAP, top + sum(heights) + len(rows) * _GAP + _MARGIN), "white"
    )
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(_TEXT)
    for k, words in enumerate(labels):
        x, y = _MARGIN + k * step, top
        for line, text in enumerate(words):
            draw.text((x + _PANEL / 2, _MARGIN + 1.3 * _TEXT * line), text, _INK, font, anchor="mm")
        for row, height in zip(rows, heights):
            if row[k] is not None:
                sheet.paste(Image.fromarray(to_8bit(row[k])).resize((_PANEL, height), Image.LANCZOS), (x, y))
            y += height + _GAP
    with atomic_file(path) as stream:
        sheet.save(stream, "PNG")


def _caption(figures):
    psnr, normals = (_cell(name, figures[name]) for name in ("psnr", "normal_mae_deg"))
    return " · ".join([f"{psnr} dB"] * bool(psnr) + [normals] * bool(normals))


def _rows(view, folders, background):
    """Images and normals of a view: two lists of [H, W, 3] display values, cropped to the object, the truth's first (None:
    unknown)."""
    normals = [None]
    if view.normal is not None:
        known = np.linalg.norm(view.normal, axis=-1, keepdims=True) > 0.5
        normals = [normal_colors(view.normal * known, known[..., 0])]
    normals += [_normals(folder / f"{view.name}_gbuffer.exr") for folder in folders]
    images = [np.asarray(Image.open(folder / f"{view.name}.png"))[..., :3] / 255 for folder in folders]
    for row in ([ground_truth(view, background), *images], normals):
        cropped = crop({k: image for k, image in enumerate(row) if image is not None}, view)
        yield [cropped.get(k) for k in range(len(row))]


def _normals(path):
    """[H, W, 3] the normals of a G-buffer (premultiplied there) as colours over white."""
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
    return normal_colors(np.stack([channels[f"sh_normal.{axis}"] for axis in "XYZ"], -1), channels["alpha.Y"])

"""Several fits side by side: means and differences, and tables of them as text and CSV.

A *row* is a dictionary: ``scene``, ``variant``, ``seed``, ``status`` ('finished', 'failed' or 'missing'), `FIGURES` and
`DETAILS` as metrics.json calls them (None where not known), and the ``error`` or None. ``variants`` gives for each name an
object with a ``label`` and ``against``, the name of the variant that it is compared with.
"""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from .figures import heading, text

SCORES = ("psnr", "ssim", "lpips", "normal_mae_deg")  # those of `evaluate.SCORES` that tables have room for
FIGURES = (*SCORES, "surfels", "render_fps", "train_seconds")
DETAILS = ("iterations", "peak_rss_mb", "normal_ssim", "normal_lpips")
_IN_PAPER = ("ssim", "normal_mae_deg", "surfels")  # of the paper's ablation, beside its PSNR


class Compared(Protocol):
    """A variant in tables: its ``label``, and the name of the variant ``against`` which it is compared."""

    @property
    def label(self) -> str: ...

    @property
    def against(self) -> str: ...


# ---- Means ----


def means(rows: Sequence[Mapping[str, Any]], variants: Mapping[str, Compared]) -> dict[str, dict[str, Any]]:
    """Return for each variant its `FIGURES`, means over seeds, then over scenes; how many ``scenes`` these are; and the
    ``difference`` of the `SCORES` to the variant ``against``, over the scenes and seeds that both have, beside it
    ``difference_by_seed``."""
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


def mean(figures: Mapping[tuple[str, int], Mapping[str, Any]], names: Iterable[str]) -> dict[str, float | None]:
    """Return for each of ``names`` the mean over scenes of the mean over their seeds of ``figures``, {(scene, seed):
    {name: value}}; None where there is no value."""
    result = {}
    for name in names:
        scenes = {}
        for (scene, _), values in figures.items():
            if values.get(name) is not None:
                scenes.setdefault(scene, []).append(values[name])
        result[name] = float(np.mean([np.mean(values) for values in scenes.values()])) if scenes else None
    return result


# ---- Tables ----


def mean_tables(
    table: Mapping[str, Mapping[str, Any]],
    variants: Mapping[str, Compared],
    paper: Mapping[str, Mapping[str, float]],
) -> str:
    """Return what `means` gave as text: a table for each variant that others are compared with, and in it the numbers of the
    ``paper``, {variant: {figure: value}}."""
    texts = []
    for against in dict.fromkeys(variants[name].against for name in table):
        names = [name for name in table if variants[name].against == against]
        beside = any(name in paper for name in names)
        header = [f"Δ: to {variants[against].label}", "scenes", *map(heading, FIGURES)]
        header += [f"Δ {heading(name)}" for name in SCORES]
        header += [f"paper: {heading('psnr')}", "Δ", *map(heading, _IN_PAPER)] if beside else []
        lines = [header]
        for name in names:
            row = table[name]
            lines.append([variants[name].label, str(row["scenes"]), *(text(n, row[n]) for n in FIGURES)])
            lines[-1] += [_difference(row, n) for n in SCORES]
            lines[-1] += _paper(paper, name, against) if beside else []
        texts.append(text_table(lines))
    return "\n\n".join(texts)


def _difference(row, name):
    """The difference, and in brackets that of each seed where there are several."""
    seeds = [d[name] for d in row["difference_by_seed"].values() if d[name] is not None]
    words = text(name, row["difference"][name], signed=True)
    return f"{words} ({', '.join(text(name, v, signed=True) for v in seeds)})" if len(seeds) > 1 else words


def _paper(paper, variant, against):
    figures, other = paper.get(variant, {}), paper.get(against, {})
    gain = figures["psnr"] - other["psnr"] if figures and other and variant != against else None
    return [
        text("psnr", figures.get("psnr"), paper=True),
        text("psnr", gain, signed=True, paper=True),
        *(text(name, figures.get(name), paper=True) for name in _IN_PAPER),
    ]


def scene_table(rows: Iterable[tuple[str, Mapping[str, Any]]]) -> str:
    """Return ``rows``, [(name, row)], of one scene or one variant as a table in text."""
    lines = [["", "seed", *map(heading, (*FIGURES, "peak_rss_mb")), ""]]
    for name, r in rows:
        note = "" if r["status"] == "finished" else r["error"] or "not yet"
        values = [text(n, r[n]) for n in (*FIGURES, "peak_rss_mb")]
        lines.append([name, str(r["seed"]), *values, note.replace("|", "\\|")])
    return text_table(lines)


def text_table(lines: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown that reads well as plain text, too: the first of ``lines`` is the header, the first column
    is words, the others are numbers."""
    widths = [max(3, *map(len, column)) for column in zip(*lines)]
    rule = [":" + "-" * (widths[0] - 1), *("-" * (width - 1) + ":" for width in widths[1:])]
    pad = lambda line: [line[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(line[1:], widths[1:]))]
    return "\n".join(f"| {' | '.join(line)} |" for line in map(pad, [lines[0], rule, *lines[1:]]))


def csv_text(rows: Sequence[Mapping[str, object]], names: Sequence[str] | None = None) -> str:
    """Return ``rows`` as CSV with the columns ``names`` (None: those of the first row).

    Words that a spreadsheet would take for a formula have an apostrophe before them, which it takes for a sign of words.
    """
    stream = io.StringIO()
    writer = csv.DictWriter(stream, list(names or rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _harmless(value) for name, value in row.items()} for row in rows)
    return stream.getvalue()


def _harmless(cell):
    if not isinstance(cell, str) or not cell.startswith(("=", "+", "-", "@", "\t", "\r")):
        return cell
    try:
        float(cell)
    except ValueError:
        return f"'{cell}"
    return cell

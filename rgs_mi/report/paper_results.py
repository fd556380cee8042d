"""The tables of the RGS paper for a suite of scenes, with a run of ours beside them.

A scene is told by its name, and with it the data set that it belongs to. Figures are named as in metrics.json; what the
paper calls parameters are surfels.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from .figures import heading, text
from .tables import DETAILS, FIGURES, mean, text_table

#: The scenes of the data sets that the paper has figures of.
SCENES = {
    "Shiny Blender": ("ball", "car", "coffee", "helmet", "teapot", "toaster"),
    "Glossy Synthetic": ("angel", "bell", "cat", "horse", "luyu", "potion", "tbell", "teapot"),
    "Ref-NeRF Real": ("gardenspheres", "sedan", "toycar"),
    "NeRF Synthetic": ("chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship"),
}
_SUFFIX = "_blender"  # of the names of Glossy Synthetic's scenes in the Blender layout

_QUALITY = ("psnr", "ssim", "lpips")
_NORMALS = ("normal_mae_deg", "normal_ssim", "normal_lpips")
_BUDGET = ("surfels", "train_seconds", "render_fps", "peak_rss_mb", "psnr")
#: The paper's tables: data sets and figures.
TABLES = {
    "Reflective objects": (("Glossy Synthetic", "Shiny Blender", "Ref-NeRF Real"), _QUALITY),
    "NeRF Synthetic": (("NeRF Synthetic",), _QUALITY),
    "Normals": (("Shiny Blender",), _NORMALS),
    "Budget": (("Shiny Blender",), _BUDGET),
}
#: What the paper writes: table -> method -> a row of numbers, or a row for each data set of the table.
PAPER = {
    "Reflective objects": {
        "Ref-NeRF": ((27.49, 0.927, 0.100), (33.12, 0.961, 0.079), (23.62, 0.645, 0.238)),
        "NPC": ((21.96, 0.841, 0.181), (27.48, 0.921, 0.145), (22.87, 0.605, 0.320)),
        "3DGS": ((26.49, 0.917, 0.092), (30.35, 0.946, 0.083), (23.85, 0.659, 0.230)),
        "3iGS": ((26.39, 0.913, 0.089), (30.64, 0.948, 0.077), (23.95, 0.657, 0.258)),
        "GaussianShader": ((27.53, 0.921, 0.086), (31.96, 0.957, 0.067), (23.46, 0.647, 0.257)),
        "ENVIDR": ((29.56, 0.952, 0.059), (33.46, 0.967, 0.045), (23.00, 0.605, 0.331)),
        "Spec-Gaussian": ((27.54, 0.931, 0.079), (31.00, 0.950, 0.075), (23.71, 0.652, 0.259)),
        "3DGS-DR": ((30.13, 0.953, 0.058), (34.08, 0.971, 0.052), (23.99, 0.658, 0.264)),
        "EnvGS": ((29.78, 0.952, 0.061), (33.82, 0.968, 0.065), (24.15, 0.659, 0.259)),
        "Ref-GS": ((30.59, 0.957, 0.058), (34.80, 0.973, 0.056), (24.21, 0.661, 0.258)),
        "Ref-Gaussian": ((30.36, 0.958, 0.051), (35.01, 0.972, 0.056), (24.13, 0.657, 0.258)),
        "RGS, the paper": ((31.24, 0.965, 0.043), (35.38, 0.976, 0.050), (24.31, 0.670, 0.257)),
    },
    "NeRF Synthetic": {
        "NeRF": ((31.01, 0.947, 0.081),),
        "VolSDF": ((27.96, 0.932, 0.096),),
        "Ref-NeRF": ((31.29, 0.947, 0.058),),
        "ENVIDR": ((28.13, 0.956, 0.067),),
        "3DGS": ((33.30, 0.969, 0.030),),
        "GaussianShader": ((31.46, 0.960, 0.042),),
        "RGS, the paper": ((33.51, 0.968, 0.028),),
    },
    "Normals": {
        "ENVIDR": ((2.74, 0.948, 0.072),),
        "Ref-Gaussian": ((2.18, 0.952, 0.053),),
        "3DGS-DR": ((2.62, 0.947, 0.065),),
        "EnvGS": ((2.66, 0.945, 0.062),),
        "RGS, the paper": ((2.04, 0.954, 0.051),),
    },
    "Budget": {
        "3DGS": ((3.3e6, 0.6 * 3600, 604, None, 30.35),),
        "3DGS-DR": ((1.1e6, 2 * 3600, 71, None, 34.08),),
        "EnvGS": ((2.9e6, 3 * 3600, 21, None, 33.82),),
        "RGS, the paper": ((0.1e6, 3 * 3600, 146, None, 35.38),),
    },
}


def by_data_set(names: Iterable[str]) -> dict[str, list[str]]:
    """Return data set -> those of ``names`` that are scenes of it; a name that two have goes where more of the others
    belong."""
    plain = {name: name.lower().removesuffix(_SUFFIX) for name in names}
    found, left = {}, set(plain)
    for data_set in sorted(SCENES, key=lambda s: -len(set(plain.values()) & set(SCENES[s]))):
        if mine := sorted(name for name in left if plain[name] in SCENES[data_set]):
            found[data_set] = mine
            left -= set(mine)
    return found


def means(rows: Sequence[Mapping[str, Any]], names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Return, for each data set that finished ``rows`` (see `tables`) are of, the means over its scenes, and how many these
    ``scenes`` are, ``of`` how many. ``names`` are all scenes of the suite, which tell its data sets."""
    table = {}
    for data_set, scenes in by_data_set(names).items():
        mine = {(r["scene"], r["seed"]): r for r in rows if r["scene"] in scenes and r["status"] == "finished"}
        if mine:
            table[data_set] = {
                "scenes": len({scene for scene, _ in mine}),
                "of": len(SCENES[data_set]),
                **mean(mine, (*FIGURES, *DETAILS)),
            }
    return table


def tables(ours: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the paper's tables of the data sets that `means` found, as sections of text, with ``ours`` as a last row of
    each."""
    sections = []
    for title, (data_sets, figures) in TABLES.items():
        found = [k for k, data_set in enumerate(data_sets) if data_set in ours]
        if not found:
            continue
        prefix = lambda k: f"{data_sets[k]}: " if len(data_sets) > 1 else ""
        lines = [("", *(f"{prefix(k)}{heading(name)}" for k in found for name in figures))]
        for method, numbers in PAPER[title].items():
            lines.append((method, *(text(name, n, paper=True) for k in found for name, n in zip(figures, numbers[k]))))
        counts = ", ".join(f"{ours[data_sets[k]]['scenes']} of {ours[data_sets[k]]['of']}" for k in found)
        lines.append(
            (
                f"this run, scenes {counts}",
                *(text(name, ours[data_sets[k]][name], paper=True) for k in found for name in figures),
            )
        )
        section = title if len(data_sets) > 1 or title == data_sets[0] else f"{title}, {data_sets[0]}"
        sections += [f"## {section}", text_table(lines)]
    return sections

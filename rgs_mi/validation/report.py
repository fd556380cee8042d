"""The cross-validation as files, which `rgs-mi crossvalidate` writes.

OUT/crossvalidation.html    everything on one page
OUT/cases.csv               a row a case
OUT/CASE.exr                float maps: path, monte_carlo, split_sum, z
"""

import itertools
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..core.color import tone_map
from ..core.files import atomic_file, write_exr
from ..core.progress import Progress
from ..report import html
from ..report.plots import curves
from ..report.tables import csv_text
from .cases import Case, Validator
from .checks import checks


def crossvalidate(
    out: Path,
    cases: Sequence[Case],
    validator: Validator,
    quiet: bool = False,
    checked: Sequence[float] = (0.1, 0.3, 0.7),
) -> int:
    """Run ``cases`` and the checks for every roughness ``checked``, write what the module says into the folder ``out``,
    print a summary and return how many bounds were broken. Raises: UserError where a file can't be written."""
    out.mkdir(parents=True, exist_ok=True)
    found, results = checks(checked), []
    with Progress(None, quiet, "comparing") as progress:
        for k, case in enumerate(cases):
            results.append(validator.run(case))
            _write_maps(out / f"{case.name}.exr", results[-1])
            progress.update((k + 1) / len(cases), cases=k + 1)
    rows = [_row(r) for r in results]
    for name, content in {"cases.csv": csv_text(rows).encode(), "crossvalidation.html": _html(results, rows, found)}.items():
        with atomic_file(out / name) as stream:
            stream.write(content)
    failures = [f"{r.case.name}: {words}" for r in results for words in r.failures()]
    failures += [f"{c.name} is {c.value:.4g} (bound: {c.bound:g})" for c in found if not c.passed]
    for line in failures:
        print(line, file=sys.stderr)
    equal = sum(r.difference.equal for r in results)
    print(
        f"monte_carlo equals path in {equal} of {len(results)} cases; split_sum is off by "
        f"{np.mean([r.error for r in results]):.2%} in the mean, {max(r.error for r in results):.2%} at most; "
        f"{sum(c.passed for c in found)} of {len(found)} checks pass\n{out / 'crossvalidation.html'}"
    )
    return len(failures)


def _row(r) -> dict:
    c = r.case
    return {
        "shape": c.shape,
        "environment": c.environment,
        "material": c.material,
        "roughness": f"{c.roughness:g}",
        "pixels": len(r.pixels),
        "z_passed": f"{r.difference.passed:.4f}",
        "z_of_sums": f"{r.difference.global_z:.2f}",
        "split_sum_error": f"{r.error:.4f}",
        "bound": "" if r.bound is None else f"{r.bound:.4f}",
        "noise": f"{r.noise:.4f}",
        "interreflection": f"{r.interreflection:+.4f}",
        "verdict": "; ".join(r.failures()) or "passes",
    }


def _write_maps(path, r):
    maps = {"path": r.path.mean, "monte_carlo": r.monte_carlo.mean, "split_sum": r.split_sum, "z": r.difference.z}
    write_exr(
        path,
        np.concatenate([r.picture(v) for v in maps.values()], -1),
        [f"{name}.{channel}" for name in maps for channel in "RGB"],
    )


def _html(results, rows, found) -> bytes:
    return html.render(
        "crossvalidation.html",
        title="Cross-validation with Mitsuba's path tracer",
        plot=_plot([r for r in results if r.case.shape == "sphere"]),
        columns=list(rows[0]),
        cases=[list(row.values()) for row in rows],
        bad_cases=[k for k, row in enumerate(rows) if row["verdict"] != "passes"],
        checks=[(c.name, f"{c.value:.4g}", f"{c.bound:g}") for c in found],
        bad_checks=[k for k, c in enumerate(found) if not c.passed],
        pictures=[_picture(*key, list(group)) for key, group in itertools.groupby(results, _what)],
    )


def _plot(results) -> str | None:
    """The error of `results` of one shape against roughness, means over environments, a curve a material."""
    series = {}
    for r in results:
        series.setdefault(r.case.material, {}).setdefault(r.case.roughness, []).append(100 * r.error)
    series = {name: (sorted(values), [np.mean(values[x]) for x in sorted(values)]) for name, values in series.items()}
    return curves(series, "roughness", "%") if series else None


def _what(r):
    return r.case.shape, r.case.environment, r.case.material


def _picture(shape, environment, material, group) -> html.Picture:
    """Results that differ in roughness alone, side by side."""
    values = ", ".join(f"{r.case.roughness:g}" for r in group)
    words = (
        f"{shape} in {environment}, {material}; roughness {values} from left to right. Rows: path, monte_carlo, split_sum; "
        "z from −5 (blue) to 5 (red); split_sum − truth from −0.2 to 0.2"
    )
    return html.png(np.concatenate([_column(r) for r in group], 1), words, zoom=2)


def _column(r):
    """The pictures of a case, one below the other."""
    estimates = [tone_map(r.picture(v)) for v in (r.path.mean, r.monte_carlo.mean, r.split_sum)]
    return np.concatenate(
        [*estimates, _signed(r.picture(r.difference.z) / 5), _signed(r.picture(r.split_sum - r.truth) * 5)]
    )


def _signed(values):
    """[H, W, 3] in −1 … 1, the mean of channels, as blue to white to red."""
    x = np.clip(values.mean(-1, keepdims=True), -1, 1)
    return np.concatenate([1 + np.minimum(x, 0), 1 - np.abs(x), 1 - np.maximum(x, 0)], -1)

"""How far split-sum may be off on a sphere: what it was found to be off, case by case, and a margin.

The approximation (three lookups in a filtered environment, for a lobe that is stretched, and cut off at the horizon) is off most
before light with hard edges: one bound for all would let a mistake pass in one case and forbid the truth in another.
"""

import numpy as np

#: Roughness of the materials that were measured.
ROUGHNESS = (0.02, 0.1, 0.2, 0.35, 0.5, 0.7, 1.0)
#: environment and material -> the error Σ|difference| / Σ truth in percent, for each `ROUGHNESS`: "split_sum_error" of the
#: default run of `scripts/crossvalidate.py`. Record it anew, and say why, when the approximation changes.
MEASURED = {
    ("studio", "metal 0.95/0.95/0.95"): (1.20, 2.88, 2.20, 2.18, 1.87, 1.63, 2.59),
    ("studio", "metal 0.9/0.6/0.2"): (1.06, 2.93, 2.27, 2.31, 1.95, 1.63, 2.47),
    ("studio", "dielectric 0/0/0"): (1.51, 4.27, 4.04, 2.93, 2.34, 2.42, 2.11),
    ("studio", "dielectric 0.8/0.8/0.8"): (0.67, 0.72, 0.62, 0.57, 0.68, 0.96, 1.53),
    ("studio", "dielectric 0.1/0.3/0.7"): (0.70, 0.97, 0.85, 0.69, 0.74, 0.98, 1.56),
    ("kitchen", "metal 0.95/0.95/0.95"): (0.86, 2.44, 2.11, 1.86, 1.92, 1.28, 2.57),
    ("kitchen", "metal 0.9/0.6/0.2"): (0.89, 2.47, 2.13, 1.84, 1.93, 1.31, 2.35),
    ("kitchen", "dielectric 0/0/0"): (1.08, 3.28, 3.45, 2.23, 2.41, 1.69, 1.44),
    ("kitchen", "dielectric 0.8/0.8/0.8"): (0.81, 0.86, 0.83, 0.78, 0.87, 1.06, 1.58),
    ("kitchen", "dielectric 0.1/0.3/0.7"): (0.85, 1.06, 1.04, 0.89, 0.98, 1.12, 1.67),
    ("city", "metal 0.95/0.95/0.95"): (0.49, 1.59, 1.17, 1.56, 2.01, 1.71, 3.14),
    ("city", "metal 0.9/0.6/0.2"): (0.55, 1.73, 1.28, 1.63, 2.15, 1.85, 2.94),
    ("city", "dielectric 0/0/0"): (0.81, 2.39, 2.18, 1.66, 2.04, 1.62, 2.49),
    ("city", "dielectric 0.8/0.8/0.8"): (0.92, 0.86, 0.70, 0.65, 0.79, 1.16, 1.94),
    ("city", "dielectric 0.1/0.3/0.7"): (0.84, 0.87, 0.70, 0.64, 0.80, 1.14, 1.94),
}
_FACTOR, _MORE = 1.15, 0.001  # the margin; to it comes the noise of the truth that a run compares with


def bound(shape: str, environment: str, material: str, roughness: float) -> float | None:
    """Return the largest error of split-sum on a sphere, without the ground truth's noise; None for other shapes, which
    reflect themselves.

    Between roughnesses that were measured it is interpolated; in an environment that was not, it is that of the worst.
    """
    if shape != "sphere":
        return None
    rows = [
        np.interp(roughness, ROUGHNESS, row)
        for (name, of), row in MEASURED.items()
        if of == material and (name == environment or (environment, of) not in MEASURED)
    ]
    return _FACTOR * max(rows) / 100 + _MORE

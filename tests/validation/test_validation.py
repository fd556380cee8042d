"""Cross-validation: it passes as it should, and fails where an estimator or a bound is wrong."""

import csv
import subprocess
import sys

import mitsuba as mi
import numpy as np
import pytest

from rgs_mi.core.errors import UserError
from rgs_mi.shading import split_sum
from rgs_mi.shading.monte_carlo import MonteCarlo, SpecularLobe
from rgs_mi.validation import bounds, cases, checks
from rgs_mi.validation.cases import Case, Validator, grid

from runs import ROOT

METAL = Case("sphere", "kitchen", 0.3, 1.0, (0.9, 0.6, 0.2))
PLASTIC = Case("sphere", "kitchen", 0.2, 0.0, (0.1, 0.3, 0.7))


@pytest.mark.parametrize(
    "case",
    [METAL, PLASTIC, Case("sphere", "kitchen", 0.02, 0.0, (0, 0, 0)), Case("toaster", "kitchen", 0.3, 1.0, (0.9, 0.6, 0.2))],
)
def test_monte_carlo_equals_path(case):
    """Specular and diffuse; the toaster, whose slots are dark, with the rays of its own scene."""
    result = Validator(16, 64).run(case)
    assert result.difference.equal
    assert len(result.pixels) > 40 and result.picture(result.truth).shape == (16, 16, 3)


def test_split_sum_is_within_bounds():
    for case in (METAL, PLASTIC):
        result = Validator(16, 256).run(case)
        assert 0 < result.error < result.bound and result.failures() == []


def test_a_tap_too_heavy_is_found(monkeypatch):
    """By a twentieth, in the lookups of split-sum."""
    right = split_sum.taps
    monkeypatch.setattr(split_sum, "taps", lambda *arguments: [(a, r, 1.05 * w) for a, r, w in right(*arguments)])
    (failure,) = Validator(16, 128).run(METAL).failures()
    assert failure.startswith("split_sum is off by")


def test_bounds():
    """Each case of the default run has its own; between roughnesses they are interpolated, elsewhere the worst holds."""
    assert {(c.environment, c.material) for c in grid()} == set(bounds.MEASURED)
    assert all(len(row) == len(bounds.ROUGHNESS) for row in bounds.MEASURED.values())
    words = "dielectric 0/0/0"
    values = [bounds.bound("sphere", "studio", words, r) for r in (0.1, 0.15, 0.2)]
    assert values[0] > values[1] > values[2] and 0.0427 < values[0] < 1.2 * 0.0427 + 0.001
    assert bounds.bound("sphere", "outdoors", words, 0.1) == values[0]
    assert bounds.bound("helmet", "studio", words, 0.1) is None


@pytest.mark.parametrize("factor", [0.97, 1.03])
def test_a_small_bias_is_found(monkeypatch, factor):
    unbiased = MonteCarlo.specular
    monkeypatch.setattr(MonteCarlo, "specular", lambda *arguments: unbiased(*arguments) * factor)
    result = Validator(16, 256).run(METAL)
    assert any("standard errors over all pixels" in words for words in result.failures())


def test_a_wrong_lobe_is_found(monkeypatch):
    """Sampled more widely than its density says."""
    sample = SpecularLobe.sample

    def wide(self, si, choice, point):
        self.roughness = self.roughness * 1.1
        return sample(self, si, choice, point)

    monkeypatch.setattr(SpecularLobe, "sample", wide)
    result = Validator(16, 128).run(METAL)
    assert not result.difference.equal
    assert not next(c for c in checks.checks((0.3,), 1 << 10) if c.name.startswith("χ²")).passed


def test_checks_pass():
    found = checks.checks((0.3,), 1 << 16)
    assert len(found) > 10 and not [c for c in found if not c.passed]


def test_grid():
    whole = grid(("sphere", "helmet"), ("studio",), (0.1, 0.5))
    assert len(whole) == len({c.name for c in whole}) == 2 * 2 * (len(cases.METALS) + len(cases.DIELECTRICS))
    for arguments, words in [
        ((["spher"],), "unknown model 'spher'"),
        ((["sphere"], ["moon"]), "unknown environment 'moon'"),
        ((["sphere"], ["studio"], [1.5]), "roughness is 1.5"),
    ]:
        with pytest.raises(UserError, match=words):
            grid(*arguments)
    with pytest.raises(UserError, match="too few"):
        Validator(64, 1)


def test_script(tmp_path):
    """A page, a table and maps; 1 where a bound is broken, as by so few samples it may be."""
    command = [
        sys.executable,
        ROOT / "scripts" / "crossvalidate.py",
        "--environments",
        "kitchen",
        "--roughness",
        "0.02",
        "--size",
        "12",
        "--samples",
        "4",
        "--out",
        tmp_path / "out",
        "--quiet",
    ]
    run = subprocess.run(command, capture_output=True, text=True)
    assert run.returncode in (0, 1) and "Traceback" not in run.stderr
    assert (run.returncode == 1) == bool(run.stderr.strip()), run.stderr
    with open(tmp_path / "out" / "cases.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == len(cases.METALS) + len(cases.DIELECTRICS) and {r["environment"] for r in rows} == {"kitchen"}
    assert (run.returncode == 1) == any(r["verdict"] != "passes" for r in rows)
    page = (tmp_path / "out" / "crossvalidation.html").read_text()
    assert page.count("<img") == len(rows) and page.count("<svg") == 1 and "://" not in page
    maps = mi.Bitmap(str(next((tmp_path / "out").glob("*.exr"))))
    names = [field.name for field in maps.struct_()]
    assert {"path.R", "monte_carlo.G", "split_sum.B", "z.R"} <= set(names) and np.isfinite(np.array(maps)).all()

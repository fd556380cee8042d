"""Mistakes that someone could make, one at a time in a copy of the package, and which tests see them.

``python tests/mutations.py [NAME ...]`` prints for each mutation what failed; it ends with 1 where none did. Each takes about a
minute on two cores. A mutation is a piece of text, which a file must hold once, and what stands there instead.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
TESTS = [
    "tests/test_quality.py",
    "tests/splat/test_splat.py",
    "tests/shading/test_split_sum.py",
    "tests/fit/test_losses.py",
    "tests/fit/test_density.py",
    "tests/validation/test_validation.py::test_split_sum_is_within_bounds",
]
MUTATIONS = {
    "a term of the hit's derivative": ("splat/hit.py", "d_h = -(d_u * self.u + d_v", "d_h = (d_u * self.u + d_v"),
    "levels of the prefilter": (
        "shading/environment.py",
        "position - mi.Float(level),\n",
        "1 - position + mi.Float(level),\n",
    ),
    "the light turned by 90°": (
        "shading/environment.py",
        "longitude -= dr.floor(longitude)",
        "longitude -= 0.25",
    ),
    "a tap's weight": ("shading/split_sum.py", "incoming += w *", "incoming += 1.05 * w *"),
    "Fresnel's term of metals": (
        "shading/split_sum.py",
        "base_color * (white - black) + black",
        "base_color * (white - black)",
    ),
    "depth-normal consistency": ("fit/losses.py", "1 - dr.dot(n, n_depth)", "1 + dr.dot(n, n_depth)"),
    "lists that end too early": ("splat/intersect.py", "_HIDDEN = 0.1", "_HIDDEN = 30.0"),
    "D-SSIM": ("fit/losses.py", "dssim * (1 - ssim(", "dssim * (1 + ssim("),
    "the mask's loss": ("fit/losses.py", "dr.mean(dr.abs(alpha - target))", "-dr.mean(dr.abs(alpha - target))"),
    "moments of kept surfels": ("fit/model.py", "reshape(value.shape)[index] *", "reshape(value.shape)[index[::-1]] *"),
    "gradients in pixels": ("fit/density.py", "gradient.x * (size[0] / 2)", "gradient.x"),
}


def run(name: str) -> str:
    """The tests that fail with the mutation ``name``, in words; none: ''."""
    file, old, new = MUTATIONS[name]
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for part in ("rgs_mi", "tests", "scenes", "scripts"):
            shutil.copytree(ROOT / part, copy / part, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copytree(ROOT / "plugins", copy / "rgs_mi" / "plugins", ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(ROOT / "pyproject.toml", copy)
        text = (copy / "rgs_mi" / file).read_text()
        assert text.count(old) == 1, f"{file} has {old!r} {text.count(old)} times"
        (copy / "rgs_mi" / file).write_text(text.replace(old, new))
        environment = os.environ | {"PYTHONPATH": folder}
        where = "import rgs_mi; print(rgs_mi.__file__)"
        found = subprocess.run(
            [sys.executable, "-c", where], cwd=copy, env=environment, capture_output=True, text=True
        ).stdout
        assert found.startswith(folder), f"the package is imported from {found}"
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *TESTS]
        output = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True).stdout
    assert re.search(r"\d+ (passed|failed)", output), output
    return ", ".join(dict.fromkeys(re.findall(r"^(?:FAILED|ERROR) \S+::(\w+)", output, re.MULTILINE)))


def main(*names):
    survived = 0
    for name in names or MUTATIONS:
        failed = run(name)
        survived += not failed
        print(f"{name}: {failed or 'SURVIVED'}", flush=True)
    sys.exit(bool(survived))


if __name__ == "__main__":
    main(*sys.argv[1:])

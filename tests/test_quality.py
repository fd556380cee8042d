"""How well a short fit does, against what it did with other seeds: a loss of the wrong sign or a gradient that has lost a term
need not break anything, but it shows here.

Two balls that reflect each other are fitted by everything that a fit has: the carved hull, split-sum, one bounce, all losses, a
light that is learned, density control. ``python tests/test_quality.py [SEED ...]`` prints the figures of seeds.
"""

import json
import sys
import tempfile
from pathlib import Path

import numpy as np

import rgs_mi

from runs import ROOT

SCENE = """<scene version="3.0.0">
    <integrator type="path"> <boolean name="hide_emitters" value="true"/> </integrator>
    <emitter type="procedural_envmap"> <string name="name" value="kitchen"/> <integer name="height" value="64"/>
        <transform name="to_world"> <rotate x="1" angle="90"/> </transform> </emitter>
    <shape type="sphere"> <point name="center" x="-0.2" y="0" z="0"/> <float name="radius" value="0.7"/>
        <bsdf type="principled"> <rgb name="base_color" value="0.9, 0.7, 0.4"/> <float name="metallic" value="1"/>
            <float name="roughness" value="0.12"/> </bsdf> </shape>
    <shape type="sphere"> <point name="center" x="0.7" y="0.3" z="-0.1"/> <float name="radius" value="0.35"/>
        <bsdf type="principled"> <rgb name="base_color" value="0.2, 0.4, 0.7"/> <float name="metallic" value="0"/>
            <float name="roughness" value="0.3"/> </bsdf> </shape>
</scene>"""
SETTINGS = [
    "iterations=240",
    "initialization.surfels=1500",
    "density.max_surfels=2500",
    "density.refine_every=40",
    "sh_order=1",
    "spp=1",
    "checkpoint_seconds=1000",
]
SEED = 0
#: Mean and standard deviation of eight seeds, 0 to 7. They lay within 30.22 to 30.53 dB, and within 2.49° to 2.58°; before
#: photographs were seen through their film their means were 29.59 dB and 2.79°.
MEASURED = {"psnr": (30.39, 0.13), "normal_mae_deg": (2.541, 0.030)}
MARGIN = 2.7  # standard deviations. A change for the better is to be recorded, too


def test_a_short_fit_is_as_good_as_it_was(tmp_path):
    figures = measure(make(tmp_path), tmp_path, SEED)
    for name, (mean, spread) in MEASURED.items():
        assert abs(figures[name] - mean) < MARGIN * spread, f"{name} is {figures[name]:.3f}: {mean} ± {MARGIN} × {spread}"
    assert figures["surfels"] > 1500  # density control was at work


def make(folder: Path):
    """(scene to fit, its photographs), written into ``folder``."""
    from rgs_mi.datasets.path_traced import render_dataset

    (folder / "balls.xml").write_text(SCENE)
    data = render_dataset(folder / "balls.xml", folder / "balls", train=24, test=6, size=72, spp=16, quiet=True)
    text = (ROOT / "scenes" / "object.xml").read_text()
    (folder / "object.xml").write_text(text.replace('name="height" value="256"', 'name="height" value="32"'))
    return folder / "object.xml", data


def measure(inputs, folder: Path, seed: int) -> dict:
    """The figures of a fit, of held-out views."""
    from rgs_mi.commands.optimize import optimize

    scene, data = inputs
    run = optimize(scene, data=data, out=folder / f"seed_{seed}", overrides=SETTINGS, seed=seed, quiet=True)
    return json.loads((run / "metrics.json").read_text())


def main(*seeds):
    rgs_mi.set_variant("llvm_ad_rgb")
    with tempfile.TemporaryDirectory() as name:
        folder, found = Path(name), []
        inputs = make(folder)
        for seed in map(int, seeds or range(8)):
            f = measure(inputs, folder, seed)
            found.append((f["psnr"], f["normal_mae_deg"]))
            print(
                f"seed {seed}: PSNR {f['psnr']:.3f}, normals {f['normal_mae_deg']:.3f}°, {f['surfels']} surfels, "
                f"{f['train_seconds']:.0f} s",
                flush=True,
            )
        for k, name in enumerate(MEASURED):
            values = np.array(found)[:, k]
            print(f"{name}: {values.mean():.4g} ± {values.std(ddof=1):.2g}, {values.min():.4g} to {values.max():.4g}")


if __name__ == "__main__":
    main(*sys.argv[1:])

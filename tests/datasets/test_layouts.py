"""A fit of a few steps runs through on a small capture in every layout."""

import json
from contextlib import nullcontext

import mitsuba as mi
import numpy as np
import pytest

from rgs_mi.commands.optimize import optimize
from rgs_mi.datasets import load_dataset
from rgs_mi.fit.scene import FitScene

from captures import (
    FOCAL,
    POINTS,
    PRINCIPAL,
    photographs,
    poses,
    write_blender,
    write_cloud,
    write_colmap,
    write_llff,
    write_nerfstudio,
    write_nero,
)

FEW = [
    "iterations=30",
    "initialization.surfels=300",
    "initialization.surroundings=600",
    "stages=[{views: 2}]",
    "indirect_start=0",
]


def nero_with_masks(folder):
    """A ball of radius 1.3 around the dots."""
    depths = []
    for pose in poses():
        x, y = np.meshgrid((np.arange(120) + 0.5 - PRINCIPAL[0]) / FOCAL[0], (np.arange(96) + 0.5 - PRINCIPAL[1]) / FOCAL[1])
        rays = np.stack([x, y, np.ones_like(x)], -1) @ pose[:3, :3].T
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        off = np.linalg.norm(np.cross(pose[:3, 3], rays), axis=-1)
        depths.append(np.where(off < 1.3, 4.0, 15.0))
    return write_nero(folder, photographs(), depths)


LAYOUTS = {
    "blender": lambda folder: write_blender(folder, photographs()),
    "nerfstudio": lambda folder: write_nerfstudio(folder, photographs(k1=-0.1), camera_model="OPENCV", k1=-0.1),
    "colmap": lambda folder: write_colmap(folder, photographs(k1=0.1), "SIMPLE_RADIAL", (95, *PRINCIPAL, 0.1)),
    "llff": lambda folder: write_llff(folder, photographs()),
    "nero": nero_with_masks,
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_fit(inputs, tmp_path, monkeypatch, layout):
    monkeypatch.chdir(tmp_path)
    (tmp_path / layout).mkdir()
    data = LAYOUTS[layout](tmp_path / layout)
    if layout == "blender":
        write_cloud(data / "points3d.ply")
    square = nullcontext() if layout in ("colmap", "llff") else pytest.warns(UserWarning, match="pixels are not square")
    with square:
        folder = optimize(inputs[0], data=data, out=tmp_path / "run", overrides=FEW, quiet=True)
    figures = json.loads((folder / "metrics.json").read_text())
    assert figures["finished"] and figures["iterations"] == 30 and figures["psnr"] > 10
    assert figures["train_views"] + figures["test_views"] == 9
    scene = mi.load_file(str(folder / "scene.xml"), parallel=False)
    centers = mi.traverse(scene)["object.centers"].numpy()
    if layout == "nero":  # its masks make a hull, and no surroundings
        assert scene.integrator().box is None and np.linalg.norm(centers, axis=1).max() < 12
    else:
        box = scene.integrator().box
        assert all((np.array(box.min) < p).all() and (p < box.max).all() for p in POINTS)
        assert np.linalg.norm(centers, axis=1).max() > 20
    assert (folder / "report.html").stat().st_size > 10_000
    assert np.isfinite(np.array(mi.render(scene, sensor=0))).all()


@pytest.mark.parametrize("layout", LAYOUTS)
def test_photographs_have_settings_of_their_own(inputs, tmp_path, layout):
    (tmp_path / layout).mkdir()
    data, photographed = LAYOUTS[layout](tmp_path / layout), layout in ("nerfstudio", "colmap", "llff")
    scene = FitScene.load(inputs[0], data)
    assert load_dataset(data).photographed == photographed
    settings = scene.settings()
    assert (settings.cameras == settings.exposure == "learned") == photographed
    assert scene.settings(overrides=["cameras=fixed"]).cameras == "fixed"
    assert scene.settings("sh2dgs").learning_rates.delta_normal == (0, 0)

"""Which captures look like a turntable's."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rgs_mi.core.camera import Camera
from rgs_mi.datasets.path_traced import test_directions as spiral
from rgs_mi.datasets.path_traced import train_directions
from rgs_mi.datasets.types import View
from rgs_mi.priors.turntable import background_stands_still, rings

WORLD = Rotation.from_euler("xyz", [25, -40, 10], degrees=True).as_matrix()  # no axis of it is up
CENTER = np.array([3.0, -1.0, 2.0])


def looking(directions, jitter=0.0, seed=0):
    """Cameras that look at `CENTER` from these directions, off by ``jitter`` degrees."""
    rng, cameras = np.random.default_rng(seed), []
    for d in directions:
        camera = Camera.look_at(CENTER + 4 * WORLD @ d, CENTER, WORLD[:, 2], 40, (64, 64))
        to_world = camera.to_world.copy()
        to_world[:3, :3] = to_world[:3, :3] @ Rotation.from_rotvec(np.radians(jitter * rng.normal(size=3))).as_matrix()
        to_world[:3, 3] += 4 * np.radians(jitter) * rng.normal(size=3)
        cameras.append(Camera(to_world, camera.focal, camera.principal, camera.size))
    return cameras


def on_rings(*elevations, count=20, spread=0.0):
    rng = np.random.default_rng(1)
    for k, elevation in enumerate(elevations):
        for azimuth in 2 * np.pi * (np.arange(count) + k / 3) / count:
            e = np.radians(elevation + spread * rng.normal())
            yield np.array([np.cos(e) * np.cos(azimuth), np.cos(e) * np.sin(azimuth), np.sin(e)])


@pytest.mark.parametrize("jitter", [0, 0.2])
@pytest.mark.parametrize("elevations", [(20,), (10, 35), (-5, 20, 60)])
def test_rings_are_found(elevations, jitter):
    table = rings(looking(on_rings(*elevations), jitter))
    assert table is not None
    assert np.degrees(np.arccos(min(1, np.dot(table.axis, WORLD[:, 2])))) < 0.01 + jitter
    away = CENTER - np.array(table.point)
    assert np.linalg.norm(away - np.dot(away, table.axis) * np.array(table.axis)) < 0.001 + 0.1 * jitter
    assert np.allclose([e for e, _ in table.rings], elevations, atol=0.1 + jitter)


def test_a_few_that_are_elsewhere_change_nothing():
    directions = [*on_rings(15, 40), *train_directions(3)]
    table = rings(looking(directions))
    assert table is not None and len(table.rings) == 2


@pytest.mark.parametrize(
    "directions",
    [train_directions(60), train_directions(300), spiral(20), spiral(200), list(on_rings(20, count=60, spread=3))],
    ids=["lattice", "many", "spiral", "long spiral", "by hand"],
)
def test_other_captures_are_none(directions):
    assert rings(looking(directions)) is None


def photographs(still, textured=True, masked=True):
    """Photographs of one ring: a disc, before a pattern that stands still or goes round."""
    rng = np.random.default_rng(0)
    pattern = (
        np.uint8(np.kron(rng.integers(40, 220, (8, 32)), np.ones((8, 8)))) if textured else np.zeros((64, 256), np.uint8)
    )
    y, x = np.mgrid[:64, :64] - 31.5
    disc, views = x**2 + y**2 < 20**2, []
    for k, camera in enumerate(looking(on_rings(20))):
        shift = 0 if still else 256 * k // 20
        grey = np.where(disc, rng.integers(0, 255), np.roll(pattern, -shift, 1)[:, :64])
        alpha = np.where(disc, 255, 0) if masked else np.full((64, 64), 255)
        views.append(View(f"{k}", camera, np.uint8(np.dstack([grey, grey, grey, alpha])), masked, None, Path(f"{k}.png")))
    return views


@pytest.mark.parametrize("masked", [True, False])
def test_backgrounds_tell(masked):
    table = rings([view.camera for view in photographs(True)])
    assert background_stands_still(photographs(True, masked=masked), table) is True
    assert background_stands_still(photographs(False, masked=masked), table) is False
    assert background_stands_still(photographs(True, textured=False, masked=masked), table) is None

"""The world of a reconstruction: up, middle and unit."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rgs_mi.core.alignment import Similarity
from rgs_mi.core.camera import Camera
from rgs_mi.datasets.types import Dataset, View
from rgs_mi.datasets.world_frame import DISTANCE, recentred, world_frame

SCRAMBLE = Similarity(0.3, Rotation.from_rotvec([2.0, 0.3, -1.0]).as_matrix(), np.array([5.0, 2.0, -9.0]))


def moved(camera, similarity):
    return Camera(similarity.pose(camera.to_world), camera.focal, camera.principal, camera.size)


def rings(azimuths, elevations, roll=0.0, center=(0.5, -0.2, 0.3)):
    """Cameras on rings about ``center``, rolled at random by ``roll`` degrees."""
    rng, cameras = np.random.default_rng(0), []
    for elevation in elevations:
        for azimuth in azimuths:
            a, e = np.radians([azimuth, elevation])
            away = 3 * np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
            camera = Camera.look_at(away + center, center, (0, 0, 1), 50, (80, 60))
            turn = np.eye(4)
            turn[:3, :3] = Rotation.from_rotvec([0, 0, np.radians(roll) * rng.normal()]).as_matrix()
            cameras.append(Camera(camera.to_world @ turn, camera.focal, camera.principal, camera.size))
    return cameras


@pytest.mark.parametrize(
    "azimuths, elevations, roll, tolerance",
    [
        (range(0, 360, 20), (10, 40), 0, 0.1),
        (range(0, 120, 8), (50,), 0, 2),  # from above, a third of the way around: their own up leans by 30 degrees
        (range(0, 360, 20), (20,), 3, 3),
        ([0, 1, 2, 3], (0, 10), 0, 6),  # all look the same way
    ],
)
def test_up_middle_and_unit(azimuths, elevations, roll, tolerance):
    cameras = [moved(camera, SCRAMBLE) for camera in rings(azimuths, elevations, roll)]
    frame = world_frame(cameras)
    up = frame.rotation @ SCRAMBLE.rotation @ [0, 0, 1]
    assert np.degrees(np.arccos(up[2])) < tolerance
    assert np.linalg.det(frame.rotation) > 0.999
    middle = frame.points(SCRAMBLE.points(np.array([0.5, -0.2, 0.3])))
    np.testing.assert_allclose(middle, 0, atol=1e-3)
    distances = [np.linalg.norm(moved(camera, frame).origin) for camera in cameras]
    np.testing.assert_allclose(np.median(distances), DISTANCE, rtol=1e-3)


def test_straight_from_above():
    """The first camera has no azimuth, and its own up is all there is of an azimuth."""
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), 50, (80, 60))
    frame = world_frame([camera, Camera.look_at((0.5, 0, 3), (0, 0, 0), (0, 1, 0), 50, (80, 60))])
    assert np.isfinite(frame.rotation).all() and np.isfinite(frame.scale)
    np.testing.assert_allclose(frame.rotation @ frame.rotation.T, np.eye(3), atol=1e-12)


# ---- Far from the origin ----


def capture(cameras, points):
    views = [
        View(f"v{i}", camera, np.full((60, 80, 4), 255, np.uint8), False, None, Path()) for i, camera in enumerate(cameras)
    ]
    return Dataset(views[1:], views[:1], points=points)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_a_world_that_is_far_away_is_moved_near(scale):
    """By whole units, so that what is told can be typed; what is seen, and points, stay where they were."""
    there = Similarity(scale, np.eye(3), scale * np.array([1e5, -3e6, 20.0]))
    near, points = rings(range(0, 360, 30), (10, 40)), np.random.default_rng(0).normal(size=(20, 3))
    far = capture([moved(camera, there) for camera in near], there.points(points))
    found = recentred(far)
    assert np.linalg.norm(found.points, axis=1).max() < 10 * scale and np.allclose(
        found.origin, there.translation, atol=2 * scale
    )
    np.testing.assert_allclose(found.points + found.origin, far.points, rtol=1e-12)
    units = np.array(found.origin) / (scale if scale != 1 else 1)
    np.testing.assert_allclose(units, np.round(units), atol=1e-6)
    for view, given in zip(found.train + found.test, far.train + far.test):
        assert np.allclose(view.camera.origin + found.origin, given.camera.origin, rtol=1e-12) and view.name == given.name
        seen, expected = (c.project(p)[0] for c, p in ((view.camera, found.points), (given.camera, far.points)))
        np.testing.assert_allclose(seen, expected, atol=1e-4)
    assert recentred(found) is found


def test_a_world_that_is_near_stays():
    cameras = [
        moved(camera, Similarity(1.0, np.eye(3), np.array([100.0, 50, 0]))) for camera in rings(range(0, 360, 30), (10,))
    ]
    assert recentred(dataset := capture(cameras, None)) is dataset and dataset.origin == (0, 0, 0)


def test_one_camera_tells_no_distance():
    assert recentred(dataset := capture(rings([30], (10,)) * 2, None)) is dataset

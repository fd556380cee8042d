"""The plane that an object stands on."""

import numpy as np
import pytest

from rgs_mi.core.bounding_box import BoundingBox
from rgs_mi.core.camera import Camera
from rgs_mi.priors.ground import Plane, ground

BOX = BoundingBox((-1, -1, -1), (1, 1, 1))
UP = np.array([0.3, -0.2, 0.9]) / np.linalg.norm([0.3, -0.2, 0.9])
BELOW = 0.8  # of the plane, from the middle of the box


def cameras(up):
    """Cameras around the box, on one side of a plane across ``up``."""
    beside = np.cross(up, [0, 1, 0])
    beside /= np.linalg.norm(beside)
    across = np.cross(up, beside)
    around = [np.cos(a) * beside + np.sin(a) * across for a in np.arange(8) * np.pi / 4]
    return [Camera.look_at(4 * (d + 0.5 * up), (0, 0, 0), up, 40, (32, 32)) for d in around]


def scattered(count, rng):
    """Points of the object, and normals of all directions."""
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return 0.6 * normals, normals


def on_plane(count, rng, noise=0.004):
    """Points of a plane 0.8 below the middle of the box, with normals that are some degrees off."""
    points = 1.5 * rng.normal(size=(count, 3))
    points += (rng.normal(0, noise, count) - BELOW - points @ UP)[:, None] * UP
    normals = UP + rng.normal(0, 0.1, (count, 3))
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def test_the_plane_below_an_object_is_found():
    rng = np.random.default_rng(0)
    points, normals = (np.concatenate(pair) for pair in zip(scattered(2000, rng), on_plane(1000, rng)))
    plane = ground(points, normals, BOX, cameras(UP), rng)
    assert plane is not None
    assert np.degrees(np.arccos(plane.normal @ UP)) < 0.2
    assert plane.offset == pytest.approx(-BELOW, abs=2e-3)
    assert np.abs(plane.height(points[2000:])).max() < 0.03


def test_heights_are_above_the_plane():
    np.testing.assert_allclose(Plane(UP, -BELOW).height(np.array([[0, 0, 0], -UP, UP])), [0.8, -0.2, 1.8])


def test_a_ceiling_a_far_wall_and_an_object_alone_are_no_ground():
    rng = np.random.default_rng(0)
    thing, floor = scattered(2000, rng), on_plane(1000, rng)
    together = [np.concatenate(pair) for pair in zip(thing, floor)]
    assert ground(*together, BOX, cameras(-UP), rng) is None  # seen from below
    assert ground(*thing, BOX, cameras(UP), rng) is None
    far = [np.concatenate(pair) for pair in zip(thing, (floor[0] - 0.5 * UP, floor[1]))]
    assert ground(*far, BOX, cameras(UP), rng) is None  # 1.3 below the middle, and the box ends at 1
    assert ground(np.zeros((0, 3)), np.zeros((0, 3)), BOX, cameras(UP), rng) is None

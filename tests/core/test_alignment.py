"""The similarity of points and of cameras."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rgs_mi.core.alignment import pose_errors, similarity

from scenes import orbit_camera

TURN = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix()


def test_a_similarity_is_found():
    source = np.random.default_rng(0).normal(size=(9, 3))
    found = similarity(source, 1.7 * source @ TURN.T + [1, 2, 3])
    assert np.isclose(found.scale, 1.7) and np.allclose(found.rotation, TURN) and np.allclose(found.translation, [1, 2, 3])
    assert np.allclose(found(source), 1.7 * source @ TURN.T + [1, 2, 3])


def test_no_mirror_image():
    source = np.random.default_rng(0).normal(size=(9, 3))
    assert np.isclose(np.linalg.det(similarity(source, source * [1, 1, -1]).rotation), 1)


@pytest.mark.parametrize("points", [np.zeros((2, 3)), np.ones((5, 3))])
def test_too_little(points):
    with pytest.raises(ValueError, match="three points"):
        similarity(points, points)


def test_errors_of_poses_know_no_world():
    truth = [orbit_camera(a, distance=4 + 0.3 * a) for a in range(6)]

    def elsewhere(camera):
        to_world = np.eye(4)
        to_world[:3, :3], to_world[:3, 3] = TURN @ camera.to_world[:3, :3], 2 * TURN @ camera.origin + 1
        return replace(camera, to_world=to_world)

    cameras = [elsewhere(c) for c in truth]
    assert np.allclose([*pose_errors(cameras, truth, 4.0)], 0, atol=1e-5)
    turned = cameras[2].to_world.copy()
    turned[:3, :3] = turned[:3, :3] @ Rotation.from_rotvec([0, 0, np.radians(1)]).as_matrix()
    cameras[2] = replace(cameras[2], to_world=turned)
    rotation, position = pose_errors(cameras, truth, 4.0)
    assert np.isclose(rotation[2], 1) and np.allclose(np.delete(rotation, 2), 0, atol=1e-5) and position.max() < 1e-8

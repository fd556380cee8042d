"""Similarities found again, and what they make of cameras."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rgs_mi.core.alignment import Similarity, pose_errors, similarity
from rgs_mi.core.camera import Camera

RNG = np.random.default_rng(3)
MAP = Similarity(2.5, Rotation.from_rotvec([0.4, -1.9, 0.7]).as_matrix(), np.array([3.0, -1.0, 8.0]))


def cameras(count=12):
    return [Camera.look_at(p, (0, 0, 0), (0, 0, 1), 40, (8, 6)) for p in RNG.normal(size=(count, 3)) * 3 + 1]


def moved(camera, similarity):
    return Camera(similarity.pose(camera.to_world), camera.focal, camera.principal, camera.size)


def test_a_similarity_is_found():
    points = RNG.normal(size=(20, 3))
    found = similarity(points, MAP.points(points))
    np.testing.assert_allclose(found.scale, MAP.scale, rtol=1e-12)
    np.testing.assert_allclose(found.rotation, MAP.rotation, atol=1e-12)
    np.testing.assert_allclose(found.translation, MAP.translation, atol=1e-11)


def test_nothing_near_it_is_nearer():
    points = RNG.normal(size=(30, 3))
    target = MAP.points(points) + 0.3 * RNG.normal(size=points.shape)
    found = similarity(points, target)
    error = lambda m: ((m.points(points) - target) ** 2).sum()
    for _ in range(50):
        turn = Rotation.from_rotvec(0.02 * RNG.normal(size=3)).as_matrix()
        other = Similarity(
            found.scale * (1 + 0.02 * RNG.normal()), turn @ found.rotation, found.translation + 0.02 * RNG.normal(size=3)
        )
        assert error(other) > error(found)


def test_mirror_images_and_flat_points():
    """The nearest rotation to a reflection is a rotation; points of a plane are enough."""
    points = RNG.normal(size=(20, 3))
    assert np.linalg.det(similarity(points, points * [1, 1, -1]).rotation) > 0.99
    flat = points * [1, 1, 0]
    np.testing.assert_allclose(similarity(flat, MAP.points(flat)).rotation, MAP.rotation, atol=1e-12)


@pytest.mark.parametrize("a, b", [((3, 3), (4, 3)), ((3, 2), (3, 2)), ((0, 3), (0, 3)), ((3,), (3,))])
def test_shapes(a, b):
    with pytest.raises(ValueError, match="both must be"):
        similarity(np.ones(a), np.ones(b))


def test_one_place():
    with pytest.raises(ValueError, match="are one"):
        similarity(np.ones((3, 3)), np.zeros((3, 3)))


def test_errors_of_poses():
    references = cameras()
    turned = []
    for camera in references:
        pose = camera.to_world.copy()
        axis = RNG.normal(size=3)
        pose[:3, :3] = Rotation.from_rotvec(np.radians(0.25) * axis / np.linalg.norm(axis)).as_matrix() @ pose[:3, :3]
        turned.append(Camera(pose, camera.focal, camera.principal, camera.size))
    angles, distances = pose_errors([moved(camera, MAP) for camera in turned], references)
    np.testing.assert_allclose(angles, 0.25, rtol=1e-6)
    np.testing.assert_allclose(distances, 0, atol=1e-9)
    assert max(pose_errors(references, references)[0]) < 1e-6

"""Lenses and learned cameras: their formulas in other words, NumPy and Dr.Jit twins, and what they are invariant under."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rgs_mi.core.camera import opaque, pixel_rays
from rgs_mi.core.learned_camera import INTRINSICS, POSE, correction, learned_camera, lens_reach
from rgs_mi.core.lens import Lens

from captures import distort
from scenes import orbit_camera

LENS = dict(k1=-0.2, k2=0.1, p1=0.01, p2=-0.02)
PIVOT = np.array([0.1, -0.2, 0.3])


def corrected(camera, pose=(0,) * 6, intrinsics=(0,) * 8):
    opaque = lambda numbers: [dr.opaque(mi.Float, float(v)) for v in numbers]
    return replace(camera, learned=learned_camera(camera, PIVOT, opaque(pose), opaque(intrinsics)))


def grid(n=21, half=0.6):
    x, y = np.meshgrid(np.linspace(-half, half, n), np.linspace(-half, half, n))
    return x.ravel(), y.ravel()


def test_lens_is_that_of_opencv():
    x, y = grid()
    assert np.allclose(Lens(**LENS).distort(x, y), distort(np.stack([x, y], -1), **LENS).T)


def test_jacobian_and_inverse():
    lens, (x, y) = Lens(**LENS), grid()
    shown = lens.distort(x, y)
    assert np.allclose(lens.undistort(*shown), (x, y), atol=1e-4)
    h = 1e-6
    across = (np.array(lens.distort(x + h, y)) - lens.distort(x - h, y)) / (2 * h)
    down = (np.array(lens.distort(x, y + h)) - lens.distort(x, y - h)) / (2 * h)
    xx, xy, yy = lens.jacobian(x, y)
    assert np.allclose([xx, xy, xy, yy], [*across, *down], atol=1e-7)


def test_what_is_far_off_the_picture_stays_there():
    """Polynomials would bring it back."""
    x, y = np.linspace(1.0, 50, 99), np.linspace(0.0, 30, 99)
    u, v = Lens(**LENS, reach=0.8).distort(x, y)
    assert (np.diff(np.hypot(u, v)) > 0).all() and (np.hypot(u, v) > 0.6).all()


def test_twins_of_numpy_and_drjit_agree():
    camera = replace(orbit_camera(1.0, (30, 20)), lens=Lens(**LENS, reach=0.5))
    rays = camera.rays().reshape(-1, 3)
    assert np.allclose(pixel_rays(camera, dr.arange(mi.UInt32, 600)).numpy().T, rays, atol=1e-5)
    pixels, _ = camera.project(camera.origin + 2.5 * rays)
    centers = np.stack(np.meshgrid(np.arange(30) + 0.5, np.arange(20) + 0.5), -1).reshape(-1, 2)
    assert np.allclose(pixels, centers, atol=1e-3)


def test_nothing_learned_is_the_camera():
    camera = orbit_camera(2.0, (30, 20))
    same = corrected(camera).baked()
    assert np.allclose(same.to_world, camera.to_world, atol=1e-6) and np.allclose(same.rays(), camera.rays(), atol=1e-6)
    assert camera.baked() is camera


def test_pose_turns_the_scene_about_the_pivot():
    """(12) in other words, to the third order of the rotation."""
    camera, pose = orbit_camera(2.0, (30, 20)), np.array([0.03, -0.02, 0.05, 0.01, -0.02, 0.03])
    moved = corrected(camera, pose).baked()
    points = np.random.default_rng(0).normal(size=(50, 3))
    distance = np.linalg.norm(PIVOT - camera.origin)
    turned = (points - PIVOT) @ camera.rotation.T @ Rotation.from_rotvec(pose[:3]).as_matrix().T
    expected = turned + camera.rotation @ (PIVOT - camera.origin) + distance * pose[3:]
    assert np.allclose((points - moved.origin) @ moved.rotation.T, expected, atol=1e-4)
    assert np.allclose(moved.rotation @ moved.rotation.T, np.eye(3), atol=1e-12)


def test_a_correction_is_found_again():
    camera, pose = orbit_camera(2.0, (30, 20)), np.array([0.03, -0.02, 0.05, 0.01, -0.02, 0.03])
    assert np.allclose(correction(camera, corrected(camera, pose).baked(), PIVOT), pose, atol=1e-6)
    assert np.allclose(correction(camera, camera, PIVOT), 0, atol=1e-12)


def test_intrinsics():
    camera = replace(orbit_camera(2.0, (30, 20)), focal=(40.0, 42.0), principal=(14.0, 11.0))
    values = dict(zip(INTRINSICS, (0.01, -0.02, 0.002, 0.003, -0.02, 0.01, 0.005, -0.004)))
    moved, reach = corrected(camera, intrinsics=values.values()).baked(), lens_reach(camera)
    assert np.allclose(moved.focal, [40 * np.exp(0.01), 42 * np.exp(-0.02)])
    assert np.allclose(moved.principal, [14 + 40 * 0.002, 11 + 42 * 0.003])
    expected = [values["k1"] / reach**2, values["k2"] / reach**4, values["p1"] / reach, values["p2"] / reach]
    assert np.allclose(moved.lens.coefficients, expected)
    again = corrected(moved, intrinsics=values.values()).baked()  # what is there is added to
    assert np.allclose(again.lens.coefficients, np.multiply(2, expected)) and np.isclose(again.lens.reach, reach)


@pytest.mark.parametrize("change", [lambda c: c.cropped(3, 5, 12, 10), lambda c: c.resized(60, 40)])
def test_windows_and_sizes_keep_what_is_learned(change):
    camera, rng = orbit_camera(2.0, (30, 20)), np.random.default_rng(1)
    moved = corrected(camera, 0.02 * rng.normal(size=len(POSE)), 0.02 * rng.normal(size=len(INTRINSICS)))
    before, after = change(moved.baked()), change(moved)
    size = after.size[0] * after.size[1]
    rays = pixel_rays(after, dr.arange(mi.UInt32, size)).numpy().T
    assert np.allclose(rays, before.rays().reshape(-1, 3), atol=1e-5)
    assert np.allclose(np.array(opaque(after).origin).ravel(), before.origin, atol=1e-5)

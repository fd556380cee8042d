"""One function takes pixels to rays: its NumPy and Dr.Jit twins agree, with projection and with Mitsuba's sensor."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rgs_mi.core.camera import Camera, focus_point, pixel_directions, pixel_rays

from scenes import orbit_camera

CAMERAS = [
    orbit_camera(1.0, (20, 14)),
    replace(orbit_camera(2.0, (15, 20)), principal=(4.0, 11.5)),
    replace(orbit_camera(0.3, (20, 15)), focal=(30.0, 21.0)),
]


@pytest.mark.parametrize("camera", CAMERAS)
def test_rays_of_numpy_and_drjit_agree(camera):
    width, height = camera.size
    rays = camera.rays().reshape(-1, 3)
    index = dr.arange(mi.UInt32, width * height)
    assert np.allclose(pixel_rays(camera, index).numpy().T, rays, atol=1e-5)
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    assert np.allclose(pixel_directions(camera, index).numpy().T, unit, atol=1e-6)


@pytest.mark.parametrize("camera", CAMERAS)
def test_rays_are_the_inverse_of_projection(camera):
    depth = np.random.default_rng(0).uniform(0.5, 5, camera.size[::-1])
    pixels, z = camera.project((camera.origin + depth[..., None] * camera.rays()).reshape(-1, 3))
    centers = np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in camera.size)), -1)
    assert np.allclose(pixels, centers.reshape(-1, 2)) and np.allclose(z, depth.ravel())


@pytest.mark.parametrize("camera", CAMERAS[:2])  # Mitsuba's pixels are square
def test_rays_are_those_of_mitsuba(camera):
    index = dr.arange(mi.UInt32, camera.size[0] * camera.size[1])
    uv = mi.Point2f(index % camera.size[0], index // camera.size[0]) + 0.5
    sensor = mi.load_dict(camera.to_sensor_dict())
    ray, _ = sensor.sample_ray(0, 0.5, uv / mi.Point2f(*camera.size), mi.Point2f(0.5))
    assert np.allclose(ray.d.numpy(), pixel_directions(camera, index).numpy(), atol=1e-5)
    assert np.allclose(Camera.from_sensor(sensor).rays(), camera.rays(), atol=1e-5)


def test_focus_point_is_where_axes_meet():
    target = np.array([0.3, -0.2, 0.5])
    cameras = [Camera.look_at(o, target, (0, 0, 1), 40, (8, 8)) for o in ((3, 0, 0), (0, 3, 1), (-2, -2, 2.0))]
    point, reach = focus_point(cameras)
    assert np.allclose(point, target, atol=1e-4)
    assert np.isclose(reach, max(np.linalg.norm(c.origin - target) for c in cameras), atol=1e-3)

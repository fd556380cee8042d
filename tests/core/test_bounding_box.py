"""The box around an object without a mask: what reflects and is met is in it, and its surroundings lie beyond."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rgs_mi.core.bounding_box import BoundingBox
from rgs_mi.datasets.types import Dataset, View
from rgs_mi.fit.density import Statistics, densify
from rgs_mi.fit.model import Model
from rgs_mi.priors.initialization import surroundings
from rgs_mi.settings.settings import Density
from rgs_mi.shading import deferred
from rgs_mi.shading.environment import Environment
from rgs_mi.shading.lighting import Lighting, Shading, lighting_of
from rgs_mi.shading.split_sum import SplitSum
from rgs_mi.surfels.proxies import Proxies

from scenes import orbit_camera, shape, sphere_surfels

BOX = BoundingBox((-2.0, -2.0, -2.0), (2.0, 0.0, 2.0))  # half of the unit sphere


def cameras(count=8, distance=4.0):
    return [orbit_camera(angle, distance=distance) for angle in np.linspace(0, 6, count)]


def photographs():
    """Views of nothing but red, without masks."""
    red = np.zeros((40, 48, 4), np.uint8)
    red[:] = 255, 0, 0, 255
    return Dataset([View(str(k), camera, red, False, None, None) for k, camera in enumerate(cameras())], [])


def test_found_from_cameras():
    box = BoundingBox.seen_by(cameras())
    inside = lambda p: (np.array(box.min) < p).all() and (p < np.array(box.max)).all()
    assert inside(np.zeros(3)) and 1.5 < box.radius < 2.5
    assert not any(inside(camera.origin) for camera in cameras())
    np.testing.assert_allclose(box.center, 0, atol=0.15)
    larger = BoundingBox.seen_by(cameras(distance=8.0))
    assert larger.radius == pytest.approx(2 * box.radius, rel=0.1)


def test_found_from_points():
    """Those near what the cameras look at, less stray ones; what lies far away, and few points, change nothing."""
    cube, rng = BoundingBox.seen_by(cameras()), np.random.default_rng(0)
    near, far = rng.uniform((-0.5, -0.2, 0), (0.5, 0.2, 0.4), (2000, 3)), rng.uniform(20, 30, (500, 3))
    box = BoundingBox.seen_by(cameras(), np.concatenate([near, far, [[1.4, 1.4, 1.4]]]))
    np.testing.assert_allclose(box.min, (-0.6, -0.3, -0.1), atol=0.02)
    np.testing.assert_allclose(box.max, (0.6, 0.3, 0.5), atol=0.02)
    assert BoundingBox.seen_by(cameras(), near[:20]) == BoundingBox.seen_by(cameras(), far) == cube


@pytest.mark.parametrize("numbers", [(0, 0, 0, 1, 1), (0, 0, 0, 1, 0, 1), (0, 0, 0, 1, 1, float("inf"))])
def test_six_numbers(numbers):
    with pytest.raises(ValueError, match="a box is six numbers"):
        BoundingBox.of(numbers)
    assert BoundingBox.of(map(float, str(BOX).split())) == BOX


@pytest.mark.parametrize("lit", [False, True])
def test_only_what_is_in_the_box_reflects(lit):
    surfels, camera = sphere_surfels(800, scale=1.0), orbit_camera(0.3)
    environment = Environment(mi.TensorXf(np.random.default_rng(0).random((8, 16, 3), np.float32)), np.eye(3)).filtered()
    shade = lambda box: deferred.render(surfels, camera, Lighting(SplitSum(environment), lit=lit, box=box))
    whole, half, none = (np.array(shade(box).color).T for box in (None, BOX, BoundingBox((5.0,) * 3, (6.0,) * 3)))
    own = np.array(deferred.render(surfels, camera, None).color).T
    np.testing.assert_array_equal(none, own)
    maps = deferred.render(surfels, camera, None).gbuffer.all
    alpha, depth = maps.alpha.numpy(), maps.depth.numpy()
    points = camera.origin + (camera.rays() * (depth / np.maximum(alpha, 1e-9)).reshape(40, 48, 1)).reshape(-1, 3)
    sure = (alpha > 0.5) & (abs(points[:, 1]) > 1e-3)
    reflects = sure & (points[:, 1] < 0)
    assert min(reflects.sum(), (sure & ~reflects).sum()) > 100
    np.testing.assert_allclose(half[reflects], whole[reflects], atol=1e-6)
    np.testing.assert_allclose(half[sure & ~reflects], own[sure & ~reflects], atol=1e-6)
    assert abs(whole - own)[sure & ~reflects].mean() > 0.01


def test_rays_meet_what_is_in_the_box():
    surfels, rng = sphere_surfels(200, scale=0.7), np.random.default_rng(1)
    centers = surfels.numpy()["centers"]
    target = centers[rng.integers(200, size=2000)]
    direction = -target
    hit = {}
    for box in (BOX, None):
        rays = mi.Point3f((3 * target).T), mi.Vector3f(0), mi.Vector3f(direction.T)
        found, number, _ = Proxies(surfels, box=box).intersect(*rays)
        hit[box] = centers[number.numpy()[found.numpy()], 1]
        assert len(hit[box]) > 500
    assert (hit[BOX] <= 0).all() and (hit[None] > 0).mean() > 0.3


def test_what_lies_beyond_the_box_radiates_as_it_was_photographed():
    """Surfels around the box send their own radiance alone; those in the box reflect light, too."""
    surfels = sphere_surfels(300, scale=0.9, opacity_shift=3)
    environment = Environment(mi.TensorXf(np.random.default_rng(0).random((8, 16, 3), np.float32)), np.eye(3)).filtered()
    centers, uv = surfels.numpy()["centers"], dr.zeros(mi.Point2f, 300)
    view = mi.Vector3f((3 * orbit_camera(0.3).origin - centers).T)
    view = dr.normalize(view)
    radiance = lambda box: lighting_of(Shading(box=box), surfels, environment).radiance(surfels, uv, view).numpy().T
    half, whole, own = radiance(BOX), radiance(None), surfels.radiance(-view).numpy().T
    beyond = centers[:, 1] > 0
    np.testing.assert_array_equal(half[beyond], own[beyond])
    np.testing.assert_allclose(half[~beyond], whole[~beyond], atol=1e-6)
    assert abs(whole - own)[beyond].mean() > 0.02


def test_in_scenes():
    surfels = sphere_surfels(800, scale=1.0)
    sensor = mi.load_dict(orbit_camera(0.3).to_sensor_dict())
    scene = mi.load_dict({"type": "scene", "object": shape(surfels), "light": {"type": "constant"}})
    image = lambda kind, **more: np.array(
        mi.render(scene, sensor=sensor, spp=4, integrator=mi.load_dict({"type": kind, "hide_emitters": True, **more}))
    )
    everywhere, half = image("rgs_deferred"), image("rgs_deferred", box=str(BOX))
    assert 0.1 < (abs(everywhere - half).max(-1) > 0.01).mean() < 0.8 * (everywhere.max(-1) > 0).mean()
    np.testing.assert_array_equal(half, image("rgs_deferred", box="-2,-2,-2, 2,0,2"))
    taken_out = image("rgs_path", box=str(BOX))
    assert 0.05 < (taken_out.max(-1) > 0).mean() < (half.max(-1) > 0).mean()
    for kind in ("rgs_deferred", "rgs_path"):
        with pytest.raises(Exception, match="box '1 2 3': a box is six numbers"):
            mi.load_dict({"type": kind, "box": "1 2 3"})


def test_surroundings():
    positions, normals, spacing, (colors, *_) = surroundings(photographs(), 300)
    distance = np.linalg.norm(positions, axis=1)
    assert (distance > 30).all() and (distance < 60).all()
    assert ((positions * normals).sum(1) < 0).all() and (spacing > 1).all()
    np.testing.assert_allclose(colors, np.tile([1, 0, 0], (300, 1)), atol=1e-6)


def test_far_surfels_may_be_large():
    positions = np.array([[0.0, 0, 0], [40, 0, 0], [0, 0.5, 0]], np.float32)
    spacing = np.array([0.1, 3.0, 3.0], np.float32)
    colors, light = np.full((3, 3), 0.5, np.float32), np.ones((4, 8, 3), np.float32)

    def left(extent):
        model = Model.start(positions, None, colors, spacing, light, np.eye(3), 1)
        statistics, nothing = Statistics(3), dr.zeros(mi.Vector2f, 3)
        statistics.add(dr.arange(mi.UInt32, 3), nothing, nothing, dr.full(mi.Bool, True, 3), (100, 100))
        densify(model, statistics, extent, Density(), np.random.default_rng(0), 10)
        return model.numpy("centers")

    np.testing.assert_array_equal(left(1.0), positions[:1])
    np.testing.assert_array_equal(left(np.array([1.0, 40.0, 1.0])), positions[:2])

"""An object on a turntable: a light that goes round with the camera is a light that was turned for each view."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rgs_mi.core.camera import Camera
from rgs_mi.core.learned_camera import learned_camera
from rgs_mi.core.turntable import Turntable
from rgs_mi.shading import deferred
from rgs_mi.shading.environment import Environment
from rgs_mi.shading.lighting import Shading, lighting_of
from rgs_mi.surfels.surfels import Surfels

from scenes import colors, orbit_camera, shape, sphere_surfels

AXIS, POINT = np.array([0.1, -0.2, 0.97]) / np.linalg.norm([0.1, -0.2, 0.97]), (0.1, 0.05, -0.1)
TABLE = Turntable((float(AXIS[0]), float(AXIS[1]), float(AXIS[2])), POINT)


def azimuth(camera, table=TABLE):
    """The camera's azimuth in radians, by its definition."""
    side, across, _ = table.frame()
    away = camera.origin - np.array(table.point)
    return np.arctan2(away @ across, away @ side)


def environment(seed=0):
    texels = np.random.default_rng(seed).uniform(0.1, 2, (16, 32, 3)).astype(np.float32)
    return Environment(mi.TensorXf(texels), Rotation.from_euler("xyz", [80, 20, -30], degrees=True).as_matrix())


def test_rotation_is_that_of_a_slow_twin():
    table = replace(TABLE, rings=((11.0, 0.0), (60.0, 25.0)))
    for angle in (0.2, 2.0, 4.5):
        for height, turn in ((0, 0), (5, 25)):
            camera = Camera.look_at((4 * np.cos(angle), 4 * np.sin(angle), 0.8 + height), POINT, (0, 0, 1), 40, (8, 8))
            expected = Rotation.from_rotvec(-AXIS * (azimuth(camera) + np.radians(turn))).as_matrix()
            found = np.array(table.to_lamps(camera)).reshape(3, 3)
            assert np.abs(found - expected).max() < 1e-5
            assert (
                np.abs(np.array(table.turned(mi.Float(azimuth(camera) + np.radians(turn)))).reshape(3, 3) - expected).max()
                < 1e-5
            )


@pytest.mark.parametrize(
    "specular, indirect, diffuse",
    [
        ("split_sum", "none", "radiance"),
        ("split_sum", "one_bounce", "radiance"),
        ("split_sum", "none", "lit"),
        ("monte_carlo", "none", "radiance"),
        ("monte_carlo", "one_bounce", "radiance"),
        ("monte_carlo", "one_bounce", "lit"),
    ],
)
def test_light_goes_round_with_the_camera(specular, indirect, diffuse):
    surfels, light = sphere_surfels(200, scale=0.9, opacity_shift=3), environment()
    shading = Shading(specular=specular, diffuse=diffuse, indirect=indirect, samples=4)
    for angle in (0.3, 3.0):
        camera = orbit_camera(angle)
        turned = replace(light, rotation=Rotation.from_rotvec(AXIS * azimuth(camera)).as_matrix() @ light.rotation)
        expected = colors(surfels, camera, shading, turned)
        found = colors(surfels, camera, replace(shading, turntable=TABLE), light)
        still = colors(surfels, camera, shading, light)
        # single numbers jump where a sample falls to the other side of something
        assert np.mean(np.abs(found - expected) > 1e-3) < 2e-3
        assert np.abs(found - still).mean() > 20 * np.abs(found - expected).mean() > 0


def test_what_surfels_hide_of_a_light_is_a_mean_over_its_turns():
    """Of a light that is the same all around the axis it is what they hide of one that stands still; of a lamp on one side it
    is as if the lamp stood on all sides at once."""
    axis = Turntable((0, 0, 1), (0, 0, 0))
    upright = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    round_, lamp = np.zeros((2, 16, 32, 3), np.float32)
    round_[:] = np.linspace(3, 0.2, 16)[:, None, None]
    lamp[:, 6:10] = 5.0
    around = np.mean([np.roll(lamp, 4 * k, 1) for k in range(8)], 0)
    ball = sphere_surfels(300, scale=0.6, opacity_shift=3).numpy()  # and another beside it, both dark
    ball |= {"base_color": 0.1 * ball["base_color"], "metallic": 0 * ball["metallic"]}
    beside = ball | {"centers": ball["centers"] + np.array([1.8, 0, 0])}
    surfels = Surfels.from_numpy({name: np.concatenate([ball[name], beside[name]]) for name in ball})

    def hidden(texels, turntable):
        shading = Shading(diffuse="lit", indirect="one_bounce", turntable=turntable)
        light = Environment(mi.TensorXf(np.ascontiguousarray(texels)), upright).filtered()
        found = [lighting_of(shading, surfels, light, seed=k).indirect.irradiance_visibility.numpy() for k in range(30)]
        return np.mean(found, 0), np.std(found, 0) / np.sqrt(len(found))

    still, turned = hidden(round_, None)[0], hidden(round_, axis)[0]
    assert still.min() < 0.8 and np.abs(still - turned).max() < 1e-3
    (expected, a), (found, b) = hidden(around, None), hidden(lamp, axis)
    assert np.mean(np.abs(found - expected) < 4 * np.hypot(a, b) + 0.02) > 0.98
    assert np.abs(hidden(lamp, None)[0] - expected).mean() > 3 * np.abs(found - expected).mean()


def test_what_is_learned_of_a_pose_and_a_turn_has_derivatives():
    surfels, light, given = sphere_surfels(60, scale=1.2, opacity_shift=3), environment().finer().finer(), orbit_camera(0.7)
    weight = mi.Color3f(*(mi.Float(row) for row in np.random.default_rng(0).normal(size=(3, 48 * 40))))
    table = replace(TABLE, rings=((10.0, 0.0),))
    filtered = light.filtered()

    def loss(turn, pose):
        lighting = replace(lighting_of(Shading(turntable=table), surfels, filtered), turn=turn)
        camera = replace(given, learned=learned_camera(given, np.array(POINT), pose))
        fixed = deferred.render(surfels, given, None).gbuffer  # what is seen stays: only the light's place is looked at
        return dr.mean(dr.sum(deferred.shade(fixed, camera, lighting).specular * weight))

    turn, pose = mi.Float(0.1), [mi.Float(0.0) for _ in range(6)]
    dr.enable_grad(turn, *pose)
    dr.backward(loss(turn, pose))
    h = 2e-3
    at = lambda t, k, s: float(loss(mi.Float(t), [mi.Float(s * (j == k)) for j in range(6)])[0])
    assert float(dr.grad(turn)[0]) == pytest.approx((at(0.1 + h, 0, 0) - at(0.1 - h, 0, 0)) / (2 * h), rel=0.05)
    for k in (1, 3):
        assert float(dr.grad(pose[k])[0]) == pytest.approx((at(0.1, k, h) - at(0.1, k, -h)) / (2 * h), rel=0.05)


@pytest.mark.parametrize("text", ["0 0 1", "0 0 0 1 1 1", "0 0 1 0 0 nan", "0 0 1 0 0 0 5", "a b c d e f"])
def test_numbers_that_make_no_turntable(text):
    with pytest.raises(ValueError):
        Turntable.of(text.split())


def test_written_and_read():
    table = replace(TABLE, rings=((12.0, 0.0), (42.0, 7.5)))
    assert Turntable.of(str(table).split()).rings == table.rings
    assert np.allclose(Turntable.of(str(table).split()).axis, AXIS)


def test_scene_files_say_so():
    surfels, light, camera = sphere_surfels(100, scale=0.9), environment(), orbit_camera(2.2)
    turn = mi.ScalarTransform4f(
        np.block([[Rotation.from_rotvec(AXIS * azimuth(camera)).as_matrix(), np.zeros((3, 1))], [0, 0, 0, 1]])
    )
    placed = mi.ScalarTransform4f(np.block([[light.rotation, np.zeros((3, 1))], [0, 0, 0, 1]]))
    image = lambda to_world, **integrator: np.array(
        mi.render(
            mi.load_dict(
                {
                    "type": "scene",
                    "integrator": {"type": "rgs_deferred", **integrator},
                    "shape": shape(surfels),
                    "emitter": {"type": "envmap", "bitmap": mi.Bitmap(light.texels.numpy()), "to_world": to_world},
                }
            ),
            sensor=mi.load_dict(camera.to_sensor_dict()),
            spp=1,
        )
    )
    found, expected, still = image(placed, turntable=str(TABLE)), image(turn @ placed), image(placed)
    assert np.abs(found - expected).max() < 2e-3
    assert np.abs(found - still).mean() > 0.05  # background and reflections
    with pytest.raises(Exception, match="a turntable is six numbers"):
        mi.load_dict({"type": "rgs_deferred", "turntable": "1, 2"})

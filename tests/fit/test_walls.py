"""Walls of a near room, told by what several photographs show reflected."""

from collections import defaultdict
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from scipy import ndimage

from rgs_mi.core.camera import Camera
from rgs_mi.datasets.path_traced import train_directions
from rgs_mi.datasets.types import Dataset
from rgs_mi.fit import light, walls
from rgs_mi.fit.model import Model
from rgs_mi.fit.trainer import Fit
from rgs_mi.settings.settings import Stage
from rgs_mi.shading.environment import Environment
from rgs_mi.shading.lighting import Shading, lighting_of
from rgs_mi.shading.room import Room

from fits import SETTINGS, mirror_ball, photographs

DISTANCES = np.array([3.0, 4.0, 2.4, 3.5, 2.6, 5.0])
FAR = np.full(6, np.inf)
EYES = 2.3 * np.concatenate([np.eye(3), -np.eye(3)])  # where cameras stand
BALL = 3000  # surfels
SETTINGS_ROOM = replace(SETTINGS, stages=(Stage(1.0, 1, 1),), specular_start=0.0, light="world", room="auto")


def painting(rows=64):
    """Smooth noise on a map [rows, 2 rows, 3]: logarithms of radiance."""
    noise = ndimage.gaussian_filter(np.random.default_rng(1).normal(size=(rows, 2 * rows, 3)), (3, 3, 0), mode="wrap")
    return np.float32(noise / noise.std())


def reflections(distances, n=20000):
    """What a ball of radius 1 shows of a room whose walls are painted as the center sees them."""
    rng = np.random.default_rng(0)
    direction, q = rng.normal(size=(2, n, 3))
    direction, q = direction / np.linalg.norm(direction, axis=1)[:, None], q / np.linalg.norm(q, axis=1)[:, None]
    direction *= np.sign((direction * q).sum(1))[:, None]  # from the surface, not into it
    vector = lambda a: mi.Vector3f(np.ascontiguousarray(a.T, np.float32))
    room = Room((0.0, 0.0, 0.0), mi.Float([float(1 / d) for d in distances]))
    spot = room.seen(vector(direction), vector(q))[0].numpy().T
    map_, rows = painting(), 64
    y = map_[
        np.int32(np.arccos(np.clip(spot[:, 1], -1, 1)) / np.pi * (rows - 1)),
        np.int32(np.arctan2(spot[:, 0], -spot[:, 2]) / (2 * np.pi) % 1 * 2 * rows - 1e-3),
    ]
    weight = np.float32(rng.uniform(0.2, 1, n))
    return walls.Reflections(
        vector(direction), vector(q), mi.Color3f(np.ascontiguousarray(y.T)), mi.Float(weight), np.zeros(6)
    )


def test_the_variance_is_that_of_a_slow_twin():
    seen = reflections(DISTANCES, 3000)
    rows = seen.rows
    d, q, y, w = (v.numpy() for v in (seen.direction, seen.q, seen.log_radiance, seen.weight))
    texels = defaultdict(list)
    for k in range(len(seen)):
        side = [2 * a + int(d[a, k] > 0) for a in range(3)]
        t = min((DISTANCES[s] * (2 * (s % 2) - 1) - q[a, k]) / d[a, k] for a, s in enumerate(side))
        x, up, z = (q[:, k] + t * d[:, k]) / np.linalg.norm(q[:, k] + t * d[:, k])
        row = min(int(np.arccos(up) / np.pi * rows), rows - 1)
        texels[row, int(np.arctan2(x, -z) / (2 * np.pi) % 1 * 2 * rows)].append(k)
    squares = total = 0.0
    for members in texels.values():
        if (n := len(members)) < walls._FEWEST:
            continue
        mean = (w[members] * y[:, members]).sum(1) / w[members].sum()
        squares += (w[members] * (y[:, members] - mean[:, None]) ** 2).sum() / 3 * n / (n - 1)
        total += w[members].sum()
    assert seen.variance(DISTANCES) == pytest.approx(squares / total, rel=0.01)


def test_the_walls_that_make_reflections_alike_are_found():
    distances, part = walls.nearest(reflections(DISTANCES), 1.0)
    assert np.abs(distances / DISTANCES - 1).max() < 0.1
    assert part < 0.5


@pytest.mark.parametrize("center", [(0.0, 0.0, 0.0), (0.3, -0.2, 0.1)])
def test_cameras_stand_among_the_walls(center):
    beyond = np.where(np.arange(6) == 3, 4.5, 0.0)  # where the wall stands at 3.5
    distances, _ = walls.nearest(replace(reflections(DISTANCES), reach=beyond), 1.0)
    assert distances[3] == pytest.approx(4.5, rel=0.05) and distances[3] >= 4.5
    fit = fit_of(capture(DISTANCES), replace(light.short(SETTINGS_ROOM, "world"), room=None), center)
    x, y, z = np.array([view.camera.origin - center for view in fit.dataset.train]).T
    np.testing.assert_allclose(
        walls.Reflections.seen_by(fit).reach, np.maximum([-min(x), max(x), -min(y), max(y), -min(z), max(z)], 0), rtol=1e-5
    )


def test_light_at_infinity_has_no_walls():
    assert walls.nearest(reflections(FAR), 1.0)[1] > walls._CLEAR


def spots(distances, sides=range(6), n=4000):
    """Points of the walls ``sides`` of a room, seen from its middle, a fifth of them elsewhere, and some on the object."""
    rng = np.random.default_rng(2)
    direction = rng.normal(size=(n, 3))
    away = np.where(direction > 0, distances[1::2], distances[::2]) / np.abs(direction)
    met = 2 * away.argmin(1) + (direction[np.arange(n), away.argmin(1)] > 0)
    points = direction * away.min(1, keepdims=True) * np.where(rng.random(n) < 0.2, rng.uniform(0.3, 1.5, n), 1)[:, None]
    thing = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return np.concatenate([points[np.isin(met, list(sides))], thing])


def test_walls_that_photographs_show_are_found():
    np.testing.assert_allclose(walls.surrounding(spots(DISTANCES), 1.0, EYES), DISTANCES, rtol=0.05)
    np.testing.assert_allclose(walls.surrounding(100 * spots(DISTANCES), 100.0, EYES), 100 * DISTANCES, rtol=0.05)


def test_a_wall_that_no_photograph_shows_stays_unknown():
    found = walls.surrounding(spots(DISTANCES, sides=(0, 1, 2, 4, 5)), 1.0, EYES)
    assert np.isnan(found).tolist() == [False, False, False, True, False, False]
    np.testing.assert_allclose(np.delete(found, 3), np.delete(DISTANCES, 3), rtol=0.05)
    assert np.isnan(walls.surrounding(np.zeros((0, 3)), 1.0, EYES)).all()
    assert np.isnan(walls.surrounding(spots(DISTANCES)[-50:], 1.0, EYES)).all()  # the object alone


def test_what_hangs_lower_than_a_camera_stands_is_no_ceiling():
    hanging = spots(np.where(np.arange(6) == 3, 1.3, DISTANCES))
    found = walls.surrounding(hanging, 1.0, EYES)
    assert np.isnan(found).tolist() == [False, False, False, True, False, False]


def test_mirrors_tell_the_wall_that_is_not_known():
    known = np.where(np.arange(6) == 3, np.nan, DISTANCES)
    distances, _ = walls.nearest(reflections(DISTANCES), 1.0, known)
    np.testing.assert_array_equal(np.delete(distances, 3), np.delete(DISTANCES, 3))
    assert distances[3] == pytest.approx(DISTANCES[3], rel=0.1)


def capture(distances):
    """Photographs of a mirror ball in a room, or under light at infinity."""
    room = Room((0.0, 0.0, 0.0), mi.Float([float(1 / d) for d in distances]))
    lamps = Environment(mi.TensorXf(np.exp(painting()) / 3), np.eye(3), room=room)
    ball = mirror_ball(BALL)
    cameras = [Camera.look_at(2.3 * d, (0, 0, 0), (0, 0, 1), 60, (96, 96)) for d in train_directions(40)]
    return Dataset(photographs(ball, lighting_of(Shading(), ball, lamps.filtered()), cameras), [])


def fit_of(dataset, settings, center=(0.0, 0.0, 0.0)):
    """A fit that starts on the ball, of another material, in a room that is seen from its ``center``."""
    ball = mirror_ball(BALL).numpy()
    x = ball["centers"]
    diffuse, spacing, environment = np.full((BALL, 3), 0.1), np.full(BALL, 0.1), np.full((32, 64, 3), 0.5)
    options = {"metallic": 0.8, "roughness": 0.2, "opacity": 0.98, "room": settings.room, "center": center}
    model = Model.start(x, x, diffuse, spacing, environment, np.eye(3), 1, **options)
    for name, value in {"log_scales": np.log(ball["scales"]), "curvature": ball["curvature"]}.items():
        model.set(name, value)
    return Fit(dataset, model, settings, 1.0, Shading())


@pytest.mark.parametrize("distances", [DISTANCES, FAR], ids=["room", "infinity"])
def test_short_fits_tell(monkeypatch, capfd, distances):
    monkeypatch.setattr(light, "_STEPS", 100)
    found = walls.near_room(fit_of, capture(distances), SETTINGS_ROOM, quiet=False).room
    said = capfd.readouterr().err
    if np.isinf(distances).all():
        assert found is None and "light at infinity" in said
    else:
        assert np.abs(np.array(found) / distances - 1).max() < 0.08
        assert "a room, walls at -x" in said


def test_walls_that_are_seen_are_taken(monkeypatch, capfd):
    monkeypatch.setattr(light, "_STEPS", 100)
    room = capture(DISTANCES)
    assert walls.near_room(fit_of, room, SETTINGS_ROOM, False, lambda: DISTANCES).room == tuple(DISTANCES)
    assert "what surrounds the object" in capfd.readouterr().err
    found = walls.near_room(fit_of, room, SETTINGS_ROOM, True, lambda: np.where(np.arange(6) == 3, np.nan, DISTANCES)).room
    np.testing.assert_allclose(found, DISTANCES, rtol=0.1)


def test_what_is_given_stays():
    for room in (None, 4.0):
        assert walls.near_room(fit_of, Dataset([], []), replace(SETTINGS_ROOM, room=room), quiet=True).room == room
    assert walls.near_room(fit_of, Dataset([], []), replace(SETTINGS_ROOM, specular_start=1.0), quiet=True).room is None

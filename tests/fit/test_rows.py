"""Rows that rest, against Mitsuba's Adam, which moves all of them in every step."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rgs_mi.core.camera import Camera
from rgs_mi.fit.model import SURFEL_PARAMETERS
from rgs_mi.fit.rows import EPSILON, Rows
from rgs_mi.splat.gbuffer import render_gbuffer
from rgs_mi.splat.intersect import isect_tiles
from rgs_mi.splat.project import project
from rgs_mi.splat.tiles import Cutoffs
from rgs_mi.surfels.surfels import CHANNELS

from fits import model_of
from scenes import orbit_camera, sphere_surfels

N = 40
CHANNELS_OF_ROWS = {"one": 1, "three": 3, "many": 10}  # fourteen, in rows of sixteen floats
RATES = {"one": 1e-2, "three": 3e-3, "many": 1e-1}


def fields(seed=0):
    rng = np.random.default_rng(seed)
    return {name: rng.normal(size=(N, n)).astype(np.float32) for name, n in CHANNELS_OF_ROWS.items()}


def rows_of(parts):
    """[n, 16] as a gradient is laid out, flat, of {name: [n, channels]}."""
    matrix = np.concatenate([parts[name] for name in CHANNELS_OF_ROWS], 1)
    return mi.Float(np.pad(matrix, ((0, 0), (0, 2))).astype(np.float32).ravel())


class Both:
    """The same parameters as rows that rest, and in Mitsuba's Adam, after so many steps."""

    def __init__(self, steps):
        self.rows, self.adam = Rows(fields(), steps=steps), mi.ad.Adam(lr=1, epsilon=EPSILON)
        for name, value in fields().items():
            self.adam[name] = mi.TensorXf(value)
            value, promoted, lr, (_, *moments) = self.adam.state[name]
            self.adam.state[name] = value, promoted, lr, (mi.UInt32(steps), *moments)
        self.rows.rates = RATES
        self.adam.set_learning_rate(RATES)

    def step(self, index, rng):
        """Both by random gradients of the rows ``index``; returns how far the rows of Mitsuba's have been moved by now."""
        parts = {name: 1 + rng.normal(size=(len(index), n)) for name, n in CHANNELS_OF_ROWS.items()}
        self.rows.step(mi.UInt32(index), rows_of(parts))
        for name, part in parts.items():
            gradient = np.zeros((N, part.shape[1]), np.float32)
            gradient[index] = part
            dr.set_grad(self.adam[name], mi.TensorXf(gradient))
        self.adam.step()

    def close(self, rtol):
        for name, start in fields().items():
            expected = self.adam[name].numpy()
            moved = np.abs(expected - start)
            np.testing.assert_allclose(self.rows.numpy(name), expected, rtol=0, atol=rtol * moved.max(), err_msg=name)
            _, m, v, _ = self.adam.state[name][3]
            for of, moment in (("m", m), ("v", v)):
                np.testing.assert_allclose(self.rows.numpy(name, of).ravel(), moment.numpy(), rtol=1e-4, atol=1e-6)


def test_rows_that_every_step_sees_move_as_adam_moves_them():
    both, rng = Both(0), np.random.default_rng(1)
    for _ in range(30):
        both.step(np.arange(N), rng)
    both.close(1e-5)


def test_rows_that_rest_come_to_where_adam_has_moved_them():
    """But for the correction of moments that begin at zero, which changes while they rest: most in the first steps."""
    for steps, rtol in ((5000, 1e-4), (200, 0.02)):
        both, rng = Both(steps), np.random.default_rng(2)
        for k in range(80):
            both.step(np.sort(rng.permutation(N)[: rng.integers(1, 12)]), rng)
            if k == 40:
                both.rows.catch_up()  # as whoever reads all of them has it
        both.close(rtol)


def test_rows_are_read_where_they_are_by_now():
    both, rng = Both(5000), np.random.default_rng(3)
    for _ in range(30):
        both.step(np.sort(rng.permutation(N)[:5]), rng)
    index = np.array([3, 17, 17, 0, 39])
    read = both.rows.split(both.rows.at(mi.UInt32(index)))
    for name in CHANNELS_OF_ROWS:
        np.testing.assert_array_equal(np.array(read[name]).T, both.rows.numpy(name)[index])


def test_clipping():
    rows, given = Rows(fields()), fields()
    rows.clip({"three": 0.5, "many": 1.0})
    assert np.array_equal(rows.numpy("one"), given["one"]) and abs(given["one"]).max() > 1
    for name, most in (("three", 0.5), ("many", 1.0)):
        assert np.array_equal(rows.numpy(name), given[name].clip(-most, most)) and abs(given[name]).max() > most


def test_a_step_that_sees_nothing_counts():
    both, rng = Both(5000), np.random.default_rng(4)
    both.step(np.arange(N), rng)
    before = both.rows.numpy("one")
    both.step(np.arange(0), rng)
    assert both.rows.steps == 5002
    both.close(1e-5)
    assert not np.array_equal(before, both.rows.numpy("one"))


def test_a_state_goes_on_as_if_it_had_not_been_read():
    both, rng = Both(5000), np.random.default_rng(5)
    for _ in range(20):
        both.step(np.sort(rng.permutation(N)[:5]), rng)
    again = Rows.from_state(both.rows.state(), list(CHANNELS_OF_ROWS))
    again.rates = RATES
    for rows in (both.rows, again):
        rows.step(mi.UInt32([1, 2, 30]), rows_of({name: np.full((3, n), 0.5) for name, n in CHANNELS_OF_ROWS.items()}))
    for name in CHANNELS_OF_ROWS:
        np.testing.assert_array_equal(again.numpy(name), both.rows.numpy(name))
        assert not np.array_equal(both.rows.numpy(name), fields()[name])


@pytest.mark.parametrize("every, steps", [(False, 200), (True, 200), (False, 199)])
def test_gradients_of_several_views_come_together(every, steps):
    """Of the rows that they have, of all rows where each process is to have all, and in the first steps."""
    rng, rows = np.random.default_rng(6), Rows(fields(), steps=steps)
    parts = []
    for index, once in (([2, 5, 9], True), ([5, 9, 30], True), ([9, 9, 9, 1], False)):
        parts.append((np.array(index), rng.normal(size=(len(index), 16)), once))
    parts[1][1][1, 3] = np.nan
    expected = np.zeros((N, 16))
    for index, gradient, _ in parts:
        np.add.at(expected, index, np.nan_to_num(gradient))
    index, total = rows.together([(mi.UInt32(i), mi.Float(g.ravel()), once) for i, g, once in parts], every)
    assert index.numpy().tolist() == (list(range(N)) if every or steps < 200 else [1, 2, 5, 9, 30])
    np.testing.assert_allclose(total.numpy().reshape(-1, 16), expected[index.numpy()], rtol=1e-5, atol=1e-6)


# ---- Of a model ----


@pytest.mark.parametrize("two_sided", [True, False])
def test_a_window_asks_for_all_that_it_lists_and_little_else(two_sided):
    surfels = sphere_surfels(3000, scale=0.5)
    surfels.two_sided = two_sided
    learned, left = model_of(surfels), []
    for k in range(6):
        camera = orbit_camera(angle=k, size=(160, 120))
        for window in ((0, 0, 160, 120), (40, 30, 64, 40), (100, 80, 40, 32)):
            camera_of = camera.cropped(*window)
            listed = isect_tiles(project(surfels, camera_of), camera_of.size, Cutoffs()).seen.numpy()
            asked = learned.in_view(camera_of, Cutoffs()).numpy()
            assert np.isin(np.flatnonzero(listed), asked).all() and (np.diff(asked) > 0).all()
            left.append((len(asked), listed.sum()))
    asked, listed = np.array(left).T
    assert listed[0] > 1000 and (asked[1::3] < 0.6 * asked[::3]).all() and asked.sum() < 1.8 * listed.sum()
    away = Camera.look_at([4, 0, 0], [8, 0, 0], [0, 0, 1], 30.0, (32, 32))
    assert learned.in_view(away, Cutoffs()).numpy().tolist() == [0]


def test_what_a_window_shows_has_the_gradients_of_all_surfels():
    surfels, camera = sphere_surfels(400), orbit_camera(size=(160, 120)).cropped(60, 40, 32, 24)
    learned = model_of(surfels)

    def loss(some):
        maps = render_gbuffer(some, camera).all
        return dr.sum(sum([*maps.diffuse, *maps.base_color, *maps.normal, maps.roughness, maps.metallic, maps.depth]))

    for name in CHANNELS:
        dr.enable_grad(getattr(surfels, name))
    expected = loss(surfels)
    dr.backward(expected)
    found = loss(learned.take(learned.in_view(camera, Cutoffs()), 1, once=True))
    dr.backward(found)
    assert float(found[0]) == pytest.approx(float(expected[0]), rel=1e-5)
    learned.rows.steps = 200  # from which on they rest
    index, gradient = learned.gradients()
    columns = {name: np.zeros((400, learned.numpy(name).shape[1])) for name in SURFEL_PARAMETERS}
    for name, part in learned.rows.split(gradient).items():
        columns[name][index.numpy()] = np.array(part).T
    assert 50 < dr.width(index) < 400
    values = surfels.numpy()
    chain = {"scales": lambda s: s, "opacities": lambda p: p * (1 - p)}
    for name in ("centers", "rotations", "scales", "opacities", "base_color", "roughness", "metallic", "curvature"):
        inner = chain.get(name, chain["opacities"] if name in ("base_color", "roughness", "metallic") else np.ones_like)
        own = dr.grad(getattr(surfels, name)).numpy() * inner(values[name])
        other = columns.get(name, columns.get(f"log_{name}", columns.get(f"logit_{name}")))
        assert np.abs(own).max() > 1e-3
        np.testing.assert_allclose(other, own, rtol=1e-3, atol=1e-4 * np.abs(own).max(), err_msg=name)
    sh = dr.grad(surfels.sh).numpy()
    np.testing.assert_allclose(columns["sh_rest"], sh[:, 3:], rtol=1e-3, atol=1e-4 * np.abs(sh).max())
    assert not learned._taken

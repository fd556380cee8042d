"""From samples to pixels: Mitsuba's own film is the twin."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rgs_mi.core.camera import Camera
from rgs_mi.core.film import Film, rfilter

SIZE = 5, 4
FILTERS = {
    "box": {"type": "box"},
    "gaussian": {"type": "gaussian"},
    "wide": {"type": "gaussian", "stddev": 0.8},
    "mitchell": {"type": "mitchell"},
}


def film_of(name, spp):
    return Film.of(mi.load_dict(FILTERS[name]), spp)


def sampled(film, seed=0):
    """Numbers for all samples of a picture of `SIZE`, and the same as [rows, columns]."""
    width, height = (film.samples_along(n) for n in SIZE)
    values = np.random.default_rng(seed).uniform(size=(height, width)).astype(np.float32)
    return mi.Float(values.ravel()), values


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("spp", [1, 4, 9])
def test_pixels_are_those_of_mitsubas_film(name, spp):
    """Which is given the same samples, at the same places."""
    film = film_of(name, spp)
    samples, values = sampled(film)
    border, (rows, columns) = film.margin, values.shape
    x, y = np.meshgrid((np.arange(columns) + 0.5) / film.side - border, (np.arange(rows) + 0.5) / film.side - border)
    block = mi.ImageBlock(
        mi.ScalarVector2u(*SIZE), mi.ScalarPoint2i(0, 0), 2, mi.load_dict(FILTERS[name]), border=False, normalize=False
    )
    block.put(mi.Point2f(x.ravel().astype(np.float32), y.ravel().astype(np.float32)), [samples, mi.Float(1)])
    weighed = np.array(block.tensor())
    theirs = weighed[..., 0] / weighed[..., 1]
    (pixels,) = film.develop([samples], SIZE)
    ours = pixels.numpy().reshape(SIZE[::-1])
    np.testing.assert_allclose(ours, theirs, atol=6e-3 if name in ("gaussian", "wide") else 1e-5)  # tails are left out


@pytest.mark.parametrize("spp", [1, 4])
def test_the_adjoint_is_the_transpose(spp):
    film = film_of("gaussian", spp)
    samples, _ = sampled(film)
    dr.enable_grad(samples)
    (pixels,) = film.develop([samples], SIZE)
    adjoint = mi.Float(np.random.default_rng(1).uniform(size=SIZE[0] * SIZE[1]).astype(np.float32))
    dr.backward(pixels * adjoint)
    direction, _ = sampled(film, 2)
    (moved,) = film.develop([direction], SIZE)
    assert dr.sum(dr.grad(samples) * direction)[0] == pytest.approx(dr.sum(adjoint * moved)[0], rel=1e-5)


def test_what_is_the_same_everywhere_stays_so():
    for name in FILTERS:
        film = film_of(name, 4)
        one = dr.full(mi.Float, 0.7, dr.width(sampled(film)[0]))
        pixels, narrow = film.develop([one, mi.Float(0.7)], SIZE)
        np.testing.assert_allclose(pixels.numpy(), 0.7, rtol=1e-6)
        assert narrow.numpy() == np.float32(0.7)


def test_samples_lie_around_their_pixels():
    """A point in the middle of a pixel lies in the middle of its samples."""
    camera = Camera.look_at((3, 0, 0), (0, 0, 0), (0, 0, 1), 40, SIZE)
    film = Film.gaussian(0.5, 4)
    assert (film.side, film.margin) == (2, 1)
    point = camera.origin + 2 * camera.rays()[1, 3]
    (pixel, _), (sample, _) = camera.project(point[None]), film.samples(camera).project(point[None])
    np.testing.assert_allclose(pixel, [[3.5, 1.5]], atol=1e-5)
    np.testing.assert_allclose(sample, [[2 * (3.5 + 1), 2 * (1.5 + 1)]], atol=1e-4)


def test_spread_gives_samples_what_their_pixel_has():
    film = Film.gaussian(0.5, 4)
    pixels = mi.Float(np.arange(SIZE[0] * SIZE[1], dtype=np.float32))
    spread = film.spread(pixels, SIZE).numpy().reshape([film.samples_along(n) for n in SIZE[::-1]])
    inner = spread[2:-2, 2:-2]
    assert (inner == np.repeat(np.repeat(np.arange(20).reshape(4, 5), 2, 0), 2, 1)).all()
    assert (spread[0] == spread[2]).all() and (spread[:, -1] == spread[:, -3]).all()
    assert Film().spread(pixels, SIZE) is pixels


def test_a_film_by_its_standard_deviation():
    assert Film.gaussian(0) == Film() and rfilter(0) == {"type": "box"}
    assert Film.gaussian(0, 4).weights == pytest.approx((0.5, 0.5))
    assert Film.gaussian(0.5).weights == pytest.approx((0.1065, 0.787, 0.1065), abs=1e-3)

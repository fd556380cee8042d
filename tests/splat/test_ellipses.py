"""Ellipses, surfels as viewers of splats draw them, against their slow twin, and their gradients against its differences."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rgs_mi.splat.ellipses import CUTOFFS, DILATIONS, render_ellipses
from rgs_mi.splat.reference import render_ellipses_reference
from rgs_mi.surfels.surfels import Surfels

from scenes import VARIED_CAMERAS, layered_surfels, orbit_camera, sphere_surfels

FIELDS = "centers", "rotations", "scales", "opacities", "sh"
SMOOTH = replace(CUTOFFS, alpha_min=1e-7, alpha_max=0.9999, transmittance_min=0)


def rendered(surfels, camera, dilation, whole=None):
    """Colour and alpha, [H, W, 4]."""
    picture = render_ellipses(surfels, camera, dilation, whole=whole)
    return np.stack([*picture.color.numpy(), picture.alpha.numpy()], -1).reshape(*camera.size[::-1], 4)


@pytest.mark.parametrize("dilation", DILATIONS)
@pytest.mark.parametrize("camera", VARIED_CAMERAS.values(), ids=VARIED_CAMERAS)
@pytest.mark.parametrize("scale", [0.6, 0.03], ids=["wide", "less than a pixel"])
def test_forward_equals_reference(camera, dilation, scale):
    surfels = sphere_surfels(150, seed=3, scale=scale, order=3)
    mine, twin = rendered(surfels, camera, dilation), render_ellipses_reference(surfels, camera, dilation, CUTOFFS, camera)
    # A weight within rounding of the cut-off may fall on either side of it: those few pixels differ by at most 1/255.
    difference = np.abs(mine - twin)
    assert difference.max() < 5e-3 and (difference > 1e-4).mean() < 2e-3 and twin[..., 3].max() > 0.05


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", FIELDS)
def test_gradients_equal_differences_of_the_reference(name, seed):
    camera, dilation = orbit_camera(size=(24, 24)), DILATIONS[seed]
    base = layered_surfels(camera, seed).numpy()
    weights = np.random.default_rng(1).normal(size=(24, 24, 4)).astype(np.float32)
    surfels = Surfels.from_numpy(base)
    dr.enable_grad(getattr(surfels, name))
    picture = render_ellipses(surfels, camera, dilation, cutoffs=SMOOTH)
    *color, alpha = (mi.Float(plane) for plane in weights.reshape(-1, 4).T)
    dr.backward(dr.sum(dr.dot(mi.Color3f(*color), picture.color) + alpha * picture.alpha))
    gradient = dr.grad(getattr(surfels, name)).numpy().astype(np.float64)
    # Uphill in every number, or what they add would cancel and leave rounding to compare
    direction = np.copysign(np.random.default_rng(2).normal(size=base[name].shape), gradient) * np.abs(base[name]).mean()

    def value(step):
        moved = Surfels.from_numpy({**base, name: base[name] + step * direction})
        return float((render_ellipses_reference(moved, camera, dilation, SMOOTH, camera) * weights).sum())

    central = lambda h: (value(h) - value(-h)) / (2 * h)
    expected = (4 * central(2e-3) - central(4e-3)) / 3  # Richardson: the h² term of the central difference cancels
    assert (gradient * direction).sum() == pytest.approx(expected, rel=2e-3)


def test_contributions_are_what_surfels_weigh():
    """The sum of their weights in all pixels: what their colours' gradients are, where these are not clipped."""
    surfels, camera = sphere_surfels(60, seed=5, order=0), orbit_camera(size=(32, 24))
    contribution, part = dr.zeros(mi.Vector2f, len(surfels)), 2 * np.random.default_rng(0).random(32 * 24, np.float32)
    dr.enable_grad(contribution, surfels.sh)
    picture = render_ellipses(surfels, camera, cutoffs=SMOOTH, contribution=contribution)
    dr.backward(dr.sum(picture.contribution.x + mi.Float(part) * picture.contribution.y))
    for mine, weight in zip(dr.grad(contribution), (mi.Float(1), mi.Float(part))):
        dr.set_grad(surfels.sh, dr.zeros(mi.TensorXf, surfels.sh.shape))
        dr.backward(dr.sum(weight * render_ellipses(surfels, camera, cutoffs=SMOOTH).color.y))
        expected = dr.grad(surfels.sh).numpy()[:, 1] * 2 * np.sqrt(np.pi)
        assert expected.max() > 1
        np.testing.assert_allclose(mine.numpy(), expected, atol=1e-3 * expected.max())


def test_a_part_of_a_picture_shows_what_the_whole_does():
    """From among the surfels, where viewers leave out what lies far beside a picture, and not what lies beside a part of it."""
    whole = orbit_camera(size=(64, 48), distance=0.6)
    surfels = sphere_surfels(200, seed=1, scale=0.5)
    picture = rendered(surfels, whole, DILATIONS[0])
    part = whole.cropped(40, 8, 24, 32)
    shown = rendered(surfels, part, DILATIONS[0], whole)
    twin = render_ellipses_reference(surfels, part, DILATIONS[0], CUTOFFS, whole)
    assert np.abs(shown - twin).max() < 5e-3 and np.abs(shown - picture[8:40, 40:]).max() < 5e-3
    assert np.abs(rendered(surfels, part, DILATIONS[0]) - shown).max() > 0.05


def test_what_lies_behind_or_beside_is_not_drawn():
    camera = orbit_camera(size=(32, 24))
    away = replace(camera, to_world=camera.to_world @ np.diag([-1.0, 1, -1, 1]))
    picture = rendered(sphere_surfels(60), away, DILATIONS[0])
    assert np.isfinite(picture).all() and not picture.any()

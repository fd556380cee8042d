"""A fit of splats to pictures, as viewers will show them."""

from pathlib import Path

import numpy as np
import pytest

from rgs_mi.core.color import to_8bit
from rgs_mi.datasets.types import View
from rgs_mi.evaluation.metrics import psnr
from rgs_mi.fit.splats import SplatFit
from rgs_mi.splat.ellipses import DILATIONS, render_ellipses
from rgs_mi.surfels.surfels import SH_0, Surfels

from fits import model_of
from scenes import orbit_camera, sphere_surfels

SIZE, MINUTES = (64, 48), 0.12
CAMERAS = [orbit_camera(angle, SIZE) for angle in np.linspace(0, 2 * np.pi, 12, endpoint=False)]


def shown(surfels, camera, dilation=DILATIONS[0]):
    """Straight RGBA [H, W, 4], as a viewer has it."""
    picture = render_ellipses(surfels, camera, dilation)
    alpha = picture.alpha.numpy()[:, None]
    return np.concatenate([picture.color.numpy().T / np.maximum(alpha, 1e-6), alpha], 1).reshape(*SIZE[::-1], 4)


def over_white(image):
    return np.clip(image[..., :3] * image[..., 3:] + 1 - image[..., 3:], 0, 1)


@pytest.fixture
def true():
    return sphere_surfels(200, seed=2, order=3, scale=0.8, opacity_shift=2.0)


@pytest.fixture
def views(true):
    return [
        View(str(k), camera, to_8bit(np.clip(shown(true, camera), 0, 1)), True, None, Path())
        for k, camera in enumerate(CAMERAS)
    ]


def test_finds_what_pictures_show(true, views):
    """From views between those that it was fitted to, in viewers of either kind."""
    fields, rng = true.numpy(), np.random.default_rng(0)
    spoiled = Surfels.from_numpy(
        fields
        | {
            "sh": np.zeros_like(fields["sh"]),
            "centers": fields["centers"] + 0.03 * rng.normal(size=(200, 3)),
            "scales": 0.7 * fields["scales"],
        }
    )
    fit = SplatFit(views, model_of(spoiled), MINUTES, 400, extent=1.0)
    while fit.progress < 1:
        fit.step()
    found = fit.splats()
    for dilation in DILATIONS:
        error = lambda surfels: np.mean(
            [
                psnr(*(over_white(shown(s, orbit_camera(angle, SIZE), dilation)) for s in (surfels, true)))
                for angle in (0.26, 2.9, 4.4)
            ]
        )
        assert error(found) > 26 > 22 > error(spoiled)


def test_coefficients_stay_where_viewers_hold_them(true, views):
    fields = true.numpy()
    glaring = Surfels.from_numpy(fields | {"sh": 3 * np.sign(fields["sh"])})
    fit = SplatFit(views, model_of(glaring), MINUTES, 400, extent=1.0)
    fit.step()
    sh = fit.splats().numpy()["sh"]
    assert np.abs(sh[:, :3]).max() == np.float32(0.5 / SH_0) and np.abs(sh[:, 3:]).max() == 1
    for _ in range(30):
        fit.step()
    kept = fit.model.numpy("sh_rest")
    assert np.abs(kept).max() < 1.2 and (np.abs(kept) < 0.9).mean() > 0.01


def test_budget_is_kept(true, views):
    fit = SplatFit(views, model_of(true), MINUTES, 230, extent=1.0)
    while fit.progress < 1:
        fit.step()
    assert 150 < len(fit.model) <= 230

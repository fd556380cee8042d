"""What the colours of pictures mean."""

import numpy as np
import pytest

from rgs_mi.datasets.types import View
from rgs_mi.evaluation.evaluate import Rendering
from rgs_mi.evaluation.metrics import normal_mae_deg
from rgs_mi.evaluation.pictures import NORMAL_RANGE, RAMP, panels, ramp
from rgs_mi.report import html

from scenes import orbit_camera


def test_normal_error_has_the_angle():
    """The mean over the picture's degrees is the figure of metrics.json."""
    rng = np.random.default_rng(0)
    truth, normal = rng.normal(size=(2, 20, 20, 3)) + [4, 0, 0]
    truth /= np.linalg.norm(truth, axis=-1, keepdims=True)
    truth[:5] = 0  # unknown
    angles = (np.arange(0, 256) / 255, ramp(np.arange(0, 256) / 255) * 255)
    assert np.abs(np.diff(angles[1].mean(-1))).max() < 2  # no steps
    assert (np.diff(angles[1] @ [0.2126, 0.7152, 0.0722]) < 0).all()  # the larger the darker
    view = View("v", orbit_camera(0, size=(20, 20)), np.full((20, 20, 4), 255, np.uint8), False, truth, None)
    maps = {
        name: np.zeros((20, 20, 1 if name in ("roughness", "metallic", "depth") else 3))
        for name in ("color", "diffuse", "specular", "base_color", "roughness", "metallic", "depth")
    } | {"sh_normal": normal}
    shown = panels(view, Rendering(np.ones((20, 20, 3)), np.ones((20, 20, 1)), maps), 1.0)["normal error"]
    assert (shown[:5] == 255).all()
    nearest = np.abs(shown[5:, :, None].astype(float) - angles[1]).sum(-1).argmin(-1) / 255 * NORMAL_RANGE
    small = nearest < NORMAL_RANGE  # beyond, the ramp ends
    assert small.sum() > 100
    known = np.zeros((20, 20))
    known[5:][small] = 1
    assert nearest[small].mean() == pytest.approx(normal_mae_deg(normal, truth, known), abs=0.1)


def test_rgbe():
    rng = np.random.default_rng(1)
    radiance = np.exp(rng.normal(size=(8, 16, 3)) * 4)
    radiance[0, 0], radiance[0, 1] = 0, [-1, np.nan, 1e3]
    packed = html.rgbe(radiance).astype(float)
    light = packed[:8] * 2.0 ** (packed[8:] - 136)
    error = np.abs(light - np.maximum(np.nan_to_num(radiance), 0)) / np.maximum(radiance.max(-1, keepdims=True), 1e-9)
    assert np.nan_to_num(error).max() < 1 / 127 and (light[0, 0] == 0).all()
    assert light[0, 1, 2] == pytest.approx(1e3, rel=0.01)


def test_the_ramp_ends_as_it_says():
    assert (ramp(np.array([0.0, 1.0, 7.0])) == RAMP[[0, -1, -1]]).all()

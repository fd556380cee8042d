"""Metrics and colour against scikit-image and closed forms."""

import numpy as np
import pytest
from skimage import metrics as reference

from rgs_mi.color import display, srgb_decode, srgb_encode
from rgs_mi.metrics import normal_mae_deg, psnr, ssim


@pytest.fixture
def pair():
    rng = np.random.default_rng(0)
    a = rng.random((40, 50, 3))
    return a, np.clip(a + 0.1 * rng.normal(size=a.shape), 0, 1)


def test_psnr(pair):
    assert psnr(*pair) == pytest.approx(reference.peak_signal_noise_ratio(*pair, data_range=1))
    assert psnr(np.zeros((2, 2, 3)), np.full((2, 2, 3), 0.1)) == pytest.approx(20)
    assert psnr(pair[0], pair[0]) == float("inf")


def test_ssim_uses_the_11_pixel_window(pair):
    options = dict(data_range=1, channel_axis=-1, gaussian_weights=True, sigma=1.5, use_sample_covariance=False)
    assert ssim(*pair) == pytest.approx(reference.structural_similarity(*pair, **options, truncate=3.5))
    assert ssim(pair[0], pair[0]) == pytest.approx(1)
    with pytest.raises(ValueError):  # the window does not fit
        ssim(pair[0][:10], pair[1][:10])


def test_normal_error():
    angle = np.radians(10)
    truth = np.tile([0.0, 0.0, 1.0], (4, 1, 1))
    normal = np.array([[0, 0, 5.0], [0, np.sin(angle), np.cos(angle)], [0, 0, 0], [np.nan, 0, 1]])[:, None]
    error = lambda *alpha: normal_mae_deg(normal, truth, np.array(alpha)[:, None])
    assert error(1, 0, 0, 0) == pytest.approx(0)
    assert error(0, 1, 0, 0) == pytest.approx(10)
    assert error(0, 0, 1, 0) == pytest.approx(90)
    assert error(0, 0, 0, 1) == pytest.approx(90)
    assert error(0.5, 1, 0, 0) == pytest.approx(10 / 1.5)  # weighted by alpha
    truth[1] = 0
    assert error(1, 1, 0, 0) == pytest.approx(0)  # unknown truth is left out
    assert np.isnan(error(0, 1, 0, 0))
    assert normal_mae_deg(-truth, truth, np.ones((4, 1))) == pytest.approx(180)


def test_srgb():
    x = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(srgb_decode(srgb_encode(x)), x, atol=1e-12)
    assert srgb_encode(0.5) == pytest.approx(0.735356983)
    assert srgb_encode(0.001) == pytest.approx(0.01292)


def test_display():
    ldr = np.array([[[255, 0, 0, 51]]], np.uint8)
    np.testing.assert_allclose(display(ldr, 1.0), [[[1, 0.8, 0.8]]], atol=1e-6)
    hdr = np.array([[[7.0, 0.5, 0, 1]]], np.float32)
    out = display(hdr, (0, 0, 0))
    np.testing.assert_allclose(out, [[[1, 0.735357, 0]]], atol=1e-6)
    assert out.dtype == np.float32

"""Metrics and colour against slow twins, scikit-image and closed forms; the scores of a view."""

from types import SimpleNamespace

import numpy as np
import pytest
from skimage import metrics as reference

from rgs_mi.core.color import display, srgb_decode, srgb_encode
from rgs_mi.evaluation import evaluate, lpips
from rgs_mi.evaluation.metrics import normal_colors, normal_mae_deg, psnr, ssim


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


def slow_ssim(a, b):
    """Equation 13 of Wang et al. 2004 at each pixel that has a whole 11 x 11 window, and its mean."""
    offset = np.arange(-5, 6)
    window = np.exp(-(offset[:, None] ** 2 + offset**2) / (2 * 1.5**2))
    window = (window / window.sum())[..., None]
    mean = lambda patch: (window * patch).sum((0, 1))
    values = []
    for y in range(a.shape[0] - 10):
        for x in range(a.shape[1] - 10):
            p, q = (image[y : y + 11, x : x + 11] for image in (a, b))
            mp, mq = mean(p), mean(q)
            vp, vq, covariance = mean((p - mp) ** 2), mean((q - mq) ** 2), mean((p - mp) * (q - mq))
            values.append(
                (2 * mp * mq + 0.01**2) * (2 * covariance + 0.03**2) / ((mp**2 + mq**2 + 0.01**2) * (vp + vq + 0.03**2))
            )
    return np.mean(values)


def test_ssim_is_its_slow_twin():
    rng = np.random.default_rng(0)
    for _ in range(20):
        a = rng.random((*rng.integers(11, 24, 2), 3))
        b = np.clip(a + rng.random() * rng.normal(size=a.shape), 0, 1)
        assert ssim(a, b) == pytest.approx(slow_ssim(a, b), abs=1e-6)


def test_normal_colors():
    normal = np.array([[[0, 0, 1.0], [0, -0.5, 0], [0, 0, 0]]])  # premultiplied
    colors = normal_colors(normal, np.array([[1, 0.5, 0]]))
    np.testing.assert_allclose(colors, [[[0.5, 0.5, 1], [0.75, 0.5, 0.75], [1, 1, 1]]])


# ---- Scores of a view ----


@pytest.fixture
def scored():
    """(view, rendering): noise, opaque in the left half, whose normals are known but for the first row; its equal."""
    rng = np.random.default_rng(0)
    alpha = np.zeros((32, 40), np.float32)
    alpha[:, :20] = 1
    normal = rng.normal(size=(32, 40, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    truth = np.where(alpha[..., None] > 0, normal, 0)
    truth[0] = 0
    pixels = np.dstack([rng.integers(256, size=(32, 40, 3)), 255 * alpha]).astype(np.uint8)
    view = SimpleNamespace(pixels=pixels, alpha=alpha, normal=truth)
    return view, evaluate.Rendering(display(pixels, 1.0), alpha[..., None].copy(), {"sh_normal": normal * alpha[..., None]})


def test_scores(scored, monkeypatch):
    view, rendering = scored
    called = []
    monkeypatch.setattr(lpips, "installed", lambda: True)
    monkeypatch.setattr(lpips, "distance", lambda a, b, network: called.append(network) or float(np.abs(a - b).max()))
    figures = evaluate.score(view, rendering, 1.0)
    assert tuple(figures) == evaluate.SCORES and called == ["vgg", "alex", "vgg"]
    assert figures["psnr"] == np.inf and figures["ssim"] == figures["normal_ssim"] == pytest.approx(1)
    assert figures["lpips"] == figures["lpips_alex"] == 0
    assert figures["normal_lpips"] == pytest.approx(0, abs=1e-6)  # the first row is white in both
    rendering.maps["sh_normal"][5, 5] *= -1
    rendering.image[5, 5] = 1 - rendering.image[5, 5]
    figures = evaluate.score(view, rendering, 1.0)
    assert figures["lpips"] > 0.01 and figures["normal_lpips"] > 0.01 and figures["normal_ssim"] < 0.999
    rendering.alpha[10:, 30:] = 1  # a floater where the view is empty counts, though its normals are not known there
    assert evaluate.score(view, rendering, 1.0)["normal_ssim"] < figures["normal_ssim"] - 0.01


def test_scores_that_are_unknown(scored, monkeypatch):
    view, rendering = scored
    monkeypatch.setattr(lpips, "installed", lambda: False)
    figures = evaluate.score(view, rendering, 1.0)
    assert [name for name, value in figures.items() if value is None] == ["lpips", "lpips_alex", "normal_lpips"]
    view.normal = None
    bare = evaluate.score(view, rendering, 1.0)
    assert all(bare[name] is None for name in evaluate.SCORES if name.startswith("normal"))
    mean = evaluate.mean_scores([figures, bare])
    assert mean["lpips"] is None and mean["normal_ssim"] == figures["normal_ssim"]


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

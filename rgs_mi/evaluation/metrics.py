"""Scores of NumPy images: those that the papers report, computed as they do."""

import numpy as np


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Return the peak signal-to-noise ratio in dB of two [H, W, 3] images in [0, 1]; inf where they are equal."""
    error = np.mean((np.asarray(a, np.float64) - np.asarray(b, np.float64)) ** 2)
    return float(-10 * np.log10(error)) if error > 0 else float("inf")


def ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Return the mean structural similarity of two [H, W, 3] images in [0, 1], at least 11 pixels wide and high.

    Wang et al. 2004 as the literature has it: an 11x11 Gaussian window of sigma 1.5 (scikit-image truncates it at 3.5
    sigma, which is that size), population covariances, the mean over the channels.
    """
    from skimage.metrics import structural_similarity

    similarity = structural_similarity(
        np.asarray(a, np.float64),
        np.asarray(b, np.float64),
        data_range=1.0,
        channel_axis=-1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    assert isinstance(similarity, float), "the mean alone was asked for"
    return float(similarity)


def normal_mae_deg(normal: np.ndarray, truth: np.ndarray, alpha: np.ndarray) -> float:
    """Return the mean angular error of normals in degrees, weighted by the ground truth's alpha as in Ref-NeRF (Verbin et al.
    2022).

    ``normal`` [H, W, 3] are vectors of any length, ``truth`` [H, W, 3] unit vectors, ``alpha`` [H, W] is in [0, 1]. Pixels
    whose ``truth`` is zero are unknown and left out; a zero or non-finite ``normal`` counts as 90 degrees. NaN where nothing
    is known.
    """
    weight = np.where(np.linalg.norm(truth, axis=-1) > 0.5, alpha, 0).astype(np.float64)
    if weight.sum() == 0:
        return float("nan")
    return float((weight * normal_angles_deg(normal, truth)).sum() / weight.sum())


def normal_angles_deg(normal: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the degrees [H, W] between vectors [H, W, 3] of any length; 90 where one is zero, or ``normal`` is not finite."""
    normal, truth = np.asarray(normal, np.float64), np.asarray(truth, np.float64)
    normal = np.where(np.isfinite(normal).all(-1, keepdims=True), normal, 0)
    # Half-angle form: exact for small angles, where arccos of a rounded product is not.
    a = normal * np.linalg.norm(truth, axis=-1, keepdims=True)
    b = truth * np.linalg.norm(normal, axis=-1, keepdims=True)
    angle = 2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))
    return np.degrees(np.where(a.any(-1) & b.any(-1), angle, np.pi / 2))


def normal_colors(normal: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Return colours [H, W, 3] in [0, 1] that show normals: n / 2 + 1/2, in world space, over white.

    ``normal`` [H, W, 3] is premultiplied by ``alpha`` [H, W]. `ssim` and LPIPS of normals are those of such images: the tables
    of the papers give them without saying over which background.
    """
    alpha = np.asarray(alpha, np.float64)[..., None]
    return np.clip((normal + alpha) / 2 + 1 - alpha, 0, 1)


def relative_error(values: np.ndarray, truth: np.ndarray) -> float:
    """Return Σ |values − truth| / Σ truth, of radiance of any one shape."""
    return float(np.abs(values - truth).sum() / truth.sum())

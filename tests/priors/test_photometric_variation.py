"""How points look to the photographs that see them: against a loop over points, and what is told of mirrors and matte paint."""

import numpy as np
import pytest

from rgs_mi.core.camera import Camera
from rgs_mi.core.color import srgb_decode
from rgs_mi.datasets.types import View
from rgs_mi.priors import photometric_variation
from rgs_mi.priors.photometric_variation import Appearance, appearance

COUNT, SIZE = 14, 24


def views(pixels) -> list[View]:
    """Photographs of what lies about the origin, from all around; ``pixels(index)`` are theirs."""
    angles = np.linspace(0, 2 * np.pi, COUNT, endpoint=False)
    cameras = [Camera.look_at((4 * np.cos(a), 4 * np.sin(a), 1), (0, 0, 0), (0, 0, 1), 40, (SIZE, SIZE)) for a in angles]
    return [View(str(k), camera, pixels(k), True, None, None) for k, camera in enumerate(cameras)]


@pytest.fixture
def noise():
    rng = np.random.default_rng(3)

    def pixels(_):
        image = rng.integers(0, 256, (SIZE, SIZE, 4), np.uint8)
        image[..., 3] = rng.choice([0, 128, 255], (SIZE, SIZE), p=[0.2, 0.2, 0.6])
        return image

    return views(pixels)


def sees(index, z, column, row):
    return (3 * index + column + 2 * row) % 5 > 1


def slow(position, views):
    """`appearance` of one point, whose color is NaN where nothing sees it."""
    total, weight, opaque = 0.0, 0.0, []
    for index, view in enumerate(views):
        (pixel,), (z,) = view.camera.project(position[None])
        column, row = np.floor(pixel).astype(int)
        if z <= 0 or not (0 <= column < SIZE and 0 <= row < SIZE) or not sees(index, z, column, row):
            continue
        rgb, alpha = srgb_decode(view.pixels[row, column, :3] / 255), view.pixels[row, column, 3] / 255
        total, weight = total + alpha * rgb, weight + alpha
        if alpha == 1:
            opaque.append(rgb)
    color = total / weight if weight else np.full(3, np.nan)
    if len(opaque) < 6:
        return color, np.full(3, np.nan), np.nan
    rank = lambda values, part: np.sort(values, 0)[int(np.round(part * (len(values) - 1)))]
    luminance = np.mean(opaque, 1)
    spread = 1.4826 * rank(np.abs(luminance - rank(luminance, 0.5)), 0.5)
    return color, rank(np.array(opaque), 0.25), spread / (rank(luminance, 0.5) + 0.2)


@pytest.mark.parametrize("chunk", [5_000_000, 500])
def test_points_look_as_in_a_loop(noise, monkeypatch, chunk):
    monkeypatch.setattr(photometric_variation, "_CHUNK", chunk)
    positions = np.random.default_rng(1).uniform(-1.5, 1.5, (150, 3)).astype(np.float32)
    expected = [np.array(part) for part in zip(*(slow(p, noise) for p in positions))]
    found = appearance(positions, noise, sees)
    seen = np.isfinite(expected[0])
    np.testing.assert_allclose(found.color[seen], expected[0][seen], rtol=1e-5)
    for got, true in zip(found[1:], expected[1:]):
        np.testing.assert_allclose(got, true, rtol=1e-4, atol=1e-6)
    few = np.isnan(found.variation)
    assert 5 < few.sum() < 145 and all(part.dtype == np.float32 for part in found)
    np.testing.assert_allclose(found.metallic[few], 0.4)
    np.testing.assert_allclose(found.diffuse[few], 0.5 * found.color[few])


def test_what_changes_from_view_to_view_is_taken_for_a_metal():
    """A lower half of one matte grey, and an upper one that shows each photograph another radiance of a city's range."""
    shown = np.random.default_rng(0).permutation(np.linspace(20, 250, COUNT)).astype(np.uint8)

    def pixels(index):
        image = np.full((SIZE, SIZE, 4), 255, np.uint8)
        image[: SIZE // 2, :, :3], image[SIZE // 2 :, :, :3] = shown[index], 120
        return image

    look = appearance(np.array([[0, 0, 0.5], [0, 0, -0.5]], np.float32), views(pixels), lambda *_: True)
    mirror, matte = look.metallic
    assert mirror > 0.7 and matte == pytest.approx(0.05)
    grey = srgb_decode(np.array(120 / 255))
    np.testing.assert_allclose(look.diffuse[1], 0.95 * grey, rtol=1e-4)
    assert look.diffuse[0].max() < 0.2 * look.color[0].min()


def test_of_points_that_have_no_more_than_a_color_nothing_else_is_known():
    color = np.array([[0.2, 0.4, 0.6]], np.float32)
    look = Appearance.of(color)
    np.testing.assert_allclose(look.diffuse, 0.5 * color)
    assert look.metallic == pytest.approx([0.4])

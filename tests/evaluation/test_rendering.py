"""Renderings in bands, and how fast they are."""

import numpy as np

from rgs_mi.core.film import Film
from rgs_mi.evaluation import evaluate

from fits import photographed
from scenes import orbit_camera


def test_bands_make_the_same_picture(monkeypatch):
    """They begin where tiles do, so not even the order of surfels is another."""
    (surfels, lighting), film = photographed(), Film.gaussian(0.5, 4)
    camera = orbit_camera(0.4, size=(50, 61))
    whole = evaluate.render_view(surfels, lighting, camera, 1.0, film)
    monkeypatch.setattr(evaluate, "_MOST_SAMPLES", 50 * 4 * 19)
    assert [band.size for band in evaluate._bands(camera, film)] == [(50, 16)] * 3 + [(50, 13)]
    bands = evaluate.render_view(surfels, lighting, camera, 1.0, film)
    assert whole.alpha.max() > 0.9 and whole.alpha.shape == bands.alpha.shape == (61, 50, 1)
    np.testing.assert_allclose(bands.image, whole.image, atol=2e-5)
    for name, values in whole.maps.items():
        np.testing.assert_allclose(bands.maps[name], values, atol=1e-4, err_msg=name)


def test_speed_is_measured_within_a_time():
    surfels, lighting = photographed()
    assert evaluate.frames_per_second(surfels, lighting, [orbit_camera(0.4)], seconds=0.0) > 0

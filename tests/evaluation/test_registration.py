"""A held-out view finds its pose and exposure by every other part of its photograph."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

import rgs_mi
from rgs_mi.evaluation import evaluate, metrics
from rgs_mi.evaluation.registration import Registration, chessboard, register

from captures import perturbed
from fits import photographed, random_photographs


@pytest.fixture(scope="module")
def dataset():
    rgs_mi.set_variant()
    return random_photographs(distance=3.5)


@pytest.mark.parametrize("poses, exposure", [(True, True), (True, False), (False, True)])
def test_what_is_off_comes_back(dataset, poses, exposure):
    surfels, lighting = photographed()
    off = {"degrees": 1.0 * poses, "position": 0.01 * poses, "stops": 0.3 * exposure}
    others, exposures = perturbed(dataset, focal=0.0, quality=None, dilation=None, **off)
    for truth, view in list(zip(dataset.train, others.train))[:2]:
        found = register(Registration(poses, exposure), surfels, lighting, view, 1.0)
        turned = np.trace(found.camera.rotation @ truth.camera.rotation.T)
        assert np.degrees(np.arccos(np.clip((turned - 1) / 2, -1, 1))) < 0.3
        assert np.linalg.norm(found.camera.origin - truth.camera.origin) < 0.015
        assert (found.gain is None) == (not exposure)
        if exposure:
            assert np.allclose(np.log2(found.gain), exposures[view.name], atol=0.03)
        image = lambda camera, gain: evaluate.render_view(surfels, lighting, camera, 1.0, gain=gain).image
        before, after = (
            metrics.psnr(image(*seen), evaluate.ground_truth(view, 1.0))
            for seen in ((view.camera, None), (found.camera, found.gain))
        )
        assert after > before + 3 and after > 40


def test_the_other_parts_are_not_looked_at(dataset):
    """Not even where some pixels of one are of the other at a level: their edges are a margin."""
    surfels, lighting = photographed()
    view = dataset.train[0]
    height, width = view.pixels.shape[:2]
    fitted = chessboard(width, height)
    assert 0.4 < fitted.mean() < 0.6 and fitted[0, 0] and not fitted[0, -1] and not fitted[-1, 0] and fitted[-1, -1]
    spoiled = view.pixels.copy()
    spoiled[ndimage.binary_erosion(~fitted, iterations=3, border_value=1)] = 0
    assert (spoiled != view.pixels).any(-1).mean() > 0.1
    plain, other = (
        register(Registration(True, True), surfels, lighting, v, 1.0) for v in (view, replace(view, pixels=spoiled))
    )
    assert np.allclose(plain.camera.to_world, other.camera.to_world, atol=5e-3) and np.allclose(plain.gain, other.gain, 5e-3)

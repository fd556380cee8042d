"""What a fit does of itself where settings leave it open."""

from dataclasses import replace

import numpy as np
import pytest

from rgs_mi.fit.plan import COST, LAST, LEAST_STEPS, OFTEN, STEPS, agree, planned, told
from rgs_mi.fit.trainer import Fit
from rgs_mi.settings.config import to_dict
from rgs_mi.settings.settings import Density, Initialization, Settings, Stage

from fits import SETTINGS, model


def with_pixels(dataset, count, masked=False):
    """``dataset`` with cameras that see so many times as many pixels a side, all of the object, in photographs that are white."""
    views = []
    for view in dataset.train:
        camera = view.camera.resized(view.camera.size[0] * count, view.camera.size[1] * count)
        white = np.broadcast_to(np.uint8(255), (*camera.size[::-1], 4))
        views.append(replace(view, camera=camera, pixels=white, masked=masked))
    return replace(dataset, train=views)


@pytest.mark.parametrize(
    "minutes, scale, photographed, masked, most",
    [
        (8, 1, True, True, 50_000),
        (10, 4, True, True, 83 * 75 * 16),
        (5, 4, True, True, 75_000),
        (20, 1, True, True, 100_000),
        (4, 4, True, True, 60_000),
        (None, 4, True, True, 50_000),
        (10, 4, False, True, 50_000),
        (30, 1, False, True, 150_000),
        (10, 4, False, False, 50_000),
        (2, 4, True, False, 80_000),
        (10, 4, True, False, 83 * 75 * 16),
        (30, 9, True, False, 400_000),
        (60, 9, True, False, 400_000),
        (60, 8, False, True, 150_000),
    ],
)
def test_surfels_go_with_minutes_and_photographs_pixels(dataset, minutes, scale, photographed, masked, most):
    settings = Settings(minutes=minutes, iterations=None if minutes else 100)
    found = planned(settings, replace(with_pixels(dataset, scale, masked), photographed=photographed))
    first = int(most * (0.75 if photographed and not masked else 0.5))
    assert found.density.max_surfels == most and found.initialization.surfels == max(25_000, first)


@pytest.mark.parametrize(
    "scale, stages",
    [
        (1, [(0.2, 2), (1, 1)]),
        (7, [(0.2, 2), (1, 1)]),
        (8, [(0.1, 4), (0.2, 2), (1, 1)]),
        (15, [(0.1, 4), (0.2, 2), (1, 1)]),
        (16, [(0.05, 8), (0.1, 4), (0.2, 2), (1, 1)]),
    ],
)
def test_levels_begin_at_a_square_of_some_220_pixels(dataset, scale, stages):
    found = planned(Settings(), with_pixels(dataset, scale)).stages  # 83 x 75 pixels times the scale
    assert [(s.until, s.downscale) for s in found] == stages and {s.views for s in found} == {1}


def test_steps_of_filtered_images_take_more_samples_in_the_end(dataset):
    """A data set says how its images were filtered, unless someone does."""
    large = with_pixels(dataset, 7)
    plain, filtered = planned(Settings(), large), planned(Settings(), replace(large, rfilter=0.5))
    assert plain.rfilter == 0 and filtered.rfilter == 0.5
    assert [s.spp for s in plain.stages] == [1, 1]
    assert [(s.until, s.downscale, s.spp) for s in filtered.stages] == [(0.2, 2, 1), (0.85, 1, 1), (1, 1, 4)]
    assert planned(Settings(rfilter=0), replace(large, rfilter=0.5)).stages == plain.stages


def test_what_is_asked_for_stays(dataset):
    asked = replace(SETTINGS, density=Density(max_surfels=7), initialization=Initialization(surfels=5))
    asked = replace(asked, mask_rim=2, rfilter=0.4)
    assert planned(asked, dataset) == asked
    few = planned(Settings(density=Density(max_surfels=7)), dataset)
    assert (few.density.max_surfels, few.initialization.surfels) == (7, 7)
    first = planned(Settings(initialization=Initialization(surfels=9)), dataset)
    assert (first.density.max_surfels, first.initialization.surfels) == (50_000, 9)
    own = (Stage(1.0, 3, 2),)
    assert planned(Settings(stages=own), dataset).stages == own


def test_jobs_know_their_fits(dataset):
    asked = Settings(minutes=3)
    saved = to_dict(planned(asked, dataset))
    assert agree(to_dict(asked), saved)
    assert not agree(to_dict(replace(asked, seed=1)), saved)
    assert not agree(to_dict(replace(asked, density=Density(max_surfels=9))), saved)
    assert not agree(to_dict(asked), {"minutes": 3})
    walls = saved | {"room": [3.0] * 6}
    assert agree(to_dict(replace(asked, room="auto")), walls) and agree(to_dict(replace(asked, room="auto")), saved)
    assert not agree(to_dict(asked), walls)


def test_what_is_decided_is_told(dataset):
    line = told(planned(Settings(), dataset), dataset)
    assert "6 images of known cameras of 83 x 75 pixels, with masks, and 0 held out" in line
    assert "cameras=fixed, exposure=fixed, light=auto, density.max_surfels=50000" in line
    some = [replace(dataset.train[0], masked=False), *dataset.train[1:]]
    assert "6 photographs" in told(planned(Settings(), dataset), replace(dataset, train=some, photographed=True))
    assert "5 of them with masks" in told(planned(Settings(), dataset), replace(dataset, train=some))


def test_levels_wait_for_steps_and_time(dataset, monkeypatch):
    """However fast or slow steps are: none is left early, and none begun that there is no time for."""
    stages = (Stage(0.1, 4, 1), Stage(0.2, 2, 1), Stage(1.0, 1, 1))
    fit = Fit(dataset, model(), replace(SETTINGS, iterations=None, minutes=1.0, stages=stages), 1.0)
    fit.step()
    assert fit.stage.downscale == 4
    fit.elapsed = 13.0  # past both by the clock
    assert fit.stage.downscale == 4, "too few steps"
    level = fit._level
    level.steps = STEPS[0]
    level.seconds.clear()
    level.seconds.append(47.0 / LEAST_STEPS / 4**COST / 1.02)  # the next has four times the pixels
    assert fit.stage.downscale == 2
    level.seconds.clear()
    level.seconds.append(47.0 / LEAST_STEPS / 4**COST / 0.98)
    assert fit.stage.downscale == 4, "no time for it"
    width, height = fit.photographs.window
    monkeypatch.setattr("rgs_mi.datasets.photographs.MOST_SAMPLES", width * height)
    assert fit.stage.downscale == 2, "four tiles: steps take no longer"
    level.seconds.clear()
    level.seconds.append(47.0 / LEAST_STEPS * 1.1)
    assert fit.stage.downscale == 4, "no time for it"
    fit.elapsed = 60 * (1 - LAST) + 1
    assert fit.stage.downscale == 2, "time for every view, in the last part"


def test_the_last_part_is_finer_if_all_views_have_their_turn(dataset):
    stages = (Stage(0.1, 2, 1), Stage(1.0, 1, 1))
    fit = Fit(dataset, model(), replace(SETTINGS, iterations=None, minutes=1.0, stages=stages), 1.0)
    fit.step()
    second = lambda often, time: time / (often * len(dataset.train)) / 4**COST  # of a step, to see all so often in that time

    def at(elapsed, seconds):
        fit.elapsed = elapsed
        fit._level.seconds.clear()
        fit._level.seconds.append(seconds)

    late, early = 60 * (1 - LAST) + 1, 60 * (1 - LAST) - 1
    at(late, second(1, 14) / 1.02)
    assert fit.stage.downscale == 2, "too few steps"
    fit._level.steps = STEPS[1]
    assert fit.stage.downscale == 1
    at(late, second(1, 14) / 0.98)
    assert fit.stage.downscale == 2, "no time for every view"
    at(early, second(OFTEN, 16) / 0.98)
    assert fit.stage.downscale == 2, "no time for every view six times"
    at(early, second(OFTEN, 16) / 1.02)
    assert fit.stage.downscale == 1


def test_rims_are_those_of_photographs(dataset, monkeypatch):
    monkeypatch.setattr("rgs_mi.fit.plan.rim", lambda views: 3 if views is photographed.train else None)
    photographed = replace(dataset, photographed=True)
    assert planned(Settings(), photographed).mask_rim == 3 and planned(Settings(), dataset).mask_rim == 0
    assert planned(Settings(mask_rim=1), photographed).mask_rim == 1

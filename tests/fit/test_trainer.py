"""The fit: crops, schedules, kernels that are not recompiled, and resuming."""

from dataclasses import replace
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import ndimage

from rgs_mi.commands.optimize import start
from rgs_mi.core.arrays import as_float
from rgs_mi.core.film import Film
from rgs_mi.datasets.photographs import Photographs
from rgs_mi.datasets.types import DepthPrior
from rgs_mi.evaluation.evaluate import render_view
from rgs_mi.fit import losses, objective, schedule, trainer
from rgs_mi.fit.density import Statistics
from rgs_mi.fit.light_maps import STEPS, LightMaps
from rgs_mi.fit.trainer import Fit
from rgs_mi.settings.settings import Density, Initialization, LearningRates, Settings, Stage, Weights
from rgs_mi.shading import deferred
from rgs_mi.shading.environment import Environment
from rgs_mi.shading.indirect import Indirect
from rgs_mi.shading.lighting import Lighting, Shading
from rgs_mi.shading.split_sum import SplitSum
from rgs_mi.surfels.surfels import Surfels

from fits import SETTINGS, model, photographed
from scenes import sphere_surfels


@pytest.mark.parametrize("downscale", [1, 2])
def test_crops_hold_the_object_and_their_cameras_fit(dataset, downscale):
    photographs = Photographs(dataset.train, downscale, 1.0)
    sizes = set()
    surfels = sphere_surfels(300, seed=2, scale=0.9, opacity_shift=4)
    lighting = Lighting(SplitSum(model().environment().filtered()))
    surfels = Surfels.from_numpy(surfels.numpy(), two_sided=False)
    for i, view in enumerate(dataset.train):
        photo = photographs.tile(i)
        alpha = photo.alpha
        sizes.add(photo.camera.size)
        assert photo.size == tuple(n // downscale for n in view.camera.size)
        full = view.pixels[..., 3].astype(float) / 255
        assert alpha.numpy().sum() * downscale**2 == pytest.approx(full.sum(), rel=0.01)
        rendered = deferred.render(surfels, photo.camera, lighting).gbuffer.all.alpha.numpy()
        assert np.abs(rendered - alpha.numpy()).mean() < 0.03  # a camera that is off by a pixel gives more
    assert len(sizes) == 1
    assert downscale > 1 or np.prod(sizes.pop()) < 0.8 * 83 * 75


def test_photographs_are_seen_through_their_film(dataset):
    """Those that a film has filtered are what the surfels that they show look like on it, and on none that is sharper."""
    (surfels, lighting), stddev, spp = photographed(), 0.5, 4
    film, sharp = Film.gaussian(stddev, spp), Film.gaussian(0, spp)

    def filtered(view):
        rendering = render_view(surfels, lighting, view.camera, 0.0, Film.gaussian(stddev, spp))
        straight = rendering.image / np.maximum(rendering.alpha, 1e-3)
        pixels = np.clip(np.concatenate([straight, rendering.alpha], 2), 0, 1)
        return replace(view, pixels=(pixels * 255 + 0.5).astype(np.uint8))

    filmed = replace(dataset, train=[filtered(view) for view in dataset.train])
    photo = Photographs(filmed.train, 1, 1.0).tile(2, spp=spp)
    fit = Fit(filmed, model(), replace(SETTINGS, rfilter=stddev, stages=(Stage(spp=spp),)), 1.0)
    assert fit.film == film

    def loss(film):
        with dr.suspend_grad():
            image = deferred.render(surfels, film.samples(photo.camera), lighting, cutoffs=objective.CUTOFFS)
            found = fit.objective(image, photo, True, 0.0, 0, None, film)
        return float(found.terms["loss.photometric"][0]), found.photometric

    (own, spread), (other, _) = loss(film), loss(sharp)
    assert own < 0.4 * other
    assert dr.width(spread) == np.prod([film.samples_along(n) for n in photo.camera.size])


def test_density_control_does_not_ask_for_the_number_of_samples(dataset):
    """Lengths of gradients, but for what differs between samples of a pixel, and what surfels make of pictures are the same."""
    found = []
    for spp in (1, 4):
        stages, density = (Stage(spp=spp),), replace(SETTINGS.density, prune_weight=0.05)
        fit = Fit(dataset, model(), replace(SETTINGS, stages=stages, density=density), 1.0)
        fit.photographs, statistics = Photographs(dataset.train, 1, 1.0), Statistics(300)
        fit._view(2, None, 1.0, statistics)
        found.append([values.numpy().sum() for values in (statistics.gradient, statistics.weight, statistics.share)])
    np.testing.assert_allclose(found[1][1:], found[0][1:], rtol=0.03)
    assert found[1][0] == pytest.approx(found[0][0], rel=0.35)


@pytest.mark.parametrize("downscale", [1, 2])
def test_priors_are_cropped_like_photographs(dataset, downscale):
    """A prior that is the mask itself, with a hole."""
    values = [np.where(v.pixels[..., 3] > 127, v.pixels[..., 3] / 255, np.nan).astype(np.float32) for v in dataset.train]
    photographs = Photographs(dataset.train, downscale, 1.0, [DepthPrior(v, inverse=True) for v in values])
    photo = photographs.tile(2)
    prior, alpha = photo.prior.numpy(), photo.alpha.numpy()
    assert photo.inverse and prior.shape == alpha.shape and np.isnan(prior[alpha < 0.2]).all()
    assert np.abs(prior - alpha)[(alpha > 0.9) & np.isfinite(prior)].max() < 0.2
    assert Photographs(dataset.train, downscale, 1.0).tile(2).prior is None


def test_photographs_keep_no_more_than_they_count(dataset):
    photographs = Photographs(dataset.train, 1, 1.0)
    photographs.tile(0)
    (kept,) = photographs._kept.values()
    assert kept[0].dtype == np.float16 and all(planes.base is None for planes in kept)


@pytest.mark.parametrize("downscale, rim", [(1, None), (1, 2), (2, None)])
def test_photographs_that_are_not_kept_are_the_same(dataset, monkeypatch, downscale, rim):
    values = [np.where(v.pixels[..., 3] > 127, v.pixels[..., 3] / 255, np.nan).astype(np.float32) for v in dataset.train]
    of = lambda: Photographs(dataset.train, downscale, 1.0, [DepthPrior(v) for v in values], tolerance=3, rim=rim)
    monkeypatch.setattr("rgs_mi.datasets.photographs.MOST_SAMPLES", 600)  # several tiles
    kept, made = of(), of()
    turns = [(view, turn) for view in range(3) for turn in range(2)]
    tiles = [kept.tile(view, turn) for view, turn in turns]
    monkeypatch.setattr("rgs_mi.datasets.photographs.MOST_KEPT", 0)
    for photo, (view, turn) in zip(tiles, turns):
        again = made.tile(view, turn)
        assert again.camera.principal == photo.camera.principal and 0 < photo.part < 1
        for name in ("color", "alpha", "behind", "prior"):
            np.testing.assert_array_equal(np.array(getattr(again, name)), np.array(getattr(photo, name)))
    assert len(kept._kept) == 3 and not made._kept
    assert sum(photo.alpha.numpy().sum() for photo in tiles) > 100


def test_masks_that_may_be_wrong_show_what_lies_behind(dataset):
    """Near their borders the photograph itself; farther away what is opaque, or the background."""
    view = dataset.train[1]
    view = replace(
        view, pixels=np.where(view.pixels[..., 3:] > 127, view.pixels | np.uint8([0, 0, 0, 255]), np.uint8([9, 90, 200, 0]))
    )
    exact, photo = (Photographs([view], 1, 1.0, tolerance=t).tile(0) for t in (0, 3))
    width, height = photo.camera.size
    image = lambda value: np.array(value).T.reshape(height, width, 3)
    mask = exact.alpha.numpy().reshape(height, width) > 0.5
    away = np.where(mask, *(ndimage.distance_transform_cdt(m, "chessboard") for m in (mask, ~mask)))
    assert (np.array(exact.behind) == 1).all() and np.abs(image(exact.color)[~mask] - 1).max() == 0
    near = away <= 3
    np.testing.assert_array_equal(image(photo.behind)[near], image(photo.color)[near])
    np.testing.assert_allclose(image(photo.color)[near & ~mask] * 255, [[9, 90, 200]] * (near & ~mask).sum(), atol=0.1)
    np.testing.assert_array_equal(image(photo.color)[~near], image(exact.color)[~near])
    assert (image(photo.behind)[~near] == 1).all() and (photo.alpha.numpy() == exact.alpha.numpy()).all()
    whole = replace(view, masked=False)
    assert (Photographs([whole], 1, 0.5, tolerance=3).tile(0).behind.x.numpy() == 0.5).all()


def test_steps_note_what_surfels_make_of_pictures(dataset):
    """All of them together what is covered, and the part of the photometric loss that is there; the losses and their gradients
    know nothing of it."""
    weighing = replace(SETTINGS, density=replace(SETTINGS.density, prune_weight=0.05))
    found = []
    for settings in (SETTINGS, weighing):
        fit, statistics = Fit(dataset, model(), settings, 1.0), Statistics(len(model()))
        fit.photographs = Photographs(dataset.train, 1, 1.0)
        loss = fit._view(3, None, 1.0, statistics)
        found.append((float(loss["loss.photometric"][0]), statistics.gradient.numpy()))
        assert settings is weighing or not (statistics.weight.numpy().any() or statistics.share.numpy().any())
    assert found[0][0] == found[1][0]
    np.testing.assert_allclose(found[0][1], found[1][1], rtol=1e-4, atol=1e-9)
    photo = fit.photographs.tile(3)
    image = deferred.render(fit.model.surfels(0), photo.camera, None, cutoffs=objective.CUTOFFS)
    covered = image.gbuffer.all.alpha.numpy()
    loss = fit.objective(image, photo, True, 0, 0).photometric.numpy()
    assert statistics.weight.numpy().sum() == pytest.approx(covered.mean(), rel=1e-4)
    assert statistics.share.numpy().sum() == pytest.approx((covered * loss).mean(), rel=1e-3)
    assert statistics.share.numpy().min() >= 0


def test_tiles_of_a_large_window_estimate_it(dataset, monkeypatch):
    """Turn by turn they cover it, through cameras of their own; the mean of their losses, and of the gradients that density
    control takes, are those of the whole."""
    weights = Weights(dssim=0, consistency=(0, 0), normal=0, minimum_variation=0)  # what is a mean over pixels
    settings = replace(SETTINGS, weights=weights)
    fit, view = Fit(dataset, model(), settings, 1.0), 3
    fit.photographs = Photographs(dataset.train, 1, 1.0)
    (width, height), whole = fit.photographs.tile(view).camera.size, fit.photographs.tile(view)
    rays = whole.camera.rays().reshape(height, width, 3)
    color = np.array(whole.color).T.reshape(height, width, 3)

    def measured():
        statistics = Statistics(len(fit.model))
        loss = fit._view(view, None, 1.0, statistics)
        return float(loss["loss.photometric"][0]), float(loss["error"][0]), statistics.gradient.numpy()

    expected = measured()
    monkeypatch.setattr("rgs_mi.datasets.photographs.MOST_SAMPLES", width * height // 3)
    covered, found = np.zeros((height, width), int), []
    for turn in range(4):
        tile = fit.photographs.tile(view, turn)
        w, h = tile.camera.size
        corner = np.abs(rays - tile.camera.rays()[0, 0]).sum(-1).argmin()
        top, left = divmod(corner, width)
        covered[top : top + h, left : left + w] += 1
        np.testing.assert_allclose(tile.camera.rays(), rays[top : top + h, left : left + w], atol=1e-6)
        np.testing.assert_allclose(np.array(tile.color).T.reshape(h, w, 3), color[top : top + h, left : left + w], atol=1e-6)
        assert tile.part == w * h / (width * height) < 1 / 2
        fit.views_used = turn * len(dataset.train)
        found.append(measured())
    assert covered.min() == 1 and (covered > 1).mean() < 0.1
    for k in range(2):
        assert np.mean([f[k] for f in found]) == pytest.approx(expected[k], rel=0.1)
    total = np.sum([f[2] for f in found], 0)
    strong = expected[2] > np.percentile(expected[2], 50)
    assert np.median(total[strong] / expected[2][strong]) == pytest.approx(1, abs=0.1)


def test_a_fit_gets_better(dataset):
    fit = Fit(dataset, model(), SETTINGS, 1.0)
    fit.step()
    first = fit.psnr
    while fit.progress < 1:
        fit.step()
    assert fit.psnr > first + 2
    assert fit.views_used == fit.step_number == 40


def test_a_wrong_depth_prior_bends_the_surface(dataset):
    """A plane as the prior and a great weight: the rendered depth takes its slope."""
    rows = np.broadcast_to(np.arange(75, dtype=np.float32)[:, None], (75, 83))
    settings = replace(
        SETTINGS, weights=Weights(dssim=0, mask=0, normal=0, depth=10), learning_rates=LearningRates(centers=(5e-3, 5e-3))
    )
    correlation = {}
    for sign in (1, -1):
        fit = Fit(dataset, model(), settings, 1.0, priors=[DepthPrior(sign * rows)] * 6)
        while fit.progress < 1:
            fit.step()
        maps = deferred.render(fit.model.surfels(0), dataset.train[0].camera, None).gbuffer.all
        alpha = maps.alpha.numpy()
        depth = (maps.depth.numpy() / np.maximum(alpha, 1e-3))[alpha > 0.5]
        correlation[sign] = np.corrcoef(depth, rows.ravel()[alpha > 0.5])[0, 1]
    assert correlation[1] > correlation[-1] + 0.2


def test_specular_starts_late(dataset):
    fit = Fit(dataset, model(), replace(SETTINGS, specular_start=0.5), 1.0)
    before = fit.model.numpy("log_environment")
    changed = []
    while fit.progress < 1:
        fit.step()
        changed.append(not np.array_equal(before, fit.model.numpy("log_environment")))
    assert not any(changed[:19]) and changed[-1]
    assert Fit(dataset, model(), replace(SETTINGS, specular_start=1.0), 1.0).shading.specular == "none"


@pytest.mark.parametrize("shading", [Shading("monte_carlo"), Shading("monte_carlo", "lit"), Shading("split_sum", "lit")])
def test_estimators_learn(dataset, shading):
    """Each of them improves on a start with wrong roughness and colours; a fit that samples the light begins without."""
    settings = replace(SETTINGS, iterations=40, monte_carlo_start=0.2, monte_carlo_samples=2)
    fit, errors, kinds = Fit(dataset, model(), settings, 1.0, shading), [], []
    while fit.progress < 1:
        fit.step()
        errors.append(fit.psnr)
        kinds.append(type(fit.lighting(fit.model.surfels(0), training=True).estimator).__name__)
    assert np.mean(errors[-6:]) > np.mean(errors[:6]) + 1
    assert kinds[0] == "SplitSum" and kinds[-2] == ("MonteCarlo" if shading.specular == "monte_carlo" else "SplitSum")
    assert dr.all(dr.isfinite(fit.model["log_environment"].array))


def test_guided_surfels_need_half_the_gradient(dataset):
    """What is reflective covers the object here, so all surfels are guided, and more of them pass the threshold."""
    grown = {}
    for guided in (False, True):
        density = Density(start=0.0, stop=1.0, refine_every=20, grow_grad2d=2e-3, guided=guided, max_surfels=10_000)
        fit = Fit(dataset, model(), replace(SETTINGS, iterations=21, density=density), 1.0)
        while fit.progress < 1:
            fit.step()
        grown[guided] = len(fit.model)
        picture = fit.guided_picture()
        assert (picture is not None) == guided
        assert not guided or len(np.unique(picture.reshape(-1, 3), axis=0)) > 10
    assert grown[True] > grown[False] > 0


def test_without_specular_the_environment_stays(dataset, monkeypatch):
    monkeypatch.setattr(Environment, "filtered", None)  # nothing asks for it
    fit = Fit(dataset, model(), SETTINGS, 1.0, shading=Shading("none"))
    before = {name: fit.model.numpy(name) for name in ("log_environment", "sh_dc", "centers")}
    for _ in range(10):
        fit.step()
    same = {name: np.array_equal(value, fit.model.numpy(name)) for name, value in before.items()}
    assert same == {"log_environment": True, "sh_dc": False, "centers": False}
    again = Fit.resume(dataset, SETTINGS, *fit.state(), shading=Shading("none"))
    again.step()
    assert np.isfinite(again.psnr)


def test_every_view_is_used_once_a_round(dataset):
    fit = Fit(dataset, model(), SETTINGS, 1.0)
    rounds = [fit._next_views(4) + fit._next_views(2) for _ in range(3)]
    assert all(sorted(r) == list(range(6)) for r in rounds) and len({tuple(r) for r in rounds}) > 1


def test_distortion_draws_surfels_together(dataset):
    """Of three shells, one in the other: the depths that a ray meets come closer."""
    spread = {}
    for weight in (0.0, 1000.0):  # as 2DGS has it
        weights = Weights(dssim=0, mask=0, normal=0, distortion=weight)
        settings = replace(SETTINGS, weights=weights, learning_rates=LearningRates(centers=(5e-3, 5e-3)))  # far in few steps
        fit = Fit(dataset, model(), settings, 1.0)
        fit.model.set("centers", fit.model.numpy("centers") * np.linspace(0.9, 1.1, 3)[np.arange(300) % 3, None])
        while fit.progress < 1:
            fit.step()
        maps = deferred.render(fit.model.surfels(0), dataset.train[0].camera, None, full=True).gbuffer.all
        spread[weight] = losses.distortion(maps, 1.0)[0]
    assert spread[1000.0] < 0.7 * spread[0.0]


def test_surfels_that_density_control_makes_hide_what_their_parents_did(dataset, monkeypatch):
    """Rays ask every 200 steps, not after each round."""
    asked, parents, hidden = [], [], Fit._hidden
    monkeypatch.setattr(Fit, "_hidden", lambda fit, surfels: (asked.append(fit.step_number), hidden(fit, surfels))[1])
    density = Density(max_surfels=400, start=0.0, stop=1.0, refine_every=10)
    settings = replace(SETTINGS, density=density, indirect="one_bounce", indirect_start=0.0)
    fit = Fit(dataset, model(), settings, 1.0, Shading(diffuse="relightable"))
    refine = fit.density.refine
    fit.density.refine = lambda *arguments: (parents.append(refine(*arguments)), parents[-1])[1]
    for _ in range(19):
        fit.step()
    before = np.arange(3 * len(fit.model), dtype=np.float32).reshape(3, -1)
    fit.irradiance_visibility = mi.Color3f(before)
    fit.step()
    assert len(fit.model) > before.shape[1] > 200 and len(parents) == 2
    np.testing.assert_array_equal(np.array(fit.irradiance_visibility), before[:, parents[-1]])
    fit.step()
    assert asked == [0]


@pytest.mark.parametrize(
    "indirect, diffuse",
    [("none", "radiance"), ("none", "relightable"), *(("one_bounce", d) for d in ("radiance", "relightable", "lit"))],
)
def test_no_kernel_is_compiled_after_warm_up(dataset, indirect, diffuse, monkeypatch):
    """Also with another number of surfels: density control changes it all the time."""
    hits, radiance = [], Indirect._radiance
    monkeypatch.setattr(Indirect, "_radiance", lambda *args: (hits.append(dr.width(args[1])), radiance(*args))[1])
    weights = replace(SETTINGS.weights, residual=1e-6)  # so that in all cases the same pixels become reflective
    settings = replace(SETTINGS, iterations=1000, indirect=indirect, indirect_start=0.0, weights=weights)
    fit = Fit(dataset, model(), settings, 1.0, Shading(diffuse=diffuse))
    centers = fit.model.numpy("centers")
    fit.model.set("centers", centers + np.where(np.arange(len(centers)) % 2, 0, 1.5)[:, None])  # two balls, side by side
    for n in (290, 270):
        for _ in range(4):
            fit.step()
        fit.model.select(np.arange(n), {})
        fit.density.statistics, fit.proxies, fit.irradiance_visibility = Statistics(n), None, None
    fit.step()
    fit.model.select(np.arange(250), {})
    fit.density.statistics, fit.proxies, fit.irradiance_visibility = Statistics(250), None, None
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for _ in range(8):
            fit.step()
        history = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    assert len(history) > 100 and (len(set(hits)) > 5) == (indirect != "none")
    assert min(hits[-8:], default=2) > 1  # a single ray takes other kernels
    assert (fit.irradiance_visibility is not None) == (indirect != "none" and diffuse != "radiance")
    assert [k["hash"] for k in history if not k["cache_hit"] or k["cache_disk"]] == []  # nor read from earlier sessions


def test_resume_goes_on_where_it_stopped(dataset):
    whole = Fit(dataset, model(), SETTINGS, 1.0)
    for _ in range(4 * STEPS):
        whole.step()
    half = Fit(dataset, model(), SETTINGS, 1.0)
    for _ in range(2 * STEPS):
        half.step()
    again = Fit.resume(dataset, SETTINGS, *half.state())
    for _ in range(2 * STEPS):
        again.step()
    assert again.step_number == again.views_used == 4 * STEPS
    # Atomic additions round differently from run to run. Measured, the largest of eight pairs: 1.2e-7, 6e-6, 6e-6 and 1e-6 dB;
    # without the moments, or with views from the beginning, 6e-4, 0.07, 0.07 and 0.1 dB.
    for name, tolerance in (("centers", 5e-6), ("logit_opacities", 3e-4), ("log_environment", 3e-4)):
        np.testing.assert_allclose(again.model.numpy(name), whole.model.numpy(name), rtol=0, atol=tolerance, err_msg=name)
    assert again.psnr == pytest.approx(whole.psnr, abs=1e-3)


def test_a_view_that_overflows_does_not_end_a_fit(dataset):
    """One of six has a pixel that is not a number, which reaches all gradients: they are dropped, and all else is kept."""
    linear = dataset.train[2].pixels.astype(np.float32) / 255
    linear[37, 41, 0] = np.nan
    views = [replace(view, pixels=linear) if k == 2 else view for k, view in enumerate(dataset.train)]
    density = Density(max_surfels=300, start=0.0, stop=1.0, refine_every=10)
    fit = Fit(replace(dataset, train=views), model(), replace(SETTINGS, density=density), 1.0)
    errors = []
    while fit.progress < 1:
        fit.step()
        errors.append(fit.psnr)
        assert all(np.isfinite(array.numpy()).all() for array in fit.density.statistics.sums())
    assert np.isfinite(errors).all() and errors[-1] > errors[0] + 2
    assert all(np.isfinite(array).all() for array in fit.state()[0].values())


def test_ten_overflows_in_a_row_do(dataset, monkeypatch):
    fit, errors = Fit(dataset, model(), SETTINGS, 1.0), []
    broken, view = {*range(2, 11), *range(12, 22)}, Fit._view
    nan = lambda fit: {"error": mi.Float(np.nan)} if fit.step_number in broken else {}
    monkeypatch.setattr(Fit, "_view", lambda self, *arguments: view(self, *arguments) | nan(self))
    for _ in range(23):
        fit.step()
        errors.append(fit.psnr)
    assert np.isfinite(errors[:21]).all() and np.isnan(errors[21]) and np.isfinite(errors[22])
    assert len(set(errors[1:11])) == 1  # the last that was a number


def test_progress_and_bands_of_harmonics(dataset):
    settings = Settings(minutes=1.0, sh_order=2, sh_start=0.5)
    fit = Fit(dataset, model(), settings, 1.0)
    orders = []
    for elapsed in (0, 29, 31, 46, 60, 99):
        fit.elapsed = elapsed
        orders.append(fit.sh_order)
    assert orders == [0, 0, 1, 2, 2, 2] and fit.progress == 1


def test_a_fit_that_is_stopped_is_shaded_by_what_has_begun(dataset):
    settings = replace(
        SETTINGS, iterations=100, specular_start=0.2, indirect="one_bounce", indirect_start=0.4, monte_carlo_start=0.6
    )
    fit, begun = Fit(dataset, model(), settings, 1.0, Shading("monte_carlo")), []
    for fit.step_number in (10, 30, 50, 70):
        shading = fit.shading
        begun.append((shading.specular, shading.indirect))
        lighting = fit.lighting(fit.model.surfels(0))
        assert (lighting is None) == (shading.specular == "none")
        assert (lighting is not None and lighting.indirect is not None) == (shading.indirect != "none")
    assert begun == [("none", "none"), ("split_sum", "none"), ("split_sum", "one_bounce"), ("monte_carlo", "one_bounce")]


@pytest.mark.parametrize("two_sided, normals_start, part", [(False, 0.2, 0.1), (False, 0.0, 1), (True, 0.2, 1)])
def test_normals_of_a_hull_wait_for_the_light(dataset, two_sided, normals_start, part):
    """Adam's first step is as long as its rate, where there is a gradient. Random normals have nothing to wait with."""
    learned = model()
    learned.two_sided = two_sided
    settings = replace(SETTINGS, normals_start=normals_start, sh_start=1.0)
    fit, before = Fit(dataset, learned, settings, 1.0), {k: learned.numpy(k) for k in ("rotations", "centers")}
    fit.step()
    moved = {k: np.abs(learned.numpy(k) - value).max() for k, value in before.items()}
    assert moved["rotations"] == pytest.approx(part * 2e-3, rel=0.01) and moved["centers"] == pytest.approx(5e-4, rel=0.01)
    fit.step_number = 8  # of 40
    fit._follow_schedule()
    assert fit.model.rows.rates["rotations"] == pytest.approx(2e-3 * 0.1**0.2)


@pytest.mark.parametrize("cooldown, parts", [(0.25, [1, 1, 0.5, 0.1]), (0.0, [1, 1, 1, 1])])
def test_rates_fall_to_zero_in_the_end(dataset, cooldown, parts):
    fit = Fit(dataset, model(), replace(SETTINGS, cooldown=cooldown), 1.0)
    for fit.step_number, part in zip((20, 30, 35, 39), parts):
        fit._follow_schedule()
        set_to = fit.model.rows.rates | {"log_environment": fit.model.optimizer.learning_rate("log_environment")}
        for name, (first, last) in (("centers", (5e-4, 1e-5)), ("log_environment", (6e-2, 5e-3))):
            rate = first * (last / first) ** (fit.step_number / 40)
            assert set_to[name] == pytest.approx(part * rate)


def test_a_light_that_is_given_keeps_its_rows(dataset):
    given = replace(SETTINGS, refine_start=0.0, learning_rates=LearningRates(environment=(0.0, 0.0)))
    fit = Fit(dataset, model(), given, 1.0, Shading("split_sum"))
    fit.step()
    np.testing.assert_array_equal(fit.model.numpy("log_environment"), model().numpy("log_environment"))


@pytest.mark.parametrize(
    "refine_start, downscale, most, rows",
    [(0.5, 1, 512, 64), (0.6, 1, 512, 16), (0.5, 2, 512, 32), (0.5, 4, 512, 16), (0.5, 1, 63, 32)],
)
def test_environment_gets_the_rows_that_photographs_tell_apart(dataset, monkeypatch, refine_start, downscale, most, rows):
    """A mirror ball whose radius is 3/8 of 83 pixels has 49 of them from pole to pole (π r/2)."""
    monkeypatch.setattr(schedule, "_MOST_ROWS", most)
    settings = replace(SETTINGS, refine_start=refine_start, stages=(Stage(1.0, downscale, 1),), indirect="none")
    fit = Fit(dataset, model(), settings, 1.0, Shading("split_sum"))
    fit.step_number = 19  # of 40
    fit.step()
    assert fit.model["log_environment"].shape == (16, 32, 3)
    fit.step()
    assert fit.model["log_environment"].shape == (rows, 2 * rows, 3)
    resumed = Fit.resume(dataset, settings, *fit.state(), shading=Shading("split_sum"))
    before = resumed.model.numpy("log_environment")
    resumed.step()
    moved = np.abs(resumed.model.numpy("log_environment") - before).max()
    assert before.shape[0] == rows and 0 < moved < 0.1


def test_gradients_of_some_steps_reach_the_environment_together():
    """Their sum, in the maps of the first, whatever the optimizer has made of the environment meanwhile."""
    learned, still, maps, rng = model(), model(), LightMaps(), np.random.default_rng(0)
    logarithm = still["log_environment"]
    dr.enable_grad(logarithm, learned["log_environment"])
    for step in range(STEPS):
        seen = maps.see(learned, filtered=True)
        gradient = mi.Float(rng.normal(size=dr.width(seen.texels)))
        dr.backward(dr.dot(still.environment().filtered().texels, gradient))
        together = maps.gather(step, gradient)
        assert (together is not None) == (step == STEPS - 1)
        assert abs(dr.grad(learned["log_environment"]).numpy()).max() == 0
        if together is not None:
            maps.pass_on(learned, together)
        else:
            learned.set("log_environment", learned.numpy("log_environment") + 0.01, reset=False)
            dr.enable_grad(learned["log_environment"])
    expected = dr.grad(logarithm).numpy()
    np.testing.assert_allclose(
        dr.grad(learned["log_environment"]).numpy(), expected, rtol=1e-4, atol=1e-4 * abs(expected).max()
    )
    again = maps.see(learned, filtered=True)
    np.testing.assert_allclose(again.texels.numpy(), seen.texels.numpy() * np.exp(0.03), rtol=1e-3)


def test_a_finer_environment_goes_on_with_the_moments_that_it_would_have():
    """Those of Adam after a constant derivative: itself and its square."""
    theta, phi = np.meshgrid(np.linspace(0.2, np.pi - 0.2, 1500), (np.arange(3000) + 0.5) / 3000 * 2 * np.pi, indexing="ij")
    d = mi.Vector3f(*(x.ravel() for x in (np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi))))
    learned, seen = model(), []
    for _ in range(2):
        logarithm = learned["log_environment"]
        dr.enable_grad(logarithm)
        radiance = learned.environment().unfiltered().eval(d)
        dr.backward(dr.mean(dr.sum(radiance * dr.square(1.5 + d.x * mi.Color3f(0.1, 0.3, 0.5)))))
        gradient = dr.grad(logarithm).numpy()
        t, m, v, _ = learned.optimizer.state["log_environment"][3]
        seen.append((gradient, m.numpy().reshape(gradient.shape), v.numpy().reshape(gradient.shape), int(np.ravel(t)[0])))
        learned._set_moments("log_environment", mi.UInt32(7), as_float(gradient), as_float(gradient**2))
        learned.refine_environment()
    (_, _, _, before), (gradient, m, v, after) = seen
    inner = slice(4, -4)  # no lookups near the poles
    np.testing.assert_allclose(m[inner], gradient[inner], rtol=0.06)
    np.testing.assert_allclose(v[inner], gradient[inner] ** 2, rtol=0.12)
    assert (before, after) == (0, 7)


@pytest.mark.parametrize("where, opacity", [("hull", 0.7), ("points", 0.7), ("anywhere", 0.1)])
def test_opacities_to_start_with(dataset, where, opacity):
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    data = replace(dataset, points=points if where == "points" else None)
    scene = SimpleNamespace(shading=Shading(), environment=model().environment())
    settings = replace(SETTINGS, initialization=Initialization(surfels=50, hull=where == "hull"), weights=Weights(depth=0))
    surfels = start(scene, data, settings).model.surfels(0)
    np.testing.assert_allclose(surfels.opacities.numpy(), opacity, rtol=1e-5)
    settings = replace(settings, initialization=replace(settings.initialization, opacity=0.4))
    np.testing.assert_allclose(start(scene, data, settings).model.surfels(0).opacities.numpy(), 0.4, rtol=1e-5)


@pytest.mark.parametrize("chosen, hull, two_sided", [(False, True, False), (True, True, True), (False, False, True)])
def test_which_surfels_show_from_behind(dataset, chosen, hull, two_sided):
    scene = SimpleNamespace(shading=Shading(), environment=model().environment())
    begin = Initialization(surfels=50, hull=hull, two_sided=chosen)
    assert start(scene, dataset, replace(SETTINGS, initialization=begin)).model.two_sided == two_sided


def test_gives_memory_back_that_steps_have_freed(dataset, monkeypatch):
    """Once a GiB and a half more is held than when that was done last; a system that does not say what is held is left alone."""
    held, released = iter([1.0, 1.5, 2.4, 2.9, 3.1, 1.2, 2.6]), []
    monkeypatch.setattr(trainer.memory, "held", lambda: int(next(held) * 2**30))
    monkeypatch.setattr(trainer, "release_memory", lambda: released.append(fit.step_number))
    fit = Fit(dataset, model(), SETTINGS, 1.0)
    for _ in range(4):
        fit.step()
    assert released == [0, 3]
    monkeypatch.setattr(trainer.memory, "held", lambda: 0)
    fit = Fit(dataset, model(), SETTINGS, 1.0)
    fit.step()
    fit.step()
    assert released == [0, 3, 0]

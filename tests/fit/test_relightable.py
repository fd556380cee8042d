"""Base colors that explain a radiance: of a matte ball under a light that is known."""

from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rgs_mi.core.color import to_8bit
from rgs_mi.datasets.types import Dataset, View
from rgs_mi.fit import losses
from rgs_mi.fit.model import Model, logit
from rgs_mi.fit.objective import Objective
from rgs_mi.fit.schedule import Schedule
from rgs_mi.fit.trainer import Fit
from rgs_mi.settings.settings import LearningRates
from rgs_mi.shading import deferred, tables
from rgs_mi.shading.environment import Environment
from rgs_mi.shading.lighting import Lighting, Shading
from rgs_mi.shading.split_sum import SplitSum
from rgs_mi.surfels.surfels import Surfels

from fits import SETTINGS
from scenes import orbit_camera, tangent_surfels

COUNT = 300


def light():
    """Bright from one side, of another colour from the other; [16, 32, 3]."""
    azimuth = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    part = (0.5 + 0.5 * np.cos(azimuth))[None, :, None]
    return np.broadcast_to(0.1 + part * [1.1, 0.9, 0.6] + (1 - part) * [0.05, 0.1, 0.3], (16, 32, 3)).copy()


def matte() -> Surfels:
    """A ball of four colours, whose own radiance is a grey."""
    fields = tangent_surfels(COUNT).numpy()
    sectors = np.int32(np.floor((np.arctan2(*fields["centers"][:, 1::-1].T) + np.pi) / np.pi * 2)) % 4
    colors = np.array([[0.8, 0.2, 0.2], [0.2, 0.7, 0.3], [0.3, 0.3, 0.8], [0.7, 0.7, 0.2]])[sectors]
    materials = {"base_color": colors, "metallic": np.zeros((COUNT, 1)), "roughness": np.full((COUNT, 1), 0.6)}
    return Surfels.from_numpy(fields | materials, two_sided=False)


def photographs(truth, specular=0.5) -> Dataset:
    """Six views of the ball, lit."""
    environment = Environment(mi.TensorXf(np.float32(light())), np.eye(3)).filtered()
    lighting = Lighting(SplitSum(environment, tables.eta_of(specular)), lit=True)
    views = []
    for k in range(6):
        camera = orbit_camera(k, size=(72, 64))
        image = deferred.render(truth, camera, lighting)
        alpha = np.clip(image.gbuffer.all.alpha.numpy(), 0, 1).reshape(64, 72, 1)
        shown = losses.display(image.color, image.gbuffer.all.alpha, 0.0).numpy().T.reshape(64, 72, 3)
        pixels = to_8bit(np.concatenate([np.clip(shown / np.maximum(alpha, 1e-3), 0, 1), alpha], 2))
        views.append(View(f"r_{k}", camera, pixels, True, None, Path(f"r_{k}.png")))
    return Dataset(views, [])


def fitted(diffuse, specular=None) -> tuple[Fit, Surfels]:
    """A fit of colours and radiance alone, or where ``specular`` says what the ball reflects, of that alone: all else is as it
    should be."""
    truth = matte()
    centers = truth.numpy()["centers"]
    scale = float(truth.numpy()["scales"].mean())
    spacing, grey = np.full(COUNT, scale), np.full((COUNT, 3), 0.3)
    start = specular and 0.5
    model = Model.start(centers, centers, grey, spacing, light(), np.eye(3), 1, opacity=0.8, roughness=0.6, specular=start)
    model.set("rotations", truth.numpy()["rotations"])
    model.set("logit_metallic", np.full((COUNT, 1), -7.0))
    if specular:
        model.set("logit_base_color", logit(truth.numpy()["base_color"]))
    held = (
        "centers",
        "rotations",
        "scales",
        "opacities",
        "delta_normal",
        "curvature",
        "environment",
        "roughness",
        "metallic",
        *(["base_color"] if specular else []),
    )
    rates = replace(LearningRates(), sh_dc=(0.2, 0.02), specular=(0.1, 0.02), **{name: (0.0, 0.0) for name in held})
    settings = replace(SETTINGS, iterations=120, indirect_start=0.0, refine_start=0.2, learning_rates=rates)
    fit = Fit(photographs(truth, specular or 0.5), model, settings, 1.0, Shading(diffuse=diffuse))
    while fit.progress < 1:
        fit.step()
    return fit, truth


def test_base_colors_are_found_beside_the_radiance():
    """Of what photographs show nothing changes, and what was grey is the true colour."""
    errors, psnr = {}, {}
    for diffuse in ("radiance", "relightable"):
        fit, truth = fitted(diffuse)
        seen = abs(truth.numpy()["centers"][:, 2]) < 0.6
        errors[diffuse] = abs(fit.model.surfels(1).base_color.numpy() - truth.numpy()["base_color"])[seen].mean()
        psnr[diffuse] = fit.psnr
    assert errors["relightable"] < 0.04 < 0.15 < errors["radiance"]
    assert min(psnr.values()) > 45


@pytest.mark.parametrize(
    "diffuse, relit, specular",
    [
        ("relightable", (0.8, 0.95), "split_sum"),
        ("relightable", (1.0, 1.0), "split_sum"),
        ("relightable", (0.8, 0.95), "monte_carlo"),
    ]
    + [(diffuse, (0.8, 0.95), "split_sum") for diffuse in ("radiance", "lit")],
)
def test_surfels_are_lit_towards_the_end(diffuse, relit, specular):
    """Once, and then what base colors and metals are is settled; where there is a radiance, and no samples."""
    settings = replace(SETTINGS, relit=relit, indirect_start=0.1, monte_carlo_start=0.7)
    schedule = Schedule.of(settings, Shading(diffuse=diffuse, specular=specular))
    explained = diffuse == "relightable" and specular == "split_sum"
    once = explained and relit[0] < 1
    assert schedule.explains(0.5) == (diffuse == "relightable") and not schedule.explains(0.05)
    assert [schedule.explains(p) for p in (0.75, 0.9, 0.97)] == [explained, explained > once, explained > once]
    assert [schedule.relights(p) for p in (0.5, 0.79, 0.81, 0.94, 0.96)] == [False, False, once, once, False]
    names = ("centers", "sh_dc", "logit_base_color", "logit_metallic")
    moving = [[rate > 0 for rate in schedule.learning_rates(names, p, 1.0, False).values()] for p in (0.9, 0.97)]
    assert moving == [[True, not once, True, True], [True, True, not once, not once]]


def test_lit_steps_move_no_radiance_and_the_last_ones_no_base_color():
    truth = matte()
    centers, spacing, grey = truth.numpy()["centers"], np.full(COUNT, 0.15), np.full((COUNT, 3), 0.3)
    model = Model.start(centers, centers, grey, spacing, light(), np.eye(3), 1, opacity=0.8, roughness=0.6)
    settings = replace(SETTINGS, iterations=6, relit=(0.3, 0.6), indirect_start=0.0)
    fit, moved = Fit(photographs(truth), model, settings, 1.0, Shading(diffuse="relightable")), []
    while fit.progress < 1:
        before = {name: fit.model.numpy(name) for name in ("sh_dc", "logit_base_color", "logit_metallic")}
        assert not fit.lighting(fit.model.surfels(0)).lit  # what a rendering of the fit shows is its radiance throughout
        fit.step()
        moved.append(tuple(not np.array_equal(fit.model.numpy(name), value) for name, value in before.items()))
    assert moved == [(True, True, True)] * 2 + [(False, True, True)] * 2 + [(True, False, False)] * 2


def test_what_no_metal_reflects_is_found():
    fit, _ = fitted("lit", specular=0.9)
    assert fit.model.specular()[0] == pytest.approx(0.9, abs=0.05)
    assert fit.shading.eta == pytest.approx(tables.eta_of(0.9), abs=0.03)


def test_the_residual_and_its_gradient():
    """None where radiance is what base colors reflect; else as finite differences say."""
    surfels = matte()
    lighting = Lighting(SplitSum(Environment(mi.TensorXf(np.float32(light())), np.eye(3)).filtered()))
    camera, objective = orbit_camera(0.4, size=(72, 64)), Objective(SETTINGS, 1.0)
    weight = SETTINGS.weights.residual

    def loss(colors):
        changed = replace(surfels, base_color=mi.TensorXf(np.float32(colors)))
        dr.enable_grad(changed.base_color)
        value = objective.residual(changed, lighting, camera)
        dr.backward(value)
        return float(value[0]), dr.grad(changed.base_color).numpy()

    colors = surfels.numpy()["base_color"]
    value, gradient = loss(colors)
    facing = (surfels.numpy()["centers"] @ camera.origin) > 1.2  # well within what is seen
    step = np.where(facing[:, None], 3e-3 * np.sign(gradient), 0)
    difference = (loss(colors + step)[0] - loss(colors - step)[0]) / 2
    texels = lighting.estimator.environment.texels
    held = texels, surfels.centers, surfels.rotations, surfels.roughness, surfels.metallic, surfels.sh
    dr.enable_grad(held)
    loss(colors)
    assert not any(dr.grad(v).numpy().any() for v in held)  # it moves no light
    assert value > 0.05 * weight and abs((gradient * step).sum() / difference - 1) < 0.03
    assert abs(gradient[facing]).max() > 0 and (gradient[(surfels.numpy()["centers"] @ camera.origin) < 0.9] == 0).all()

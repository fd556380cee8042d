"""The tiled splatter against its slow twin, and its gradients against finite differences."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rgs_mi.splat import gbuffer
from rgs_mi.splat.reference import render_gbuffer_reference
from rgs_mi.splat.tiles import Cutoffs
from rgs_mi.surfel import CHANNELS, Surfels

from scenes import orbit_camera, sphere_surfels

MAPS = ("diffuse", "normal", "base_color", "roughness", "metallic", "delta_normal", "depth", "alpha")
SMOOTH = Cutoffs(alpha_min=1e-7, alpha_max=0.9999, transmittance_min=0)


def render_gbuffer(surfels, camera, cutoffs=Cutoffs()):
    return gbuffer.render_gbuffer(surfels, camera, cutoffs=cutoffs).all


def stacked(maps):
    """All maps as one array [K, pixels]."""
    return np.concatenate([np.atleast_2d(getattr(maps, name).numpy()) for name in MAPS])


def inner(maps, weights):
    """<weights, maps> as a Dr.Jit scalar."""
    columns = [c for name in MAPS for c in (getattr(maps, name) if name in
               ("diffuse", "normal", "base_color", "delta_normal") else [getattr(maps, name)])]
    return sum(dr.sum(c * mi.Float(w)) for c, w in zip(columns, weights))


def gradients(render, surfels, camera, weights):
    for name in CHANNELS:
        dr.enable_grad(getattr(surfels, name))
    dr.backward(inner(render(surfels, camera, cutoffs=SMOOTH), weights))
    result = {name: dr.grad(getattr(surfels, name)).numpy() for name in CHANNELS}
    for name in CHANNELS:
        dr.disable_grad(getattr(surfels, name))
    return result


@pytest.mark.parametrize("camera", [
    orbit_camera(), orbit_camera(2.0, (37, 53)), orbit_camera(1.0, (64, 64), distance=1.6),
    replace(orbit_camera(0.7), principal=(11.0, 31.0)), replace(orbit_camera(0.2), focal=(90.0, 50.0)),
], ids=["plain", "odd size", "inside reach", "principal point", "anisotropic pixels"])
@pytest.mark.parametrize("count", [40, 300])
def test_forward_equals_reference(camera, count):
    surfels = sphere_surfels(count, seed=count)
    mine, reference = stacked(render_gbuffer(surfels, camera)), stacked(render_gbuffer_reference(surfels, camera))
    # A weight within rounding of the cut-off may fall on either side of it: those few pixels differ by at most 1/255.
    difference = np.abs(mine - reference)
    assert (difference > 2e-3 * max(1, np.abs(reference).max())).mean() == 0
    assert (difference > 1e-4).mean() < 2e-3
    assert reference[-1].max() > 0.5


def test_backward_equals_reference():
    surfels, camera = sphere_surfels(30, seed=3), orbit_camera(size=(32, 24))
    weights = np.random.default_rng(0).normal(size=(16, 32 * 24)).astype(np.float32)
    mine = gradients(render_gbuffer, surfels, camera, weights)
    reference = gradients(render_gbuffer_reference, surfels, camera, weights)
    for name in CHANNELS:
        scale = np.abs(reference[name]).max()
        assert scale > 0, name
        assert np.abs(mine[name] - reference[name]).max() < 1e-3 * scale, name


@pytest.mark.parametrize("name", CHANNELS)
def test_gradients_equal_finite_differences(name):
    surfels, camera = sphere_surfels(12, seed=8, scale=0.35), orbit_camera(size=(24, 24))
    weights = np.random.default_rng(1).normal(size=(16, 24 * 24)).astype(np.float32)
    weights[14] = 0  # depth jumps where the low-pass takes over: its derivative is tested against the twin instead
    gradient = gradients(render_gbuffer, surfels, camera, weights)[name].astype(np.float64)
    base = surfels.numpy()
    direction = np.random.default_rng(2).normal(size=base[name].shape) * np.abs(base[name]).mean()

    def value(step):
        moved = Surfels.from_numpy({**base, name: base[name] + step * direction})
        return float((stacked(render_gbuffer(moved, camera, cutoffs=SMOOTH)).astype(np.float64) * weights).sum())

    # Richardson: the h² term of the central difference cancels
    h = 3e-4 if name in ("centers", "rotations") else 2e-3  # a longer step changes the order of depths
    central = lambda h: (value(h) - value(-h)) / (2 * h)
    expected = (4 * central(h) - central(2 * h)) / 3
    size = np.linalg.norm(gradient) * np.linalg.norm(direction)
    assert abs((gradient * direction).sum() - expected) < 1e-3 * max(abs(expected), 0.05 * size)


def test_forward_mode_equals_backward_mode():
    surfels, camera = sphere_surfels(20, seed=7), orbit_camera(size=(16, 16))
    weights = np.random.default_rng(1).normal(size=(16, 256)).astype(np.float32)
    gradient = gradients(render_gbuffer, surfels, camera, weights)
    rng = np.random.default_rng(3)
    expected = 0.0
    for name in CHANNELS:
        tangent = rng.normal(size=gradient[name].shape).astype(np.float32)
        expected += float((tangent * gradient[name]).sum())
        dr.enable_grad(getattr(surfels, name))
        dr.set_grad(getattr(surfels, name), mi.TensorXf(tangent))
    value = inner(render_gbuffer(surfels, camera, cutoffs=SMOOTH), weights)
    dr.forward_to(value)
    assert dr.grad(value)[0] == pytest.approx(expected, rel=1e-3)


def test_nothing_to_draw():
    surfels, camera = sphere_surfels(5), orbit_camera()
    behind = replace(camera, to_world=camera.to_world @ np.diag([1, -1, -1, 1]))
    assert np.all(stacked(render_gbuffer(surfels, behind)) == 0)

"""The tiled splatter against its slow twin, and its gradients against finite differences."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rgs_mi.splat import gbuffer, intersect
from rgs_mi.splat.project import project
from rgs_mi.splat.reference import render_gbuffer_reference
from rgs_mi.splat.tiles import Cutoffs
from rgs_mi.surfels.surfels import CHANNELS, Surfels, rotation_from_normal

from scenes import VARIED_CAMERAS, layered_surfels, orbit_camera, sphere_surfels, tangent_surfels

MAPS = ("diffuse", "normal", "base_color", "roughness", "metallic", "delta_normal", "depth", "square", "alpha")
SORTED = Cutoffs(resort_window=96)  # more than the surfels of any tile here that overlap
SMOOTH = Cutoffs(alpha_min=1e-7, alpha_max=0.9999, transmittance_min=0, resort_window=96)


def render_gbuffer(surfels, camera, cutoffs=Cutoffs()):
    return gbuffer.render_gbuffer(surfels, camera, cutoffs=cutoffs, full=True).all


def stacked(maps):
    """All maps as one array [K, pixels]."""
    return np.concatenate([np.atleast_2d(getattr(maps, name).numpy()) for name in MAPS])


def inner(maps, weights):
    """<weights, maps> as a Dr.Jit scalar."""
    columns = [
        c
        for name in MAPS
        for c in (
            getattr(maps, name) if name in ("diffuse", "normal", "base_color", "delta_normal") else [getattr(maps, name)]
        )
    ]
    return sum(dr.sum(c * mi.Float(w)) for c, w in zip(columns, weights))


def gradients(render, surfels, camera, weights):
    for name in CHANNELS:
        dr.enable_grad(getattr(surfels, name))
    dr.backward(inner(render(surfels, camera, cutoffs=SMOOTH), weights))
    result = {name: dr.grad(getattr(surfels, name)).numpy() for name in CHANNELS}
    for name in CHANNELS:
        dr.disable_grad(getattr(surfels, name))
    return result


@pytest.mark.parametrize("camera", VARIED_CAMERAS.values(), ids=VARIED_CAMERAS)
@pytest.mark.parametrize("count", [40, 300])
def test_forward_equals_reference(camera, count):
    surfels = sphere_surfels(count, seed=count)
    mine, reference = (stacked(f(surfels, camera, SORTED)) for f in (render_gbuffer, render_gbuffer_reference))
    # A weight within rounding of the cut-off may fall on either side of it: those few pixels differ by at most 1/255.
    difference = np.abs(mine - reference)
    assert (difference > 2e-3 * max(1, np.abs(reference).max())).mean() == 0
    assert (difference > 1e-4).mean() < 2e-3
    assert reference[-1].max() > 0.5


def test_backward_equals_reference():
    surfels, camera = sphere_surfels(30, seed=3), orbit_camera(size=(32, 24))
    weights = np.random.default_rng(0).normal(size=(17, 32 * 24)).astype(np.float32)
    mine = gradients(render_gbuffer, surfels, camera, weights)
    reference = gradients(render_gbuffer_reference, surfels, camera, weights)
    for name in CHANNELS:
        scale = np.abs(reference[name]).max()
        assert scale > 0, name
        assert np.abs(mine[name] - reference[name]).max() < 1e-3 * scale, name


@pytest.mark.parametrize("full", [False, True])
def test_contributions_are_what_surfels_weigh(full):
    """The sum of their weights in all pixels, as the gradient of the twin's metallic has it; and no other map changes."""
    surfels, camera = sphere_surfels(60, seed=5), orbit_camera(size=(32, 24))
    contribution, part = dr.zeros(mi.Vector2f, len(surfels)), 2 * np.random.default_rng(0).random(32 * 24, np.float32)
    dr.enable_grad(contribution, surfels.metallic)
    found = gbuffer.render_gbuffer(surfels, camera, cutoffs=SMOOTH, full=full, contribution=contribution).all
    plain = gbuffer.render_gbuffer(surfels, camera, cutoffs=SMOOTH, full=full).all
    for name in MAPS if full else ("diffuse", "normal", "base_color", "roughness", "metallic", "depth", "alpha"):
        assert np.array_equal(getattr(found, name).numpy(), getattr(plain, name).numpy()), name
    dr.backward(dr.sum(found.contribution.x + mi.Float(part) * found.contribution.y))
    assert not dr.grad(surfels.metallic).numpy().any()
    for mine, weight in zip(dr.grad(contribution), (mi.Float(1), mi.Float(part))):
        dr.backward(dr.sum(weight * render_gbuffer_reference(surfels, camera, cutoffs=SMOOTH).metallic))
        expected = dr.grad(surfels.metallic).numpy().ravel()
        assert expected.max() > 1
        np.testing.assert_allclose(mine.numpy(), expected, atol=1e-3 * expected.max())
        dr.set_grad(surfels.metallic, dr.zeros(mi.TensorXf, surfels.metallic.shape))


def test_window_brings_tiles_into_order():
    """A surface whose surfels are as far apart as its pixels: what is left of the tiles' grid is faint."""
    surfels, camera = replace(sphere_surfels(20_000), two_sided=False), orbit_camera(size=(96, 96))

    def image(shift, window):
        maps = render_gbuffer(surfels, camera.cropped(-shift, -shift, 104, 104), Cutoffs(resort_window=window))
        return stacked(maps).reshape(17, 104, 104)[:, shift : shift + 96, shift : shift + 96]

    seams = {window: np.square(image(0, window) - image(4, window)).mean() for window in (1, 16)}
    assert 0 < seams[16] < 0.1 * seams[1], seams


@pytest.mark.parametrize("least", [1e-4, 1e-2])
def test_lists_end_behind_what_hides(least):
    """Of many surfels one behind the other lists hold the first, and what they leave out no pixel would have seen."""
    camera, rng = orbit_camera(size=(32, 24)), np.random.default_rng(0)
    right, down, forward = camera.rotation
    surfels = sphere_surfels(240, scale=1.6, opacity_shift=3).numpy()
    across, layer = rng.uniform(-1.2, 1.2, (240, 2)), np.linspace(-1, 1, 240)[:, None]
    surfels["centers"] = across[:, :1] * right + across[:, 1:] * down + layer * forward
    surfels["rotations"] = rotation_from_normal(np.tile(-forward, (240, 1)), rng.uniform(0, 6, 240))
    surfels, cutoffs = Surfels.from_numpy(surfels), Cutoffs(transmittance_min=least, resort_window=96)
    mine, reference = (stacked(f(surfels, camera, cutoffs)) for f in (render_gbuffer, render_gbuffer_reference))
    # A pixel goes on while another of its block does: that far at most
    assert (np.abs(mine - reference) < 3 * least * np.abs(reference).max(1, keepdims=True) + 1e-4).all()
    with dr.suspend_grad():
        listed = lambda least: dr.sum(
            intersect.isect_tiles(project(surfels, camera), camera.size, replace(cutoffs, transmittance_min=least)).count
        )[0]
        assert 0 < listed(least) < 0.8 * listed(0)


def test_tiles_come_before_depths():
    """One number sorts by both, however near or far, and nothing that is not a number spoils it."""
    rng = np.random.default_rng(0)
    tile, depth = rng.integers(0, 3000, 20_000).astype(np.uint32), np.exp(rng.uniform(-4, 6, 20_000)).astype(np.float32)
    depth[5] = np.nan
    depths = intersect._Depths.of(mi.Float(depth))
    order = dr.argsort(intersect._sort_key(mi.UInt32(tile), mi.Float(depth), 3000, depths)).numpy()
    assert (np.diff(tile[order].astype(int)) >= 0).all()
    ahead, behind = depth[order][:-1], depth[order][1:]
    same = (np.diff(tile[order].astype(int)) == 0) & np.isfinite(ahead) & np.isfinite(behind)
    assert (behind >= ahead * (1 - 1e-3))[same].all()


def test_curved_surfels_have_the_normals_of_a_sphere():
    """Surfels that touch a unit sphere: with its curvature they show its normals many times as well as without."""
    camera = orbit_camera(size=(96, 96))
    directions = camera.rays().reshape(-1, 3)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    closest = -directions @ camera.origin
    inside = 1 - ((camera.origin + closest[:, None] * directions) ** 2).sum(1)
    seen = inside > 0.2  # away from the silhouette
    true = camera.origin + (closest - np.sqrt(np.maximum(inside, 0)))[:, None] * directions

    def degrees(curvature):
        normal = render_gbuffer(tangent_surfels(400, curvature), camera).normal.numpy().T
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
        return np.degrees(np.arccos(np.clip((normal * true).sum(1)[seen], -1, 1))).mean()

    assert 4 * degrees([1, 0, 1]) < degrees([0, 0, 0])
    assert degrees([-1, 0, -1]) > degrees([0, 0, 0])  # the sign matters


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", CHANNELS)
def test_gradients_equal_finite_differences(name, seed):
    camera = orbit_camera(size=(24, 24))
    base = layered_surfels(camera, seed).numpy()
    weights = np.random.default_rng(1).normal(size=(17, 24 * 24)).astype(np.float32)
    gradient = gradients(render_gbuffer, Surfels.from_numpy(base), camera, weights)[name].astype(np.float64)
    # Uphill in every number, or what they add would cancel and leave rounding to compare
    direction = np.copysign(np.random.default_rng(2).normal(size=base[name].shape), gradient) * np.abs(base[name]).mean()

    def value(step):
        moved = Surfels.from_numpy({**base, name: base[name] + step * direction})
        return float((stacked(render_gbuffer(moved, camera, cutoffs=SMOOTH)).astype(np.float64) * weights).sum())

    h = 2e-3 if name in ("centers", "rotations", "scales") else 2e-2  # in the others the image is a polynomial
    central = lambda h: (value(h) - value(-h)) / (2 * h)
    expected = (4 * central(h) - central(2 * h)) / 3  # Richardson: the h² term of the central difference cancels
    assert (gradient * direction).sum() == pytest.approx(expected, rel=1e-3)


def test_forward_mode_equals_backward_mode():
    surfels, camera = sphere_surfels(20, seed=7), orbit_camera(size=(16, 16))
    weights = np.random.default_rng(1).normal(size=(17, 256)).astype(np.float32)
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


@pytest.mark.parametrize("scale", [1e-3, 1e3, 1e6])
def test_a_world_of_other_units_looks_the_same(scale):
    """Nothing but the depth knows in which units a world is."""
    camera, surfels = orbit_camera(0), sphere_surfels(60)
    here = render_gbuffer(surfels, camera)
    changed = surfels.numpy() | {name: scale * surfels.numpy()[name] for name in ("centers", "scales")}
    there = Surfels.from_numpy(changed, two_sided=surfels.two_sided)
    to_world = camera.to_world.copy()
    to_world[:3, 3] *= scale
    found = render_gbuffer(there, replace(camera, to_world=to_world))
    for name in MAPS:
        one, other = (np.atleast_2d(getattr(maps, name).numpy()) for maps in (here, found))
        other = other / {"depth": scale, "square": scale**2}.get(name, 1)
        apart = np.quantile(abs(other - one), 0.99)  # a pixel may fall on the other side of an edge
        assert apart < 1e-3 * abs(one).max(), name

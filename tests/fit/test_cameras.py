"""Cameras that learn: gradients against finite differences and the slow twin, the gauge, and poses that come back."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rgs_mi.core.alignment import pose_errors
from rgs_mi.core.camera import Camera
from rgs_mi.core.learned_camera import INTRINSICS, POSE, learned_camera
from rgs_mi.datasets.photographs import Photographs
from rgs_mi.fit import losses
from rgs_mi.fit.cameras import EXPOSURE, LENSES, POSES, Cameras, Rows, _similarities
from rgs_mi.fit.trainer import Fit
from rgs_mi.shading import deferred
from rgs_mi.shading.environment import Environment
from rgs_mi.shading.lighting import Lighting
from rgs_mi.shading.split_sum import SplitSum
from rgs_mi.splat import gbuffer
from rgs_mi.splat.reference import render_gbuffer_reference
from rgs_mi.splat.tiles import Cutoffs
from rgs_mi.surfels.surfels import Surfels

from captures import perturbed
from fits import SETTINGS, model, photographed, random_photographs
from scenes import layered_surfels, orbit_camera, sphere_surfels

SMOOTH = Cutoffs(alpha_min=1e-7, alpha_max=0.9999, transmittance_min=0, resort_window=96)
NUMBERS = len(POSE) + len(INTRINSICS)
PIVOT = np.array([0.05, -0.1, 0.1])
SIZE = (24, 24)
START = 0.02 * np.random.default_rng(5).normal(size=NUMBERS)  # not at zero, where half of the derivatives are nothing


def seen(camera, numbers):
    """``camera`` with the corrections ``numbers``, Dr.Jit values."""
    return replace(camera, learned=learned_camera(camera, PIVOT, numbers[: len(POSE)], numbers[len(POSE) :]))


def gradient(value, numbers):
    """Of ``value(leaves)``, a Dr.Jit scalar, by automatic differentiation: [K]."""
    leaves = [dr.opaque(mi.Float, float(v)) for v in numbers]
    dr.enable_grad(leaves)
    dr.backward(value(leaves))
    return np.array([float(dr.grad(leaf)[0]) for leaf in leaves])


def differences(value, numbers, h=2e-3):
    """The same by Richardson's extrapolation of central differences."""

    def at(k, step):
        moved = np.array(numbers, float)
        moved[k] += step
        with dr.suspend_grad():
            return float(value([dr.opaque(mi.Float, v) for v in moved])[0])

    central = lambda k, h: (at(k, h) - at(k, -h)) / (2 * h)
    return np.array([(4 * central(k, h) - central(k, 2 * h)) / 3 for k in range(len(numbers))])


def splatted(surfels, camera, weights, render):
    """<weights, maps> as a function of the corrections."""

    def value(numbers):
        maps = render(surfels, seen(camera, numbers))
        columns = [*maps.diffuse, *maps.normal, *maps.base_color, maps.roughness, maps.depth, maps.alpha]
        return sum(dr.sum(c * mi.Float(w)) for c, w in zip(columns, weights))

    return value


def smooth_weights(count, seed=1):
    """[count, pixels]: low frequencies, under which rounding of single pixels does not count."""
    rng, (x, y) = np.random.default_rng(seed), np.meshgrid(*(np.linspace(0, 1, n) for n in SIZE))
    a, b, c = rng.normal(size=(3, count, 1, 1))
    return (1 + np.sin(3 * a * x + 3 * b * y + c)).reshape(count, -1).astype(np.float32)


@pytest.mark.parametrize("seed", range(2))
def test_gradients_of_the_splatter(seed):
    camera = orbit_camera(size=SIZE)
    surfels, weights = layered_surfels(camera, seed), smooth_weights(12)
    mine = splatted(surfels, camera, weights, lambda s, c: gbuffer.render_gbuffer(s, c, cutoffs=SMOOTH).all)
    twin = splatted(surfels, camera, weights, lambda s, c: render_gbuffer_reference(s, c, SMOOTH))
    found, scale = gradient(mine, START), np.abs(gradient(mine, START)).max()
    assert np.abs(found - gradient(twin, START)).max() < 1e-3 * scale
    expected = differences(mine, START)
    assert np.abs(found - expected).max() < 2e-3 * scale and np.allclose(found, expected, rtol=0.02, atol=5e-4 * scale)


@pytest.mark.parametrize("lens", [(0, 0, 0, 0), (-0.1, 0.05, 0.02, -0.03)])
def test_maps_through_a_lens_are_those_of_the_twin(lens):
    camera, surfels = orbit_camera(size=(48, 40)), sphere_surfels(60, seed=4)
    numbers = [dr.opaque(mi.Float, float(v)) for v in (*START[: len(POSE) + 4], *lens)]
    exact = Cutoffs(resort_window=96)
    mine = gbuffer.render_gbuffer(surfels, seen(camera, numbers), cutoffs=exact).all
    twin = render_gbuffer_reference(surfels, seen(camera, numbers), exact)
    for name in ("diffuse", "normal", "depth", "alpha"):
        a, b = (getattr(maps, name).numpy() for maps in (mine, twin))
        assert (np.abs(a - b) > 1e-4).mean() < 5e-3 and np.abs(a - b).max() < 2e-2 * max(1, np.abs(b).max()), name


def test_linear_about_the_center_is_little_off():
    """Small surfels through a strong lens, against the picture of a pinhole taken through it pixel by pixel."""
    camera, surfels = orbit_camera(size=(96, 96), distance=3.0), sphere_surfels(3000, seed=4)
    numbers = [dr.opaque(mi.Float, float(v)) for v in (*(0,) * 10, -0.1, 0, 0.02, 0)]

    def depth(camera):
        maps, (width, height) = gbuffer.render_gbuffer(surfels, camera).all, camera.size
        return (maps.depth / dr.maximum(maps.alpha, 0.5)).numpy().reshape(height, width)

    through, plain, bare = depth(seen(camera, numbers)), depth(camera.resized(960, 960)), depth(camera)
    plane = seen(camera, numbers).baked().image_plane()
    column, row = (10 * (v * f + p) for v, f, p in zip(plane, camera.focal, camera.principal))
    looked_up = plain[np.clip(row, 0, 959).astype(int), np.clip(column, 0, 959).astype(int)]
    off, moved = np.abs(through - looked_up), np.abs(bare - looked_up)
    assert off.mean() < 0.2 * moved.mean() and moved.mean() > 0.02


@pytest.mark.parametrize("lit", [False, True])
def test_gradients_through_what_is_reflected(lit):
    """View directions, normals in the light's frame, mirror directions and exposure: all of the shading."""
    camera = orbit_camera(size=SIZE)
    fields = layered_surfels(camera, 0).numpy()
    fields |= {"opacities": np.full_like(fields["opacities"], 0.9), "roughness": np.full_like(fields["roughness"], 0.5)}
    surfels = Surfels.from_numpy({**fields, "scales": 2 * fields["scales"]})
    rows, columns = np.meshgrid(np.arange(32), np.arange(64), indexing="ij")
    texels = 1 + 0.5 * np.sin(rows / 5)[..., None] * np.cos(columns[..., None] * np.pi / 32 + np.arange(3))
    texels[[0, -1]] = texels[[0, -1]].mean(1, keepdims=True)
    lighting = Lighting(SplitSum(Environment(mi.TensorXf(texels), np.eye(3)).filtered()), lit=lit)
    weights = smooth_weights(3)

    def value(numbers):
        gain = dr.exp(mi.Color3f(*numbers[NUMBERS:]))
        seen_by = seen(camera, numbers[:NUMBERS])
        image = deferred.shade(gbuffer.render_gbuffer(surfels, seen_by, cutoffs=SMOOTH), seen_by, lighting)
        shown = losses.display(image.color * gain, image.gbuffer.all.alpha, 0.5)
        return sum(dr.sum(c * mi.Float(w)) for c, w in zip(shown, weights))

    numbers = np.append(START, [0.1, -0.1, 0.2])
    found, expected = gradient(value, numbers), differences(value, numbers, h=5e-3)
    scale = np.abs(expected[:NUMBERS]).max()
    assert np.abs(found - expected).max() < 0.02 * scale, np.stack([found, expected])
    assert np.allclose(found[NUMBERS:], expected[NUMBERS:], rtol=2e-3)


# ---- What moves ----


def test_rows_without_gradient_stay():
    rows = Rows(4, 3)
    rows.step({1: np.array([1.0, -2.0, 2.0])}, 0.1)
    first = -0.1 * np.array([1, -2, 2]) / np.sqrt(3)  # Adam's first step is as long as its rate
    assert np.allclose(rows.value[1], first)
    rows.step({1: np.array([np.nan, 1, 1]), 2: np.full(3, 0.01)}, 0.1)
    assert not rows.value[[0, 3]].any() and np.allclose(rows.value[1], first)
    scale = np.sqrt((0.99 * 3 + 0.01**2) / (1 + 0.99))  # shared: of the mean squares of both rows' gradients, weighted
    assert np.allclose(rows.value[2], -0.1 * 0.01 / scale, rtol=1e-6)


def test_similarities_of_the_world_are_invisible():
    """To first order: what a mode does to the cameras, a similarity of the world undoes on every picture."""
    rng, h = np.random.default_rng(0), 1e-3
    cameras = [orbit_camera(a, distance=3 + a) for a in range(5)]
    points = rng.normal(size=(20, 3))
    modes = _similarities(cameras, PIVOT)
    assert modes.shape == (30, 7) and np.allclose(modes.T @ modes, np.eye(7))
    poses = (modes @ rng.normal(size=7)).reshape(5, 6) * h
    opaque = lambda row: [dr.opaque(mi.Float, float(v)) for v in row]
    before = np.concatenate([c.project(points)[0] for c in cameras])
    moved = [replace(c, learned=learned_camera(c, PIVOT, opaque(p))).baked() for c, p in zip(cameras, poses)]
    shift = (np.concatenate([c.project(points)[0] for c in moved]) - before).ravel()
    similarities = []  # all that moving the points by small similarities can do
    for k in range(7):
        turn = np.eye(3)[k % 3]
        change = np.cross(turn, points) if k < 3 else np.broadcast_to(turn, points.shape) if k < 6 else points
        similarities.append((np.concatenate([c.project(points + h * change)[0] for c in cameras]) - before).ravel())
    left = shift - np.transpose(similarities) @ np.linalg.lstsq(np.transpose(similarities), shift, rcond=None)[0]
    assert np.linalg.norm(left) < 0.02 * np.linalg.norm(shift)


def test_poses_and_exposures_come_back():
    """Of photographs whose cameras are a degree off, and of other exposures, under the surfels that they show."""
    surfels, lighting = photographed()
    dataset = random_photographs(distance=3.5)
    others, exposures = perturbed(dataset, degrees=1.0, focal=0.0, quality=None, dilation=None)
    photographs, truth = Photographs(others.train, 1, 1.0), [v.camera for v in dataset.train]
    cameras, schedule = Cameras([v.camera for v in others.train], 1.0, True, True), np.geomspace(3e-3, 1e-4, 50)
    cameras._modes = np.zeros((36, 0))  # these surfels follow nothing
    before = pose_errors(cameras.given, truth)
    for rate in schedule:
        for view in range(6):
            photo = photographs.tile(view)
            s = cameras.see(view, photo.camera, SETTINGS.weights)
            image = deferred.render(surfels, s.camera, lighting)
            shown = losses.display(image.color * s.gain, image.gbuffer.all.alpha, 1.0)
            dr.backward(dr.mean(losses.photometric(shown, photo.color, s.camera.size, 0.2)) + s.prior)
            cameras.step(cameras.gradients(), {POSES: rate, LENSES: 0.0, EXPOSURE: 10 * rate})
    after = pose_errors([cameras.camera(k) for k in range(6)], truth)
    assert np.median(before[0]) > 0.8 and np.median(after[0]) < 0.35, (before, after)
    assert np.median(after[1]) < 0.4 * np.median(before[1])
    stops = np.array([exposures[v.name] for v in dataset.train])
    found = np.log2([cameras.gain(k) for k in range(6)])
    assert np.abs(found - (stops - stops.mean())[:, None]).max() < 0.05 < np.abs(stops - stops.mean()).max()


def test_gauge(dataset):
    """However views pull, the world comes back, and so does the mean of the gains."""
    cameras, rng = Cameras([v.camera for v in dataset.train], 1.0, True, True), np.random.default_rng(0)
    for view in (0, 3, 5, 1):
        s = cameras.see(view, dataset.train[view].camera, SETTINGS.weights)
        pulled = [*s.camera.learned.numbers().origin, *s.gain]
        dr.backward(sum(v * float(w) for v, w in zip(pulled, rng.normal(size=6))) + s.prior)
        cameras.step(cameras.gradients(), {POSES: 1e-2, LENSES: 1e-3, EXPOSURE: 1e-2})
    assert np.abs(cameras.rows[POSES].value).max() > 3e-3 and np.abs(cameras.rows[EXPOSURE].value).max() > 3e-3
    poses, gains = (cameras.rows[name].value for name in (POSES, EXPOSURE))
    drift = lambda: np.abs(cameras._modes.T @ poses.ravel()).max() + np.abs(gains.mean(0)).max()
    others = lambda: poses.ravel() - cameras._modes @ (cameras._modes.T @ poses.ravel())
    before, kept = drift(), others()
    for _ in range(200):
        cameras.step({}, {})
    assert drift() < 0.03 * before and before > 1e-3 and np.allclose(others(), kept)


def test_who_learns(dataset):
    rows = lambda **settings: set(c.rows) if (c := Cameras.of(dataset, replace(SETTINGS, **settings), 1.0)) else None
    assert rows() is None
    assert rows(cameras="learned") == {POSES, LENSES}
    assert rows(exposure="learned") == {EXPOSURE}
    assert rows(cameras="learned", exposure="learned") == {POSES, LENSES, EXPOSURE}


def test_cameras_begin_elsewhere(dataset):
    given = [v.camera for v in dataset.train]
    others = [
        replace(c, to_world=c.to_world @ Camera.look_at((0.02, 0, 0), (0, 0.03, 1), (0, 1, 0), 50, (8, 8)).to_world)
        for c in given
    ]
    cameras = Cameras(given, 1.0, True, False)
    cameras.begin(others)
    assert all(np.allclose(cameras.camera(k).to_world, c.to_world, atol=1e-5) for k, c in enumerate(others))
    still = cameras.see(2, given[2], SETTINGS.weights, started=False)  # as they begin, and with nothing to learn
    assert np.allclose(still.camera.baked().to_world, others[2].to_world, atol=1e-5)
    assert not cameras.gradients()[POSES]
    fixed = Cameras(given, 1.0, False, True)
    fixed.begin(others)
    assert fixed.camera(0) is given[0]


def test_exposures_start_where_exif_says(dataset, monkeypatch):
    told = np.linspace(-0.5, 0.5, len(dataset.train))
    monkeypatch.setattr("rgs_mi.fit.cameras.log_gains", lambda paths: told if len(paths) == len(told) else None)
    cameras = Cameras.of(dataset, replace(SETTINGS, exposure="learned"), 1.0)
    assert cameras.gain(0) == pytest.approx(np.exp(-0.5)) and cameras.gain(len(told) - 1) == pytest.approx(np.exp(0.5))


def test_views_of_one_camera_share_its_intrinsics(dataset):
    cameras = [v.camera for v in dataset.train]
    cameras[2:4] = [replace(c, focal=(c.focal[0] * 1.1, c.focal[1])) for c in cameras[2:4]]
    learned = Cameras(cameras, 1.0, True, False)
    learned.rows[LENSES].value[:, 0] = [0.01, 0.02]
    factor = [np.log(learned.camera(k).focal[0] / c.focal[0]) for k, c in enumerate(cameras)]
    assert np.allclose(factor, [0.01, 0.01, 0.02, 0.02, 0.01, 0.01])
    other = Camera.look_at((3, 0, 0), (0, 0, 0), (0, 0, 1), 50, (8, 8))
    assert learned.calibrated(other) is other
    elsewhere = learned.calibrated(replace(cameras[2], to_world=other.to_world))
    assert np.isclose(elsewhere.focal[0], cameras[2].focal[0] * np.exp(0.02))
    assert np.allclose(elsewhere.to_world, other.to_world, atol=1e-6)


def test_checkpoints_hold_cameras(dataset):
    settings = replace(SETTINGS, cameras="learned", exposure="learned", cameras_start=0.0)
    fit = Fit(dataset, model(), settings, 1.0)
    for _ in range(8):
        fit.step()
    again = Fit.resume(dataset, settings, *fit.state())
    for name, rows in fit.cameras.rows.items():
        assert all(np.array_equal(v, again.cameras.rows[name].state()[k]) for k, v in rows.state().items())
        assert rows.value.any() and rows.steps.max() >= 1
    assert Fit.resume(dataset, settings, *Fit(dataset, model(), settings, 1.0).state()).cameras is not None


def test_no_kernel_is_compiled_again(dataset):
    """Poses, gains and rates differ from step to step."""
    settings = replace(SETTINGS, cameras="learned", exposure="learned", cameras_start=0.0)
    fit = Fit(dataset, model(), settings, 1.0)
    for _ in range(9):
        fit.step()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for _ in range(3):
            fit.step()
        history = dr.kernel_history([dr.KernelType.JIT])
    assert history and all(entry["cache_hit"] for entry in history)

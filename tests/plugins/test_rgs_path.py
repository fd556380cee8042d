"""Surfels in a path-traced scene: crossings against brute force, pictures against Mitsuba's path tracer by statistics."""

import importlib
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rgs_mi.core.camera import Camera
from rgs_mi.core.errors import UserError
from rgs_mi.export.render import sensor_dict
from rgs_mi.surfels import proxies, ray_tracing
from rgs_mi.surfels.surfels import CHANNELS, SH_0, Surfels, rotation_from_normal
from rgs_mi.validation.statistics import Difference, Estimate

from scenes import sphere_surfels

BATCHES = 8


# ---- Crossings ----


def brute_force(surfels, origin, direction, maxt, leaves):
    """(8) of `rays.py` for each ray: (A, t, unit normal, roughness, weights [rays, N] in the order of the surfels)."""
    s = {name: value.astype(np.float64) for name, value in surfels.numpy().items()}
    t_u, t_v, normal = (np.array(v, np.float64).T for v in surfels.frames())
    cut, thickness = ray_tracing._CUTOFFS, proxies._THICKNESS * 2 * s["scales"].min(1).mean()
    coverage, t_mean, mean, rough = (np.zeros((len(origin), k)) for k in (1, 1, 3, 1))
    weights = np.zeros((len(origin), len(surfels)))
    for r, (o, d) in enumerate(zip(origin, direction)):
        cosine = normal @ d
        t = ((s["centers"] - o) * normal).sum(1) / cosine
        offset = o + t[:, None] * d - s["centers"]
        u, v = ((offset * axis).sum(1) / s["scales"][:, k] for k, axis in enumerate((t_u, t_v)))
        K_uu, K_uv, K_vv = s["curvature"].T / np.sqrt(s["scales"].prod(1))
        x, y = u * s["scales"][:, 0], v * s["scales"][:, 1]
        bent = normal + (K_uu * x + K_uv * y)[:, None] * t_u + (K_uv * x + K_vv * y)[:, None] * t_v
        alpha = np.minimum(s["opacities"][:, 0] * np.exp(-0.5 * (u * u + v * v)), cut.alpha_max)
        spared = (cosine > 0) & ((t < thickness) if surfels.two_sided else True) & (leaves or not surfels.two_sided)
        remaining = 1.0
        for i in np.argsort(t):
            if 0 < t[i] < maxt and alpha[i] > cut.alpha_min and not spared[i] and remaining > cut.transmittance_min:
                weights[r, i] = w = remaining * alpha[i]
                remaining -= w
        facing = np.where((cosine > 0)[:, None], -bent, bent) + s["delta_normal"]
        coverage[r], mean[r], t_mean[r] = 1 - remaining, weights[r] @ facing, weights[r] @ np.where(weights[r] > 0, t, 0)
        rough[r] = weights[r] @ s["roughness"]
    some = np.maximum(coverage, 1e-9)
    length = np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    return coverage, t_mean / some, mean / length, rough / some, weights


@pytest.mark.parametrize(
    "two_sided, leaves, maxt", [(True, False, 10), (False, False, 10), (True, True, 10), (True, False, 1.5)]
)
def test_rays_meet_what_brute_force_says(two_sided, leaves, maxt):
    rng = np.random.default_rng(0)
    surfels = replace(sphere_surfels(150, scale=0.5), two_sided=two_sided)
    origin = 1.2 * rng.normal(size=(600, 3))
    direction = 0.4 * rng.normal(size=(600, 3)) - origin
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    sample = rng.random(600)
    hit = ray_tracing.SurfelRayTracer(surfels)
    ray = mi.Ray3f(mi.Point3f(origin.T), mi.Vector3f(direction.T))
    mine = hit.intersect(ray, mi.Float(maxt), mi.Bool(leaves), mi.Float(sample), mi.Bool(True))
    coverage, t, normal, roughness, weights = brute_force(surfels, origin, direction, maxt, leaves)
    near = lambda a, b: np.mean(np.abs(a - b) < 1e-3)  # a few rays lie within rounding of a cutoff
    transmittance = hit.transmittance(ray, mi.Float(maxt), mi.Bool(leaves), mi.Bool(True)).numpy()
    through = np.where(1 - coverage[:, 0] > ray_tracing._CUTOFFS.transmittance_min, 1 - coverage[:, 0], 0)
    assert near(transmittance, through) > 0.99
    found = mine.found.numpy()
    assert 0.2 < found.mean() < 0.95
    assert np.mean(found == ((coverage[:, 0] > sample) | (through == 0))) > 0.99
    for value, expected in ((mine.t, t), (mine.normal, normal), (mine.roughness, roughness)):
        value = np.atleast_2d(value.numpy()).T
        assert near(value[found], expected[found]) > 0.99
    # the surfel whose share the sample falls into, front to back
    order = np.argsort(((surfels.numpy()["centers"][None] - origin[:, None]) * direction[:, None]).sum(-1), 1)
    share = weights[np.arange(600), mine.index.numpy()]
    assert order.shape == weights.shape and (share[found] > 0).mean() > 0.99


def test_surfels_are_found_as_often_as_they_weigh():
    surfels = sphere_surfels(40, scale=0.5)
    origin, n = np.array([[0.2, -3, 0.1]]), 20000
    direction = np.array([[0, 1.0, 0]])
    ray = mi.Ray3f(mi.Point3f(*origin[0].tolist()), mi.Vector3f(*direction[0].tolist()))
    sample = mi.Float((np.arange(n) + 0.5) / n)
    hit = ray_tracing.SurfelRayTracer(surfels).intersect(ray, mi.Float(10), mi.Bool(False), sample, mi.Bool(True))
    *_, weights = brute_force(surfels, origin, direction, 10, False)
    counted = np.bincount(hit.index.numpy()[hit.found.numpy()], minlength=40) / n
    assert (weights > 0.02).sum() > 3
    np.testing.assert_allclose(counted, weights[0], atol=0.011)  # what is left of the transmittance goes to the last


# ---- Pictures ----


def plane(half=20, count=80, **fields):
    """A floor of surfels, z ≈ 0, so dense that nothing is seen through it. No two lie in one plane, as after a fit."""
    step, rng = 2 * half / count, np.random.default_rng(0)
    x, y = np.meshgrid(*2 * [step * (np.arange(count) + 0.5) - half])
    centers = np.stack([x.ravel(), y.ravel(), rng.uniform(-2e-3, 2e-3, count**2)], 1)
    n = len(centers)
    each = lambda v: np.tile(np.atleast_1d(np.float32(v)), (n, 1))
    values = {"sh": (np.zeros(3) - 0.5) / SH_0, "base_color": (0.6, 0.3, 0.2), "roughness": 0.3, "metallic": 0.3} | fields
    return Surfels.from_numpy(
        {
            "centers": centers,
            "rotations": rotation_from_normal(np.tile([0.0, 0, 1], (n, 1))),
            "scales": each([step, step]),
            "opacities": each(0.99),
            "delta_normal": each([0, 0, 0]),
        }
        | {name: each(value) for name, value in values.items()}
    )


def shapes():
    """What stands on the floor: a mirror, something to throw a shadow, a lamp."""
    ball = lambda x, y, r, bsdf: {"type": "sphere", "center": [x, y, 1.3], "radius": r, "bsdf": bsdf}
    return {
        "mirror": ball(-1, 0, 1, {"type": "conductor", "material": "none"}),
        "ball": ball(1.2, -0.5, 0.6, {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.5, 0.7]}}),
        "lamp": {
            "type": "sphere",
            "center": [2, 2, 4],
            "radius": 0.5,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [12, 10, 8]}},
        },
        "sky": {"type": "constant", "radiance": 0.3},
    }


def estimate(scene, integrator, first):
    sensor = mi.load_dict(Camera.look_at([0, -7, 4], [0, 0, 0.6], [0, 0, 1], 45, (28, 20)).to_sensor_dict())
    scene, integrator = mi.load_dict({"type": "scene"} | scene), mi.load_dict(integrator)
    return Estimate.of(
        [
            mi.render(scene, sensor=sensor, integrator=integrator, spp=64, seed=first + k).numpy()[..., :3].reshape(-1, 3)
            for k in range(BATCHES)
        ]
    )


def surfel_shape(surfels):
    return {"type": "surfels", "two_sided": False, **{name: getattr(surfels, name) for name in CHANNELS}}


def rectangle(**more):
    bsdf = {
        "type": "principled",
        "base_color": {"type": "rgb", "value": [0.6, 0.3, 0.2]},
        "roughness": 0.3,
        "metallic": 0.3,
        "eta": 1.5,
    } | more.pop("bsdf", {})
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale([20, 20, 1]), "bsdf": bsdf} | more


@pytest.mark.parametrize("depth", [2, 5])
def test_a_floor_of_surfels_is_a_principled_rectangle(monkeypatch, depth):
    """Lit by lamp and sky, in shadow, seen directly and in a mirror, and lighting a ball."""
    monkeypatch.setattr(proxies, "_CLEARANCE", 1e-4)
    own = {"type": "rgs_path", "diffuse": "lit", "max_depth": depth}
    mine = estimate(shapes() | {"floor": surfel_shape(plane())}, own, 0)
    other = estimate(shapes() | {"floor": rectangle()}, {"type": "path", "max_depth": depth}, 100)
    assert Difference(mine, other).equal
    duller = estimate(shapes() | {"floor": surfel_shape(plane(roughness=0.35))}, own, 200)
    assert not Difference(duller, other).equal  # the test has the power to tell


def test_surfels_that_send_what_was_photographed_are_an_area_light(monkeypatch):
    monkeypatch.setattr(proxies, "_CLEARANCE", 1e-4)
    radiance = np.array([0.5, 0.8, 0.2])
    own = plane(sh=(radiance - 0.5) / SH_0, base_color=(0, 0, 0), metallic=0)
    mine = estimate(shapes() | {"floor": surfel_shape(own)}, {"type": "rgs_path", "max_depth": 5}, 0)
    black = {"base_color": {"type": "rgb", "value": 0.0}, "metallic": 0.0}
    lamp = {"type": "area", "radiance": {"type": "rgb", "value": radiance.tolist()}}
    other = estimate(shapes() | {"floor": rectangle(bsdf=black, emitter=lamp)}, {"type": "path", "max_depth": 5}, 100)
    assert Difference(mine, other).equal


def test_a_scene_without_surfels_in_sight_is_that_of_path():
    far = Surfels.from_numpy(plane(half=1, count=4).numpy() | {"centers": np.full((16, 3), [0, 0, -30], np.float32)})
    mine = estimate(shapes() | {"floor": rectangle(), "far": surfel_shape(far)}, {"type": "rgs_path"}, 0)
    other = estimate(shapes() | {"floor": rectangle()}, {"type": "path"}, 100)
    assert Difference(mine, other).equal


def test_emitters_hide_and_coverage_is_alpha():
    surfels = sphere_surfels(300)
    sensor = mi.load_dict(sensor_dict(Camera.look_at([0, -4, 0], [0, 0, 0], [0, 0, 1], 40, (24, 24))))
    scene = mi.load_dict({"type": "scene", "object": surfel_shape(surfels), "sky": {"type": "constant"}})

    def picture(kind, **more):
        return mi.render(scene, sensor=sensor, integrator=mi.load_dict({"type": kind, **more}), spp=256).numpy()

    hidden, shown = (picture("rgs_path", hide_emitters=value) for value in (True, False))
    assert (shown[..., 3] == 1).all() and hidden[0, 0, 3] == 0 and (hidden[0, 0, :3] == 0).all()
    splatted = picture("rgs_deferred", specular="none", hide_emitters=True)
    assert abs(hidden[..., 3] - splatted[..., 3]).mean() < 0.02  # whose low-pass widens small surfels


def test_kernels_of_their_own_change_nothing(monkeypatch):
    """As OptiX needs them, which traces rays through one scene in a kernel."""
    if not mi.variant().startswith("llvm"):
        pytest.skip("can't do without them")
    scene = mi.load_dict({"type": "scene"} | shapes() | {"object": surfel_shape(sphere_surfels(300))})
    sensor = mi.load_dict(Camera.look_at([0, -7, 4], [0, 0, 0.6], [0, 0, 1], 45, (28, 20)).to_sensor_dict())
    rgs_path = importlib.import_module("rgs_mi.plugins.rgs_path")  # which needs a variant
    pictures, kernels = [], []
    for apart in (False, True):
        monkeypatch.setattr(rgs_path, "_apart", lambda: apart)
        integrator = mi.load_dict({"type": "rgs_path", "diffuse": "lit", "max_depth": 4})
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            pictures.append(mi.render(scene, sensor=sensor, integrator=integrator, spp=16).numpy())
            kernels.append(len(dr.kernel_history((dr.KernelType.JIT,))))
    np.testing.assert_allclose(*pictures, rtol=1e-4, atol=1e-5)
    assert kernels[1] > kernels[0] + 8


@pytest.mark.parametrize(
    "change, message", [({"diffuse": "no"}, "unknown diffuse 'no'"), ({"max_depth": -3}, "max_depth -3")]
)
def test_bad_settings(change, message):
    with pytest.raises(Exception, match=message):
        mi.load_dict({"type": "rgs_path"} | change)


def test_no_surfels():
    scene = mi.load_dict({"type": "scene", "sky": {"type": "constant"}})
    with pytest.raises(UserError, match="no surfels"):
        mi.load_dict({"type": "rgs_path"}).sample(scene, mi.load_dict({"type": "independent"}), mi.Ray3f())

"""The object reflected in itself, against brute force, Mitsuba's path tracer and finite differences."""

import functools
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import ndimage

from rgs_mi.core.bounding_box import BoundingBox
from rgs_mi.core.camera import Camera
from rgs_mi.shading import deferred, indirect
from rgs_mi.shading.environment import Environment
from rgs_mi.shading.indirect import Indirect
from rgs_mi.shading.lighting import Lighting
from rgs_mi.shading.monte_carlo import MonteCarlo
from rgs_mi.shading.split_sum import DEFAULT_ETA, SplitSum
from rgs_mi.shading.surface import Surface
from rgs_mi.surfels.proxies import Proxies
from rgs_mi.surfels.surfels import CHANNELS, SH_0, Surfels, rotation_from_normal

from scenes import sphere_surfels, tangent_surfels

SIZE = (96, 96)
CAMERA = Camera.look_at([0, -3, 1.2], [0, 0, 0.3], [0, 0, 1], 40, SIZE)
LIGHT = 0.4  # of the environment
WALL = np.array([0.9, 0.3, 0.1])  # radiance


def brute_force(surfels, origin, direction, solid=0.2):
    """[R] number of the nearest quad that each ray meets (-1: none), whether it meets its front, where [R, 2], in standard
    deviations from its middle, and the distance to it."""
    s = {name: value.astype(np.float64) for name, value in surfels.numpy().items()}
    t_u, t_v, normal = (np.array(v).T for v in surfels.frames())
    extent = np.sqrt(2 * np.log(np.maximum(s["opacities"] / solid, 1)))
    nearest, number, front = np.full(len(origin), np.inf), np.full(len(origin), -1), np.zeros(len(origin), bool)
    uv_hit = np.zeros((len(origin), 2))
    for i in range(len(surfels)):
        cosine = direction @ normal[i]
        t = ((s["centers"][i] - origin) @ normal[i]) / cosine
        offset = origin + t[:, None] * direction - s["centers"][i]
        uv = np.stack([offset @ t_u[i], offset @ t_v[i]], 1) / s["scales"][i]
        hit = (abs(uv) < extent[i]).all(1) & (t > 0) & (t < nearest)
        nearest[hit], number[hit], front[hit], uv_hit[hit] = t[hit], i, cosine[hit] < 0, uv[hit]
    return number, front, uv_hit, nearest


@pytest.mark.parametrize("two_sided", [True, False])
def test_rays_meet_what_brute_force_says(two_sided):
    rng = np.random.default_rng(0)
    surfels = replace(sphere_surfels(300, scale=0.3), two_sided=two_sided)
    origin = rng.normal(size=(4000, 3))
    direction = 0.5 * rng.normal(size=(4000, 3)) - origin  # inwards, mostly
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    normal = np.zeros((4000, 3))
    proxies = Proxies(surfels)
    found, number, uv = proxies.intersect(mi.Point3f(origin.T), mi.Vector3f(normal.T), mi.Vector3f(direction.T))
    expected, front, where, distance = brute_force(surfels, origin, direction)
    hit = (expected >= 0) & (front | (two_sided & (distance > proxies.thickness.numpy())))
    assert 0.1 < hit.mean() < 0.9
    assert not two_sided or min(((expected >= 0) & ~front & ~hit).sum(), (hit & ~front).sum()) > 10
    differs = (found.numpy() != hit) | hit & (number.numpy() != expected)
    assert differs.mean() < 1e-3  # rays along an edge, in single precision
    assert np.allclose(uv.numpy().T[hit & ~differs], where[hit & ~differs], atol=1e-3)


def test_what_rays_meet_reflects_by_normals_that_turn():
    """A ball of mirrors in a light that changes slowly: what comes from it is that of a sphere, many times as well as with
    surfels of one normal each."""
    rng = np.random.default_rng(0)
    polar, azimuth = np.meshgrid(np.linspace(0, np.pi, 16), np.arange(32) * np.pi / 16, indexing="ij")
    texels = 0.5 + 0.4 * np.stack([np.cos(polar), np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth)], -1)
    estimator = SplitSum(Environment(mi.TensorXf(texels.astype(np.float32)), np.eye(3)).filtered())
    point = rng.normal(size=(4000, 3))
    point /= np.linalg.norm(point, axis=1, keepdims=True)
    towards = 0.5 * rng.normal(size=(4000, 3)) - point
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    ahead = (point * towards).sum(1) < -0.5
    normal, direction = mi.Vector3f(point[ahead].T), mi.Vector3f(towards[ahead].T)
    expected = estimator.specular(Surface(normal, -direction, mi.Float(0.1), mi.Float(1), mi.Color3f(1))).numpy()

    def error(curvature):
        base = tangent_surfels(400, curvature).numpy()
        full = lambda name, value: {name: np.full_like(base[name], value)}
        surfels = Surfels.from_numpy(
            base
            | full("roughness", 0.1)
            | full("metallic", 1)
            | full("base_color", 1)
            | {"sh": np.full((400, 3), -0.5 / SH_0)},
            two_sided=False,
        )
        indirect = Indirect("one_bounce", Proxies(surfels), surfels)
        none = dr.zeros(mi.Color3f, dr.width(direction))
        mine = indirect.incident_radiance(
            none, mi.Point3f(normal - direction), mi.Vector3f(0), direction, Lighting(estimator, indirect=indirect)
        ).numpy()
        hit = mine.max(0) > 0
        assert hit.mean() > 0.9
        return abs(mine - expected)[:, hit].mean()

    assert 3 * error([1, 0, 1]) < error([0, 0, 0])


def plate(origin, across, up, count=60):
    """Centres [count², 3] of surfels over the parallelogram that starts at ``origin``."""
    x, y = np.meshgrid((np.arange(count) + 0.5) / count, (np.arange(count) + 0.5) / count)
    return np.asarray(origin) + x.reshape(-1, 1) * np.asarray(across) + y.reshape(-1, 1) * np.asarray(up)


def corner():
    """A mirror on the floor, z = 0, and a wall behind it, y = 1, that shines: its own specular part is black, as its base
    colour is."""
    floor, wall = plate([-1, -1, 0], [2, 0, 0], [0, 2, 0]), plate([-1, 1, 0], [2, 0, 0], [0, 0, 1.5])
    n, is_wall = len(floor), np.repeat([False, True], len(floor))
    pick = lambda of_floor, of_wall: np.where(is_wall[:, None], of_wall, of_floor).astype(np.float32)
    return Surfels.from_numpy(
        {
            "centers": np.concatenate([floor, wall]),
            "rotations": np.concatenate([rotation_from_normal(np.tile(d, (n, 1))) for d in ([0.0, 0, 1], [0.0, -1, 0])]),
            "scales": np.full((2 * n, 2), 2 / 60),
            "opacities": np.full((2 * n, 1), 0.99),
            "sh": (pick(np.zeros(3), WALL) - 0.5) / SH_0,
            "base_color": pick(np.ones(3), np.zeros(3)),
            "roughness": pick([0], [1]),
            "metallic": pick([1], [1]),
            "delta_normal": np.zeros((2 * n, 3)),
        },
        two_sided=False,
    )


def image(surfels, kind, environment=None):
    """Linear radiance; ``kind``: of `Indirect`, None: without."""
    environment = environment or Environment(mi.TensorXf(np.full((16, 32, 3), LIGHT, np.float32)), np.eye(3))
    indirect = kind and Indirect(kind, Proxies(surfels), surfels)
    lighting = Lighting(SplitSum(environment.filtered()), indirect=indirect or None)
    return deferred.render(surfels, CAMERA, lighting).color


def array(color):
    return dr.detach(color).numpy().T.reshape(*SIZE[::-1], 3)


@functools.cache
def truth():
    """The same corner from Mitsuba's path tracer: a mirror and an area light."""
    square = lambda matrix: mi.ScalarTransform4f(np.array(matrix, float))
    return mi.render(
        mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "path", "max_depth": 3, "hide_emitters": True},
                "sensor": CAMERA.to_sensor_dict() | {"sampler": {"type": "independent"}},
                "floor": {"type": "rectangle", "bsdf": {"type": "conductor", "material": "none"}},
                "wall": {
                    "type": "rectangle",
                    "bsdf": {"type": "diffuse", "reflectance": 0.0},
                    "to_world": square([[1, 0, 0, 0], [0, 0, -1, 1], [0, 0.75, 0, 0.75], [0, 0, 0, 1]]),
                    "emitter": {"type": "area", "radiance": {"type": "rgb", "value": WALL.tolist()}},
                },
                "light": {"type": "constant", "radiance": LIGHT},
            }
        ),
        spp=64,
    ).numpy()[..., :3]


def floor_reflecting(expected, radiance):
    """[H, W] bool: pixels of the floor that reflect ``radiance`` in the image ``expected``, clear of edges, where surfels
    reach beyond the rectangles that they stand for."""
    rays = CAMERA.rays()
    t = -CAMERA.origin[2] / rays[..., 2]
    floor = (t > 0) & (abs((CAMERA.origin + t[..., None] * rays)[..., :2]) < 0.9).all(-1)
    return ndimage.binary_erosion(floor & (abs(expected - radiance).max(-1) < 1e-3), iterations=3)


@pytest.mark.parametrize("two_sided", [True, False])
def test_a_mirror_shows_the_wall_as_the_path_tracer_does(two_sided):
    mine, expected = array(image(replace(corner(), two_sided=two_sided), "one_bounce")), truth()
    for radiance, pixels in ((WALL, 1000), (LIGHT, 50)):
        where = floor_reflecting(expected, radiance)
        assert where.sum() > pixels
        assert abs(mine - expected)[where].max() < 1e-3


def test_kinds():
    surfels = corner()
    where = floor_reflecting(truth(), WALL)
    assert abs(array(image(surfels, "visibility"))[where]).max() < 1e-3
    assert abs(array(image(surfels, None))[where] - LIGHT).max() < 1e-3


@pytest.mark.parametrize("sampled", [False, True])
@pytest.mark.parametrize("roughness, part", [(0.2, 1), (0.25, 0.75), (0.35, 0.25), (0.4, 0)])
def test_what_is_rough_reflects_no_surfels_with_a_radiance_of_their_own(roughness, part, sampled):
    base = corner().numpy()
    surfels = Surfels.from_numpy(
        base | {"roughness": np.where(base["roughness"] < 0.5, roughness, base["roughness"]).astype(np.float32)},
        two_sided=False,
    )
    shade = lambda *how: array(deferred.render(surfels, CAMERA, lighting(surfels, *how)).specular)
    free, wholly, mine = shade(None, sampled), shade("visibility", sampled, True), shade("visibility", sampled)
    hidden, where = free - wholly, floor_reflecting(truth(), WALL)
    assert hidden[where].min() > 0.05
    assert np.allclose((free - mine)[where], part * hidden[where], atol=2e-3)


def test_gradients_equal_finite_differences():
    """In what the surfels send to each other, and in the environment: rays stay where they are."""
    rng = np.random.default_rng(1)
    surfels = corner()
    base = surfels.numpy()
    shape = base["roughness"].shape
    base |= {
        "roughness": np.full(shape, 0.28, np.float32),
        "metallic": np.full(shape, 0.6, np.float32),
        "sh": base["sh"] + np.float32(0.5),  # a radiance of zero is a kink
        "base_color": rng.uniform(0.3, 0.8, base["base_color"].shape).astype(np.float32),
    }
    base["texels"] = rng.uniform(0.3, 0.9, (16, 32, 3)).astype(np.float32)
    weights = rng.normal(size=(3, SIZE[0] * SIZE[1])).astype(np.float32)

    def render(arrays):
        surfels, texels = Surfels.from_numpy(arrays, two_sided=False), mi.TensorXf(arrays["texels"])
        for value in [*(getattr(surfels, n) for n in CHANNELS), texels]:
            dr.enable_grad(value)
        return image(surfels, "one_bounce", Environment(texels, np.eye(3))), surfels, texels

    color, surfels, texels = render(base)
    without = array(image(surfels, None, Environment(texels, np.eye(3))))
    assert (abs(array(color) - without).max(-1) > 0.05).sum() > 300  # indirect light is there to be differentiated
    dr.backward(sum(dr.sum(c * mi.Float(w)) for c, w in zip(color, weights)))
    for name in ("texels", "sh", "base_color", "metallic", "roughness"):
        gradient = dr.grad(texels if name == "texels" else getattr(surfels, name)).numpy().astype(np.float64)
        direction = np.copysign(rng.uniform(0.2, 1, gradient.shape), gradient)
        value = lambda h: (render(base | {name: base[name] + h * direction})[0].numpy().astype(np.float64) * weights).sum()
        central = lambda h: (value(h) - value(-h)) / (2 * h)
        expected = (4 * central(1e-3) - central(2e-3)) / 3
        rel = 1e-2 if name == "roughness" else 1e-3  # kinks between entries of the tables
        assert (gradient * direction).sum() == pytest.approx(expected, rel=rel), name


def lighting(surfels, kind, sampled=False, lit=False):
    """The `Lighting` of ``surfels`` by a constant light; ``kind``: of `Indirect`, None: without."""
    environment = Environment(mi.TensorXf(np.full((16, 32, 3), LIGHT, np.float32)), np.eye(3))
    estimator = (
        SplitSum(environment.filtered())
        if not sampled
        else MonteCarlo(environment.unfiltered(), environment.emitter(), DEFAULT_ETA, 256, mi.UInt32(0))
    )
    return Lighting(estimator, indirect=kind and Indirect(kind, Proxies(surfels), surfels), lit=lit)


def disc_over_a_patch(height=0.5, radius=0.4):
    """One surfel that looks up to a disc of many."""
    rng = np.random.default_rng(0)
    r, phi = radius * np.sqrt(rng.random(4000)), rng.uniform(0, 2 * np.pi, 4000)
    centers = np.concatenate([[[0, 0, 0]], np.stack([r * np.cos(phi), r * np.sin(phi), np.full(4000, height)], 1)])
    n = len(centers)
    normals = np.tile([0.0, 0.0, -1.0], (n, 1))
    normals[0] = 0, 0, 1
    full = lambda value, channels: np.full((n, channels), value, np.float32)
    return Surfels.from_numpy(
        {
            "centers": centers,
            "rotations": rotation_from_normal(normals),
            "scales": full(0.01, 2),
            "opacities": full(0.99, 1),
            "sh": full(0, 3),
            "base_color": full(0.5, 3),
            "roughness": full(0.5, 1),
            "metallic": full(0, 1),
            "delta_normal": full(0, 3),
        },
        two_sided=False,
    )


@pytest.mark.parametrize("two_sided", [True, False])
def test_share_of_diffuse_light_under_a_disc(two_sided):
    """(9) under a constant light: a disc hides r²/(r² + h²) of a hemisphere's cosine."""
    surfels = replace(disc_over_a_patch(), two_sided=two_sided)
    light = lighting(surfels, "visibility", lit=True)
    irradiance_visibility = np.mean(
        [light.with_irradiance_visibility(seed).indirect.irradiance_visibility.numpy()[:, 0] for seed in range(40)], 0
    )
    radius, height = 0.4 + 0.02, 0.5 - 0.02  # quads reach nearly two standard deviations; rays start as far above
    # all of it where what shows from behind is hidden by nothing
    share = 1 if two_sided else 1 - radius**2 / (radius**2 + height**2)
    assert irradiance_visibility[0] == pytest.approx(share, abs=1e-6 if two_sided else 0.01)


def test_hidden_light_of_many_surfels_is_found_in_rounds(monkeypatch):
    surfels = corner()
    light = lighting(surfels, "visibility", lit=True)
    of = lambda: light.with_irradiance_visibility(3).indirect.irradiance_visibility.numpy()
    together = of()
    monkeypatch.setattr(indirect, "_MOST_RAYS", 5 * len(surfels))  # of 32 for each
    assert together.min() < 0.7 < together.mean()
    np.testing.assert_allclose(of(), together, atol=1e-5)


def test_hidden_light_is_asked_for_in_the_box_alone():
    surfels = corner()
    light = lighting(surfels, "visibility", lit=True)
    of = lambda box: replace(light, box=box).with_irradiance_visibility(3).indirect.irradiance_visibility.numpy()[0]
    everywhere, inside = of(None), surfels.numpy()["centers"][:, 0] < 0
    part = of(BoundingBox((-9, -9, -9), (0, 9, 9)))
    assert everywhere[inside].min() < 0.8 and everywhere[~inside].min() < 0.8
    assert (part[~inside] == 1).all() and abs(part - everywhere)[inside].mean() < 0.06  # 32 rays, others
    assert (part - everywhere)[inside].mean() == pytest.approx(0, abs=3e-3)
    assert (of(BoundingBox((8, 8, 8), (9, 9, 9))) == 1).all()


@pytest.mark.parametrize("kind", ["visibility", "one_bounce"])
def test_diffuse_light_of_split_sum_is_that_of_monte_carlo(kind):
    """On the floor before the wall, both matte and lit: without shares half of the light would be too much in the edge."""
    base = corner().numpy()
    surfels = Surfels.from_numpy(
        base
        | {
            "metallic": np.zeros_like(base["metallic"]),
            "roughness": np.ones_like(base["roughness"]),
            "base_color": np.full_like(base["base_color"], 0.2),
        },
        two_sided=False,
    )
    lightings = [lighting(surfels, *how, lit=True) for how in ((kind, True), (None,), (kind,))]
    lightings[2] = lightings[2].with_irradiance_visibility()
    expected, free, shared = (array(deferred.render(surfels, CAMERA, l).diffuse)[..., 0] for l in lightings)
    floor = floor_reflecting(truth(), WALL)
    error = lambda image: abs(image - expected)[floor].mean() / expected[floor].mean()
    assert error(free) > 0.1 and error(shared) < 0.03

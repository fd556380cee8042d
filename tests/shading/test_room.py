"""A room that is near: an environment on walls is what Mitsuba sees of walls that shine."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rgs_mi.core.turntable import Turntable
from rgs_mi.shading import deferred
from rgs_mi.shading.environment import Environment
from rgs_mi.shading.indirect import Indirect
from rgs_mi.shading.lighting import Shading, lighting_of
from rgs_mi.shading.monte_carlo import MonteCarlo
from rgs_mi.shading.room import Room
from rgs_mi.shading.split_sum import SplitSum
from rgs_mi.shading.surface import Surface

from scenes import colors, orbit_camera, shape, sphere_surfels

CENTER, DISTANCES = np.array([0.2, -0.1, 0.3]), (2.0, 1.5, 3.0, 1.2, 1.8, 2.5)  # to -x, +x, -y, ... in the map's frame
ROTATION = Rotation.from_euler("xyz", [80, 20, -30], degrees=True).as_matrix()
COLORS = np.array([[3, 1, 1], [1, 3, 1], [1, 1, 3], [3, 3, 0.5], [0.5, 3, 3], [3, 0.5, 3]], np.float32)


def room(distances=DISTANCES):
    return Room.of([*CENTER, *distances])


def met(q, d, distances=DISTANCES):
    """(point, wall) where a ray from ``q`` along ``d`` meets the walls, in the map's frame and relative to the center: a slow
    twin, by trying all walls."""
    hits = []
    for wall, distance in enumerate(distances):
        axis, sign = wall // 2, 2 * (wall % 2) - 1
        if sign * d[axis] > 0:
            hits.append(((distance - sign * q[axis]) / (sign * d[axis]), wall))
    t, wall = min(hits)
    return q + t * d, wall


def unit(rng, n):
    d = rng.normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def arrays(n=200, seed=0):
    rng = np.random.default_rng(seed)
    return unit(rng, n), rng.uniform(-0.8, 0.8, (n, 3))


def vector(values):
    return mi.Vector3f(np.ascontiguousarray(np.asarray(values, np.float32).T))


def painted(rows=512, distances=DISTANCES):
    """The environment of walls of one radiance each, as the center sees them."""
    theta, phi = np.meshgrid(np.pi * np.arange(rows) / (rows - 1), np.pi * (np.arange(2 * rows) + 0.5) / rows, indexing="ij")
    d = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], -1)
    inverse = np.stack([np.maximum((2 * (w % 2) - 1) * d[..., w // 2], 0) / distances[w] for w in range(6)], -1)
    return Environment(mi.TensorXf(COLORS[inverse.argmax(-1)]), ROTATION, room=room(distances))


def test_directions_are_those_of_a_slow_twin():
    d, q = arrays()
    seen, farther, _ = room().seen(vector(d), vector(q))
    points = np.array([met(*pair)[0] for pair in zip(q, d)])
    expected = points / np.linalg.norm(points, axis=1, keepdims=True)
    assert np.abs(seen.numpy().T - expected).max() < 1e-5
    ratio = np.linalg.norm(points, axis=1) / np.linalg.norm(points - q, axis=1)
    assert np.allclose(farther.numpy(), ratio, rtol=1e-4)
    back = room().seen_from(seen, vector(q)).numpy().T
    assert np.abs(back - d).max() < 1e-4


def test_density_is_that_of_differences():
    d, q = arrays()
    density = room().seen(vector(d), vector(q))[2].numpy()
    h, areas = 1e-4, []
    for direction, point in zip(d, q):
        side = np.linalg.svd(direction[None])[2][1:]
        image = lambda w: (lambda p: p / np.linalg.norm(p))(met(point, w / np.linalg.norm(w))[0])
        du, dv = ((image(direction + h * s) - image(direction - h * s)) / (2 * h) for s in side)
        areas.append(np.linalg.norm(np.cross(du, dv)))
    assert np.median(np.abs(density / areas - 1)) < 1e-5
    assert np.mean(np.abs(density / areas - 1) < 1e-3) > 0.97  # others see an edge


def test_no_walls_are_light_at_infinity():
    d, q = arrays()
    far = Room.of([*CENTER, *[float("inf")] * 6])
    seen, farther, density = far.seen(vector(d), vector(q))
    assert np.abs(seen.numpy().T - d).max() < 1e-6
    assert np.allclose(farther.numpy(), 1, atol=1e-6) and np.allclose(density.numpy(), 1, atol=1e-5)


def test_derivatives_are_those_of_differences():
    d, q = arrays(60)
    weight = vector(np.random.default_rng(3).normal(size=(60, 3)))

    def loss(nearness, point):
        seen, farther, density = replace(room(), nearness=nearness).seen(vector(d), point)
        return dr.sum(dr.dot(seen, weight) + 0.3 * farther + 0.1 * density)

    nearness, point = room().nearness, vector(q)
    dr.enable_grad(nearness, point)
    dr.backward(loss(nearness, point))
    h, at = 1e-3, lambda k, s: mi.Float(room().nearness.numpy() + s * np.eye(6, dtype=np.float32)[k])
    for k in range(6):
        numeric = float((loss(at(k, h), vector(q)) - loss(at(k, -h), vector(q)))[0]) / (2 * h)
        assert float(dr.grad(nearness)[k]) == pytest.approx(numeric, rel=0.02, abs=0.02)
    gradient = dr.grad(point).numpy().sum(1)
    for k in range(3):
        numeric = float((loss(at(0, 0), vector(q + h * np.eye(3)[k])) - loss(at(0, 0), vector(q - h * np.eye(3)[k])))[0])
        assert gradient[k] == pytest.approx(numeric / (2 * h), rel=0.02, abs=0.05)


def walls():
    """The room as Mitsuba's rectangles that shine inwards."""
    shapes = {}
    for wall in range(6):
        axis, sign = wall // 2, 2 * (wall % 2) - 1
        n = np.eye(3)[axis] * -sign
        u = np.roll(np.eye(3)[axis], 1)
        frame = np.eye(4)
        frame[:3, :3] = ROTATION @ (np.stack([u, np.cross(n, u), n], 1) * [6, 6, 1])
        frame[:3, 3] = CENTER + ROTATION @ (-n * DISTANCES[wall])
        radiance = {"type": "rgb", "value": COLORS[wall].tolist()}
        shapes[f"wall{wall}"] = {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f(frame),
            "emitter": {"type": "area", "radiance": radiance},
        }
    return shapes


def test_what_a_surface_reflects_is_what_the_path_tracer_sees():
    """Spheres of several materials in a room whose walls shine: by statistics, with Monte Carlo; the split sum is near."""
    color, count = [0.9, 0.6, 0.3], 1 << 15
    environment = painted()
    for roughness, metallic in ((0.1, 1.0), (0.4, 0.0), (0.6, 1.0)):
        bsdf = {
            "type": "principled",
            "roughness": roughness,
            "metallic": metallic,
            "eta": 1.5,
            "base_color": {"type": "rgb", "value": color},
        }
        ball = {"type": "sphere", "center": (0.5, -0.4, 0.2), "radius": 0.3, "bsdf": bsdf}
        scene = mi.load_dict({"type": "scene", "ball": ball, **walls()})
        path = mi.load_dict({"type": "path", "max_depth": 2})
        target = np.array([0.5, -0.4, 0.2])
        for toward in unit(np.random.default_rng(7), 4):
            origin = target + 0.6 * toward + 0.1
            ray = mi.Ray3f(mi.Point3f(*map(float, origin)), dr.normalize(mi.Vector3f(*map(float, target - origin + 0.12))))
            si = scene.ray_intersect(ray)
            assert si.is_valid()[0] and si.t[0] < 1
            sampler = mi.load_dict({"type": "independent"})
            sampler.seed(0, count)
            many = mi.RayDifferential3f(dr.gather(type(ray.o), ray.o, dr.zeros(mi.UInt32, count)), ray.d)
            seen = path.sample(scene, sampler, many)[0].numpy()
            surface = Surface(si.n, -ray.d, mi.Float(roughness), mi.Float(metallic), mi.Color3f(*color), mi.Point3f(si.p))
            estimate = lambda e: (e.specular(surface) + e.diffuse(surface)).numpy()[:, 0]
            mine = np.array(
                [
                    estimate(MonteCarlo(environment.unfiltered(), environment.emitter(), 1.5, 1024, mi.UInt32(s)))
                    for s in range(16)
                ]
            )
            error = np.hypot(seen.std(1) / np.sqrt(count), mine.std(0) / 4)
            assert np.all(np.abs(mine.mean(0) - seen.mean(1)) < 4 * error + 0.004 * seen.mean(1))
            near = estimate(SplitSum(environment.filtered()))
            assert np.all(np.abs(near - seen.mean(1)) < 0.15 * seen.mean(1) + 0.03)


@pytest.mark.parametrize("diffuse", ["radiance", "lit"])
@pytest.mark.parametrize("specular", ["split_sum", "monte_carlo"])
def test_walls_far_away_are_light_at_infinity(specular, diffuse):
    surfels, light, camera = sphere_surfels(200, scale=0.9, opacity_shift=3), painted(32), orbit_camera()
    shading = Shading(specular=specular, diffuse=diffuse, indirect="one_bounce", samples=4)
    infinite = colors(surfels, camera, shading, replace(light, room=None))
    far = colors(surfels, camera, shading, replace(light, room=room([1e5] * 6)))
    near = colors(surfels, camera, shading, light)
    assert np.mean(np.abs(far - infinite) > 1e-2) < 2e-3  # a sample may fall to the other side of something
    assert np.abs(near - infinite).mean() > 20 * np.abs(far - infinite).mean()


def test_what_reflected_rays_meet_stands_in_the_room_too():
    surfels, light = sphere_surfels(300, scale=0.9, opacity_shift=3), painted(64)
    index, uv = mi.UInt32([3, 50, 120, 260]), mi.Point2f([0.3, 0, -0.5, 0.2], [0, 0.4, 0.1, -0.6])
    direction = vector(-surfels.numpy()["centers"][index.numpy()])
    lighting = lighting_of(Shading(indirect="one_bounce"), surfels, light.filtered())
    assert isinstance(lighting.indirect, Indirect)
    found = lighting.indirect._radiance(index, uv, direction, lighting)
    hit = surfels.take(index)
    t_u, t_v, _ = (v.numpy().T for v in hit.frames())
    scales = surfels.numpy()["scales"][index.numpy()] * uv.numpy().T
    point = surfels.numpy()["centers"][index.numpy()] + scales[:, :1] * t_u + scales[:, 1:] * t_v
    normal = hit.normals(uv)
    surface = Surface(
        dr.mulsign(normal, -dr.dot(direction, normal)),
        -direction,
        hit.column(mi.Float, "roughness"),
        hit.column(mi.Float, "metallic"),
        hit.column(mi.Color3f, "base_color"),
        mi.Point3f(vector(point)),
    )
    expected = hit.radiance(direction) + SplitSum(light.filtered()).specular(surface)
    assert np.allclose(found.numpy(), expected.numpy(), atol=1e-4)


def test_a_room_goes_round_with_the_camera():
    """On a turntable it is the room that turns, about an axis through its center."""
    axis = np.array([0.1, -0.2, 0.97]) / np.linalg.norm([0.1, -0.2, 0.97])
    table = Turntable(tuple(axis), tuple(CENTER))
    surfels, light, camera = sphere_surfels(200, scale=0.9, opacity_shift=3), painted(32), orbit_camera(2.0)
    turn = Rotation.from_matrix(np.array(table.to_lamps(camera)).reshape(3, 3)).inv().as_matrix()
    turned = replace(light, rotation=turn @ ROTATION)
    shading = Shading(indirect="one_bounce")
    expected = colors(surfels, camera, shading, turned)
    found = colors(surfels, camera, replace(shading, turntable=table), light)
    assert np.mean(np.abs(found - expected) > 1e-2) < 2e-3
    assert np.abs(colors(surfels, camera, shading, light) - expected).mean() > 20 * np.abs(found - expected).mean()


def test_learned_with_the_surfels():
    """Walls come to where they were, seen in a mirror."""
    surfels = sphere_surfels(400, scale=0.9, opacity_shift=3)
    fields = surfels.numpy()
    fields |= {"metallic": np.ones_like(fields["metallic"]), "roughness": np.full_like(fields["roughness"], 0.15)}
    surfels = type(surfels).from_numpy({**fields, "sh": np.zeros_like(fields["sh"]) - 10})
    cameras = [orbit_camera(a) for a in np.linspace(0, 6, 8)]
    light = painted(64)
    truth = [mi.Color3f(colors(surfels, c, Shading(), light)) for c in cameras]
    optimizer = mi.ad.Adam(lr=0.05)
    optimizer["log_nearness"] = mi.Float(np.log([1 / 4.0] * 6))
    for step in range(120):
        nearness = dr.exp(optimizer["log_nearness"])
        near = replace(light, room=replace(room(), nearness=nearness))
        k = step % len(cameras)
        color = deferred.render(surfels, cameras[k], lighting_of(Shading(), surfels, near.filtered())).color
        dr.backward(dr.mean(dr.sum(dr.square(color - truth[k]))))
        optimizer.step()
    found = np.exp(-optimizer["log_nearness"].numpy())
    assert np.abs(found / DISTANCES - 1).max() < 0.1


@pytest.mark.parametrize(
    "text", ["0 0 1", "0 0 0 1 1 1 1 1 0", "0 0 0 1 1 1 1 1 -1", "0 0 nan 1 1 1 1 1 1", "a b c d e f g h i"]
)
def test_numbers_that_make_no_room(text):
    with pytest.raises(ValueError):
        Room.of(text.split())


def test_written_and_read():
    written = room([2.0, 1.5, float("inf"), 1.2, 1.8, 2.5])
    read = Room.of(str(written).split())
    assert read.center == written.center and np.allclose(read.distances, written.distances, rtol=1e-6)


def test_scene_files_say_so():
    far = tuple(3 * d for d in DISTANCES)  # walls around the sensor, too
    surfels, light, camera = sphere_surfels(100, scale=0.9), painted(256, far), orbit_camera(3.2, distance=6)
    placed = mi.ScalarTransform4f(np.block([[light.rotation, np.zeros((3, 1))], [0, 0, 0, 1]]))
    scene = mi.load_dict(
        {
            "type": "scene",
            "shape": shape(surfels),
            "sensor": camera.to_sensor_dict(),
            "emitter": {"type": "envmap", "bitmap": mi.Bitmap(light.texels.numpy()), "to_world": placed},
            "integrator": {"type": "rgs_deferred", "hide_emitters": True, "room": str(light.room)},
        }
    )
    found = np.array(mi.render(scene, spp=1))
    expected = colors(surfels, camera, Shading(), light).T.reshape(found.shape)
    assert np.abs(found - expected).max() < 2e-3
    # behind the surfels are the walls, as they are seen from where the sensor stands
    scene.integrator().hide_emitters = False
    behind, empty = np.array(mi.render(scene, spp=1)), (found == 0).all(axis=-1)
    rays = (camera.rays() / np.linalg.norm(camera.rays(), axis=-1, keepdims=True))[empty] @ ROTATION
    place = (camera.origin - CENTER) @ ROTATION
    walls_met = COLORS[[met(place, ray, far)[1] for ray in rays]]
    assert empty.sum() > 200 and np.mean(np.abs(behind[empty] - walls_met).max(1) < 0.02) > 0.85  # but for blurred edges

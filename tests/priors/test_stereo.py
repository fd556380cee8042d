"""What photographs agree on, and look through: a tray with a floor, and things that must stay; kernels against loops."""

import functools
import tracemalloc

import mitsuba as mi
import numpy as np
import pytest
from scipy import ndimage

from rgs_mi.core.camera import Camera
from rgs_mi.core.color import srgb_decode
from rgs_mi.datasets.types import Dataset, View
from rgs_mi.priors import hull, initialization, sampling, stereo
from rgs_mi.priors.initialization import initial_points
from rgs_mi.priors.openings import openings, seen_through
from rgs_mi.priors.sampling import thinned
from rgs_mi.priors.surface_points import oriented_points, smoothed

SIZE, VIEWS = 128, 48
RIM, FLOOR, HALF, INNER = 0.25, -0.1, 0.5, 0.42  # of the tray: heights, half widths outside and inside


def texture(contrast, seed=0, side=64, blotch=3):
    """Blotches, some pixels wide in the photographs: Gaussian noise of ``side`` texels."""
    noise = np.random.default_rng(seed).normal(size=(side, side, 1))
    noise = ndimage.gaussian_filter(noise, (blotch, blotch, 0), mode="wrap")
    return mi.Bitmap(np.float32(np.clip(0.5 + contrast * noise / noise.std(), 0, 1)).repeat(3, 2))


def panel(center, u, v, *of):
    """A rectangle that shines with a `texture` of what is given, to the side of u × v."""
    matrix = np.eye(4)
    matrix[:3] = np.stack([u, v, np.cross(u, v) / np.linalg.norm(np.cross(u, v)), center], 1)
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f(matrix.tolist()),
        "bsdf": {"type": "diffuse", "reflectance": 0.0},
        "emitter": {"type": "area", "radiance": {"type": "bitmap", "bitmap": texture(*of), "raw": True}},
    }


def tray(contrast):
    """A box that is open above, with a floor at half its height."""
    shapes = {
        "floor": panel([0, 0, FLOOR], [INNER, 0, 0], [0, INNER, 0], contrast, 1),
        "below": panel([0, 0, -RIM], [0, HALF, 0], [HALF, 0, 0], contrast, 2),
    }
    up, middle, wall = np.array([0, 0, 1.0]), (INNER + HALF) / 2, (HALF - INNER) / 2
    height, depth = (RIM + FLOOR) / 2 * up, (RIM - FLOOR) / 2 * up
    for k, (x, y) in enumerate([(1, 0), (-1, 0), (0, 1), (0, -1)]):
        out, side = np.array([x, y, 0.0]), np.array([-y, x, 0.0])
        shapes |= {
            f"outer{k}": panel(HALF * out, HALF * side, RIM * up, contrast, 10 + k),
            f"inner{k}": panel(INNER * out + height, depth, INNER * side, contrast, 20 + k),
            f"rim{k}": panel(middle * out + RIM * up, wall * out, HALF * side, contrast, 30 + k),
        }
    return shapes


@functools.cache
def textured_tray():
    return photographs(tray(0.25))


def above(distance):
    """Cameras on the upper half of a Fibonacci sphere."""
    k = np.arange(VIEWS) + 0.5
    z, angle = 1 - k / VIEWS, np.pi * (1 + 5**0.5) * k
    away = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], 1)
    return [Camera.look_at(distance * a, (0, 0, 0), (0, 0, 1), 40, (SIZE, SIZE)) for a in away]


def photographs(shapes, cameras=None):
    """`View` objects of Mitsuba ``shapes``, without light that is reflected twice; None: from `above`."""
    integrator = {"type": "path", "max_depth": 2, "hide_emitters": "light" in shapes}
    scene = mi.load_dict({"type": "scene", "integrator": integrator, **shapes})
    views = []
    for i, camera in enumerate(cameras or above(2.2)):
        sensor = camera.to_sensor_dict()
        sensor["film"] |= {"pixel_format": "rgba"}
        image = np.array(mi.render(scene, sensor=mi.load_dict(sensor), spp=16, seed=i))
        color = np.clip(image[..., :3] / np.maximum(image[..., 3:], 1e-6), 0, 1)
        views.append(
            View(
                str(i),
                camera,
                np.uint8(255 * np.concatenate([color, image[..., 3:].clip(0, 1)], -1) + 0.5),
                True,
                None,
                None,
            )
        )
    return views


def unmasked(views, noise=0.0):
    """``views`` without their masks, and with ``noise`` of this standard deviation, in grey levels."""
    rng, opaque = np.random.default_rng(0), np.uint8([0, 0, 0, 255])
    noisy = lambda pixels: np.uint8(np.clip(pixels + rng.normal(size=pixels.shape) * noise, 0, 255) + 0.5)
    return [View(v.name, v.camera, noisy(v.pixels) | opaque, False, None, None) for v in views]


def in_cavity(x, y, z):
    return (abs(x) < INNER - 0.04) & (abs(y) < INNER - 0.04) & (z > FLOOR + 0.04) & (z < RIM + 0.04)


def on_floor(x, y, z):
    return (abs(x) < INNER - 0.04) & (abs(y) < INNER - 0.04) & (abs(z - FLOOR) < 0.03)


def starts(views):
    """Positions and normals of the first points on the hull, and those where photographs were compared."""
    return [initial_points(Dataset(views, []), 4000, compare=compare)[:2] for compare in (False, True)]


@pytest.mark.parametrize("compared", [40, 120])
def test_a_tray_gets_its_inside(monkeypatch, compared):
    """Also where not all of the photographs are compared."""
    monkeypatch.setattr(initialization, "_COMPARED", compared)
    (lid, _), (points, normals) = starts(textured_tray())
    assert in_cavity(*lid.T).mean() > 0.1
    assert in_cavity(*points.T).mean() < 0.02
    floor = on_floor(*points.T)
    assert floor.mean() > 0.05 and np.median(normals[floor, 2]) > 0.95
    outside = lambda p: (p[:, 2] < FLOOR).sum()
    assert outside(points) > 0.97 * outside(lid)


def test_no_more_photographs_are_compared_than_needed(monkeypatch):
    """But those that are lie evenly among all."""
    monkeypatch.setattr(initialization, "_COMPARED", 5)
    asked = []
    monkeypatch.setattr(stereo, "depth_maps", lambda views, *_, **__: asked.append(views) or [])
    monkeypatch.setattr(stereo, "verified", lambda maps: maps)
    monkeypatch.setattr(initialization, "oriented_points", lambda *_: (np.zeros((0, 3)), None))
    views = unmasked(textured_tray())
    initial_points(Dataset(views, []), 10)
    (chosen,) = asked
    assert [k for k, view in enumerate(views) if any(view is c for c in chosen)] == [0, 12, 24, 35, 47]


def test_without_masks_points_lie_on_surfaces_too():
    maps = stereo.depth_maps(unmasked(textured_tray()))
    points, normals = oriented_points(stereo.verified(maps), 3000, np.random.default_rng(0))
    assert len(points) > 1000
    x, y, z = points.T
    walls = [abs(abs(c) - w) < 0.04 for c in (x, y) for w in (INNER, HALF)]
    on_surface = np.any([*walls, abs(z - FLOOR) < 0.04, abs(z - RIM) < 0.04, abs(z + RIM) < 0.04], 0)
    assert on_surface.mean() > 0.9
    assert np.median(normals[on_floor(x, y, z), 2]) > 0.9


@pytest.mark.parametrize("compared", [40, 120])
def test_without_masks_walls_do_not_colour_what_they_hide(monkeypatch, compared):
    monkeypatch.setattr(initialization, "_COMPARED", compared)
    points, _, _, (colors, *_) = initial_points(Dataset(unmasked(textured_tray()), []), 4500)
    floor = on_floor(*points.T)
    alone = photographs({"floor": tray(0.25)["floor"]})[0]
    column, row = alone.camera.project(points[floor])[0].astype(int).T
    truth = srgb_decode(alone.pixels[row, column, 0] / 255)
    assert floor.sum() > 200 and np.corrcoef(colors[floor, 0], truth)[0, 1] > 0.9
    assert np.abs(colors[floor, 0] - truth).mean() < 0.2 * truth.std()


def test_without_masks_faint_texture_has_depth_finer_than_levels():
    """A papered wall in noisy photographs, from directions so far apart that what is alike lies between two levels."""
    border, cameras = 20, []
    for k, angle in enumerate(np.linspace(0, 2 * np.pi, 10, endpoint=False)):
        beside = (0.7, 1.0)[k % 2] * np.array([np.cos(angle), np.sin(angle)])
        cameras.append(Camera.look_at((*beside, 2.2), (0, 0, 0), (0, 1, 0), 40, (2 * SIZE, 2 * SIZE)))
    wall = {"wall": panel([0, 0, 0], [2, 0, 0], [0, 2, 0], 0.05, 0, 512, 1)}
    views = unmasked(photographs(wall, cameras), noise=2.5)
    known, errors = [], []
    for m in stereo.verified(stereo.depth_maps(views)):
        part = np.s_[border:-border, border:-border]
        truth = -m.camera.origin[2] / m.camera.rays()[..., 2]
        levels = (np.abs(m.depth - truth) / (m.tolerance / stereo.SAME))[part]
        known.append((m.likeness[part] > 0.3) & (levels < 1))
        errors.append(levels[known[-1]])
    assert np.mean(known) > 0.85  # 0.61 where windows have 5 x 5 pixels
    assert np.median(np.concatenate(errors)) < 0.08  # 0.13 where there is nothing between levels


def test_without_texture_nothing_changes():
    (hull_points, _), (points, _) = starts(photographs(tray(0.0)))
    assert len(points) == pytest.approx(len(hull_points), rel=0.05)
    assert in_cavity(*points.T).sum() == pytest.approx(in_cavity(*hull_points.T).sum(), rel=0.1)


def test_a_mirror_stays():
    """What it shows looks as if it lay below the surface, elsewhere for other views."""
    noise = ndimage.gaussian_filter(np.random.default_rng(5).normal(size=(64, 128, 1)), (2, 2, 0), mode="wrap")
    noise = np.float32(np.clip(0.5 + 0.25 * noise / noise.std(), 0, 1)).repeat(3, 2)
    light = {"type": "envmap", "bitmap": mi.Bitmap(noise)}
    ball = {"type": "sphere", "radius": 0.5, "bsdf": {"type": "conductor", "material": "none"}}
    (on_hull, _), (points, _) = starts(photographs({"light": light, "ball": ball}))
    assert len(points) > 0.99 * len(on_hull)
    assert (np.linalg.norm(points, axis=1) < 0.45).mean() < 0.01


def test_a_sweep_is_what_loops_say():
    """Every score of a few pixels, window by window, in NumPy."""
    every = textured_tray()
    small = [stereo.SmallImage.of(view) for view in every[:5]]
    mesh = hull.surface(hull.visual_hull(every, 48))
    depths = hull.depth_maps(*mesh[:2], [s.camera for s in small])
    levels, margin = [-0.02, 0.05, 0.2], 0.03
    filled = np.nan_to_num(depths[0], nan=1.0)
    others = [(s.camera, s.normalized(), d) for s, d in zip(small[1:], depths[1:])]
    mine = stereo.sweep(small[0].camera, small[0].normalized(), [filled + below for below in levels], others, margin)
    rng = np.random.default_rng(0)
    inner = np.argwhere(ndimage.binary_erosion(np.isfinite(depths[0]), iterations=4))
    for row, column in inner[rng.permutation(len(inner))[:25]]:
        for k, below in enumerate(levels):
            scores = [likeness(small[0], filled + below, *other, row, column, margin) for other in others]
            assert mine[k, row, column] == pytest.approx(np.mean(sorted(scores)[-3:]), abs=2e-3)


def likeness(here, depth, camera, image, surface, row, column, margin):
    """Of the 5 × 5 pixels around one of ``here``, at ``depth``, and what another view shows there."""
    rows, columns = np.mgrid[row - 2 : row + 3, column - 2 : column + 3]
    points = here.camera.origin + here.camera.rays()[rows, columns].reshape(-1, 3) * depth[rows, columns].reshape(-1, 1)
    pixel, z = camera.project(points)
    pixel = pixel - 0.5
    at = np.floor(pixel).astype(int)
    inside = (pixel >= 0).all(1) & (pixel < np.array(camera.size) - 1).all(1)
    there = np.where(np.isfinite(surface), surface, np.inf)[tuple(np.clip(at, 0, SIZE - 1).T[::-1])]
    allowed = inside & (z > there - margin)
    if not allowed[12]:
        return -1.0
    seen = ndimage.map_coordinates(image, pixel.T[::-1], order=1)
    return np.where(allowed, here.normalized()[rows, columns].ravel() * seen, -1).mean()


def depth_map(rng, camera):
    depth = rng.uniform(1.5, 3, camera.size[::-1]).astype(np.float32)
    depth[rng.random(depth.shape) < 0.1] = np.nan
    return stereo.DepthMap(
        camera, depth, rng.uniform(0, 1, depth.shape).astype(np.float32), np.full(depth.shape, 0.3, np.float32)
    )


def test_agreement_is_what_loops_say():
    rng = np.random.default_rng(3)
    maps = [depth_map(rng, camera) for camera in above(2.2)[:6]]
    points = rng.uniform(-0.6, 0.6, (40, 3)).astype(np.float32)
    count, same, through = stereo.agreement(points, maps)
    for k, point in enumerate(points):
        expected = np.zeros(3)
        for m in maps:
            (pixel,), (z,) = m.camera.project(point[None])
            column, row = np.floor(pixel).astype(int)
            if not (0 <= column < SIZE and 0 <= row < SIZE) or np.isnan(m.depth[row, column]):
                continue
            farther, weight = m.depth[row, column] - z, m.likeness[row, column]
            meets = abs(farther) <= 0.3
            expected += [meets, weight * meets, weight * (farther > 0.3)]
        assert [count[k], same[k], through[k]] == pytest.approx(expected, abs=1e-5)


def flat_map(camera, depth, likeness=1.0, gain=1.0):
    """A wall at ``depth`` below a hull at 2."""
    return stereo.DepthMap(camera, *(np.full((SIZE, SIZE), v, np.float32) for v in (depth, likeness, 0.075, 2.0, gain)))


def test_seen_through_asks_for_several_and_heeds_who_sees_a_surface():
    camera, center = above(2.2)[0], np.zeros((1, 3))
    far, near = flat_map(camera, 3.0), flat_map(camera, 2.2)
    assert not seen_through(center, [far] * 2, [])[0]
    assert seen_through(center, [far] * 3, [])[0]
    assert not seen_through(center, [far] * 3, [near])[0]
    assert seen_through(center, [far] * 3, [near, far])[0]


def test_openings_are_where_views_agree_on_what_is_more_alike_than_the_hull():
    """Views of one place find a wall below their hull; not where the hull is as alike, where they differ, or at the hull."""
    camera = above(2.2)[0]
    cameras = [
        Camera.look_at(camera.origin + 0.03 * np.eye(3)[k % 3] * (k - 3), (0, 0, 0), (0, 0, 1), 40, (SIZE, SIZE))
        for k in range(8)
    ]
    opened = lambda depths, gain: np.mean(
        [m.likeness.mean() for m in openings([flat_map(c, d, gain=gain) for c, d in zip(cameras, depths)])]
    )
    assert opened([2.5] * 8, 0.2) > 0.5
    assert opened([2.5] * 8, 0.05) == 0
    assert opened([2.3 + 0.2 * k for k in range(8)], 0.2) == 0
    assert opened([2.1] * 8, 0.2) == 0


@pytest.mark.parametrize("chunk", [300, 10_000])
def test_thinned_points_keep_their_distance_and_leave_no_gap(monkeypatch, chunk):
    monkeypatch.setattr(sampling, "_CHUNK", chunk)
    rng = np.random.default_rng(0)
    points, radius = rng.random((2000, 3)), rng.uniform(0.05, 0.15, 2000)
    kept = thinned(points, radius)
    distance = np.linalg.norm(points[:, None] - points[kept], axis=-1)
    least = np.minimum(radius[:, None], radius[kept])
    own = np.arange(len(points))[:, None] == kept
    assert (distance < least)[kept][~own[kept]].sum() == 0
    assert (distance < least).any(1).all()


def test_thinning_holds_few_neighbours_at_a_time(monkeypatch):
    points, peak = np.random.default_rng(0).random((20_000, 3)), {}
    for chunk in (1000, 20_000):
        monkeypatch.setattr(sampling, "_CHUNK", chunk)
        tracemalloc.start()
        thinned(points, np.full(20_000, 0.08))
        peak[chunk] = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak[1000] < 0.6 * peak[20_000]


def test_smoothing_takes_noise_out_and_leaves_an_edge():
    rng = np.random.default_rng(0)
    flat = np.c_[rng.random((3000, 2)), 0.003 * rng.normal(size=3000)].astype(np.float32)
    normals = np.float32([0, 0, 1]) + 0.2 * rng.normal(size=(3000, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    side = np.float32([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # a quarter turn about y
    points, turned = smoothed(np.r_[flat, flat @ side.T], np.r_[normals, normals @ side.T])
    assert abs(points[:3000, 2]).mean() < 0.5 * abs(flat[:, 2]).mean()
    inner = flat[:, 0] > 0.1
    assert np.degrees(np.arccos(turned[:3000][inner, 2])).mean() < 5

"""Carving the visual hull by what photographs look through: a tray with a floor, and things that must stay."""

import functools

import mitsuba as mi
import numpy as np
import pytest
from scipy import ndimage

from rgs_mi.core.camera import Camera
from rgs_mi.datasets.types import View
from rgs_mi.priors import hull, stereo

SIZE, VIEWS = 128, 48
RIM, FLOOR, HALF, INNER = 0.25, -0.1, 0.5, 0.42  # of the tray: heights, half widths outside and inside


def texture(contrast, seed=0):
    """Blotches, some pixels wide in the photographs."""
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=(64, 64, 1)), (3, 3, 0), mode="wrap")
    return mi.Bitmap(np.float32(np.clip(0.5 + contrast * noise / noise.std(), 0, 1)).repeat(3, 2))


def panel(center, u, v, contrast, seed):
    """A rectangle that shines with a `texture`, to the side of u × v."""
    matrix = np.eye(4)
    matrix[:3] = np.stack([u, v, np.cross(u, v) / np.linalg.norm(np.cross(u, v)), center], 1)
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f(matrix.tolist()),
        "bsdf": {"type": "diffuse", "reflectance": 0.0},
        "emitter": {"type": "area", "radiance": {"type": "bitmap", "bitmap": texture(contrast, seed), "raw": True}},
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


def photographs(shapes, distance=2.2):
    """`View` objects of Mitsuba ``shapes``, without light that is reflected twice."""
    integrator = {"type": "path", "max_depth": 2, "hide_emitters": "light" in shapes}
    scene = mi.load_dict({"type": "scene", "integrator": integrator, **shapes})
    views = []
    for i, camera in enumerate(above(distance)):
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


def kept(views, *regions):
    """A pair (before, after) for each of ``regions``, functions of x, y, z: the part of its nodes that hull and carved hull
    fill."""
    parts = []
    for field in (hull.visual_hull(views, 64), stereo.carved_hull(views, 64)):
        x, y, z = np.indices(field.values.shape) * field.step + field.lower[:, None, None, None]
        parts.append([(field.values[inside(x, y, z)] > 0).mean() for inside in regions])
    return list(zip(*parts))


def cavity(x, y, z):
    return (abs(x) < INNER - 0.07) & (abs(y) < INNER - 0.07) & (z > FLOOR + 0.06) & (z < RIM - 0.05)


def body(x, y, z):
    return (abs(x) < HALF - 0.04) & (abs(y) < HALF - 0.04) & (z < FLOOR - 0.05) & (z > -RIM + 0.04)


def test_a_tray_gets_its_inside():
    (before, after), (_, left) = kept(textured_tray(), cavity, body)
    assert before > 0.95 and after < 0.2
    assert left > 0.97


def test_without_texture_nothing_is_carved():
    ((before, after),) = kept(photographs(tray(0.0)), cavity)
    assert after == before


def test_a_mirror_stays():
    """What it shows looks as if it lay below the surface, elsewhere for other views."""
    noise = ndimage.gaussian_filter(np.random.default_rng(5).normal(size=(64, 128, 1)), (2, 2, 0), mode="wrap")
    noise = np.float32(np.clip(0.5 + 0.25 * noise / noise.std(), 0, 1)).repeat(3, 2)
    light = {"type": "envmap", "bitmap": mi.Bitmap(noise)}
    ball = {"type": "sphere", "radius": 0.5, "bsdf": {"type": "conductor", "material": "none"}}
    views = photographs({"light": light, "ball": ball})
    ((_, left),) = kept(views, lambda x, y, z: x**2 + y**2 + z**2 < 0.45**2)
    assert left > 0.99


def test_what_is_cut_off_a_fine_hull_is_what_the_rough_one_lost():
    """A ball on a grid, a half-space on a coarser one that does not share its nodes: their intersection."""

    def grid(lower, step, count, value):
        x, y, z = lower + step * np.indices((count,) * 3)
        return hull.SignedField(value(x, y, z).astype(np.float32), np.full(3, lower), step)

    ball = grid(-0.6, 0.02, 61, lambda x, y, z: 0.5 - np.sqrt(x**2 + y**2 + z**2))
    below = grid(-0.73, 0.05, 30, lambda x, y, z: 0.1 - z)
    least = stereo._least(ball, below)
    z = ball.lower[2] + ball.step * np.arange(61)
    np.testing.assert_allclose(least.values, np.minimum(ball.values, 0.1 - z), atol=1e-6)
    np.testing.assert_array_equal(least.lower, ball.lower)


def test_views_that_agree_by_chance_do_not_count():
    """A tenth of the points of one heap, and all of another's: only the latter's surroundings agree with them."""
    rng, step = np.random.default_rng(0), 0.01
    heaps = np.array([0, 1]).repeat(2000)
    points = rng.normal(size=(4000, 3)) * 5 * step + 80 * step * heaps[:, None]
    agreed = np.where(heaps | (rng.random(4000) < 0.1), 0.8, 0.1)
    around = stereo._mean_around(points, agreed, step)
    assert around[heaps == 0].max() < stereo._AROUND < around[heaps == 1].min()
    near = np.exp(-0.5 * ((points[:50, None] - points) ** 2).sum(-1) / (stereo._SURROUNDINGS * step) ** 2)
    assert around[:50] == pytest.approx((near * agreed).sum(1) / near.sum(1), abs=0.02)


def test_photo_consistency_is_what_loops_say():
    """Every correlation of a few pixels, window by window, in NumPy."""
    every = textured_tray()
    views = every[:5]
    small = [stereo.SmallImage.of(view) for view in views]
    mesh = hull.surface(hull.visual_hull(every, 48))
    depths = hull.depth_maps(*mesh[:2], [s.camera for s in small])
    level, margin = np.array([-0.02, 0.05, 0.2]), 0.03
    mine = stereo.photo_consistency(small[0], depths[0], level, list(zip(small[1:], depths[1:])), margin)
    rng = np.random.default_rng(0)
    inner = np.argwhere(ndimage.binary_erosion(np.isfinite(depths[0]), iterations=4))
    for row, column in inner[rng.permutation(len(inner))[:25]]:
        for k, below in enumerate(level):
            scores = [
                correlation(small[0], depths[0] + below, *pair, row, column, margin) for pair in zip(small[1:], depths[1:])
            ]
            assert mine[k, row, column] == pytest.approx(np.mean(sorted(scores)[-3:]), abs=2e-3)


def correlation(here, depth, other, surface, row, column, margin):
    """Of the 5 × 5 pixels around one of ``here``, at ``depth``, and what ``other`` shows there."""
    rows, columns = np.mgrid[row - 2 : row + 3, column - 2 : column + 3]
    points = here.camera.origin + here.camera.rays()[rows, columns].reshape(-1, 3) * depth[rows, columns].reshape(-1, 1)
    pixel, z = other.camera.project(points)
    pixel = pixel - 0.5
    at = np.floor(pixel).astype(int)
    inside = (pixel >= 0).all(1) & (pixel < np.array(other.camera.size) - 1).all(1)
    there = np.where(np.isfinite(surface), surface, np.inf)[tuple(np.clip(at, 0, SIZE - 1).T[::-1])]
    allowed = inside & (z > there - margin)
    if not allowed[12]:
        return -1.0
    seen = ndimage.map_coordinates(other.grey, pixel.T[::-1], order=1)
    a, b = here.grey[rows, columns].ravel(), np.where(allowed, seen, 1)
    cross = ((a - a.mean()) * (b - b.mean())).mean()
    return cross / np.sqrt(max(a.var(), 1e-4) * max(b.var(), 1e-4))

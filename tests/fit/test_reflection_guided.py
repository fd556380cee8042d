"""Reflection-guided densification: masks, boxes, and the meeting of pyramids against its literal construction."""

import itertools

import numpy as np
import pytest

from rgs_mi.core.camera import Camera
from rgs_mi.fit import reflection_guided

from scenes import orbit_camera

# ---- Masks and boxes ----


def test_reflective_is_the_smoothest_part_of_the_foreground():
    rng = np.random.default_rng(0)
    roughness, alpha = rng.permutation(400).reshape(20, 20) / 400, np.ones((20, 20))
    alpha[:, :10] = 0.5  # half covered is not foreground
    roughness[:, :10] /= 100
    mask = reflection_guided.reflective_mask(roughness, alpha, 0.3)
    assert mask.sum() == 60 and not mask[:, :10].any()
    assert roughness[mask].max() < roughness[:, 10:][~mask[:, 10:]].min()


def test_reflective_mask_of_degenerate_views():
    flat, full = np.full((6, 5), 0.3, np.float32), np.ones((6, 5), np.float32)
    assert not reflection_guided.reflective_mask(flat, 0 * full).any()
    assert reflection_guided.reflective_mask(flat, full).all()
    broken = flat.copy()
    broken[2, 3] = np.nan
    assert np.array_equal(reflection_guided.reflective_mask(broken, full), np.isfinite(broken))
    assert not reflection_guided.reflective_mask(np.full_like(flat, np.nan), full).any()


def test_boxes_hold_components_and_no_specks():
    mask = np.zeros((30, 40), bool)
    mask[2:8, 5:9] = mask[8:12, 9:20] = True  # touch at a corner: one component
    mask[20:30, 39] = True  # at the border of the image
    mask[15:17, 1:4] = True  # a speck
    assert reflection_guided.boxes(mask, 7).tolist() == [[5, 2, 20, 12], [39, 20, 40, 30]]
    assert reflection_guided.boxes(mask, 6).tolist() == [[5, 2, 20, 12], [1, 15, 4, 17], [39, 20, 40, 30]]
    for empty in (np.zeros((4, 4), bool), np.ones((2, 2), bool)):
        assert reflection_guided.boxes(empty).shape == (0, 4)


# ---- The literal construction ----


def half_spaces(camera, box):
    """The pyramid behind a box as five half-spaces: (inward normals [5, 3], points on the planes [5, 3], whether the plane
    itself is outside [5]). Each side is spanned by the rays through two neighbouring corners; the last is what lies in
    front. A half-open box leaves out its right and bottom side."""
    x0, y0, x1, y1 = box
    (fx, fy), (cx, cy) = camera.focal, camera.principal
    a, b, c, d = (
        camera.to_world[:3, :3] @ [(x - cx) / fx, (y - cy) / fy, 1] for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))
    )
    normals = [np.cross(a, b), np.cross(b, c), np.cross(c, d), np.cross(d, a), camera.to_world[:3, 2]]
    return np.array(normals), np.tile(camera.origin, (5, 1)), np.array([False, True, True, False, True])


def guided_reference(centers, cameras, boxes_per_view):
    """Algorithm 1 as it is written: each pair of views, each pair of their boxes, the region between all ten planes."""
    inside_any = np.zeros(len(centers), bool)
    pyramids = [[half_spaces(camera, box) for box in found] for camera, found in zip(cameras, boxes_per_view)]
    for first, second in itertools.combinations(pyramids, 2):
        for one, other in itertools.product(first, second):
            normals, points, is_open = map(np.concatenate, zip(one, other))
            height = ((centers[:, None] - points) * normals).sum(-1)  # [N, 10]
            inside_any |= np.where(is_open, height > 0, height >= 0).all(1)
    return inside_any


def random_boxes(rng, size):
    n = rng.integers(0, 6)
    low, high = np.sort([rng.integers(0, np.add(size, 1), (n, 2)) for _ in range(2)], 0)
    found = np.concatenate([low, high], 1)
    return found[(low < high).all(1)]


def random_view(rng):
    """A camera anywhere, the surfels' midst included, that looks anywhere, often at the surfels; and boxes."""
    size = tuple(int(n) for n in rng.integers(8, 200, 2))
    origin = rng.normal(size=3) * rng.choice([0.5, 2, 4])
    target = rng.normal(size=3) * 0.3 if rng.random() < 0.8 else rng.normal(size=3) * 10
    to_world = Camera.look_at(origin, target, rng.normal(size=3), 60, size).to_world
    focal = tuple(rng.uniform(0.5, 1.5, 2) * size)
    principal = tuple(rng.uniform(0, 1, 2) * size)
    return Camera(to_world, focal, principal, size), random_boxes(rng, size)


def test_counting_views_is_intersecting_pyramids():
    share = []
    for seed in range(1000):
        rng = np.random.default_rng(seed)
        cameras, found = zip(*[random_view(rng) for _ in range(rng.integers(2, 8))])
        centers = rng.normal(size=(60, 3)) * rng.choice([0.3, 1])
        flags = reflection_guided.guided(centers, cameras, found)
        assert flags.dtype == bool and np.array_equal(flags, guided_reference(centers, cameras, found)), seed
        share.append(flags.mean())
    assert 0.05 < np.mean(share) < 0.95 and np.count_nonzero(share) > 300


def test_counting_views_is_intersecting_pyramids_on_their_very_sides():
    """Right angles and dyadic numbers, whose arithmetic is exact: surfels lie on sides, edges and apexes of pyramids."""
    on_side = 0
    axes = [np.array(p) for p in itertools.product((-1, 0, 1), repeat=3) if np.abs(p).sum() == 1]
    for seed in range(120):
        rng = np.random.default_rng(seed)
        cameras, found = [], []
        for _ in range(3):
            x = axes[rng.integers(6)]
            z = rng.permutation([a for a in axes if not (a @ x)])[0]
            to_world = np.eye(4)
            to_world[:3] = np.stack([x, np.cross(z, x), z, rng.integers(-3, 1) * z + rng.integers(-1, 2, 3)], 1)
            cameras.append(Camera(to_world, tuple(2.0 ** rng.integers(1, 4, 2)), tuple(rng.integers(0, 17, 2) / 2), (8, 8)))
            found.append(random_boxes(rng, (8, 8)))
        centers = np.stack(np.meshgrid(*[np.arange(-6, 7) / 2] * 3), -1).reshape(-1, 3)
        flags = reflection_guided.guided(centers, cameras, found)
        assert np.array_equal(flags, guided_reference(centers, cameras, found)), seed
        x, y = cameras[0].project(centers)[0].T
        on_side += sum(np.isin(x, box[::2]).sum() + np.isin(y, box[1::2]).sum() for box in found[0])
    assert on_side > 10000


# ---- What it means ----


def test_a_cluster_seen_by_boxes_is_guided():
    rng = np.random.default_rng(1)
    cluster, rest = rng.normal(size=(50, 3)) * 0.05, rng.uniform(1, 2, (50, 3)) * rng.choice([-1, 1], (50, 3))
    cameras = [orbit_camera(angle, size=(64, 48)) for angle in (0.0, 1.5, 3.0)]
    found = []
    for camera in cameras:
        pixel = camera.project(cluster)[0]
        found.append(np.array([[*np.floor(pixel.min(0)), *np.floor(pixel.max(0)) + 1]], int))
    centers = np.concatenate([cluster, rest]).astype(np.float32)
    assert reflection_guided.guided(centers, cameras, found).tolist() == [True] * 50 + [False] * 50
    # one view localises nothing, however many boxes it has
    everything, none = np.array([[0, 0, 64, 48], [10, 10, 50, 40]]), np.zeros((0, 4), int)
    assert not reflection_guided.guided(centers, cameras, [everything, none, none]).any()
    assert not reflection_guided.guided(centers, [], []).any()
    with pytest.raises(ValueError):
        reflection_guided.guided(centers, cameras, found[:2])


def test_centres_that_are_not_finite_are_not_guided():
    cameras = [orbit_camera(angle) for angle in (0.0, 1.5)]
    centers = np.array([[0, 0, 0], [np.nan, 0, 0]])
    everything = np.array([[0, 0, 48, 40]])
    assert reflection_guided.guided(centers, cameras, [everything] * 2).tolist() == [True, False]


def test_picture():
    camera = orbit_camera(size=(100, 80))
    mask = np.zeros((80, 100), bool)
    mask[20:60, 30:70] = True
    behind = 2 * camera.origin
    boxes = reflection_guided.boxes(mask)
    x, y = (400.5 / 8 - 50) / camera.focal[0], (320.5 / 8 - 40) / camera.focal[1]  # the middle of a pixel, not its border
    inside = camera.origin + 4 * camera.rotation.T @ [x, y, 1]
    shown = reflection_guided.picture(np.full((80, 100, 3), 0.5), mask, boxes, camera, np.stack([inside, behind]))
    assert shown.shape == (640, 800, 3) and shown.dtype == np.uint8
    color = lambda *rgb: (shown == rgb).all(-1)
    assert np.argwhere(color(*reflection_guided.DOT)).tolist() == [[320, 400]]
    rows, columns = np.nonzero(color(*reflection_guided.LINE))
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (160, 479, 240, 559)
    assert color(128, 128, 128).sum() == 640 * 800 - 320 * 320  # untouched outside the mask
    assert reflection_guided.picture(
        np.zeros((80, 900, 3)), np.zeros((80, 900), bool), np.zeros((0, 4), int), camera, np.zeros((0, 3))
    ).shape == (80, 900, 3)

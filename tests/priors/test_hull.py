"""The visual hull and the initial points, on spheres with analytic masks written in the Blender layout."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage, spatial

from rgs_mi.core.camera import Camera
from rgs_mi.core.errors import UserError
from rgs_mi.datasets import load_dataset, path_traced
from rgs_mi.datasets.types import Dataset, View
from rgs_mi.priors import hull
from rgs_mi.priors.initialization import initial_points
from rgs_mi.priors.sampling import sample_surface

CENTRE, RADIUS, SIZE, VIEWS = np.array([0.7, -0.4, 0.3]), 0.5, 96, 40
RGB = np.array([200, 100, 50])
OVERSAMPLING = 4
CV_TO_GL = np.diag([1.0, -1.0, -1.0, 1.0])


def around(target=CENTRE, distance=2.5, fov=40, size=SIZE):
    """Cameras on a Fibonacci sphere around ``target``."""
    k = np.arange(VIEWS) + 0.5
    z, angle = 1 - 2 * k / VIEWS, np.pi * (1 + 5**0.5) * k
    d = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], 1)
    return [Camera.look_at(target + distance * o, target, (0, 0, 1), fov, (size, size)) for o in d]


def hits(camera, center=CENTRE, radius=RADIUS):
    """[H, W] z-depth of a sphere, NaN beside it."""
    rays, offset = camera.rays(), camera.origin - center
    a, b, c = (rays**2).sum(-1), rays @ offset, offset @ offset - radius**2
    with np.errstate(invalid="ignore"):
        return (-b - np.sqrt(b * b - a * c)) / a


def photograph(camera, **sphere):
    """[H, W, 4] uint8: the sphere with an antialiased mask."""
    fine = camera.resized(*(OVERSAMPLING * n for n in camera.size))
    alpha = (
        np.isfinite(hits(fine, **sphere)).reshape(camera.size[1], OVERSAMPLING, camera.size[0], OVERSAMPLING).mean((1, 3))
    )
    pixels = np.zeros((*alpha.shape, 4), np.uint8)
    pixels[..., :3], pixels[..., 3] = RGB, np.round(255 * alpha)
    return pixels


def views_of(cameras, **sphere):
    return [View(str(i), c, photograph(c, **sphere), True, None, None) for i, c in enumerate(cameras)]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A sphere off the origin, in the Blender layout."""
    root = tmp_path_factory.mktemp("sphere")
    frames = []
    for i, camera in enumerate(around()):
        Image.fromarray(photograph(camera)).save(root / f"r_{i}.png")
        frames.append({"file_path": f"./r_{i}", "transform_matrix": (camera.to_world @ CV_TO_GL).tolist()})
    (root / "transforms_train.json").write_text(json.dumps({"camera_angle_x": np.radians(40), "frames": frames}))
    return load_dataset(root)


@pytest.fixture(scope="module")
def mesh(data):
    return hull.surface(hull.visual_hull(data.train, 96))


def test_signed_distance_is_exact_to_a_small_part_of_a_pixel():
    x, y = np.meshgrid(np.arange(512), np.arange(512))
    inside = np.hypot(x - 250.3, y - 247.9) < 150.0  # eight times finer
    alpha = inside.reshape(64, 8, 64, 8).mean((1, 3))
    x, y = np.meshgrid(np.arange(64), np.arange(64))
    truth = 150 / 8 - np.hypot(x + 0.5 - 250.8 / 8, y + 0.5 - 248.4 / 8)
    error = hull._signed_distance(alpha) - truth
    assert np.abs(error[np.abs(truth) < 0.5]).max() < 0.15 and np.abs(error[np.abs(truth) < 0.5]).mean() < 0.04
    assert np.abs(error).max() < 0.75


def test_box_of_an_object_off_the_origin(data):
    lower, upper = hull.object_box(data.train)
    assert (lower < CENTRE - RADIUS).all() and (upper > CENTRE + RADIUS).all()
    assert (upper - lower < 2 * RADIUS * 1.3).all()


def test_box_where_cameras_do_not_look_at_the_object():
    lower, upper = hull.object_box(views_of(around(distance=4), center=CENTRE + [0.5, 0.3, -0.4]))
    np.testing.assert_allclose((lower + upper) / 2, CENTRE + [0.5, 0.3, -0.4], atol=0.1)


def test_hull_of_a_sphere(mesh):
    vertices, faces, normals = mesh
    radial = vertices - CENTRE
    distance = np.linalg.norm(radial, axis=1)
    # Forty cones leave a little around the sphere; nothing may be missing beyond a quarter of a pixel (.0047).
    assert distance.min() > RADIUS - 0.005 and distance.max() < RADIUS * 1.06
    assert distance.mean() == pytest.approx(RADIUS, rel=0.02)
    angle = np.degrees(np.arccos(np.clip((normals * radial).sum(1) / distance, -1, 1)))
    assert angle.mean() < 6 and np.percentile(angle, 99) < 20
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    volume = np.einsum("fi,fi->", corners[:, 0] - CENTRE, cross) / 6  # positive: faces turn outward
    assert volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.05)


def test_surface_is_not_stair_stepped(data):
    """At a coarse resolution, too, the sphere stays round: far better than half a step."""
    field = hull.visual_hull(data.train, 32)
    vertices, _, _ = hull.surface(field)
    distance = np.linalg.norm(vertices - CENTRE, axis=1)
    assert distance.std() < 0.25 * field.step


@pytest.mark.parametrize("size, steps", [(96, 160), (640, 392), (1280, 400)])
def test_a_step_is_a_pixel_within_bounds(size, steps):
    """A box 1.12 wide, 2.5 away: 0.448 of a frame of 40 degrees is 0.6154 of its width."""
    silhouettes = hull._silhouettes(views_of(around(size=size)[:3]))
    half = np.array([0.3, 0.56, 0.5])
    expected = np.clip(1.12 / 2.5 / (2 * np.tan(np.radians(20))) * size, 160, 400)
    assert hull._pixels_across(silhouettes, CENTRE - half, CENTRE + half) == int(expected) == pytest.approx(steps, abs=2)


def test_coarse_to_fine_skips_nothing(data):
    """The narrow band gives what carving every node does."""
    silhouettes = hull._silhouettes(data.train)
    box = hull._object_box(silhouettes)
    field = hull.carve(data.train, box, 48)
    points = np.stack(np.meshgrid(*(np.arange(n) for n in field.values.shape), indexing="ij"), -1).reshape(-1, 3)
    full = hull._carve(silhouettes, (field.lower + field.step * points).astype(np.float32), 3 * field.step)
    full = ndimage.gaussian_filter(full.reshape(field.values.shape), 0.6)[1:-1, 1:-1, 1:-1]
    close = np.abs(full) < field.step
    np.testing.assert_allclose(field.values[1:-1, 1:-1, 1:-1][close], full[close], atol=1e-3 * field.step)


@pytest.mark.parametrize("size", [32, 100])
@pytest.mark.parametrize("count, peak", [(8, 1.12), (16, 1.06), (30, 1.03)])  # cones of few views leave peaks
@pytest.mark.parametrize("center", [(0, 0, 0), (400, -300, 250)])
def test_object_that_fills_the_frame(size, count, peak, center):
    """As `rgs_mi.datasets.path_traced` photographs objects: space that no frame shows is carved all the same."""
    center, distance = np.array(center, float), path_traced.MARGIN / np.sin(np.radians(path_traced.FOV / 2))
    views = views_of(
        [
            Camera.look_at(center + distance * d, center, (0, 0, 1), path_traced.FOV, (size, size))
            for d in path_traced.train_directions(count)
        ],
        center=center,
        radius=1,
    )
    lower, upper = hull.object_box(views)
    assert (lower < center - 0.95).all() and (upper > center + 0.95).all() and (upper - lower).max() < 2.5
    vertices, _, _ = hull.surface(hull.visual_hull(views, 80))
    radius = np.linalg.norm(vertices - center, axis=1)
    assert radius.min() > 0.98 and np.median(radius) < 1.02 and radius.max() < peak


def test_only_a_border_that_the_mask_touches_is_undecided():
    camera, alpha = around()[20], np.zeros((SIZE, SIZE), np.float32)
    alpha[30:60, :40] = 1  # leaves the frame on the left
    silhouette = hull._Silhouette.of(alpha, camera)

    def sample(*pixel):
        """In pixels."""
        ray = camera.rotation.T @ [*((np.array(pixel) - camera.principal) / camera.focal), 1]
        return silhouette.sample((camera.origin + 2 * ray)[None].astype(np.float32))[0] * camera.focal[0] / 2

    assert sample(20, 45) > 0 and np.isnan(sample(-5, 45)) and np.isnan(sample(-5, -5))
    assert -61 < sample(20, -30) < -30 and -161 < sample(200, 45) < -104  # at least as far as the frame
    behind = (camera.origin - 0.5 * camera.to_world[:3, 2])[None].astype(np.float32)
    assert np.isnan(silhouette.sample(behind))
    alpha[:, 0] = 0
    assert hull._Silhouette.of(alpha, camera).sample(behind) == pytest.approx(-0.5)


def test_views_that_lose_the_object_do_not_carve_it(data):
    """Close-ups that show a part of the sphere leave the rest of it alone."""
    close = views_of([Camera.look_at(c.origin, CENTRE + [0.3, 0.3, 0], (0, 0, 1), 12, (SIZE, SIZE)) for c in around()[::10]])
    assert any(v.pixels[:, 0, 3].any() or v.pixels[0, :, 3].any() for v in close)
    vertices, _, _ = hull.surface(hull.visual_hull(data.train + close, 64))
    distance = np.linalg.norm(vertices - CENTRE, axis=1)
    assert distance.min() > RADIUS - 0.01 and distance.max() < RADIUS * 1.06


def test_a_wrong_mask_is_outvoted(data):
    """Half of the sphere is missing in one mask, which cuts it unless it is outvoted; a hull of few cones is hardly fatter."""
    views = list(data.train)
    pixels = views[3].pixels.copy()
    pixels[:, : SIZE // 2, 3] = 0
    views[3] = replace(views[3], pixels=pixels)
    radius = lambda outvoted: np.linalg.norm(hull.surface(hull.visual_hull(views, 64, outvoted))[0] - CENTRE, axis=1)
    assert radius(0).min() < 0.3 * RADIUS
    assert radius(1).min() > 0.98 * RADIUS and np.median(radius(1)) < 1.04 * RADIUS


def test_how_deep_points_lie(data):
    field = hull.visual_hull(data.train, 96)
    outward = np.random.default_rng(0).normal(size=(500, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    for radius in (1.2, 0.9, 0.5):  # of the sphere's
        depth = field.depth(CENTRE + radius * RADIUS * outward)
        np.testing.assert_allclose(depth, max(1 - radius, 0) * RADIUS, atol=2 * field.step)


def test_depth_maps(mesh):
    camera = around(size=64)[7]
    depth, truth = hull.depth_maps(*mesh[:2], [camera])[0], hits(camera)
    seen = np.isfinite(truth)
    assert depth.shape == (64, 64) and (np.isfinite(depth) & seen).sum() / (np.isfinite(depth) | seen).sum() > 0.97
    assert np.nanmedian(np.abs(depth - truth)) < 0.02


def test_samples_are_spread_evenly(mesh):
    positions, normals = sample_surface(*mesh, 2000, np.random.default_rng(0))
    assert positions.shape == normals.shape == (2000, 3) and positions.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    assert ((positions - CENTRE) * normals).sum(1).min() > 0
    nearest = spatial.cKDTree(positions).query(positions, 2)[0][:, 1]
    random = 0.5 * np.sqrt(4 * np.pi * RADIUS**2 / 2000)  # what independent samples have
    assert nearest.mean() > 1.4 * random and np.percentile(nearest, 5) > random
    again, _ = sample_surface(*mesh, 2000, np.random.default_rng(0))
    np.testing.assert_array_equal(positions, again)


def test_samples_are_denser_where_a_mesh_bends():
    x = np.linspace(-0.7, 0.7, 71)
    q = np.abs(np.stack(np.meshgrid(x, x, x, indexing="ij"), -1)) - 0.5
    cube = -(np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0))
    mesh = hull.surface(hull.SignedField(cube.astype(np.float32), np.full(3, -0.7), 0.02))
    positions, _ = sample_surface(*mesh, 3000, np.random.default_rng(0))
    second = np.sort(np.abs(positions), axis=1)[:, 1]  # 0.5 at an edge
    strips = [(low < second) & (second < low + 0.02) for low in (0.2, 0.475)]
    areas = [8 * (low + 0.02) ** 2 - 8 * low**2 for low in (0.2, 0.475)]  # of square frames, up to a factor
    plain, bent = (strip.sum() / area for strip, area in zip(strips, areas))
    assert 2.5 < bent / plain < 5, bent / plain
    assert len(positions) == 3000


def test_no_masks_and_no_common_volume(data):
    bare = [View(v.name, v.camera, v.pixels, False, None, v.path) for v in data.train]
    with pytest.raises(UserError, match="needs alpha masks in two views or more.*random points"):
        hull.visual_hull(bare)
    apart = views_of(around()[:6]) + views_of(around()[6:12], center=CENTRE + [0.7, 0, 0], radius=0.1)
    with pytest.raises(UserError, match="no common volume|hull is empty"):
        hull.visual_hull(apart)


# ---- Initial points ----


def test_initial_points_from_masks(data):
    positions, normals, spacing, look = initial_points(data, 1500, 0)
    assert positions.shape == normals.shape == look.color.shape == (1500, 3) and spacing.shape == (1500,)
    assert np.linalg.norm(positions - CENTRE, axis=1).mean() == pytest.approx(RADIUS, rel=0.02)
    linear = ((RGB / 255 + 0.055) / 1.055) ** 2.4
    for color in (look.color, look.lasting):
        np.testing.assert_allclose(color, np.broadcast_to(linear, color.shape), atol=1e-4)
    assert np.abs(look.variation).max() < 1e-6  # one colour from wherever one looks
    assert spacing.mean() == pytest.approx(np.sqrt(4 * np.pi * RADIUS**2 / 1500), rel=0.3)


def test_hidden_views_do_not_colour_a_point(data):
    """Photographs from above are white, those from below black: the sphere's poles must be, too."""
    views = []
    for v in data.train:
        pixels = v.pixels.copy()
        pixels[..., :3] = 255 * (v.camera.origin[2] > CENTRE[2])
        views.append(View(v.name, v.camera, pixels, True, None, v.path))
    positions, _, _, (colors, *_) = initial_points(Dataset(views, []), 1000, 0)
    height = (positions[:, 2] - CENTRE[2]) / RADIUS
    assert colors[height > 0.9].mean() > 0.85 and colors[height < -0.9].mean() < 0.15


def test_initial_points_without_masks(data):
    bare = [View(v.name, v.camera, v.pixels, False, None, v.path) for v in data.train]
    positions, normals, spacing, (colors, *_) = initial_points(Dataset(bare, []), 500, 0)
    assert normals is None and np.isfinite(colors).all() and (spacing > 0).all()
    assert np.linalg.norm(positions.mean(0) - CENTRE) < 0.1
    cloud = np.random.default_rng(0).random((300, 3))
    positions, normals, _, (colors, *_) = initial_points(Dataset(bare, [], cloud, cloud), 200, 0)
    assert normals is None and positions.shape == (200, 3)
    np.testing.assert_array_equal(positions, colors)
    assert initial_points(Dataset(bare, [], cloud), 400, 0)[0].shape == (300, 3)

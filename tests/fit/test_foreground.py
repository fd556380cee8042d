"""What of photographs without masks is the object."""

from dataclasses import replace
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import ndimage

from rgs_mi.core.bounding_box import BoundingBox
from rgs_mi.core.camera import Camera
from rgs_mi.datasets.path_traced import train_directions
from rgs_mi.datasets.types import Dataset
from rgs_mi.fit import foreground
from rgs_mi.fit.model import Model
from rgs_mi.fit.trainer import Fit
from rgs_mi.priors.ground import Plane
from rgs_mi.priors.initialization import Points, spacing_of
from rgs_mi.priors.photometric_variation import Appearance
from rgs_mi.settings.settings import Stage
from rgs_mi.shading.environment import Environment
from rgs_mi.shading.lighting import Shading, lighting_of
from rgs_mi.surfels.surfels import SH_0, Surfels, rotation_from_normal

from fits import SETTINGS, mirror_ball, photographs

BALL, FLOOR, REACH = 5000, 60, 4.0  # surfels of the ball; along a side of the floor, and half of that side
GROUND = -1.2
BOX = BoundingBox((-1.6, -1.6, -1.4), (1.6, 1.6, 1.6))
SETTINGS_FOUND = replace(SETTINGS, stages=(Stage(1.0, 1, 1),), light="world", box=BOX.corners)
DOWN = Plane(np.array([0.0, 0.0, 1.0]), GROUND)


def noise(shape, seed=0):
    """Smooth noise around 0, of standard deviation 1."""
    smooth = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=shape), (1.5, 1.5, 0), mode="wrap")
    return smooth / smooth.std()


def floor():
    """Positions [N, 3] and colours [N, 3] of a floor below the ball."""
    x, y = np.meshgrid(*2 * [np.linspace(-REACH, REACH, FLOOR)])
    return np.stack([x, y, np.full_like(x, GROUND)], -1).reshape(-1, 3), np.exp(noise((FLOOR, FLOOR, 3)) - 1).reshape(-1, 3)


def scene(ball=True):
    """A mirror ball on a floor with a texture, or the floor alone, as surfels."""
    positions, colors = floor()
    count, up = len(positions), np.tile([0.0, 0.0, 1.0], (len(positions), 1))
    fields = {
        "centers": positions,
        "rotations": rotation_from_normal(up),
        "scales": np.full((count, 2), REACH / FLOOR),
        "opacities": np.full((count, 1), 0.98),
        "sh": (colors - 0.5) / SH_0,
        "base_color": np.zeros((count, 3)),
        "roughness": np.ones((count, 1)),
        "metallic": np.ones((count, 1)),
        "delta_normal": np.zeros((count, 3)),
        "curvature": np.zeros((count, 3)),
    }
    if ball:
        fields = {name: np.concatenate([value, mirror_ball(BALL).numpy()[name]]) for name, value in fields.items()}
    return Surfels.from_numpy(fields, two_sided=False)


@pytest.fixture
def capture():
    """Photographs of the ball on the floor, which are not masked."""
    surfels, lamps = scene(), Environment(mi.TensorXf(np.float32(np.exp(noise((32, 64, 3), 1)) / 3)), np.eye(3))
    cameras = [Camera.look_at(5 * d, (0, 0, 0), (0, 0, 1), 40, (128, 128)) for d in train_directions(40) if d[2] > 0.2]
    return Dataset(photographs(surfels, lighting_of(Shading(), surfels, lamps.filtered()), cameras, masked=False), [])


def points(ball=True):
    """Where photographs agree on a depth: on the floor, and anywhere between the ball and what it mirrors, at half its radius."""
    positions, colors = floor()
    normals = np.tile([0.0, 0.0, 1.0], (len(positions), 1))
    if ball:
        images = mirror_ball(BALL).numpy()["centers"]
        positions, normals = (
            np.concatenate([positions, np.random.default_rng(3).uniform(0.5, 1, (BALL, 1)) * images]),
            np.concatenate([normals, images]),
        )
        colors = np.concatenate([colors, np.full_like(images, 0.4)])
    as_single = [np.float32(values) for values in (positions, normals, spacing_of(positions))]
    return Points(*as_single, Appearance.of(np.float32(colors)))


def start(dataset):
    def fit_of(points, settings):
        environment = np.full((16, 32, 3), 0.5)
        options = {"opacity": 0.7, "two_sided": True}
        look = points.appearance.diffuse
        model = Model.start(points.positions, points.normals, look, points.spacing, environment, np.eye(3), 1, **options)
        return Fit(dataset, model, settings, BOX.radius, Shading(box=BOX))

    return fit_of


def test_a_mirror_ball_on_a_floor_is_found(monkeypatch, capture, capfd):
    monkeypatch.setattr(foreground, "_STEPS", 100)
    given = points()
    found = foreground.found(start(capture), capture, given, SETTINGS_FOUND, BOX, quiet=False)
    assert found is not None and "an object that mirrors" in capfd.readouterr().err
    begun, box = found
    radius = np.linalg.norm(begun.positions, axis=1)
    on_ball = (radius < 1.3) & (begun.positions[:, 2] > -0.7)
    assert on_ball.sum() > len(given.positions) * foreground._LEAST / 2
    assert np.abs(radius[on_ball] - 1).mean() < 0.03
    assert radius.min() > 0.8  # no mirror image is left
    outward = (begun.normals * begun.positions).sum(1)[on_ball] / radius[on_ball]
    assert np.degrees(np.arccos(np.clip(outward, -1, 1))).mean() < 6
    assert np.abs(np.array(box.max) - 1.1).max() < 0.1
    beside = (np.abs(begun.positions) > 1.5).any(1)
    assert beside.sum() == (np.abs(given.positions) > 1.5).any(1).sum()


def test_silhouettes_are_those_of_what_is_above_the_ground(capture):
    surfels = scene()
    fit = SimpleNamespace(stage=Stage(1.0, 2, 1), dataset=capture, model=SimpleNamespace(surfels=lambda sh_order: surfels))
    views = foreground.silhouettes(fit, BOX, DOWN)
    assert len(views) == len(capture.train)
    for view in views:
        (column, row), (z,) = view.camera.project(np.zeros((1, 3)))[0][0], view.camera.project(np.zeros((1, 3)))[1]
        x, y = np.meshgrid(*(np.arange(n) + 0.5 for n in view.camera.size))
        off = np.hypot(x - column, y - row) / view.camera.focal[0] * z
        assert view.masked and view.alpha[off < 0.9].min() > 0.5
        assert view.alpha[off > 1.15].max() < 0.5


def test_a_floor_alone_is_no_object(monkeypatch, capfd):
    monkeypatch.setattr(foreground, "_STEPS", 20)
    surfels = scene(ball=False)
    cameras = [Camera.look_at(5 * d, (0, 0, 0), (0, 0, 1), 40, (64, 64)) for d in train_directions(20) if d[2] > 0.2]
    lamps = Environment(dr.full(mi.TensorXf, 0.1, (16, 32, 3)), np.eye(3))
    bare = Dataset(photographs(surfels, lighting_of(Shading(), surfels, lamps.filtered()), cameras, masked=False), [])
    assert foreground.found(start(bare), bare, points(ball=False), SETTINGS_FOUND, BOX, quiet=False) is None
    assert "no one object" in capfd.readouterr().err

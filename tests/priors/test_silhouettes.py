"""Cameras from silhouettes: three balls whose masks are exact, seen by cameras that are not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation

from rgs_mi.commands.optimize import start
from rgs_mi.core.alignment import pose_errors
from rgs_mi.core.camera import Camera
from rgs_mi.datasets.types import Dataset, View
from rgs_mi.fit.scene import PHOTOGRAPHS, FitScene
from rgs_mi.priors.silhouettes import agreement

from runs import ROOT

BALLS = [((0.5, 0.1, 0.0), 0.35), ((-0.4, 0.3, 0.2), 0.25), ((-0.1, -0.4, -0.3), 0.3)]
SCENE = ROOT / "scenes" / "object.xml"
VIEWS, SIZE, OVERSAMPLING = 24, (240, 200), 4


def around(distance=2.8, fov=45):
    """Cameras on a Fibonacci sphere."""
    k = np.arange(VIEWS) + 0.5
    z, angle = 1 - 2 * k / VIEWS, np.pi * (1 + 5**0.5) * k
    d = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], 1)
    return [Camera.look_at(distance * o, (0, 0, 0), (0, 0, 1), fov, SIZE) for o in d]


def view(name, camera):
    """The balls with an antialiased mask."""
    rays, hit = camera.resized(*(OVERSAMPLING * n for n in camera.size)).rays(), False
    for center, radius in BALLS:
        offset = camera.origin - center
        b, c = rays @ offset, offset @ offset - radius**2
        hit = hit | (b * b > (rays**2).sum(-1) * c)
    width, height = camera.size
    alpha = np.reshape(hit, (height, OVERSAMPLING, width, OVERSAMPLING)).mean((1, 3))
    pixels = np.zeros((height, width, 4), np.uint8)
    pixels[..., 3] = np.round(255 * alpha)
    return View(name, camera, pixels, True, None, None)


def off(camera, rng, degrees=0.5, part=0.01):
    """The camera as someone has estimated it."""
    direction = lambda: (d := rng.normal(size=3)) / np.linalg.norm(d)
    to_world = camera.to_world.copy()
    to_world[:3, :3] = to_world[:3, :3] @ Rotation.from_rotvec(np.radians(degrees) * direction()).as_matrix()
    to_world[:3, 3] += part * np.linalg.norm(camera.origin) * direction()
    return replace(camera, to_world=to_world)


@pytest.fixture(scope="module")
def views():
    return [view(str(k), camera) for k, camera in enumerate(around())]


def estimated(views, seed=0):
    rng = np.random.default_rng(seed)
    return [replace(v, camera=off(v.camera, rng)) for v in views]


def off_surface(fit):
    """The median distance of a fit's surfels from the balls, where these are all of the hull."""
    centers = fit.model.numpy("centers")
    return np.median(np.min([np.abs(np.linalg.norm(centers - c, axis=1) - r) for c, r in BALLS], axis=0))


def errors(cameras, views):
    return pose_errors(cameras, [v.camera for v in views])


def test_cameras_come_back(views):
    given = estimated(views)
    found = agreement(given)
    assert found.better and found.now < 0.05 < 1 < found.given
    before, after = (errors(cameras, views) for cameras in ([v.camera for v in given], found.cameras))
    assert np.median(before[0]) > 0.4 and np.median(after[0]) < 0.15
    assert np.median(after[1]) < 0.3 * np.median(before[1])
    assert all(a.focal == v.camera.focal for a, v in zip(found.cameras, given))


def test_right_cameras_stay_whatever_masks_are(views):
    """Drawn masks: their borders wander by a pixel or two."""
    rng = np.random.default_rng(0)

    def drawn(v):
        wander = ndimage.gaussian_filter(rng.normal(size=v.alpha.shape), 4)
        field = ndimage.gaussian_filter(v.alpha, 2) + 0.15 * wander / wander.std()
        pixels = v.pixels.copy()
        pixels[..., 3] = 255 * (field > 0.5)
        return replace(v, pixels=pixels)

    found = agreement([drawn(v) for v in views])
    assert 0.2 < found.given and not found.better


def test_what_the_frame_cuts_off_is_no_contact(views):
    """A third of the photographs lack a strip of the object."""
    cut = []
    for k, v in enumerate(estimated(views)):
        if k % 3 == 0:
            left = int(np.flatnonzero(v.alpha.max(0) > 0.5)[0]) + 20
            camera = v.camera.cropped(left, 0, SIZE[0] - left, SIZE[1])
            v = replace(v, camera=camera, pixels=v.pixels[:, left:])
        cut.append(v)
    found = agreement(cut)
    assert found.better and np.median(errors(found.cameras, views)[0]) < 0.2


def test_a_photograph_without_a_silhouette_keeps_its_camera(views):
    given = estimated(views)
    empty, full = (replace(given[k], pixels=np.full_like(given[k].pixels, value)) for k, value in ((3, 0), (5, 255)))
    given[3], given[5] = empty, full
    found = agreement(given)
    assert found.better and found.cameras[3] is given[3].camera and found.cameras[5] is given[5].camera


def test_two_photographs_from_one_place_have_no_baseline(views):
    given = estimated(views)
    found = agreement([*given, replace(given[2], name="again")])
    assert found.better and np.median(errors(found.cameras, [*views, views[2]])[0]) < 0.2


def test_a_fit_begins_there(views, tmp_path, capsys):
    """Its hull is that of these cameras, and a step sees photographs from them; without it all is as given."""
    scene, dataset = FitScene.load(SCENE, tmp_path), Dataset(estimated(views), [], photographed=True)
    chosen = ["minutes=null", "iterations=9", "initialization.surfels=500", "initialization.compare=false", "light=world"]
    fit, unmoved = (
        start(scene, dataset, scene.settings(PHOTOGRAPHS, [*chosen, f"initialization.silhouettes={on}"]), quiet=not on)
        for on in (True, False)
    )
    assert "where silhouettes agree" in capsys.readouterr().out
    begun, given = ([f.cameras.camera(k) for k in range(VIEWS)] for f in (fit, unmoved))
    assert np.median(errors(begun, views)[0]) < 0.4 * np.median(errors(given, views)[0])
    assert off_surface(fit) < 0.6 * off_surface(unmoved)
    assert fit.step() in (True, False) and np.isfinite(fit.psnr)


def test_nothing_to_agree_on(views):
    assert agreement(views[:7]) is None
    assert agreement([replace(v, masked=False) for v in views]) is None
    assert agreement([replace(views[0], name=str(k)) for k in range(9)]) is None
    assert agreement([replace(v, pixels=np.zeros_like(v.pixels)) for v in views]) is None

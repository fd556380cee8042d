"""Whether it is the light that stands still, or the camera: told by poses, by backgrounds, by two short fits."""

import json
from dataclasses import replace
from functools import cache

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from rgs_mi.plugins import surfels_of
from scipy import ndimage

from rgs_mi.commands.optimize import optimize, start
from rgs_mi.core.camera import Camera
from rgs_mi.core.errors import UserError
from rgs_mi.core.files import write_json
from rgs_mi.core.scene_files import find_scene, load_scene
from rgs_mi.core.turntable import Turntable
from rgs_mi.datasets.path_traced import train_directions
from rgs_mi.datasets.types import Dataset
from rgs_mi.export.relight import relight
from rgs_mi.export.render import straight
from rgs_mi.fit import light
from rgs_mi.fit.scene import FitScene
from rgs_mi.fit.trainer import Fit
from rgs_mi.settings.settings import Settings, Stage
from rgs_mi.shading.environment import Environment
from rgs_mi.shading.lighting import Shading, lighting_of

from fits import SETTINGS, mirror_ball, model, photographs

ELEVATIONS, COUNT, SIZE, MOVED = (10, 40), 10, 48, 50.0
ONE_STAGE = replace(SETTINGS, iterations=60, stages=(Stage(1.0, 1, 1),), specular_start=0.0)


def cameras(directions=None):
    around = 2 * np.pi * np.arange(COUNT) / COUNT
    if directions is None:
        directions = [
            [np.cos(e) * np.cos(a + e), np.cos(e) * np.sin(a + e), np.sin(e)] for e in np.radians(ELEVATIONS) for a in around
        ]
    return [Camera.look_at(4 * np.array(d), (0, 0, 0), (0, 0, 1), 40, (SIZE, SIZE)) for d in directions]


@cache
def capture(turned, moved=0.0, masked=True):
    """Photographs of a mirror ball from two rings, under lamps that stand still, or go round with the camera."""
    ball = mirror_ball()
    noise = ndimage.gaussian_filter(np.random.default_rng(1).normal(size=(32, 64, 3)), (3, 3, 0), mode="wrap")
    lamps = Environment(
        mi.TensorXf(np.float32(np.exp(2 * noise / noise.std()) / 3)), np.eye(3)[[0, 2, 1]] * [[1], [1], [-1]]
    )
    table = Turntable((0, 0, 1), (0, 0, 0), ((ELEVATIONS[0], 0.0), (ELEVATIONS[1], moved)))
    lighting = lighting_of(Shading(turntable=table if turned else None), ball, lamps.filtered())
    return Dataset(photographs(ball, lighting, cameras(), masked), [])


def fit_of(shown, settings, whole=None):
    return Fit(shown, model(), settings, 1.0, Shading(turntable=light.turntable_of(settings, whole or shown)))


def test_poses_leave_it_open_or_not():
    settings, seen = light.decided(Settings(), capture(True))
    assert settings.light == "auto" and "2 rings" in seen
    lattice = [replace(v, camera=c) for v, c in zip(capture(True).train, cameras(train_directions(2 * COUNT)))]
    assert light.decided(Settings(), Dataset(lattice, []))[0].light == "world"
    assert light.decided(Settings(light="turntable"), capture(True)) == (Settings(light="turntable"), "")
    assert light.decided(Settings(specular_start=1), capture(True))[0].light == "world"
    assert light.decided(Settings(), capture(True, masked=False))[0].light == "world"


@pytest.mark.parametrize("turned, expected", [(True, "turntable"), (False, "world")])
def test_two_short_fits_tell(monkeypatch, capfd, turned, expected):
    monkeypatch.setattr(light, "_STEPS", 60)
    assert light.tried(fit_of, capture(turned), replace(ONE_STAGE, light="auto"), quiet=False).light == expected
    assert "decides nothing" not in capfd.readouterr().err


def test_a_difference_that_is_none_is_said(monkeypatch, capfd):
    monkeypatch.setattr(light, "_STEPS", 1)
    assert light.tried(fit_of, capture(True), replace(ONE_STAGE, light="auto"), quiet=False).light == "world"
    assert "decides nothing" in capfd.readouterr().err


def test_a_camera_that_was_moved_among_the_lamps(monkeypatch):
    monkeypatch.setattr(light, "_STEPS", 60)
    settings, whole = replace(ONE_STAGE, light="turntable"), capture(True, MOVED)
    found = light.ring_turns(lambda shown, s: fit_of(shown, s, whole), whole, settings, quiet=True)
    assert found.turns is not None and found.turns[0] == 0 and found.turns[1] == pytest.approx(MOVED, abs=6)
    # what was given stays, and so does a camera that was not moved
    assert light.ring_turns(fit_of, whole, replace(settings, turns=(0.0, 3.0)), quiet=True).turns == (0.0, 3.0)
    unmoved = light.ring_turns(lambda shown, s: fit_of(shown, s, capture(True)), capture(True), settings, quiet=True)
    assert unmoved.turns is not None and abs(unmoved.turns[1]) <= 4


def test_turns_are_learned_and_resumed():
    settings = replace(ONE_STAGE, light="turntable", turns=(0.0, MOVED - 8), iterations=300)
    fit = fit_of(capture(True, MOVED), settings)
    for _ in range(300):
        fit.step()
    table = fit.shading.turntable
    assert table is not None and table.rings[0][1] == 0
    assert abs(table.rings[1][1] - MOVED) < 4
    again = Fit.resume(capture(True, MOVED), settings, *fit.state(), shading=fit.schedule.final)
    assert again.shading.turntable == table


def written(folder):
    """`capture` with a camera that was moved, as files in the Blender layout; every fifth view held out."""
    views = capture(True, MOVED).train
    for split, chosen in {"train": [v for k, v in enumerate(views) if k % 5], "test": views[::5]}.items():
        (folder / split).mkdir(parents=True)
        frames = []
        for view in chosen:
            Image.fromarray(view.pixels).save(folder / split / f"{view.name}.png")
            pose = (view.camera.to_world @ np.diag([1, -1, -1, 1])).tolist()
            frames.append({"file_path": f"./{split}/{view.name}", "transform_matrix": pose})
        write_json(folder / f"transforms_{split}.json", {"camera_angle_x": np.radians(40), "frames": frames})
    return folder


def test_a_run_says_that_its_object_turns(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(light, "_STEPS", 60)
    overrides = ["iterations=60", "initialization.surfels=400", "initialization.compare=false", "spp=1"]
    run = optimize(
        find_scene("object", "scenes"), data=written(tmp_path / "ball"), out=tmp_path / "run", overrides=overrides
    )
    told = capfd.readouterr()
    assert "2 rings about one axis" in told.out and "light=turntable" in told.out and "was moved" in told.out
    figures = json.loads((run / "metrics.json").read_text())
    (low, still), (high, turned) = figures["turntable"]["rings"]
    assert (low, high) == pytest.approx(ELEVATIONS, abs=0.1) and still == 0 and turned == pytest.approx(MOVED, abs=8)
    assert figures["settings"]["light"] == "turntable"
    # the scene that it leaves behind knows it, too: from either height it looks as the run's own picture does
    scene = load_scene(run / "scene.xml", {})
    for sensor in scene.sensors()[::3]:
        image = straight(np.array(mi.render(scene, sensor=sensor, spp=1)))
        shown = image[..., :3] * image[..., 3:] + 1 - image[..., 3:]
        written_by_run = np.asarray(Image.open(run / "test" / f"{sensor.id()}.png"), float)[..., :3] / 255
        assert np.abs(shown - written_by_run).mean() < 4e-3


def test_a_run_in_a_room(tmp_path):
    """Walls are learned, go on where they were, and stand in the scene that a run leaves behind."""
    still = ["light=world", "initialization.surfels=400", "initialization.compare=false", "spp=1", "room=3"]
    scene, data = find_scene("object", "scenes"), written(tmp_path / "ball")
    run = optimize(scene, data=data, out=tmp_path / "run", overrides=[*still, "iterations=40"])
    walls = json.loads((run / "metrics.json").read_text())["room"]["distances"]
    assert len(set(walls.values())) == 6 and all(1 < d < 9 for d in walls.values())
    first = load_scene(run / "scene.xml", {})
    eta = json.loads((run / "metrics.json").read_text())["eta"]
    assert surfels_of(first, run).eta == pytest.approx(eta, abs=1e-5) and abs(eta - 1.5) > 1e-3  # one that was learned
    assert first.integrator().room.distances == pytest.approx(list(walls.values()), rel=1e-4)
    sensor = first.sensors()[0]
    image = straight(np.array(mi.render(first, sensor=sensor, spp=1)))
    shown = image[..., :3] * image[..., 3:] + 1 - image[..., 3:]
    written_by_run = np.asarray(Image.open(run / "test" / f"{sensor.id()}.png"), float)[..., :3] / 255
    assert np.abs(shown - written_by_run).mean() < 4e-3
    optimize(scene, data=data, out=run, overrides=[*still, "iterations=41"], resume=True)
    later = json.loads((run / "metrics.json").read_text())["room"]["distances"]
    assert all(abs(later[side] / walls[side] - 1) < 0.05 for side in walls)
    relight(first, run / "scene.xml", envmap="studio")
    assert first.integrator().room is None


def test_a_room_turns_about_its_center(tmp_path):
    fitted = FitScene.load(find_scene("object", "scenes"), written(tmp_path / "ball"))
    overrides = ["light=turntable", "turns=[0,0]", "room=3", "initialization.surfels=400", "initialization.compare=false"]
    fit = start(fitted, fitted.dataset(quiet=True), fitted.settings(overrides=overrides))
    table = fit.shading.turntable
    assert table is not None and fit.model.center == pytest.approx(table.point, abs=1e-6)


@pytest.mark.parametrize("eta, learned", [(1.7, True), (2.4, False)])
def test_an_index_that_specular_can_not_say_stays(tmp_path, eta, learned):
    scene = (find_scene("object", "scenes")).read_text()
    material = '<bsdf type="principled" id="material"'
    changed = scene.replace(f"{material}/>", f'{material}><float name="eta" value="{eta}"/></bsdf>')
    (tmp_path / "object.xml").write_text(changed)
    fitted = FitScene.load(tmp_path / "object.xml", written(tmp_path / "ball"))
    overrides = ["light=world", "initialization.surfels=400", "initialization.compare=false"]
    fit = start(fitted, fitted.dataset(quiet=True), fitted.settings(overrides=overrides))
    assert (fit.model.specular() is not None) == learned and fit.shading.eta == pytest.approx(eta, abs=1e-5)


def test_bad_settings():
    lattice = [replace(v, camera=c) for v, c in zip(capture(True).train, cameras(train_directions(2 * COUNT)))]
    with pytest.raises(UserError, match="do not stand on rings"):
        light.turntable_of(Settings(light="turntable"), Dataset(lattice, []))
    with pytest.raises(UserError, match="one for each ring, at 10, 40 degrees"):
        light.turntable_of(Settings(light="turntable", turns=(0.0,)), capture(True))
    assert light.turntable_of(Settings(light="world"), Dataset(lattice, [])) is None

"""What a window shows, without a browser: sizes, refinement, generations, kernels, and the command line's own pictures."""

import shlex
import sys
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rgs_mi import cli
from rgs_mi.core.errors import UserError
from rgs_mi.core.scene_files import load_scene
from rgs_mi.export import video
from rgs_mi.export.render import pose, posed
from rgs_mi.viewer import maps, passes, window
from rgs_mi.viewer.look import OWN, Look, Material, quaternion, window_camera
from rgs_mi.viewer.pace import GRIDS, RATE, Pace
from rgs_mi.viewer.subject import Subject
from rgs_mi.viewer.warm import draw, warm

from scenes import orbit_camera
from windows import psnr, write_scene

CAMERA = orbit_camera(0.7, size=(56, 48))


def seen(subject, look, most=passes.Refined().total):
    """The picture at rest after that many passes, display values."""
    refined, camera = passes.Refined(), window.seen(subject, look)
    for _ in range(most):
        refined.add(subject, replace(look, camera=camera))
    return window.picture_of(subject, look, camera, refined.means)


# ---- Sizes ----


def paced(seconds_a_point, fixed=0.002):
    """A pace on a machine of that speed."""
    pace = Pace()
    pace.seconds = {grid: fixed + seconds_a_point * grid**2 for grid in GRIDS}
    return pace


def test_sizes_follow_the_machine():
    fastest, slowest = paced(1e-8), paced(1e-3)
    assert fastest.choose() == GRIDS[-1] and slowest.choose() == GRIDS[0]
    chosen = paced(0.9e-6)
    grid = chosen.choose()
    assert grid in GRIDS[1:-1] and chosen.seconds[grid] < 1 / RATE < chosen.seconds[GRIDS[GRIDS.index(grid) + 1]]
    assert chosen.choose(windows=4) < grid
    assert fastest.choose(side=210) == GRIDS[2]  # no finer than the window, or just so


def test_sizes_follow_what_frames_take():
    pace = paced(0.9e-6)
    first = pace.choose()
    for _ in range(30):
        pace.note(first, 3 * pace.seconds[first])
    slower = pace.choose()
    assert slower < first
    for _ in range(60):
        pace.note(slower, pace.seconds[slower])
    assert pace.choose() == first


# ---- Refinement ----


def test_at_rest_it_is_what_the_command_line_renders(subject, scene_file, tmp_path, monkeypatch):
    assert compared(Look(CAMERA), subject, scene_file, tmp_path, monkeypatch) > 45
    assert (
        compared(Look(CAMERA), subject, scene_file, tmp_path, monkeypatch, 9) < 45
    )  # it can fail: half of it has one sample


EDITED = {
    "light": Look(CAMERA, light="light.exr", rotate=70, brighten=0.5),
    "own light": Look(CAMERA, rotate=-40.5, brighten=-1, background="light"),
    "material": Look(CAMERA, material=Material(0.4, 1.5, 0.7)),
    "region": Look(CAMERA, region=(0.5, 0.6, 0.3, 0.8), region_material=Material(0.2, 1, 0.3), material=Material(1.2)),
    "exposure": Look(CAMERA, exposure=1.3, tone="reinhard"),
}


@pytest.mark.parametrize("name", EDITED)
def test_the_command_renders_what_is_seen(name, subject, scene_file, tmp_path, monkeypatch):
    look = EDITED[name]
    look = replace(look, light=str(scene_file.with_name(look.light)) if look.light != OWN else OWN)
    assert compared(look, subject, scene_file, tmp_path, monkeypatch) > 45
    assert psnr(seen(subject, look, 1), seen(subject, Look(CAMERA), 1)) < 35  # which is not what it was before


def compared(look, subject, file, folder, monkeypatch, most=passes.Refined().total):
    """PSNR of a window's picture against that of the command that it tells."""
    mine = seen(subject, look, most)
    text = look.command(str(file), 4.0)
    monkeypatch.setattr(sys, "argv", [*shlex.split(text), f"--out={folder / 'picture.png'}"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code in (None, 0)
    return psnr(mine, video.over_white(folder / "picture.png") / 255)


def test_a_path_tells_its_key_frames():
    keys = [orbit_camera(a, size=(64, 48)) for a in (0, 1, 2)]
    text = Look(CAMERA).command("runs/x y", 4.0, keys, 30)
    words = shlex.split(text)
    assert words[:3] == ["rgs-mi", "render", "runs/x y"] and sum(w.startswith("--camera=") for w in words) == 3
    assert "--path=30" in words and "--video" in words and "--size=64x48" in words


def test_poses_come_back():
    for angle in (0.1, 2, 4):
        camera = orbit_camera(angle, size=(64, 40))
        again = posed(pose(camera, 3.0), camera.size)
        assert np.allclose(again.to_world, camera.to_world, atol=1e-7) and np.allclose(again.focal, camera.focal)
    for bad in ("", "1,2", "0,0,0,0,0,0,0,0,1,40", "0,0,0,1,0,0,0,0,1,nan", "0,0,0,1,0,0,0,0,1,180", "a" * 10):
        with pytest.raises(UserError, match="ten numbers"):
            posed(bad, (4, 4))


# ---- Generations ----


def test_a_move_interrupts_what_is_at_rest(subject, monkeypatch):
    monkeypatch.setattr(window, "REST", 0)
    seen, pace = window.Window(Look(CAMERA)), paced(1e-8)
    assert seen.blank and seen.due() == 0
    assert seen.work(subject, pace).part is None and not seen.blank  # the first picture is a quick one
    shown = [seen.work(subject, pace) is not None for _ in range(17)]
    assert [k + 1 for k, there in enumerate(shown) if there] == [1, 5, 9, 13, 17] and seen.due() == float("inf")

    add = passes.Refined.add

    def moved(refined, *arguments):
        add(refined, *arguments)
        seen.change(camera=orbit_camera(0.9, size=(56, 48)))

    monkeypatch.setattr(passes.Refined, "add", moved)
    seen.change(exposure=1.0)
    assert seen.work(subject, pace) is None  # outdated before it was done
    monkeypatch.setattr(passes.Refined, "add", add)
    assert seen.due() == 0 and seen.work(subject, pace) is not None and seen.refined.passes == 1


def test_motion_then_rest(subject, monkeypatch):
    monkeypatch.setattr(window, "REST", 100)
    seen, pace = window.Window(Look(CAMERA)), paced(1e-8)
    assert seen.due() == 0
    moving = seen.work(subject, pace)
    assert moving.pixels.shape == (GRIDS[0],) * 2 + (3,) and moving.quality < 60  # the window has 56 pixels
    assert 0 < seen.due() <= window.REST  # drawn: now it waits
    seen.moved -= window.REST
    assert seen.due() == 0 and seen.work(subject, pace).pixels.shape == (48, 56, 3)


def test_no_change_is_no_change():
    seen = window.Window(Look(CAMERA))
    seen.change(camera=replace(CAMERA, to_world=CAMERA.to_world.copy()), exposure=0.0)
    assert seen.generation == 0
    seen.change(camera=CAMERA.resized(57, 48))
    seen.change(material=Material(0.5))
    assert seen.generation == 2


# ---- Kernels ----


def test_nothing_is_compiled_after_warming_up(subject):
    """Whatever varies from frame to frame: poses, light, materials, exposure, maps, backgrounds."""
    grid, rng = GRIDS[0], np.random.default_rng(3)
    for _ in warm(subject, grid):
        pass
    draw(subject, grid)
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    try:
        dr.kernel_history_clear()
        for k in range(24):
            turn = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
            to_world = CAMERA.to_world.copy()
            to_world[:3] = turn @ to_world[:3]
            to_world[:3, 3] *= rng.uniform(0.5, 3)
            look = Look(
                replace(CAMERA, to_world=to_world),
                map=list(maps.MAPS)[k % len(maps.MAPS)],
                background=("white", "black", "light")[k % 3],
                rotate=rng.uniform(-180, 180),
                brighten=rng.normal(),
                exposure=rng.normal(),
                material=Material(*rng.uniform(0.5, 2, 3)) if k % 2 else Material(),
                region=(*rng.normal(size=3), 0.5) if k % 3 else None,
                region_material=Material(*rng.uniform(0.5, 2, 3)),
            )
            passes.measure(subject, look, look.camera.resized(grid, grid), settled=False)
        history = dr.kernel_history((dr.KernelType.JIT,))
        assert len(history) > 400 and not [e for e in history if not e["cache_hit"] or e["cache_disk"]]
        passes.measure(subject, Look(CAMERA), CAMERA.resized(grid + 3, grid), settled=False)
        assert [e for e in dr.kernel_history((dr.KernelType.JIT,)) if not e["cache_hit"] or e["cache_disk"]]  # it can fail
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, False)


# ---- Maps ----


def test_maps_differ_and_are_colors(subject):
    views = {name: seen(subject, Look(CAMERA, map=name), 1) for name in maps.MAPS}
    for name, picture in views.items():
        assert picture.shape == (48, 56, 3) and picture.min() >= 0 and picture.max() <= 1 + 1e-6, name
    different = [name for name in views if name not in ("picture", "alpha") and psnr(views[name], views["picture"]) > 30]
    assert different == []
    assert np.allclose(views["alpha"][..., 0], views["alpha"][..., 1]) and views["alpha"].max() > 0.9


def test_error_is_none_in_the_place_of_a_photograph(subject):
    view = subject.views[1]
    look = Look(view.camera, map="error")
    assert seen(subject, look).min() > 0.97  # white: the photograph is what was rendered there
    elsewhere = replace(look, camera=replace(view.camera, to_world=orbit_camera(1.7).to_world))
    assert np.array_equal(seen(subject, elsewhere), seen(subject, look))  # compared where the photograph was taken
    assert seen(subject, replace(look, rotate=90), 1).min() < 0.8


def test_photograph_under_a_slider(subject):
    view = subject.views[0]
    look = Look(view.camera, through=view.name, wipe=0.5)
    shown, width = seen(subject, look, 1), view.camera.size[0]
    expected = maps.photograph(view, view.camera, "white")
    assert psnr(expected, video_free(view)) > 60
    assert np.array_equal(shown[:, : width // 2], expected[:, : width // 2].astype(shown.dtype))
    assert psnr(shown[:, width // 2 :], expected[:, width // 2 :]) < 50
    wide = replace(view.camera, size=(90, 50), principal=(45.0, 25.0))
    assert psnr(maps.photograph(view, wide, "white")[:, 15:75], expected) > 60  # the same pixels in a wider window


def video_free(view):
    pixels = view.pixels / 255.0
    return pixels[..., :3] * pixels[..., 3:] + 1 - pixels[..., 3:]


def test_a_click_finds_the_surface(subject):
    camera = orbit_camera(3.8, size=(56, 48))
    point = passes.point_at(subject, Look(camera), camera, 0.5, 0.5)
    assert np.linalg.norm(point - camera.origin / np.linalg.norm(camera.origin)) < 0.15
    assert passes.point_at(subject, Look(camera), camera, 0.01, 0.01) is None


def test_light_that_is_hidden_settles(tmp_path):
    """What a lit object hides of its light is that of the light before, until it rests."""
    subject = Subject.of(load_scene(write_scene(tmp_path, count=400, diffuse="lit"), {}))
    subject.lit(Look(CAMERA), settled=True)
    before = subject.irradiance_visibility
    turned = Look(CAMERA, rotate=120)
    moving, settled = subject.lit(turned, False).lighting.indirect, subject.lit(turned, True).lighting.indirect
    assert moving.irradiance_visibility is before
    assert np.abs(settled.irradiance_visibility.numpy() - before.numpy()).max() > 0.01


def test_stills_are_by_the_scenes_own_integrator(tmp_path):
    subject = Subject.of(load_scene(write_scene(tmp_path, "rgs_path", count=400), {}))
    one, many = (seen(subject, Look(CAMERA), n) for n in (1, 16))
    assert subject.still is not None and psnr(one, many) < 45  # noise that goes away
    assert psnr(many, seen(subject, Look(CAMERA, map="diffuse"), 1)) < 35


# ---- What pages send ----


@pytest.mark.parametrize("number", [np.nan, np.inf, "far"])
def test_cameras_that_are_none(number):
    good = quaternion(CAMERA.to_world), CAMERA.origin, 0.7, (40, 30)
    assert np.allclose(window_camera(*good).to_world, CAMERA.to_world)
    if isinstance(number, str):
        assert window_camera(np.zeros(4), *good[1:]) is None and window_camera(*good[:2], 4.0, good[3]) is None
        assert window_camera(*good[:3], (0, 30)) is None and window_camera(*good[:3], (1 << 20, 30)) is None
        large = window_camera(*good[:3], (8000, 6000))
        assert large.size[0] * large.size[1] <= 1 << 21 and abs(large.size[0] / large.size[1] - 4 / 3) < 0.01
    else:
        assert (
            window_camera(good[0], [number, 0, 0], *good[2:]) is None and window_camera(*good[:2], number, good[3]) is None
        )

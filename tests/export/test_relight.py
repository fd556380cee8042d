"""Light and material of a fit: put under another light, edited, compared with the truth, and in a stock scene."""

import json

import mitsuba as mi
import numpy as np
import pytest

import rgs_mi
from rgs_mi.commands.recovery import hidden, recovery, true_maps
from rgs_mi.core.camera import Camera
from rgs_mi.core.errors import UserError
from rgs_mi.core.scene_files import load_scene
from rgs_mi.datasets import load_dataset
from rgs_mi.evaluation import metrics
from rgs_mi.evaluation.evaluate import ground_truth
from rgs_mi.export.relight import edit, relight
from rgs_mi.export.render import render_scene, sensor_dict, straight

from runs import TARGET, make_inputs
from variants import VARIANT

SETTINGS = [
    "iterations=150",
    "initialization.surfels=800",
    "stages=[{views: 2}]",
    "density.stop=0",
    "learning_rates.environment=[0.1,0.03]",
]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    rgs_mi.set_variant(VARIANT)
    return make_inputs(tmp_path_factory.mktemp("inputs"), size=40)


@pytest.fixture(scope="module")
def run(inputs, tmp_path_factory):
    """The folder of a lit fit."""
    from rgs_mi.commands.optimize import optimize

    scene, data = inputs
    return optimize(
        scene,
        data=data,
        out=tmp_path_factory.mktemp("runs") / "ball",
        overrides=SETTINGS,
        quiet=True,
        variables={"diffuse": "lit"},
    )


def render(scene, **options):
    return np.array(mi.render(scene, sensor=0, **options))


def test_light_in_a_stock_scene_reproduces_the_photographs(run, inputs):
    """Of the true ball: turned by a quarter, upside down or mirrored it does not."""
    exported = np.array(mi.Bitmap(str(run / "environment.exr")).convert(mi.Bitmap.PixelFormat.RGB))
    views = load_dataset(inputs[1]).train

    def psnr(pixels):
        bsdf = {
            "type": "principled",
            "metallic": 1.0,
            "roughness": 0.25,
            "base_color": {"type": "rgb", "value": [0.6, 0.4, 0.2]},
        }
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "path", "hide_emitters": True},
                "ball": {"type": "sphere", "bsdf": bsdf},
                "light": {
                    "type": "envmap",
                    "bitmap": mi.Bitmap(np.ascontiguousarray(pixels)),
                    "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90),
                },
            }
        )
        errors = []
        for view in views[:4]:
            color = straight(np.array(mi.render(scene, sensor=mi.load_dict(sensor_dict(view.camera)), spp=64)))
            image = color[..., :3] * color[..., 3:] + 1 - color[..., 3:]
            errors.append(metrics.psnr(image, ground_truth(view, 1.0)))
        return np.mean(errors)

    right = psnr(exported)
    wrong = [
        np.roll(exported, exported.shape[1] // 4, 1),
        exported[::-1],
        exported[:, ::-1],
        np.roll(exported, exported.shape[1] // 2, 1),
        np.roll(exported, exported.shape[1] // 16, 1),
    ]
    assert right > 24 and all(psnr(pixels) < right - 2 for pixels in wrong)


def test_relight(run, tmp_path):
    path = run / "scene.xml"
    before = render(load_scene(path, {}))

    def relit(*arguments):
        scene = load_scene(path, {})
        relight(scene, path, *arguments)
        return render(scene)

    assert np.allclose(relit(None, 0.0), before, atol=1e-4) and np.allclose(relit(None, 360.0), before, atol=1e-3)
    assert abs(relit(None, 90.0) - before).mean() > 1e-3
    same = run / "environment.exr"
    assert np.allclose(relit(same, 0.0), before, atol=1e-4)
    mi.Bitmap(np.full((8, 16, 3), 3.0, np.float32)).write(str(tmp_path / "white.exr"))
    white = relit(tmp_path / "white.exr")
    assert np.allclose(relit(tmp_path / "white.exr", 77.0), white, atol=1e-4) and white[..., :3].max() < 3.1
    assert abs(relit("kitchen") - white).mean() > 1e-2


def test_turning_the_light_turns_the_highlight(run, tmp_path):
    """By 90° about the vertical, z: light from +x comes from +y then, as a camera sees it that is turned along."""
    path, light = run / "scene.xml", np.zeros((32, 64, 3), np.float32)
    light[12:20, 14:18] = 20.0  # longitude 90°: +x in the emitter's frame and the world's
    mi.Bitmap(light).write(str(tmp_path / "lamp.exr"))
    scene = load_scene(path, {})
    edit(scene, path, ["roughness=0.3", "metallic=1", "base_color=0.8"])
    relight(scene, path, tmp_path / "lamp.exr", 90.0)
    brightest = {}
    for name, origin in {"+x": (6, 0, 0), "+y": (0, 6, 0), "-x": (-6, 0, 0), "-y": (0, -6, 0)}.items():
        camera = Camera.look_at(origin, (0, 0, 0), (0, 0, 1), 25.0, (32, 32))
        brightest[name] = np.array(mi.render(scene, sensor=mi.load_dict(sensor_dict(camera))))[14:18, 14:18, :3].mean()
    assert max(brightest, key=brightest.get) == "+y"


def test_another_light_stands_still_where_its_own_goes_round(run, tmp_path):
    text = (run / "scene.xml").read_text()
    path = run / "on_turntable.xml"
    path.write_text(text.replace("</integrator>", '<string name="turntable" value="0 0 1 0 0 0"/></integrator>'))
    before = render(load_scene(run / "scene.xml", {}))
    scene = load_scene(path, {})
    assert abs(render(scene) - before).mean() > 1e-3
    relight(scene, path, run / "environment.exr")
    assert np.allclose(render(scene), before, atol=1e-4)


def test_base_colors_take_over_where_light_or_material_changes(run, tmp_path):
    """Of a scene that is relightable, not of others: there the surfels' own radiance stays."""
    text = (run / "scene.xml").read_text()

    def rendered(diffuse, change):
        path = run / f"{diffuse}.xml"
        path.write_text(text.replace('name="diffuse" value="lit"', f'name="diffuse" value="{diffuse}"'))
        scene = load_scene(path, {})
        change(scene, path)
        return render(scene)

    changes = [
        lambda scene, path: relight(scene, path, "kitchen"),
        lambda scene, path: relight(scene, path, rotate=60),
        lambda scene, path: relight(scene, path, brighten=1),
        lambda scene, path: edit(scene, path, ["base_color=0.1,0.9,0.5"]),
    ]
    for change in changes:
        lit, relightable, own = (rendered(diffuse, change) for diffuse in ("lit", "relightable", "radiance"))
        assert np.allclose(relightable, lit, atol=1e-4) and abs(own - lit).mean() > 1e-3
    lit, relightable, own = (
        rendered(d, lambda scene, path: relight(scene, path)) for d in ("lit", "relightable", "radiance")
    )
    assert np.allclose(relightable, own, atol=1e-5) and abs(own - lit).mean() > 1e-3


def test_edit(run):
    path = run / "scene.xml"
    scene = load_scene(path, {})
    before = render(scene)
    edit(scene, path, ["roughness=0.9", "base_color=0.1,0.2,0.9", "metallic=0"])
    after = render(scene)
    inside = after[..., 3] > 0.9
    assert (after[inside, 2] > after[inside, 0]).mean() > 0.95 and (before[inside, 0] > before[inside, 2]).mean() > 0.9


def test_script_options(run, tmp_path):
    plain = render_scene(run, out=tmp_path / "a.png", quiet=True)
    other = render_scene(run, out=tmp_path / "b.png", envmap="city", rotate=30, changes=["roughness=0.1"], quiet=True)
    assert plain[0].read_bytes() != other[0].read_bytes()


@pytest.mark.parametrize(
    "options, words",
    [
        ({"envmap": "none.exr"}, "no environment map at none.exr"),
        ({"changes": ["colour=1"]}, "unknown material 'colour'"),
        ({"changes": ["roughness=1.5"]}, "from 0 to 1"),
        ({"changes": ["roughness=a"]}, "expected roughness=NUMBER"),
        ({"changes": ["roughness=0.1,0.2"]}, "needs 1 number"),
    ],
)
def test_mistakes(run, tmp_path, options, words):
    with pytest.raises(UserError, match=words):
        render_scene(run, out=tmp_path / "a.png", quiet=True, **options)


def test_bad_environment_maps(run, tmp_path):
    (tmp_path / "text.exr").write_text("not an image")
    mi.Bitmap(np.full((4, 8, 3), np.nan, np.float32)).write(str(tmp_path / "nan.exr"))
    for name, words in (("text.exr", "text.exr: can't be read"), ("nan.exr", "NaN")):
        with pytest.raises(UserError, match=words):
            render_scene(run, out=tmp_path / "a.png", envmap=tmp_path / name, quiet=True)


#: Figures of a recovery and the largest that a fit may have. Measured for two seeds, and for a start without a fit:
#: metallic 0.30 and 0.30 (0.60), light 0.38 and 0.37 (0.73), the error under another light 0.100 and 0.103 (0.164).
RECOVERED = {"metallic_mae": 0.42, "environment_log_rmse": 0.52, "relit_rmse": 0.13}


def test_recovery(run, inputs, tmp_path, monkeypatch):
    """Of the ball: a fit comes closer to light and material than its start is; the figures are those that are written."""
    from rgs_mi.commands.optimize import optimize

    monkeypatch.chdir(tmp_path)
    (tmp_path / "ball.xml").write_text(
        TARGET.replace(
            '<scene version="3.0.0">', '<scene version="3.0.0"><default name="environment" value="night"/>'
        ).replace('value="studio"/> <i', 'value="$environment"/> <i')
    )
    scene, data = inputs
    overrides = [*SETTINGS, "iterations=1"]
    start = optimize(scene, data=data, out=tmp_path / "run", overrides=overrides, quiet=True, variables={"diffuse": "lit"})

    def within(folder, **variables):
        figures = recovery(folder, tmp_path / "ball.xml", ["kitchen"], variables=variables, size=32, quiet=True)
        assert figures == json.loads((folder / "recovery" / "recovery.json").read_text())
        scale = max(abs(factor - 1) for factor in figures["base_color_factor"])
        assert abs(figures["base_color_mae"] - figures["base_color_mae_unaligned"]) <= scale
        figures["relit_rmse"] = 10 ** (-figures["relit"]["kitchen"]["psnr"] / 20)
        return {name: figures[name] < most for name, most in RECOVERED.items()}

    assert within(run, environment="studio") == dict.fromkeys(RECOVERED, True)
    assert within(start, environment="studio") == dict.fromkeys(RECOVERED, False)
    assert not within(run)["environment_log_rmse"]  # the night that the file has unless told is not what was photographed
    assert (run / "recovery" / "relit_kitchen.png").is_file()


def test_true_maps(inputs):
    view = load_dataset(inputs[1]).test[0]
    maps = true_maps(view)
    inside = maps["Alpha"][..., 0] > 0.99
    assert np.allclose(maps["Roughness"][inside], 0.25, atol=1e-3) and np.allclose(maps["Metallic"][inside], 1, atol=1e-3)
    assert maps["Normal"].shape[-1] == maps["Albedo"].shape[-1] == 3
    assert np.allclose(np.linalg.norm(maps["Normal"][inside], axis=-1), 1, atol=1e-3)


def test_hidden():
    """A ball over a floor hides the sky from what is under it, and not from what is beside it; not from a point that has
    sunk a little into the floor either."""
    scene = mi.load_dict(
        {"type": "scene", "floor": {"type": "rectangle"}, "ball": {"type": "sphere", "center": [0, 0, 0.6], "radius": 0.3}}
    )
    point = np.array([[0, 0, 0], [0.8, 0, 0], [0.8, 0, -1e-4]])
    up = np.tile([0.0, 0.0, 1.0], (3, 1))
    assert hidden(scene, point, up, up).tolist() == [True, False, False]

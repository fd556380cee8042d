"""``rgs-mi export``: what it writes of a run, and what it says of what is none."""

import builtins
import json
import shutil
import struct

import mitsuba as mi
import numpy as np
import pytest

import rgs_mi
from rgs_mi.commands import export_splats
from rgs_mi.commands.export import FORMATS, export
from rgs_mi.core.errors import UserError
from rgs_mi.evaluation.metrics import psnr
from rgs_mi.export.bake import bake
from rgs_mi.splat.ellipses import render_ellipses
from rgs_mi.surfels.ply import read_ply, write_ply
from rgs_mi.surfels.surfels import Surfels

from judges import package, splat_transform, validated_gltf
from readers import glb_splats, harmonics
from runs import start_script
from scenes import orbit_camera, sphere_surfels, tangent_surfels
from splat_viewers import rendered
from variants import VARIANT

SCENE = """<scene version="3.0.0">
    <integrator type="rgs_deferred"> <boolean name="hide_emitters" value="true"/> </integrator>
    <shape type="surfels"> <string name="filename" value="object.ply"/> </shape>
    <emitter type="envmap"> <string name="filename" value="environment.exr"/>
        <transform name="to_world"> <rotate x="1" angle="90"/> </transform> </emitter>
    <sensor type="perspective"> <float name="fov" value="30"/>
        <transform name="to_world"> <lookat origin="4, 0, 1" target="0, 0, 0" up="0, 0, 1"/> </transform>
        <film type="hdrfilm"> <integer name="width" value="32"/> <integer name="height" value="32"/> </film> </sensor>
</scene>"""


def make_run(folder):
    """The folder of a finished run of few surfels."""
    folder.mkdir()
    write_ply(folder / "object.ply", sphere_surfels(300, seed=1).numpy())
    light = np.random.default_rng(0).uniform(0.2, 0.9, (16, 32, 3))
    mi.Bitmap(np.float32(light)).write(str(folder / "environment.exr"))
    (folder / "scene.xml").write_text(SCENE)
    (folder / "metrics.json").write_text(json.dumps({"finished": True, "settings": {}}))
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    rgs_mi.set_variant(VARIANT)
    return make_run(tmp_path_factory.mktemp("runs") / "ball")


@pytest.mark.parametrize("to, names", [("splat", ["splats.ply"]), ("gltf-splat", ["splats.glb"])])
def test_writes_beside_the_run(run, to, names):
    paths = export(run, to, quiet=True)
    assert paths == [run / "export" / to / name for name in names] and all(path.stat().st_size > 1e4 for path in paths)
    assert sorted(path.name for path in (run / "export" / to).iterdir()) == names


def test_usd_has_the_environment_beside_it(run, tmp_path):
    pytest.importorskip("pxr", reason="needs OpenUSD: pip install usd-core")
    paths = export(run, "usd", out=tmp_path / "a", kernel="surflet", quiet=True)
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == ["environment.exr", "splats.usdc"]
    own, written = (np.array(mi.Bitmap(str(path))) for path in (run / "environment.exr", paths[1]))
    assert np.allclose(own, written, atol=1e-3)


def test_refined_splats_look_as_the_run_does(run, tmp_path, monkeypatch):
    """A mirror more than baked ones do, in a viewer, from where it has not been looked at."""
    monkeypatch.setattr(export_splats, "_VIEWS", 40)
    monkeypatch.setattr(export_splats, "_WITHIN", 500)
    shutil.copytree(run, tmp_path / "mirror")
    mirror = tangent_surfels(2000, curvature=(1, 0, 1)).numpy()
    mirror |= {"roughness": np.full((2000, 1), 0.1), "metallic": np.ones((2000, 1)), "sh": np.full((2000, 3), -3.0)}
    write_ply(tmp_path / "mirror" / "object.ply", mirror)
    path = tmp_path / "mirror" / "scene.xml"
    scene = mi.load_file(str(path))
    cameras = [orbit_camera(angle, (48, 48)) for angle in np.linspace(0, 6, 30)]
    baked = bake(scene, path, quiet=True)
    refined = export_splats.refine(baked, scene, path, cameras, 0.4, quiet=True)

    def score(splats):
        own = {name: getattr(splats, name) for name in ("centers", "rotations", "scales")}
        own |= {"opacities": splats.opacities[:, None], "sh": splats.harmonics.reshape(len(splats), -1)}
        surfels, scores = Surfels.from_numpy(sphere_surfels(len(splats)).numpy() | own), []
        for camera in (orbit_camera(angle, (48, 48)) for angle in (0.1, 1.9, 4.3)):
            true, picture = rendered(scene, camera), render_ellipses(surfels, camera)
            shown = np.array(picture.color).T + 1 - np.array(picture.alpha)[:, None]
            scores.append(psnr(shown.clip(0, 1).reshape(true.shape), true))
        return np.mean(scores)

    assert score(refined) > 30 > 27 > score(baked)
    assert len(refined) != len(baked) and refined.origin == baked.origin
    assert np.abs(np.linalg.norm(refined.rotations, axis=1) - 1).max() < 1e-5


def test_refining_goes_into_the_file(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(export_splats, "_VIEWS", 5)
    (path,) = export(run, "gltf-splat", out=tmp_path, refine=0.02, quiet=True)
    (centers, *_), _, _ = glb_splats(path)
    assert len(centers) > 300 and "photographs are gone" in capsys.readouterr().err


def test_refining_needs_places_to_look_from(run, tmp_path):
    shutil.copytree(run, tmp_path / "blind")
    path = tmp_path / "blind" / "scene.xml"
    head, _, rest = path.read_text().partition("<sensor")
    path.write_text(head + rest.partition("</sensor>")[2])
    with pytest.raises(UserError, match="has no sensors, and its photographs are gone"):
        export(tmp_path / "blind", "splat", refine=1.0, quiet=True)


def test_script(run, tmp_path):
    process = start_script("export.py", run, "--to", "splat", "--out", tmp_path / "b")
    out, err = process.communicate()
    assert process.returncode == 0 and out.strip() == str(tmp_path / "b" / "splats.ply") and "baking 100%" in err


def test_unknown_format(run):
    for name, nearest in (("gltf", "gltf-splat"), ("splats", "splat"), ("usdz", "usd")):
        with pytest.raises(UserError, match=f"--to {name}: unknown format, nearest to '{nearest}'") as error:
            export(run, name)
        assert all(known in str(error.value) for known in FORMATS) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "options, words",
    [({"to": "splat", "kernel": "surflet"}, "only the format 'usd'"), ({"to": "usd", "kernel": "flat"}, "unknown kernel")],
)
def test_kernels(run, options, words):
    with pytest.raises(UserError, match=words):
        export(run, **options)


def _unfinished(folder):
    (folder / "metrics.json").write_text(json.dumps({"finished": False}))
    (folder / "checkpoints").mkdir()


def _no_light(folder):
    (folder / "environment.exr").unlink()


def _mirrored(folder):
    (folder / "scene.xml").write_text(SCENE.replace('<rotate x="1" angle="90"/>', '<scale x="-1"/>'))


@pytest.mark.parametrize(
    "spoil, words",
    [
        (_unfinished, "ball: holds an unfinished run: go on with 'rgs-mi optimize … --resume'"),
        (shutil.rmtree, "no run at .*ball: give the folder"),
        (lambda folder: (folder / "scene.xml").unlink(), "ball: holds no run"),
        (lambda folder: (folder / "object.ply").unlink(), "object.ply: can't be read"),
        (lambda folder: (folder / "object.ply").write_text("ply"), "object.ply: not a PLY of surfels"),
        (_no_light, "cannot load .*scene.xml"),
        (_mirrored, "scene.xml: 'to_world' of its envmap is no rotation"),
    ],
)
def test_mistakes(tmp_path, spoil, words):
    folder = make_run(tmp_path / "ball")
    spoil(folder)
    with pytest.raises(UserError, match=words) as error:
        export(folder, "gltf-splat", quiet=True)
    assert "\n" not in str(error.value) and not list(tmp_path.rglob("*.glb"))


def test_no_surfels(tmp_path):
    scene = {"type": "scene", "a": {"type": "surfels"}, "b": {"type": "rgs_deferred"}, "c": {"type": "constant"}}
    with pytest.raises(UserError, match="scene.xml: .*no"):
        bake(mi.load_dict(scene), "scene.xml")


def test_missing_package(run, monkeypatch):
    original = builtins.__import__

    def without(name, *arguments, **options):
        if name.partition(".")[0] == "pxr":
            raise ImportError(name)
        return original(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(UserError, match=r"OpenUSD is not installed: pip install 'rgs-mi\[usd\]'"):
        export(run, "usd", quiet=True)


# ---- Judged by others ----


def test_khronos_validator(run, tmp_path):
    """Its latest release, of 2024, does not know the extension: it says so, and takes no name with a colon for an attribute.
    It has nothing else to say."""
    package("gltf-validator")
    (path,) = export(run, "gltf-splat", out=tmp_path, quiet=True)

    def others(path):
        messages = validated_gltf(path)
        known = lambda m: "KHR_gaussian_splatting" in (m["pointer"] + m["message"])
        named = [m for m in messages if m["code"] == "MESH_PRIMITIVE_INVALID_ATTRIBUTE" and known(m)]
        assert len(named) in (0, 19)
        return [m for m in messages if m not in named and not (m["code"] == "UNSUPPORTED_EXTENSION" and known(m))]

    assert others(path) == []
    for spoil in (_wrong_bound, _too_many):
        assert [m for m in others(_spoiled(path, spoil)) if m["severity"] == 0]


def _wrong_bound(document):
    document["accessors"][0]["max"][0] += 1


def _too_many(document):
    document["accessors"][4]["count"] += 1


def _spoiled(path, change):
    """A copy of a GLB whose JSON ``change`` has changed."""
    data = path.read_bytes()
    end = 20 + int.from_bytes(data[12:16], "little")
    change(document := json.loads(data[20:end]))
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    sizes = struct.pack("<II", 20 + len(text) + len(data) - end, len(text))
    path = path.with_stem("spoiled")
    path.write_bytes(data[:8] + sizes + b"JSON" + text + data[end:])
    return path


def test_splat_transform_reads_the_ply(run, tmp_path):
    """And its own GLB of it, in a world that it turns by half about z, shows the same: it turns harmonics by code that is not
    ours."""
    package("@playcanvas/splat-transform")
    (path,) = export(run, "splat", out=tmp_path, quiet=True)
    splat_transform("-q", path, tmp_path / "theirs.glb")
    (centers, _, scales, opacities, sh), _, _ = glb_splats(tmp_path / "theirs.glb")
    turn, fields = np.diag([-1.0, -1.0, 1.0]), read_ply(path)
    order = [abs(centers - center).sum(1).argmin() for center in fields["centers"] @ turn]
    assert sorted(order) == list(range(300)) and abs(centers[order] - fields["centers"] @ turn).max() < 1e-5
    assert abs(scales[order][:, :2] - fields["scales"]).max() < 1e-4
    assert abs(opacities[order] - fields["opacities"][:, 0]).max() < 1e-3
    for d in np.array([[0.6, 0, 0.8], [-0.36, 0.48, 0.8], [0, -1, 0]]):
        ours = np.einsum("k,nkc->nc", harmonics(d), fields["sh"].reshape(300, 16, 3))
        theirs = np.einsum("k,nkc->nc", harmonics(turn @ d), sh[order])
        assert abs(ours - theirs).max() < 1e-3

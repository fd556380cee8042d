"""Rendered data sets: layout, cameras that reproject the geometry, normals, caching and resuming."""

import json
import shutil

import mitsuba as mi
import numpy as np
import pytest

from rgs_mi.core.camera import Camera
from rgs_mi.core.errors import UserError
from rgs_mi.datasets import load_dataset, path_traced

SIZE, RADIUS = 32, 0.5
SCENE = f"""<scene version="3.0.0">
    <default name="roughness" value="0.25"/>
    <integrator type="path"> <boolean name="hide_emitters" value="true"/> </integrator>
    <emitter type="constant"/>
    <shape type="sphere" id="ball">
        <point name="center" x="1" y="2" z="3"/> <float name="radius" value="{RADIUS}"/>
        <bsdf type="principled"> <rgb name="base_color" value="0.2, 0.4, 0.6"/> <float name="metallic" value="0.75"/>
            <float name="roughness" value="$roughness"/> </bsdf>
    </shape>
</scene>"""
CENTER = np.array([1.0, 2.0, 3.0])
SETTINGS = {"train": 2, "test": 2, "size": SIZE, "spp": 4, "quiet": True}


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "ball.xml"
    path.write_text(SCENE)
    return path


@pytest.fixture(scope="module")
def dataset(scene_file, tmp_path_factory):
    import rgs_mi

    rgs_mi.set_variant()
    return path_traced.render_dataset(scene_file, tmp_path_factory.mktemp("data") / "ball", **SETTINGS)


def views(root, split):
    """(stem, Camera) of each frame, read as any reader of the Blender layout would."""
    layout = json.loads((root / f"transforms_{split}.json").read_text())
    focal = 0.5 * SIZE / np.tan(layout["camera_angle_x"] / 2)
    for frame in layout["frames"]:
        to_world = np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])
        yield root / frame["file_path"], Camera(to_world, (focal, focal), (SIZE / 2, SIZE / 2), (SIZE, SIZE))


def maps(stem):
    """name -> [H, W] of the multichannel EXR."""
    bitmap = mi.Bitmap(f"{stem}_aov.exr")
    return {field.name: np.array(bitmap)[..., i] for i, field in enumerate(bitmap.struct_())}


def test_layout(dataset):
    for split in ("train", "test"):
        stems = [stem for stem, _ in views(dataset, split)]
        assert [s.name for s in stems] == ["r_0", "r_1"]
        for stem in stems:
            photograph, normal = np.array(mi.Bitmap(f"{stem}.png")), np.array(mi.Bitmap(f"{stem}_normal.png"))
            assert photograph.shape == normal.shape == (SIZE, SIZE, 4) and photograph.dtype == np.uint8
            linear = np.array(mi.Bitmap(f"{stem}.exr").convert(component_format=mi.Struct.Type.Float32))
            solid = linear[..., 3] > 0.99
            straight = mi.Bitmap(np.ascontiguousarray(linear[..., :3] / np.maximum(linear[..., 3:], 1e-6)))
            expected = np.array(straight.convert(component_format=mi.Struct.Type.UInt8, srgb_gamma=True)).astype(int)
            assert solid.any() and np.abs(expected - photograph[..., :3])[solid].max() <= 1
            assert photograph[0, 0, 3] == 0 and photograph[SIZE // 2, SIZE // 2, 3] == 255
            assert set(maps(stem)) == set(path_traced.AOV_CHANNELS)
    assert not [p for p in dataset.rglob("*") if ".tmp" in p.name]


def test_data_sets_know_their_film(dataset, tmp_path):
    """The Gaussian of Mitsuba's own, while pixels are as they were rendered; of images from elsewhere nobody knows it."""
    assert load_dataset(dataset).rfilter == 0.5
    assert load_dataset(dataset, longest=SIZE // 2).rfilter == 0
    shutil.copytree(dataset, tmp_path / "copy")
    (tmp_path / "copy" / path_traced.MANIFEST).unlink()
    assert load_dataset(tmp_path / "copy").rfilter == 0


def test_depth_and_pose_reproduce_the_geometry(dataset):
    for split in ("train", "test"):
        for stem, camera in views(dataset, split):
            m = maps(stem)
            inside = m["Alpha"] == 1
            points = camera.origin + m["Depth.Z"][..., None] * camera.rays()
            distance = np.linalg.norm(points - CENTER, axis=-1)[inside]
            assert np.median(np.abs(distance - RADIUS)) < 2e-3
            pixel, _ = camera.project(CENTER[None])
            assert np.allclose(pixel, SIZE / 2, atol=1e-4)
            assert 0.85 < 2 * np.sqrt((m["Alpha"]).sum() / np.pi) / SIZE <= 1  # it fills the frame


def test_normals_and_materials(dataset):
    for stem, camera in views(dataset, "test"):
        m = maps(stem)
        inside = m["Alpha"] == 1
        normal = np.stack([m[f"Normal.{k}"] for k in "XYZ"], -1)
        points = camera.origin + m["Depth.Z"][..., None] * camera.rays()
        expected = (points - CENTER) / np.linalg.norm(points - CENTER, axis=-1, keepdims=True)
        assert np.allclose(np.linalg.norm(normal[inside], axis=1), 1, atol=1e-4)
        assert (normal * camera.rays()).sum(-1)[inside].max() < 0
        assert np.median((normal * expected).sum(-1)[inside]) > 0.999
        encoded = np.array(mi.Bitmap(f"{stem}_normal.png"))
        assert np.abs(encoded[..., :3][inside] / 127.5 - 1 - normal[inside]).max() < 0.01
        names, values = ("Roughness", "Metallic", "Albedo.R", "Albedo.G", "Albedo.B"), (0.25, 0.75, 0.2, 0.4, 0.6)
        assert np.allclose([m[name][inside].mean() for name in names], values, atol=1e-5)


def test_views_are_distinct():
    directions = np.concatenate([path_traced.train_directions(60), path_traced.test_directions(20)])
    assert np.allclose(np.linalg.norm(directions, axis=1), 1)
    cosine = directions @ directions.T - 2 * np.eye(len(directions))
    assert np.degrees(np.arccos(cosine.max())) > 1
    assert -0.25 < directions[:, 2].min() < -0.1 and directions[:60, 2].max() > 0.95


def count_renders(monkeypatch, limit=None):
    """Count calls of the renderer; the one after ``limit`` dies as if the process had been interrupted."""
    calls, original = [], path_traced.Renderer.radiance

    def radiance(self, camera, spp, seed):
        if len(calls) == limit:
            raise KeyboardInterrupt
        calls.append(seed)
        return original(self, camera, spp, seed)

    monkeypatch.setattr(path_traced.Renderer, "radiance", radiance)
    return calls


def test_second_call_renders_nothing(scene_file, dataset, monkeypatch):
    calls = count_renders(monkeypatch)
    path_traced.render_dataset(scene_file, dataset, **SETTINGS)
    assert calls == []


def test_interrupted_rendering_resumes(scene_file, dataset, tmp_path, monkeypatch):
    out = tmp_path / "ball"
    with monkeypatch.context() as patch:
        count_renders(patch, limit=3)
        with pytest.raises(KeyboardInterrupt):
            path_traced.render_dataset(scene_file, out, **SETTINGS)
    assert not (out / "transforms_train.json").exists()
    calls = count_renders(monkeypatch)
    path_traced.render_dataset(scene_file, out, **SETTINGS)
    assert len(calls) == 1
    for file in (p.relative_to(out) for p in out.rglob("*.png")):
        a, b = (np.array(mi.Bitmap(str(root / file))).astype(int) for root in (out, dataset))
        assert np.abs(a - b).max() <= 1  # atomic additions in the film: the last bit may differ


def test_other_settings_render_again(scene_file, tmp_path, monkeypatch):
    out, calls = tmp_path / "ball", count_renders(monkeypatch)
    settings = SETTINGS | {"train": 1, "test": 1}
    path_traced.render_dataset(scene_file, out, **settings)
    path_traced.render_dataset(scene_file, out, variables={"roughness": 0.5}, **settings)
    assert len(calls) == 4 and np.isclose(maps(out / "test" / "r_0")["Roughness"].max(), 0.5)


@pytest.mark.parametrize(
    "content, message",
    [
        ("<scene", "cannot load"),
        ('<scene version="3.0.0"/>', "no shapes"),
        (
            '<scene version="3.0.0"><shape type="procedural_mesh"><string name="model" value="helmet"/>'
            '<string name="part" value="antenna"/></shape></scene>',
            "visor",
        ),
    ],
)
def test_bad_scenes(content, message, tmp_path):
    scene = tmp_path / "bad.xml"
    scene.write_text(content)
    with pytest.raises(UserError, match=message) as error:
        path_traced.render_dataset(scene, tmp_path / "out", **SETTINGS)
    assert "\n" not in str(error.value) and "bad.xml" in str(error.value)


def test_bad_folders(scene_file, tmp_path):
    with pytest.raises(UserError, match="no scene"):
        path_traced.render_dataset(tmp_path / "missing.xml", tmp_path / "out", **SETTINGS)
    with pytest.raises(UserError, match="can.t be written"):
        path_traced.render_dataset(scene_file, scene_file / "inside_a_file", **SETTINGS)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "photo.png").write_text("precious")
    with pytest.raises(UserError, match="another folder"):
        path_traced.render_dataset(scene_file, tmp_path / "mine", **SETTINGS)
    assert (tmp_path / "mine" / "photo.png").read_text() == "precious"

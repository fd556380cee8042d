"""A fit as a textured mesh: its surface, its textures, and what others make of its files."""

import itertools
import json
import math
import shutil
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from rgs_mi.plugins import lit_surfels
from scipy.ndimage import map_coordinates
from scipy.spatial import KDTree

import rgs_mi
from rgs_mi.commands.export import export
from rgs_mi.core.arrays import as_float
from rgs_mi.core.camera import Camera
from rgs_mi.core.color import srgb_encode
from rgs_mi.core.errors import UserError
from rgs_mi.core.film import Film
from rgs_mi.core.scene_files import load_scene
from rgs_mi.datasets.path_traced import train_directions
from rgs_mi.evaluation.evaluate import render_view
from rgs_mi.export.mesh import gltf, outlines, stock_scene, tsdf
from rgs_mi.export.mesh import refine as refine_module
from rgs_mi.export.mesh.build import build
from rgs_mi.export.mesh.depth_maps import depth_map
from rgs_mi.export.mesh.fit import _Maps, fitted
from rgs_mi.export.mesh.photographs import Photograph
from rgs_mi.export.mesh.surface import UVMesh, as_mitsuba, coverage, largest_parts, simplified, smoothed
from rgs_mi.export.mesh.textures import Texels, gltf_frames, mitsuba_frames, normal_map, vertex_tangents
from rgs_mi.export.splats import fibonacci_sphere
from rgs_mi.splat.reference import median_depth_reference
from rgs_mi.splat.tiles import Cutoffs
from rgs_mi.surfels.ply import read_ply, write_ply
from rgs_mi.surfels.surfels import Surfels, rotation_from_normal
from rgs_mi.targets.meshes import Mesh, join, unit

from judges import blender, filmed, package, validated_gltf
from scenes import orbit_camera, sphere_surfels, tangent_surfels
from variants import VARIANT

SIZE = 64


def cameras(count=12, size=SIZE):
    directions = [*train_directions(count), [0.1, 0, -1]]  # one from below closes the surface
    return [Camera.look_at(4 * np.array(d), (0, 0, 0), (0, 0, 1), 40, (size, size)) for d in directions]


def sphere_depth(camera):
    """The depth map of the unit sphere, exactly."""
    rays, o = camera.rays(), camera.origin
    a, b, c = (rays**2).sum(-1), rays @ o, o @ o - 1
    root = b * b - a * c
    return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 0).astype(np.float32)


# ---- Depth maps ----


def test_median_depth_equals_reference():
    surfels, cutoffs = sphere_surfels(200, seed=2), Cutoffs()
    camera = orbit_camera()
    (mine, coverage), (reference, covered) = depth_map(surfels, camera), median_depth_reference(surfels, camera, cutoffs)
    mine = mine.numpy()
    assert (abs(coverage.numpy() - covered) > 1e-3).mean() < 5e-3 and (covered > 0).mean() > 0.2
    assert (abs(mine - reference) > 1e-3).mean() < 5e-3 and (reference > 0).mean() > 0.2


# ---- Its surface ----


def integrated_slowly(cameras, depths, points):
    """(16) by NumPy: (mean of s, sum of w) of each point."""
    total, weight = np.zeros(len(points)), np.zeros(len(points))
    for camera, depth in zip(cameras, depths):
        for k, ((x, y), z) in enumerate(zip(*camera.project(points))):
            x, y = math.floor(x), math.floor(y)
            if z > 0 and 0 <= x < camera.size[0] and 0 <= y < camera.size[1]:
                d = depth[y, x]
                s = 1 if d == 0 else max(min((d - z) / (tsdf.TRUNCATION * VOXEL), 1), -1)
                w = min(1 + s, 1)
                total[k] += w * s
                weight[k] += w
    return np.where(weight > 0, total / np.where(weight > 0, weight, 1), 1), weight


VOXEL = 0.05


@pytest.fixture(scope="module")
def sphere():
    rgs_mi.set_variant(VARIANT)
    views = cameras()
    depths = [sphere_depth(camera) for camera in views]
    return views, depths, tsdf.fuse(views, [as_float(d) for d in depths], voxel=VOXEL)


def test_integration_equals_its_slow_twin(sphere):
    views, depths, volume = sphere
    some = np.random.default_rng(0).integers(0, [len(volume.blocks), 8, 8, 8], (3000, 4))
    voxels = 8 * volume.blocks[some[:, 0]] + some[:, 1:]
    distance, weight = integrated_slowly(views, depths, volume.origin + volume.voxel * voxels)
    at = tuple(some.T)
    same = abs(volume.weight[at] - weight) < 1e-3  # a voxel on the edge of a pixel may be on either side of it
    assert same.mean() > 0.99 and (weight > 0).mean() > 0.5 and (weight == 0).any()
    assert np.quantile(abs(volume.distance[at] - distance), 0.99) < 1e-3


def test_sphere(sphere, monkeypatch):
    """The surface of a sphere's exact depth maps: within a fraction of a voxel, closed, counter-clockwise seen from outside."""
    monkeypatch.setattr(tsdf, "_SLAB", 3)  # layers of blocks, so that there are seams
    mesh = tsdf.surface(sphere[-1])
    error = abs(np.linalg.norm(mesh.vertices, axis=1) - 1)
    assert error.mean() < 0.3 * VOXEL and error.max() < VOXEL
    centers = mesh.vertices[mesh.faces].mean(1)
    area = np.cross(*(mesh.vertices[mesh.faces[:, k]] - mesh.vertices[mesh.faces[:, 0]] for k in (1, 2)))
    assert ((area * centers).sum(1) > 0).mean() > 0.999
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    _, shared = np.unique(edges, axis=0, return_counts=True)
    assert (shared == 2).all() and len(mesh.vertices) - len(shared) + len(mesh.faces) == 2
    truth = unit(np.random.default_rng(0).normal(size=(4000, 3)))
    chamfer = KDTree(mesh.vertices).query(truth)[0].mean() + KDTree(truth).query(mesh.vertices)[0].mean()
    assert chamfer < 1.5 * VOXEL  # mostly what points of either are apart


def test_voxels_grow_where_memory_ends(sphere, monkeypatch):
    views, depths, volume = sphere
    monkeypatch.setattr(tsdf, "_MOST_VOXELS", volume.distance.size // 4)
    coarse = tsdf.fuse(views, [as_float(d) for d in depths], voxel=VOXEL)
    assert coarse.pixel == volume.pixel  # of which texels are
    assert coarse.voxel > 1.5 * VOXEL and coarse.distance.size <= volume.distance.size // 4


def test_nothing_seen():
    views = cameras(2)
    assert tsdf.fuse(views, [as_float(np.zeros(SIZE * SIZE))] * len(views)) is None


def test_largest_parts(sphere):
    mesh = tsdf.surface(sphere[-1])
    crumb = replace(mesh, vertices=0.01 * mesh.vertices).moved([3, 0, 0])
    parts = largest_parts(join(mesh, crumb))
    assert len(parts.faces) == len(mesh.faces) and parts.vertices[:, 0].max() < 2


def test_smoothing_keeps_to_the_normals(sphere):
    mesh = tsdf.surface(sphere[-1])
    noise = 0.2 * VOXEL * np.random.default_rng(0).normal(size=mesh.vertices.shape)
    rough = replace(mesh, vertices=(mesh.vertices + noise).astype(np.float32))
    smooth = smoothed(rough, unit(mesh.vertices))
    spread = lambda m: np.linalg.norm(m.vertices, axis=1).std()
    assert spread(smooth) < 0.5 * spread(rough)
    assert abs(np.linalg.norm(smooth.vertices, axis=1).mean() - 1) < 0.3 * VOXEL


@pytest.mark.parametrize("radius", [0.97, 1.02])
def test_outlines_are_those_of_coverages(radius):
    """A sphere of another radius comes to that of coverages, wherever cameras see it, by a small part of a pixel, 0.046."""
    views = cameras(size=64)
    truth = icosphere(1.0)
    coverages = [coverage(scene_of(truth), camera, 2) for camera in views]
    found = outlines.aligned(icosphere(radius), views, coverages)
    error = np.linalg.norm(found.vertices, axis=1) - 1
    assert abs(error.mean()) < 0.003 and abs(error).max() < 0.012
    assert (unit(found.vertices) * found.normals).sum(1).min() > 0.999


def test_what_fills_the_picture_has_no_outline():
    mesh, views = icosphere(1.0), cameras(3)
    found = outlines.aligned(mesh, views, [np.ones((SIZE, SIZE), np.float32)] * len(views))
    assert np.array_equal(found.vertices, mesh.vertices)


def icosphere(radius):
    """A sphere of triangles."""
    mesh = pytest.importorskip("trimesh").creation.icosphere(4, radius)
    return Mesh(np.float32(mesh.vertices), np.uint32(mesh.faces), np.float32(unit(mesh.vertices)))


def scene_of(mesh):
    return mi.load_dict({"type": "scene", "mesh": as_mitsuba(mesh)})


def test_simplified(sphere):
    pytest.importorskip("fast_simplification", reason="needs fast-simplification: pip install 'rgs-mi[mesh]'")
    mesh = simplified(tsdf.surface(sphere[-1]), 500)
    assert 400 < len(mesh.faces) <= 500 and abs(np.linalg.norm(mesh.vertices, axis=1) - 1).max() < VOXEL
    assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)


# ---- Its textures ----


def tilted_square():
    """A square on a plane, with normals that differ from its own."""
    a, b = np.array([0.6, 0, 0.8]), np.array([0, 1.0, 0])
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    vertices = uv[:, :1] * a + uv[:, 1:] * b
    normals = unit(np.cross(a, b) + 0.2 * (uv[:, :1] - 0.5) * a)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    return UVMesh(vertices.astype(np.float32), faces, normals.astype(np.float32), uv.astype(np.float32), (16, 8))


def test_texels_lie_on_the_mesh():
    mesh = tilted_square()
    texels = Texels.of(mesh)
    assert len(texels.index) == 128
    u, v = (texels.index % 16 + 0.5) / 16, (texels.index // 16 + 0.5) / 8
    assert np.allclose(texels.points, u[:, None] * [0.6, 0, 0.8] + v[:, None] * [0, 1, 0], atol=1e-5)


@pytest.mark.parametrize("frames", [mitsuba_frames, gltf_frames])
def test_tangent_frames(frames):
    """They are right-handed up to the sign of v, orthonormal, and normal maps hold the normals that they were made of."""
    mesh = tilted_square()
    texels = Texels.of(mesh)
    axes = frames(mesh, texels)
    assert np.allclose(axes @ axes.swapaxes(1, 2), np.eye(3), atol=1e-5)
    assert ((axes[:, 0] @ [0.6, 0, 0.8]) > 0.9).all()
    along_v = axes[:, 1] @ [0, 1.0, 0]
    assert (along_v < -0.9).all() if frames is gltf_frames else (along_v > 0.9).all()
    normal = unit(np.random.default_rng(0).normal(size=(8, 16, 3)) * 0.2 + np.cross([0.6, 0, 0.8], [0, 1, 0]))
    image = normal_map(mesh, texels, normal, frames)
    back = np.einsum("tij,ti->tj", axes, 2 * image.reshape(-1, 3)[texels.index] - 1)
    assert np.allclose(back, normal.reshape(-1, 3)[texels.index], atol=1e-5) and image.min() >= 0 and image.max() <= 1


def test_tangents_are_unit_and_across():
    mesh = tilted_square()
    tangents = vertex_tangents(mesh)
    assert np.allclose(np.linalg.norm(tangents[:, :3], axis=1), 1, atol=1e-5) and set(tangents[:, 3]) <= {-1.0, 1.0}
    assert abs((tangents[:, :3] * mesh.normals).sum(1)).max() < 1e-5


# ---- The whole way ----


def make_run(folder, lit=False):
    """The folder of a finished run of a ball: a red metal half, and a white one of its own radiance."""
    folder.mkdir()
    centers = fibonacci_sphere(1500)
    fields = tangent_surfels(len(centers)).numpy()
    upper = centers[:, 2:] > 0
    fields |= {
        "centers": centers,
        "rotations": rotation_from_normal(centers),
        "opacities": np.full((len(centers), 1), 0.95),
        "base_color": np.where(upper, [0.8, 0.3, 0.2], [0.7, 0.7, 0.6]),
        "metallic": np.where(upper, 1.0, 0.0),
        "roughness": np.full((len(upper), 1), 0.3),
        "sh": np.zeros((len(upper), 3)) + np.where(upper, -0.49, 0.1) / 0.28209479,
    }
    write_ply(folder / "object.ply", {k: np.float32(v) for k, v in fields.items()})
    rows, columns = np.mgrid[0:16, 0:32]
    light = 0.5 + 0.4 * np.stack([np.cos(columns / 5), np.sin(rows / 5), np.cos(columns / 5 + 1)], -1)
    mi.Bitmap(np.float32(light)).write(str(folder / "environment.exr"))
    look = lambda c: f'<matrix value="{" ".join(map(str, (c.to_world @ np.diag([-1.0, -1, 1, 1])).ravel()))}"/>'
    sensors = "".join(
        f"""<sensor type="perspective" id="r_{k}"><float name="fov" value="40"/><transform name="to_world">{look(c)}</transform>
        <film type="hdrfilm"><integer name="width" value="{SIZE}"/><integer name="height" value="{SIZE}"/>
        <rfilter type="box"/></film></sensor>"""
        for k, c in enumerate(cameras())
    )
    (folder / "scene.xml").write_text(
        f"""<scene version="3.0.0"><integrator type="rgs_deferred">
        <string name="diffuse" value="{"lit" if lit else "radiance"}"/></integrator>
        <shape type="surfels"><string name="filename" value="object.ply"/><boolean name="two_sided" value="false"/></shape>
        <emitter type="envmap" id="environment"><string name="filename" value="environment.exr"/>
        <transform name="to_world"><rotate x="1" angle="90"/></transform></emitter>{sensors}</scene>"""
    )
    (folder / "metrics.json").write_text(json.dumps({"finished": True, "settings": {}}))
    return folder


@pytest.fixture(scope="module", params=[False, True], ids=["radiance", "lit"])
def exported(request, tmp_path_factory):
    """(the run's folder, that of its mesh)."""
    for name in ("fast_simplification", "xatlas"):
        pytest.importorskip(name, reason="needs pip install 'rgs-mi[mesh]'")
    rgs_mi.set_variant(VARIANT)
    run = make_run(tmp_path_factory.mktemp("runs") / "ball", request.param)
    export(run, "mesh", quiet=True)
    return run, run / "export" / "mesh"


STOCK = """
import sys
class Nothing:
    def find_spec(self, name, *_):
        if name.partition(".")[0] == "rgs_mi":
            raise ImportError(name)
sys.meta_path.insert(0, Nothing())
import mitsuba as mi, numpy as np
mi.set_variant("llvm_ad_rgb")
scene = mi.load_file(sys.argv[1], parallel=False)
np.save(sys.argv[2], np.stack([np.array(mi.render(scene, sensor=k, spp=32))[..., :3] for k in (0, 5)]))
"""


def test_stock_mitsuba_shows_what_we_show(exported, tmp_path):
    run, folder = exported
    arguments = [sys.executable, "-c", STOCK, str(folder / stock_scene.SCENE), str(tmp_path / "stock.npy")]
    done = subprocess.run(arguments, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    scene = mi.load_file(str(run / "scene.xml"), parallel=False)
    ours = np.stack([np.array(mi.render(scene, sensor=k, spp=1))[..., :3] for k in (0, 5)])  # as fits have outlines
    theirs = np.load(tmp_path / "stock.npy")
    shown = [srgb_encode(np.clip(image, 0, 1)) for image in (ours, theirs)]
    assert -10 * np.log10(np.mean((shown[0] - shown[1]) ** 2)) > 30
    assert abs(ours.mean() / theirs.mean() - 1) < 0.02


def test_other_readers_take_the_glb(exported):
    """Khronos's validator finds no error, and trimesh the mesh, in a world whose y points up."""
    trimesh = pytest.importorskip("trimesh")
    _, folder = exported
    (mesh,) = trimesh.load(folder / gltf.NAME).geometry.values()
    own = mi.traverse(mi.load_dict({"type": "ply", "filename": str(folder / stock_scene.MESH)}))
    vertices = np.array(own["vertex_positions"]).reshape(-1, 3)
    assert np.allclose(mesh.vertices, vertices @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), atol=1e-5)
    assert mesh.volume == pytest.approx(4 / 3 * np.pi, rel=0.05)
    color = np.asarray(mesh.visual.material.baseColorTexture)
    shine = np.asarray(mesh.visual.material.metallicRoughnessTexture)
    assert color.shape[:2] == shine.shape[:2] and abs(np.median(shine[..., 1]) / 255 - 0.3) < 0.02


def test_khronos_validator(exported):
    package("gltf-validator")
    assert [m for m in validated_gltf(exported[1] / gltf.NAME) if m["severity"] < 2] == []


def test_blender_shows_what_mitsuba_shows(exported, tmp_path):
    """Cycles, under the same light: colours of what the object shows are within 5 %."""
    run, folder = exported
    scene = mi.load_file(str(folder / stock_scene.SCENE), parallel=False)
    camera, rotation = Camera.from_sensor(scene.sensors()[5]), np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    theirs = blender(folder / gltf.NAME, folder / stock_scene.ENVIRONMENT, camera, rotation, tmp_path)
    ours = np.array(mi.render(scene, sensor=filmed(camera), spp=64))[..., :3]
    inside = sphere_depth(camera) > 0
    assert np.allclose(ours[inside].mean(0), theirs[inside].mean(0), rtol=0.05)
    assert np.allclose(ours[~inside].mean(0), theirs[~inside].mean(0), rtol=0.05)
    shown = [srgb_encode(np.clip(image, 0, 1)) for image in (ours, theirs)]
    assert -10 * np.log10(np.mean((shown[0] - shown[1]) ** 2)) > 32


# ---- Refined ----


def photographs_of(folder):
    """What the stock scene in ``folder`` shows to its sensors, with masks."""
    scene = mi.load_file(str(folder / stock_scene.SCENE), parallel=False)
    views = []
    for k, sensor in enumerate(scene.sensors()):
        camera = Camera.from_sensor(sensor)
        image = np.array(mi.render(scene, sensor=k, spp=64))[..., :3]
        mask = sphere_depth(camera) > 0
        views.append(Photograph(camera, np.float32(np.concatenate([image, mask[..., None]], -1))))
    return views


@pytest.mark.parametrize("exported", [True], ids=["lit"], indirect=True)
def test_what_is_relightable_is_lit(exported, tmp_path):
    run, folder = exported
    other = shutil.copytree(run, tmp_path / "ball", ignore=shutil.ignore_patterns("export"))
    scene = other / "scene.xml"
    scene.write_text(scene.read_text().replace('value="lit"', 'value="relightable"'))
    export(other, "mesh", quiet=True)
    found = other / "export" / "mesh"
    assert sorted(path.name for path in found.iterdir()) == sorted(path.name for path in folder.iterdir())
    colors = [np.float32(np.array(mi.Bitmap(str(path / "base_color.exr")))) for path in (found, folder)]
    assert np.allclose(*colors, atol=1e-3) and colors[0].std() > 0.05


@pytest.mark.parametrize("exported", [True], ids=["lit"], indirect=True)
def test_textures_are_fitted_to_photographs(exported):
    """Base colors that were darkened, and metallic that was washed out, come back, of photographs that show the surfels."""
    run, _ = exported
    scene = load_scene(run / "scene.xml", {})
    surfels, lighting = lit_surfels(scene, run)
    views = []
    for camera in cameras():
        seen = render_view(surfels, lighting, camera, 0.0, Film.gaussian(0, 4))
        color = seen.maps["color"] / np.maximum(seen.alpha, 1e-3)
        views.append(Photograph(camera, np.concatenate([color, seen.alpha > 0.9], 2).astype(np.float32), np.full(3, 0.5)))
        views[-1].pixels[..., :3] *= 0.5  # its exposure
    ball = build(lighting.as_splatted(surfels), [v.camera for v in views], run, lit=True, eta=1.5, quiet=True)
    truth = ball.textures
    spoiled = replace(truth, base_color=0.7 * truth.base_color, metallic=0.8 * truth.metallic + 0.1)
    found = fitted(spoiled, ball.mesh, ball.texels, ball.radiance, views, lighting, quiet=True)
    for name in ("base_color", "metallic"):
        error = lambda textures: abs(getattr(textures, name) - getattr(truth, name)).mean()
        assert error(found) < 0.4 * error(spoiled), (name, error(found), error(spoiled))
    assert found.roughness is truth.roughness and found.normal is truth.normal


def test_means_over_the_rays_of_a_pixel():
    """Of textures that are linear between texels, those that no face has being like others."""
    rng, (width, height) = np.random.default_rng(0), (7, 5)
    like, known, own = rng.integers(0, 9, width * height), rng.random((9, 8), np.float32), rng.random((9, 4), np.float32)
    maps = _Maps(mi.UInt32(like.astype(np.uint32)), (width, height), as_float(known))
    uv = rng.uniform(0.12, 0.88, (4, 50, 2))
    corners = [c for ray in uv for c in maps.corners(mi.Point2f(*(as_float(ray[:, k]) for k in (0, 1))))]
    found = np.concatenate([np.atleast_2d(v.numpy()) for v in maps.means(corners, as_float(own))])
    image = np.concatenate([own, known[:, :7]], 1)[like].reshape(height, width, -1)
    at = (uv[..., 1].ravel() * height - 0.5, uv[..., 0].ravel() * width - 0.5)
    expected = [map_coordinates(image[..., k], at, order=1).reshape(4, -1).mean(0) for k in range(11)]
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize("exported", [False], ids=["radiance"], indirect=True)
def test_refining_finds_what_was_changed(exported, monkeypatch):
    """Radiance that was darkened comes back, in so many steps as a clock that counts them allows; the light stays as it was where
    it does not learn."""
    run, folder = exported
    views = photographs_of(folder)
    surfels = Surfels.from_numpy(read_ply(run / "object.ply"), two_sided=False)
    ball = build(surfels, [v.camera for v in views], run, lit=False, eta=1.5, quiet=True)
    truth, light = ball.textures.radiance, np.array(mi.Bitmap(str(run / "environment.exr")))
    spoiled = replace(ball.textures, radiance=0.7 * truth)
    stock_scene.write(folder.parent / "spoiled", ball.mesh, ball.texels, spoiled, 1.5, light, run / "scene.xml")
    monkeypatch.setattr(refine_module, "_RATES", {"radiance": 0.03, "environment": 0.0})
    monkeypatch.setattr(refine_module, "time", SimpleNamespace(monotonic=itertools.count().__next__))
    scene = folder.parent / "spoiled" / stock_scene.SCENE
    found = refine_module.refine(scene, ball.mesh, ball.texels, views, ["radiance"], 60, quiet=True)
    error = lambda image: abs(image - truth)[truth > 0.2].mean()
    assert error(found["radiance"]) < 0.5 * error(0.7 * truth) and found["radiance"].min() >= 0
    assert np.allclose(found["environment"], light, rtol=1e-3)


@pytest.mark.parametrize("exported", [True], ids=["lit"], indirect=True)
def test_refining_leaves_what_is_right(exported, monkeypatch):
    """Of photographs that are the scene's own pictures nothing is to be learned, and noise teaches next to nothing."""
    run, folder = exported
    views = photographs_of(folder)
    surfels = Surfels.from_numpy(read_ply(run / "object.ply"), two_sided=False)
    ball = build(surfels, [v.camera for v in views], run, lit=True, eta=1.5, quiet=True)
    monkeypatch.setattr(refine_module, "time", SimpleNamespace(monotonic=itertools.count().__next__))
    names = ["base_color", "roughness", "metallic"]
    found = refine_module.refine(folder / stock_scene.SCENE, ball.mesh, ball.texels, views, names, 60, quiet=True)
    drift = {name: np.sqrt(np.square(found[name] - getattr(ball.textures, name)).mean()) for name in names}
    assert max(drift.values()) < 0.004, drift


# ---- Mistakes ----


@pytest.mark.parametrize(
    "options, words",
    [
        ({"to": "usd", "data": "there"}, "--data: splats are made of a run alone, unless they are refined"),
        ({"to": "splat", "refine": float("nan")}, "--refine nan: needs a number of minutes above 0"),
        ({"to": "mesh", "refine": 0.0}, "--refine 0: needs a number of minutes above 0"),
        ({"to": "mesh", "refine": 1.0}, "does not say where the photographs are: give their folder with --data"),
        ({"to": "mesh", "data": "nowhere"}, "data folder 'nowhere' does not exist"),
    ],
)
def test_mistakes(exported, options, words):
    with pytest.raises(UserError, match=words) as error:
        export(exported[0], quiet=True, **options)
    assert "\n" not in str(error.value)


def test_missing_package(exported, monkeypatch):
    monkeypatch.setitem(sys.modules, "xatlas", None)
    with pytest.raises(UserError, match=r"packages are missing: pip install 'rgs-mi\[mesh\]'"):
        export(exported[0], "mesh", quiet=True)

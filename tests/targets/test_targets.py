"""Procedural objects and environments: sound meshes, usable light, plugins that load from a scene file."""

import importlib
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from rgs_mi import targets
from rgs_mi.core.errors import UserError
from rgs_mi.targets import helmet, implicit
from rgs_mi.targets.environments import ENVIRONMENTS, environment
from rgs_mi.targets.meshes import Mesh, between, divide, join, lathe, rounded, tube, weld

CLOSED = ("edge_trim", "visor_trim", "ridge", "vents", "knobs")
SCENES = Path(__file__).parents[2] / "scenes" / "targets"


def parts_of(model):
    return {part: targets.mesh(model, part) for part in importlib.import_module(f"rgs_mi.targets.{model}").PARTS}


def edge_counts(mesh):
    """How many faces share each undirected edge, and whether every directed edge is there at most once."""
    directed = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    number = lambda pairs: pairs[:, 0].astype(np.int64) * (1 << 32) + pairs[:, 1]
    _, counts = np.unique(number(np.sort(directed, axis=1)), return_counts=True)
    return counts, len(np.unique(number(directed))) == len(directed)


def volume(mesh):
    """Signed volume of a closed mesh: positive when its faces point outward."""
    a, b, c = mesh.vertices[mesh.faces].astype(float).transpose(1, 0, 2)
    return (a * np.cross(b, c)).sum() / 6


@pytest.mark.parametrize("model", targets.MODELS)
def test_parts_are_sound(model):
    for part, mesh in parts_of(model).items():
        assert np.isfinite(mesh.vertices).all() and np.linalg.norm(mesh.vertices, axis=1).max() < 1.1, part
        assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5), part
        a, b, c = mesh.vertices[mesh.faces].astype(float).transpose(1, 0, 2)
        face_normal = np.cross(b - a, c - a)
        area = np.linalg.norm(face_normal, axis=1)
        assert (area > 0).all(), part
        agreement = (mesh.normals[mesh.faces].mean(1) * face_normal).sum(1) / area
        assert np.average(agreement > 0.9, weights=area) > 0.94, part
        assert np.average(agreement > 0, weights=area) > 0.9995, part
        counts, oriented = edge_counts(mesh)
        assert oriented and counts.max() <= 2, part
        if model == "helmet" and part in CLOSED:
            assert counts.min() == 2 and volume(mesh) > 0


@pytest.mark.parametrize("model", sorted(set(targets.MODELS) - {"helmet"}))
def test_parts_make_closed_bodies_that_face_outward(model):
    """Parts are pieces of bodies: together they have no open edge, and every body encloses a positive volume."""
    whole = join(*parts_of(model).values())
    # Parts share borders exactly: one number tells whether vertices are equal.
    _, first, same = np.unique(whole.vertices.astype(float) @ [1, np.pi, np.e], return_index=True, return_inverse=True)
    whole = Mesh(whole.vertices[first], same[whole.faces], whole.normals[first])
    counts, oriented = edge_counts(whole)
    assert oriented and (counts == 2).all()
    a, b, c = whole.faces.T
    links = coo_array((np.ones(2 * len(a)), (np.r_[a, a], np.r_[b, c])), shape=(len(first), len(first)))
    _, body = connected_components(links, directed=False)
    p, q, r = whole.vertices[whole.faces].astype(float).transpose(1, 0, 2)
    assert (np.bincount(body[a], (p * np.cross(q, r)).sum(1) / 6) > 0).all()


def test_shell_bands_share_their_seams_and_face_outward():
    crown, stripe, base = (targets.mesh("helmet", name) for name in helmet.ROWS)
    for mesh in (crown, stripe, base):
        assert ((mesh.vertices * mesh.normals).sum(1) > 0).all()
    for upper, lower in ((crown, stripe), (stripe, base)):
        shared = set(map(tuple, upper.vertices)) & set(map(tuple, lower.vertices))
        assert len(shared) == helmet.COLUMNS


def test_primitives_have_known_volumes():
    a = np.linspace(0, 2 * np.pi, 200)
    ring = np.stack([np.cos(a), np.sin(a), 0 * a], -1)
    ring[-1] = ring[0]
    assert volume(tube(ring, [0, 0, 1], 0.2, 0.3, sides=64)) == pytest.approx(2 * np.pi * np.pi * 0.2 * 0.3, rel=5e-3)
    cylinder = lathe(np.array([[0, 1], [0.5, 1], [0.5, -1], [0, -1.0]]), np.zeros(3), [0, 1, 0])
    assert volume(cylinder) == pytest.approx(2 * np.pi * 0.25, rel=5e-3)


def test_surface_of_a_field_is_closed_and_exact():
    def field(p):
        hole, spout = ([0, 0, -1], [0, 0, 1]), [[0.4, 0, 0], [0.7, 0, 0], [0.7, 0, 0.3], [0.7, 0, 0.5]]
        block = implicit.difference(implicit.box(p, [0.5, 0.4, 0.3], 0.1), implicit.capsule(p, *hole, 0.15), 0.1)
        return implicit.union(block, implicit.swept(p, spout, [0.08, -0.03]), 0.1)

    mesh = implicit.surface(field, [-1, -1, -1], [1, 1, 1], 0.03)
    counts, oriented = edge_counts(mesh)
    assert oriented and (counts == 2).all() and 0 < volume(mesh) < 0.5
    # A vertex stays in its cell of the grid, so that those beside a border between cells are not quite on the surface.
    distance = np.abs(field(mesh.vertices.astype(float)))
    assert np.median(distance) < 1e-6 and distance.max() < 0.03 * 0.1
    ball = implicit.surface(lambda p: implicit.ellipsoid(p, (0.5, 0.5, 0.5)), [-0.6] * 3, [0.6] * 3, 0.05)
    assert volume(ball) == pytest.approx(4 / 3 * np.pi * 0.5**3, rel=0.01)
    assert np.allclose(ball.normals, ball.vertices / 0.5, atol=1e-3)


def test_surface_that_touches_itself_on_the_grid_stays_a_manifold():
    waves = lambda p: 0.1 * np.prod(np.sin(11 * p), axis=1)
    mesh = implicit.surface(lambda p: np.maximum(waves(p), implicit.box(p, [0.8] * 3, 0.1)), [-1] * 3, [1] * 3, 0.1)
    counts, oriented = edge_counts(mesh)
    assert oriented and (counts == 2).all()


def test_division_has_crisp_borders_and_stays_closed():
    cylinder = lathe(rounded([[0, 1], [0.5, 1], [0.5, -1], [0, -1]], 0.1), np.zeros(3), [0, 0, 1])
    height, near = (lambda p: p[:, 2]), (lambda p: np.abs(p[:, 0]) - 0.2)
    parts = divide(cylinder, [("band", between(height, -0.2, 0.3)), ("strip", (near,))], rest="rest")
    assert set(parts) == {"band", "strip", "rest"}
    assert np.ptp(parts["band"].vertices[:, 2]) == pytest.approx(0.5, abs=0.01)
    whole = join(*parts.values())
    counts, oriented = edge_counts(weld(whole.vertices, whole.faces))
    assert oriented and (counts == 2).all() and volume(whole) == pytest.approx(volume(cylinder), rel=1e-5)


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_environment_is_usable_light(name):
    image = environment(name, 64)
    assert image.shape == (64, 128, 3) and image.dtype == np.float32
    assert np.isfinite(image).all() and image.min() > 0 and 5 < image.max() < 60
    assert 0.2 < image.mean() < 1.5 and (image.max(2) > 20).mean() < 0.005
    assert np.array_equal(image, environment.__wrapped__(name, 64))


@pytest.mark.parametrize("model", targets.MODELS)
def test_scene_renders(model):
    """Every part of a model is in its scene, and light comes from it on every channel."""
    import mitsuba as mi

    scene = mi.load_file(str(SCENES / f"{model}.xml"), width=24, height=24, spp=4, envmap_height=64)
    # Mitsuba joins shapes that share a BSDF.
    assert sum(shape.face_count() for shape in scene.shapes()) == sum(len(m.faces) for m in parts_of(model).values())
    image = np.array(mi.render(scene))
    assert np.isfinite(image).all() and 0.1 < image[..., 3].mean() < 0.9
    assert (image[image[..., 3] > 0.99][:, :3].mean(0) > 0.02).all()


def test_plugins_load_from_xml():
    import mitsuba as mi

    scene = mi.load_string("""<scene version="3.0.0">
        <shape type="procedural_mesh" id="mirror">
            <string name="model" value="helmet"/> <string name="part" value="visor"/>
            <transform name="to_world"> <scale x="2"/> <translate z="5"/> </transform>
            <bsdf type="principled" id="metal"> <float name="roughness" value="0.1"/> </bsdf>
        </shape>
        <emitter type="procedural_envmap" id="light">
            <string name="name" value="studio"/> <integer name="height" value="16"/>
            <transform name="to_world"> <rotate x="1" angle="90"/> </transform>
        </emitter></scene>""")
    (shape,), part = scene.shapes(), targets.mesh("helmet", "visor")
    params = mi.traverse(scene)
    assert shape.id() == "mirror" and shape.bsdf().id() == "metal" and params["light.data"].shape == (16, 34, 3)
    expected = part.vertices * [2, 1, 1] + [0, 0, 5]
    assert np.allclose(np.array(params["mirror.vertex_positions"]).reshape(-1, 3), expected, atol=1e-5)
    normals = np.array(params["mirror.vertex_normals"]).reshape(-1, 3)
    expected = part.normals / [2, 1, 1]
    assert np.allclose(normals, expected / np.linalg.norm(expected, axis=1, keepdims=True), atol=1e-4)


def test_environment_is_z_up():
    """Straight up in the world is the ceiling's ring lamp or tiles, straight down the rug: as the painter says."""
    import mitsuba as mi

    from rgs_mi.targets.environments import studio

    light = mi.load_dict(
        {
            "type": "procedural_envmap",
            "name": "studio",
            "height": 256,
            "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90),
        }
    )
    rng = np.random.default_rng(0)
    d = rng.normal(size=(2000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    si = mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f(-d.T.astype(np.float32))
    seen, painted = np.array(light.eval(si)).T, studio(d)
    close = np.abs(seen - painted).max(1) < 0.1 + 0.1 * painted.max(1)
    assert close.mean() > 0.7  # the rest lies on edges finer than a texel


@pytest.mark.parametrize("model, part, known", [("boat", "hull", "helmet"), ("helmet", "antenna", "visor")])
def test_unknown_names_list_the_known_ones(model, part, known):
    with pytest.raises(UserError, match=known):
        targets.mesh(model, part)
    with pytest.raises(UserError, match="studio"):
        environment("cave")

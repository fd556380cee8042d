"""Procedural objects and environments: sound meshes, usable light, plugins that load from a scene file."""

import numpy as np
import pytest

from rgs_mi import targets
from rgs_mi.errors import UserError
from rgs_mi.targets import helmet
from rgs_mi.targets.environments import environment
from rgs_mi.targets.meshes import lathe, tube

CLOSED = ("edge_trim", "visor_trim", "ridge", "vents", "knobs")


def edge_counts(mesh):
    """How many faces share each undirected edge, and whether every directed edge is there at most once."""
    directed = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    _, counts = np.unique(np.sort(directed, axis=1), axis=0, return_counts=True)
    return counts, len(np.unique(directed, axis=0)) == len(directed)


def volume(mesh):
    """Signed volume of a closed mesh: positive when its faces point outward."""
    a, b, c = mesh.vertices[mesh.faces].astype(float).transpose(1, 0, 2)
    return (a * np.cross(b, c)).sum() / 6


@pytest.mark.parametrize("part", helmet.PARTS)
def test_part_is_sound(part):
    mesh = targets.mesh("helmet", part)
    assert np.isfinite(mesh.vertices).all() and np.linalg.norm(mesh.vertices, axis=1).max() < 1.1
    assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)
    a, b, c = mesh.vertices[mesh.faces].astype(float).transpose(1, 0, 2)
    face_normal = np.cross(b - a, c - a)
    area = np.linalg.norm(face_normal, axis=1)
    assert (area > 0).all()
    agreement = (mesh.normals[mesh.faces].mean(1) * face_normal).sum(1) / area
    assert np.average(agreement > 0.9, weights=area) > 0.97 and np.average(agreement > 0, weights=area) > 0.9999
    counts, oriented = edge_counts(mesh)
    assert oriented and counts.max() <= 2
    if part in CLOSED:
        assert counts.min() == 2 and volume(mesh) > 0


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


def test_studio_is_usable_light():
    image = environment("studio", 64)
    assert image.shape == (64, 128, 3) and image.dtype == np.float32
    assert np.isfinite(image).all() and image.min() > 0 and 5 < image.max() < 30
    assert np.array_equal(image, environment.__wrapped__("studio", 64))


def test_plugins_load_from_xml():
    import mitsuba as mi

    scene = mi.load_string("""<scene version="3.0.0">
        <shape type="procedural_mesh" id="mirror">
            <string name="model" value="helmet"/> <string name="part" value="visor"/>
            <transform name="to_world"> <scale x="2"/> <translate z="5"/> </transform>
            <bsdf type="principled" id="metal"> <float name="roughness" value="0.1"/> </bsdf>
        </shape>
        <emitter type="procedural_envmap" id="light">
            <string name="name" value="studio"/> <integer name="resolution" value="16"/>
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

    light = mi.load_dict({"type": "procedural_envmap", "name": "studio", "resolution": 256,
                          "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90)})
    rng = np.random.default_rng(0)
    d = rng.normal(size=(2000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    si = mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f(-d.T.astype(np.float32))
    seen, painted = np.array(light.eval(si)).T, studio(d)
    close = np.abs(seen - painted).max(1) < 0.1 + 0.1 * painted.max(1)
    assert close.mean() > 0.7       # the rest lies on edges finer than a texel


@pytest.mark.parametrize("model, part, known", [("boat", "hull", "helmet"), ("helmet", "antenna", "visor")])
def test_unknown_names_list_the_known_ones(model, part, known):
    with pytest.raises(UserError, match=known):
        targets.mesh(model, part)
    with pytest.raises(UserError, match="studio"):
        environment("cave")

"""Baked splats: what they look like, and that PLY, glTF and USD say the same of them, read by code that is not ours."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from rgs_mi.plugins import lit_surfels
from scipy.spatial.transform import Rotation

from rgs_mi.core.camera import Camera
from rgs_mi.core.color import srgb_decode, srgb_encode
from rgs_mi.export import gltf_splat, splat_ply, usd_splat
from rgs_mi.export.bake import DIRECTIONS, bake, fit
from rgs_mi.export.splats import Splats, fibonacci_sphere, sh_basis, sh_rotation
from rgs_mi.shading.deferred import render

from readers import glb_splats, harmonics, ply_splats
from scenes import sphere_surfels

TURN = Rotation.from_euler("xyz", [20, -70, 130], degrees=True).as_matrix()


def random_splats(n=50, seed=3):
    rng = np.random.default_rng(seed)
    fields = sphere_surfels(n, seed=seed).numpy()
    geometry = (fields[name] for name in ("centers", "rotations", "scales"))
    return Splats(*geometry, fields["opacities"][:, 0], np.float32(0.2 * rng.normal(size=(n, 16, 3))))


def covariances(rotations, scales):
    """[N, 3, 3] of quaternions (x, y, z, w)."""
    axes = Rotation.from_quat(rotations).as_matrix() * scales[:, None]
    return axes @ axes.swapaxes(1, 2)


# ---- Harmonics ----


def test_basis_is_that_of_the_textbook():
    directions = fibonacci_sphere(40)
    assert np.allclose(np.linalg.norm(directions, axis=1), 1) and np.allclose(directions.mean(0), 0, atol=0.02)
    assert np.allclose(sh_basis(directions), [harmonics(d) for d in directions], atol=1e-6)


def test_rotation_of_harmonics():
    c, D = np.random.default_rng(0).normal(size=16), sh_rotation(TURN)
    for d in fibonacci_sphere(30):
        assert abs(harmonics(TURN @ d) @ D @ c - harmonics(d) @ c) < 1e-5
    assert abs(D @ D.T - np.eye(16)).max() < 1e-5 and abs(D - np.eye(16)).max() > 0.5
    for first, last in ((0, 1), (1, 4), (4, 9), (9, 16)):  # degrees do not mix
        assert abs(D[first:last, last:]).max(initial=0) < 1e-5 and abs(D[first:last, :first]).max(initial=0) < 1e-5


def test_fit_returns_the_harmonics_that_it_was_given():
    """But for what the penalty takes of them; directions without weight say nothing."""
    rng, directions = np.random.default_rng(1), fibonacci_sphere(DIRECTIONS)
    truth = 0.1 * rng.normal(size=(3, 16, 3))
    colors = 0.5 + np.einsum("vk,nkc->nvc", [harmonics(-d) for d in directions], truth)
    weights = rng.uniform(0.5, 1, (3, DIRECTIONS))
    weights[:, :20] = 0
    colors[:, :20] = 9
    assert abs(fit(colors, weights) - truth).max() < 0.01
    weights[1] = 0
    assert np.isfinite(fit(colors, weights)).all() and abs(fit(colors, weights)[1]).max() < 1e-6


# ---- Baking ----


def scene_of(surfels, light=None, **integrator):
    """A loaded scene of ``surfels`` under a smooth light, or ``light``, a map."""
    if light is None:
        rows, columns = np.mgrid[0:16, 0:32]
        red, green = 0.5 + 0.4 * np.cos(np.pi * rows / 15), 0.4 + 0.3 * np.sin(2 * np.pi * columns / 32)
        light = np.stack([red, green, 0.6 - 0.2 * red], -1)
    fields = {name: mi.TensorXf(values) for name, values in surfels.numpy().items()}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "rgs_deferred", "hide_emitters": True} | integrator,
            "object": {"type": "surfels", "two_sided": surfels.two_sided} | fields,
            "light": {
                "type": "envmap",
                "bitmap": mi.Bitmap(np.float32(light)),
                "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90),
            },
        }
    )


def lone_surfels(two_sided=True, **changes):
    """Six surfels far from each other, turned to all sides, rough and opaque."""
    base = sphere_surfels(6, seed=5).numpy()
    n = len(base["centers"])
    fields = {
        "centers": 10 * np.repeat(np.eye(3), 2, 0) * np.tile([[1], [-1]], (3, 1)),
        "scales": np.full((n, 2), 0.5),
        "opacities": np.full((n, 1), 0.999),
        "roughness": np.full((n, 1), 0.8),
        "curvature": np.zeros((n, 3)),
        "delta_normal": np.zeros((n, 3)),
    }
    return type(sphere_surfels(1)).from_numpy(base | fields | changes, two_sided)


@pytest.mark.parametrize("integrator", [{}, {"indirect": "one_bounce"}, {"diffuse": "lit", "indirect": "one_bounce"}])
@pytest.mark.parametrize("two_sided", [True, False])
def test_splats_have_the_colours_of_renderings(integrator, two_sided):
    """What a camera sees in the middle of each surfel is what the splat shows along the same ray."""
    scene = scene_of(lone_surfels(two_sided), **integrator)
    splats = bake(scene, "scene.xml", quiet=True)
    surfels, lighting = lit_surfels(scene, "scene.xml")
    normals = Rotation.from_quat(splats.rotations).as_matrix()[:, :, 2]
    errors = []
    for k, center in enumerate(splats.centers):
        for away in fibonacci_sphere(9):
            cosine = away @ normals[k]
            if abs(cosine) < 0.35 or (cosine < 0 and not surfels.two_sided):
                continue
            camera = Camera.look_at(center + 3 * away, center, [0.3, 0.5, 0.8], 5.0, (9, 9))
            image = render(surfels, camera, lighting)
            pixel = np.array(image.color)[:, 40] / np.array(image.gbuffer.all.alpha)[40]
            errors.append(splats.colors(-away)[k] - srgb_encode(np.clip(pixel, 0, 1)))
    assert len(errors) > (30 if two_sided else 12)
    assert abs(np.array(errors)).max() < 0.03 and abs(np.array(errors)).mean() < 0.008


def test_reflections_are_baked():
    """Mirrors have no radiance of their own: what they show is light."""
    black = {"sh": np.tile([[-0.5 / 0.28209479] * 3], (6, 1)), "metallic": np.ones((6, 1))}
    splats = bake(scene_of(lone_surfels(**black, roughness=np.full((6, 1), 0.3))), "scene.xml", quiet=True)
    assert (splats.colors(np.array([0.6, 0.0, 0.8])).mean(1) > 0.2).all()
    dark = bake(scene_of(lone_surfels(**black), specular="none"), "scene.xml", quiet=True)
    assert abs(dark.colors(np.array([0.6, 0.0, 0.8]))).max() < 0.01


def test_surroundings_reflect_nothing():
    """Beyond the box they have their diffuse radiance alone."""
    surfels = lone_surfels()
    splats = bake(scene_of(surfels, box="-20 -20 -20 5 20 20"), "scene.xml", quiet=True)
    alone = bake(scene_of(surfels, specular="none"), "scene.xml", quiet=True)
    beyond = splats.centers[:, 0] > 5
    assert beyond.sum() == 1
    assert (
        np.allclose(splats.harmonics[beyond], alone.harmonics[beyond])
        and abs(splats.harmonics[~beyond] - alone.harmonics[~beyond]).max() > 0.05
    )


def test_turntable_says_at_which_azimuth(capsys):
    bake(scene_of(lone_surfels(), turntable="0 0 1 0 0 0"), "a/scene.xml", quiet=True)
    assert "a/scene.xml" in (line := capsys.readouterr().err) and "azimuth 0" in line and line.count("\n") == 1


# ---- Formats ----


def same_look(read, splats, turn=np.eye(3)):
    """Whether what was read of a file, in a world turned by ``turn``, looks as ``splats``, by the textbook's harmonics."""
    centers, rotations, scales, opacities, sh = read
    assert np.allclose(centers, splats.centers @ turn.T, atol=1e-5) and np.allclose(opacities, splats.opacities, atol=1e-5)
    shapes = turn @ covariances(splats.rotations, splats.thick_scales) @ turn.T
    assert np.allclose(covariances(rotations, scales), shapes, atol=1e-5)
    assert np.allclose(scales[:, :2], splats.scales, rtol=1e-4) and (scales[:, 2] < 0.01 * scales[:, :2].min(1)).all()
    for d in fibonacci_sphere(20):
        colors = 0.5 + np.einsum("k,nkc->nc", harmonics(turn @ d), sh)
        assert np.allclose(colors, splats.colors(d), atol=1e-4)


def test_ply(tmp_path):
    splats = random_splats()
    (path,) = splat_ply.write(tmp_path, splats)
    read, names, lines = ply_splats(path)
    same_look(read, splats)
    assert lines[1] == "format binary_little_endian 1.0" and "comment SplatRenderMode: 2dgs" in lines
    assert names[names.index("scale_0") :][:3] == ["scale_0", "scale_1", "scale_2"] and "roughness" not in names


def test_gltf_shows_what_the_ply_shows(tmp_path):
    splats = random_splats()
    (path,) = gltf_splat.write(tmp_path, splats.rotated(TURN))
    read, document, fallback = glb_splats(path)
    same_look(read, splats, TURN)
    primitive = document["meshes"][0]["primitives"][0]
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"] and primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"] == {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    mean = np.clip(0.5 + 0.28209479 * read[-1][:, 0], 0, 1)
    assert np.allclose(fallback, np.column_stack([srgb_decode(mean), read[3]]), atol=1e-5)


@pytest.mark.parametrize("kernel", usd_splat.KERNELS)
def test_usd(tmp_path, kernel):
    """OpenUSD reads the same, and finds nothing to complain about."""
    pytest.importorskip("pxr", reason="needs OpenUSD: pip install usd-core")
    from pxr import Usd, UsdGeom, UsdUtils, UsdValidation, UsdVol

    splats, light = random_splats(), np.random.default_rng(0).random((8, 16, 3), np.float32)
    path, dome = usd_splat.write(tmp_path, replace(splats.rotated(TURN), origin=(1e6, 2.0, -3.0)), light, kernel)
    assert np.allclose(np.array(mi.Bitmap(str(dome))), light)
    stage = Usd.Stage.Open(str(path))
    prim = stage.GetPrimAtPath("/World/Splats")
    of = lambda name: np.array(prim.GetAttribute(name).Get())
    quaternions = prim.GetAttribute("orientations").Get()
    rotations = np.array([[*q.GetImaginary(), q.GetReal()] for q in quaternions])
    sh = of("radiance:sphericalHarmonicsCoefficients").reshape(-1, 16, 3)
    same_look((of("positions"), rotations, of("scales"), of("opacities"), sh), splats, TURN)
    assert prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == 3
    flat = prim.HasAPI(UsdVol.ParticleFieldKernelGaussianSurfletAPI)
    solid = prim.HasAPI(UsdVol.ParticleFieldKernelGaussianEllipsoidAPI)
    assert (flat, solid) == (kernel == "surflet", kernel == "ellipsoid")
    assert UsdGeom.Xformable(prim).GetLocalTransformation().ExtractTranslation() == (1e6, 2, -3)
    lowest, highest = of("extent")
    assert (lowest < of("positions").min(0)).all() and (highest > of("positions").max(0)).all()
    layers, assets, missing = UsdUtils.ComputeAllDependencies(str(path))
    assert len(layers) == 1 and [str(tmp_path / "environment.exr")] == list(assets) and not missing
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    context = UsdValidation.ValidationContext(validators)
    assert len(validators) > 5 and [error.GetMessage() for error in context.Validate(stage)] == []
    stage.ClearDefaultPrim()  # which it does complain about
    assert context.Validate(stage)


def test_usd_dome_is_the_environment():
    """By OpenUSD's words, of OpenEXR: column 0 has longitude π, the last −π; longitude 0 is +z, π/2 is +x, and +y is up."""
    from rgs_mi.shading.environment import Environment

    rows, columns = 32, 64
    light = np.random.default_rng(0).random((rows, columns, 3), np.float32)
    world = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    environment = Environment(mi.TensorXf(light), world).unfiltered()
    for row, column in ((10, 3), (20, 30), (16, 47)):
        longitude, latitude = np.pi - 2 * np.pi * (column + 0.5) / columns, np.pi / 2 - np.pi * row / (rows - 1)
        dome = np.array([np.cos(latitude) * np.sin(longitude), np.sin(latitude), np.cos(latitude) * np.cos(longitude)])
        seen = environment.eval(mi.Vector3f(*map(float, world @ dome)))
        assert np.allclose(np.array(seen).ravel(), light[row, column], atol=0.02)

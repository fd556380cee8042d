"""The Mitsuba plugins: what a user does with `mi.load_file`, `mi.traverse` and `mi.render`."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import rgs_mi
from rgs_mi.core.errors import UserError
from rgs_mi.surfels.ply import write_ply
from rgs_mi.surfels.surfels import CHANNELS, SH_0, Surfels, rotation_from_normal

from scenes import orbit_camera, sphere_surfels
from variants import VARIANT

ALL_AOVS = "depth,sh_normal,albedo,roughness,metallic,alpha,specular,diffuse"
AOV_CHANNELS = [
    "depth.T",
    "sh_normal.X",
    "sh_normal.Y",
    "sh_normal.Z",
    "albedo.R",
    "albedo.G",
    "albedo.B",
    "roughness.Y",
    "metallic.Y",
    "alpha.Y",
    "specular.R",
    "specular.G",
    "specular.B",
    "diffuse.R",
    "diffuse.G",
    "diffuse.B",
]
XML = """<scene version="3.0.0">
  <default name="file" value="object.ply"/> <default name="format" value="rgb"/> <default name="spp" value="1"/>
  <integrator type="rgs_deferred"/>
  <shape type="surfels" id="object">
    <string name="filename" value="$file"/>
    <bsdf type="principled" id="material"><float name="specular" value="0.4"/></bsdf>
  </shape>
  <emitter type="procedural_envmap" id="environment">
    <string name="name" value="constant"/> <float name="radiance" value="0.25"/> <integer name="height" value="8"/>
    <transform name="to_world"><rotate x="1" angle="90"/></transform>
  </emitter>
  <sensor type="perspective">
    <float name="fov" value="38"/>
    <transform name="to_world"><lookat origin="4, 0, 1" target="0, 0, 0" up="0, 0, 1"/></transform>
    <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
    <film type="hdrfilm">
      <integer name="width" value="24"/> <integer name="height" value="20"/>
      <string name="pixel_format" value="$format"/>
    </film>
  </sensor>
</scene>"""


@pytest.fixture
def ply(tmp_path):
    write_ply(tmp_path / "object.ply", sphere_surfels(40).numpy())
    return str(tmp_path / "object.ply")


def smooth_environment(rows=16):
    """[rows, 2 rows, 3] radiance without high frequencies; with more rows the kinks between texels are weaker."""
    theta, phi = np.linspace(0, np.pi, rows)[:, None], np.pi * (np.arange(2 * rows) + 0.5) / rows
    color = lambda k: 1 + 0.4 * np.sin(theta) * np.cos(phi + 0.3 * k) + 0.3 * np.cos(theta + 0.3 * k)
    return np.stack([color(k) for k in range(3)], -1)


def fibonacci_sphere(n):
    """[n, 3] points spread evenly over the unit sphere."""
    k = np.arange(n) + 0.5
    z, phi = 1 - 2 * k / n, np.pi * (1 + 5**0.5) * k
    return np.stack([np.sqrt(1 - z**2) * np.cos(phi), np.sqrt(1 - z**2) * np.sin(phi), z], 1)


def mirror_sphere(n, scale):
    """A closed, black metal sphere of ``n`` surfels with standard deviations ``scale``, almost a mirror."""
    x = fibonacci_sphere(n)
    full = lambda value, channels=1: np.full((n, channels), value)
    return Surfels.from_numpy(
        {
            "centers": x,
            "rotations": rotation_from_normal(x),
            "scales": full(scale, 2),
            "opacities": full(0.95),
            "sh": full(-0.5 / SH_0, 3),
            "base_color": full(1.0, 3),
            "roughness": full(0.05),
            "metallic": full(1.0),
            "delta_normal": full(0.0, 3),
        },
        two_sided=False,
    )


def surfels_dict(surfels):
    return {"type": "surfels", **{name: getattr(surfels, name) for name in CHANNELS}, "two_sided": surfels.two_sided}


def scene_dict(surfels, camera=None, integrator=None, pixel_format="rgb", texels=None, to_world=None):
    """A scene as for ``mi.load_dict``."""
    sensor = (camera or orbit_camera(size=(24, 20))).to_sensor_dict()
    sensor["film"]["pixel_format"] = pixel_format
    texels = smooth_environment() if texels is None else texels
    return {
        "type": "scene",
        "integrator": {"type": "rgs_deferred", **(integrator or {})},
        "sensor": sensor,
        "object": surfels_dict(surfels) if surfels else {"type": "surfels"},
        "environment": {
            "type": "envmap",
            "bitmap": mi.Bitmap(texels.astype(np.float32)),
            "to_world": to_world or mi.ScalarTransform4f().rotate([1, 0, 0], 90),
        },
    }


def load(*args, **kwargs):
    return mi.load_dict(scene_dict(*args, **kwargs))


def smooth_scene(**kwargs):
    """Surfels that fill the view one behind the other, far from every cut-off: the image is smooth in all parameters."""
    rng = np.random.default_rng(4)
    n = 6
    normal = np.array([0.95, 0.3, 0.2]) + 0.06 * rng.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    surfels = Surfels.from_numpy(
        {
            "centers": np.linspace(-1, 1, n)[:, None] * [0.9, 0.3, 0.2] + 0.03 * rng.normal(size=(n, 3)),
            "rotations": rotation_from_normal(normal, rng.uniform(0, 6, n)),
            "scales": rng.uniform(1.8, 2.6, (n, 2)),
            "opacities": rng.uniform(0.3, 0.6, (n, 1)),
            "sh": 0.1 * rng.normal(size=(n, 12)),
            "base_color": rng.uniform(0.3, 0.8, (n, 3)),
            "roughness": rng.uniform(0.42, 0.53, (n, 1)),
            "metallic": rng.uniform(0.3, 0.7, (n, 1)),
            "delta_normal": 0.05 * rng.normal(size=(n, 3)),
        }
    )
    return load(surfels, orbit_camera(size=(14, 12), fov=25), **kwargs)


# ---- Loading ----


def test_load_file_finds_the_ply_beside_the_scene(ply, tmp_path, monkeypatch):
    (tmp_path / "scene.xml").write_text(XML)
    monkeypatch.chdir("/")
    for parallel in (True, False):
        scene = mi.load_file(str(tmp_path / "scene.xml"), parallel=parallel)
        assert mi.render(scene).shape == (20, 24, 3)


def test_defaults_are_substituted(ply):
    scene = mi.load_string(XML, file=ply, format="rgba")
    assert mi.render(scene).shape == (20, 24, 4)
    shape = scene.shapes()[0]
    assert shape.eta == pytest.approx(2 / (1 - np.sqrt(0.08 * 0.4)) - 1, abs=1e-5)
    assert len(shape.surfels) == 40 and "count = 40" in str(scene)


def test_traverse_shows_the_physical_fields(ply):
    params = mi.traverse(mi.load_string(XML, file=ply))
    assert {f"object.{name}" for name in CHANNELS} | {"environment.data", "environment.scale"} <= set(params.keys())
    for name, expected in sphere_surfels(40).numpy().items():
        assert np.allclose(params[f"object.{name}"].numpy(), expected, atol=1e-5), name


def test_photographs_are_kept(tmp_path):
    assert mi.load_dict({"type": "surfels", "photographs": str(tmp_path)}).photographs == str(tmp_path)
    assert mi.load_dict({"type": "surfels"}).photographs == ""


def test_constant_map_to_start_from():
    emitter = mi.load_dict({"type": "procedural_envmap", "name": "constant", "radiance": 0.3, "height": 10})
    data = mi.traverse(emitter)["data"].numpy()
    assert data.shape == (10, 22, 3) and np.allclose(data, 0.3)
    with pytest.raises(RuntimeError, match="height is 1"):
        mi.load_dict({"type": "procedural_envmap", "name": "constant", "height": 1})


def test_variants(ply):
    expected = mi.render(mi.load_string(XML, file=ply)).numpy()
    for variant in ("scalar_rgb", "llvm_ad_spectral"):
        mi.set_variant(variant)
        rgs_mi.set_variant()
        np.testing.assert_allclose(mi.render(mi.load_string(XML, file=ply)).numpy(), expected, atol=1e-6)


@pytest.mark.parametrize(
    "shape, message",
    [
        ('<string name="filenam" value="x.ply"/>', "filenam"),
        ('<string name="filename" value="absent.ply"/>', "absent.ply: can't be read"),
        ('<bsdf type="diffuse"/>', "surfels need 'principled'"),
        ('<bsdf type="principled"><float name="eta" value="3.5"/></bsdf>', "eta 3.5 is not one of surfels"),
        ('<transform name="to_world"><scale value="2"/></transform>', "'to_world' is not supported"),
    ],
)
def test_bad_shapes(shape, message):
    with pytest.raises(RuntimeError, match=message):
        mi.load_string(f'<scene version="3.0.0"><shape type="surfels">{shape}</shape></scene>')


@pytest.mark.parametrize(
    "integrator, message",
    [
        ({"specula": "none"}, "specula"),
        ({"specular": "nothing"}, "unknown specular 'nothing'"),
        ({"indirect": "two"}, "unknown indirect 'two'"),
        ({"aovs": "depth,colour"}, "unknown aov 'colour'"),
    ],
)
def test_bad_integrators(integrator, message):
    with pytest.raises(Exception, match=message):
        mi.load_dict({"type": "rgs_deferred", **integrator})


def test_scenes_that_cannot_be_rendered():
    base = scene_dict(sphere_surfels(4))
    for change, message in [
        ({"environment": None}, "no environment"),
        ({"object": {"type": "surfels"}}, "no surfels"),
        ({"sensor": {"type": "orthographic"}}, "'perspective'"),
        ({"environment": {"type": "sunsky"}}, "'envmap' or 'constant'"),
    ]:
        scene = mi.load_dict({k: v for k, v in {**base, **change}.items() if v is not None})
        with pytest.raises(UserError, match=message):
            scene.integrator().render(scene)


# ---- Images ----


def test_crop_is_a_part_of_the_image():
    surfels = sphere_surfels(40)
    whole = mi.render(load(surfels)).numpy()
    scene = scene_dict(surfels)
    scene["sensor"]["film"] |= {"crop_offset_x": 5, "crop_offset_y": 3, "crop_width": 10, "crop_height": 12}
    assert np.allclose(mi.render(mi.load_dict(scene)).numpy(), whole[3:15, 5:15], atol=1e-5)


def test_pixel_formats():
    surfels = sphere_surfels(40)
    images = {
        f: mi.render(load(surfels, pixel_format=f, integrator={"hide_emitters": True})).numpy()
        for f in ("rgb", "rgba", "luminance", "luminance_alpha", "xyz", "xyza")
    }
    rgb, alpha = images["rgb"], images["rgba"][..., 3:]
    assert alpha.min() < 0.05 and alpha.max() > 0.8 and np.all(rgb[alpha[..., 0] == 0] == 0)
    y = rgb @ np.float32([0.212671, 0.715160, 0.072169])
    assert np.allclose(images["rgba"][..., :3], rgb)
    assert np.allclose(images["luminance"][..., 0], y, atol=1e-5) and np.allclose(images["xyz"][..., 1], y, atol=1e-5)
    assert np.allclose(images["luminance_alpha"], np.dstack([y, alpha]), atol=1e-5)
    assert np.allclose(images["xyza"], np.dstack([images["xyz"], alpha]))


def test_background_is_the_environment():
    surfels = sphere_surfels(40)
    texels = smooth_environment()
    shown = mi.render(load(surfels, pixel_format="rgba", texels=texels)).numpy()
    hidden = mi.render(load(surfels, pixel_format="rgba", texels=texels, integrator={"hide_emitters": True})).numpy()
    scene = scene_dict(surfels, texels=texels, integrator={"type": "path"})
    scene.pop("object")
    behind = mi.render(mi.load_dict(scene), spp=64).numpy()
    assert np.all(shown[..., 3] == 1)
    assert np.allclose(shown[..., :3], hidden[..., :3] + (1 - hidden[..., 3:]) * behind, atol=5e-3)


def test_constant_emitter_is_a_constant_map():
    surfels = sphere_surfels(40)
    scene = scene_dict(surfels)
    scene["environment"] = {"type": "constant", "radiance": {"type": "rgb", "value": [0.5, 1.0, 2.0]}}
    expected = mi.render(load(surfels, texels=np.ones((16, 32, 3)) * [0.5, 1.0, 2.0])).numpy()
    assert np.allclose(mi.render(mi.load_dict(scene)).numpy(), expected, rtol=1e-3)


def filmed(rfilter, samples=1):
    """The scene's XML with so many ``samples`` as pixels along each side of one, filtered by the element ``rfilter``."""
    width, height = (f'value="{samples * n}"' for n in (24, 20))
    return XML.replace('value="24"', width).replace('value="20"', height).replace("</film>", f"{rfilter}</film>")


def test_samples_of_a_box_are_averaged(ply):
    box = '<rfilter type="box"/>'
    scene, fine = mi.load_string(filmed(box), file=ply, spp="9"), mi.load_string(filmed(box, 3), file=ply)
    expected = mi.render(fine).numpy().reshape(20, 3, 24, 3, 3).mean((1, 3))
    for spp in (0, 5, 9):  # 5 is rounded up to a square
        assert np.allclose(mi.render(scene, spp=spp).numpy(), expected, atol=1e-5)


@pytest.mark.parametrize(
    "rfilter, stddev", [("", 0.5), ('<rfilter type="gaussian"><float name="stddev" value="0.3"/></rfilter>', 0.3)]
)
def test_the_films_filter_weighs_samples(ply, rfilter, stddev):
    """Mitsuba's own, Gaussian by default; away from the border, where a film has no samples beyond."""
    samples = mi.render(mi.load_string(filmed('<rfilter type="box"/>', 3), file=ply)).numpy()
    x = (np.arange(9) + 0.5) / 3 - 1.5  # from the middle of a pixel
    weights = np.exp(-(x**2) / (2 * stddev**2))
    weights /= weights.sum()
    windows = np.lib.stride_tricks.sliding_window_view(samples, (9, 9), (0, 1))[::3, ::3]
    expected = np.einsum("yxcij,i,j->yxc", windows, weights, weights)
    image = mi.render(mi.load_string(filmed(rfilter), file=ply, spp="9")).numpy()
    assert np.abs(image[1:-1, 1:-1] - expected).mean() < 1e-3  # samples lie in other tiles, and see surfels in another order
    assert np.abs(samples[4:-4:3, 4:-4:3] - expected).mean() > 2e-3


def test_parts_add_up():
    surfels = sphere_surfels(40)
    image = mi.render(load(surfels, integrator={"aovs": "diffuse,specular,alpha", "hide_emitters": True})).numpy()
    diffuse_only = mi.render(load(surfels, integrator={"specular": "none", "hide_emitters": True})).numpy()
    assert np.allclose(image[..., :3], image[..., 3:6] + image[..., 6:9], atol=1e-6)
    assert np.allclose(diffuse_only, image[..., 3:6], atol=1e-6)
    assert image[..., 6:9].max() > 0.1


def test_diffuse_needs_no_environment():
    scene = scene_dict(sphere_surfels(40), integrator={"specular": "none"})
    scene.pop("environment")
    assert mi.render(mi.load_dict(scene)).numpy().max() > 0.1


def test_shapes_are_one_cloud():
    arrays = sphere_surfels(40, order=2).numpy()
    whole = load(Surfels.from_numpy(arrays))
    parts = scene_dict(Surfels.from_numpy({k: v[:15] for k, v in arrays.items()}))
    rest = Surfels.from_numpy({k: v[15:] for k, v in arrays.items()})
    parts["more"] = surfels_dict(rest)
    assert np.allclose(mi.render(mi.load_dict(parts)).numpy(), mi.render(whole).numpy(), atol=1e-5)
    flat = Surfels.from_numpy({**rest.numpy(), "sh": rest.sh.numpy()[:, :3]})  # another SH order
    parts["more"]["sh"] = flat.sh
    assert mi.render(mi.load_dict(parts)).shape == (20, 24, 3)
    parts["more"]["two_sided"] = False
    with pytest.raises(UserError, match="differ in 'two_sided'"):
        mi.load_dict(parts).integrator().render(mi.load_dict(parts))


def test_aovs_are_named_channels_of_the_exr(tmp_path):
    scene = load(sphere_surfels(40), pixel_format="rgba", integrator={"aovs": ALL_AOVS})
    image = mi.render(scene).numpy()
    mi.util.write_bitmap(str(tmp_path / "image.exr"), scene.sensors()[0].film().bitmap(), write_async=False)
    bitmap = mi.Bitmap(str(tmp_path / "image.exr"))
    names = [field.name for field in bitmap.struct_()]
    assert sorted(names) == sorted(["R", "G", "B", "A", *AOV_CHANNELS])
    order = [names.index(name) for name in ["R", "G", "B", "A", *AOV_CHANNELS]]
    assert np.allclose(np.array(bitmap, np.float32)[..., order], image, rtol=2e-3, atol=1e-3)  # half precision at worst
    layers = dict(bitmap.split())
    assert set(layers) == {"<root>", *ALL_AOVS.split(",")}


def test_aovs_have_names_of_their_own():
    scene = load(sphere_surfels(40), integrator={"aovs": "dd:depth, nn:sh_normal,alpha"})
    assert scene.integrator().aov_names() == ["dd.T", "nn.X", "nn.Y", "nn.Z", "alpha.Y"]
    named, plain = (mi.render(load(sphere_surfels(40), integrator={"aovs": aovs})).numpy() for aovs in ("a:depth", "depth"))
    np.testing.assert_array_equal(named, plain)
    for aovs, message in (("a:depth,a:alpha", "two aovs are called 'a'"), ("a:", "unknown aov ''")):
        with pytest.raises(RuntimeError, match=message):
            load(sphere_surfels(40), integrator={"aovs": aovs})


def test_one_sided_surfels_vanish_from_behind():
    arrays = mirror_sphere(500, 0.09).numpy()
    behind = {k: v[arrays["centers"] @ orbit_camera().origin < -1.5] for k, v in arrays.items()}
    for two_sided, coverage in ((True, 0.9), (False, 0.0)):
        scene = load(Surfels.from_numpy(behind, two_sided), integrator={"aovs": "alpha"})
        assert mi.render(scene).numpy()[..., 3].max() == pytest.approx(coverage, abs=0.1)


def test_depth_is_distance_along_the_ray():
    camera = orbit_camera(size=(96, 80))
    scene = load(mirror_sphere(6000, 0.025), camera, integrator={"aovs": "depth,alpha"})
    depth, alpha = np.moveaxis(mi.render(scene).numpy()[28:52, 36:60, 3:], -1, 0)
    stock = scene_dict(None, camera, integrator={"type": "aov", "aovs": "d:depth"})
    stock["object"] = {"type": "sphere"}
    stock["sensor"]["near_clip"] = 1e-4  # Mitsuba's rays, and so its depth, begin there
    expected = mi.render(mi.load_dict(stock), spp=64).numpy()[28:52, 36:60, -1]
    assert np.allclose(depth / alpha, expected, atol=0.003)


# ---- Shapes ----


def test_rays_pass_without_proxies():
    scene = load(sphere_surfels(40))
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(0, 0, 5), mi.Vector3f(0, 0, -1)))
    assert not dr.any(si.is_valid())
    centers = sphere_surfels(40).centers.numpy()
    box = scene.shapes()[0].bbox()
    assert np.all(np.array(box.min) < centers.min(0)) and np.all(np.array(box.max) > centers.max(0))
    params = mi.traverse(scene)
    params["object.centers"] = params["object.centers"] + 10
    params.update()
    assert np.allclose(scene.shapes()[0].bbox().min, np.array(box.min) + 10, atol=1e-4)


def test_proxies_are_hit():
    surfels = mirror_sphere(40, 0.05)
    scene = scene_dict(surfels)
    scene["object"]["proxies"] = True
    scene = mi.load_dict(scene)

    def hit(offset):
        c = surfels.column(mi.Point3f, "centers")
        return scene.ray_intersect(mi.Ray3f(c * 1.5 + offset, -c))  # towards the centre of the sphere

    si = hit(0)
    assert np.array_equal((si.prim_index // 2).numpy(), np.arange(40)) and np.allclose(si.t.numpy(), 0.5, atol=0.1)
    params = mi.traverse(scene)
    params["object.centers"] = params["object.centers"] + 10
    params.update()
    assert np.array_equal((hit(10).prim_index // 2).numpy(), np.arange(40))
    assert not dr.any(hit(0).is_valid())


def test_lengths_must_agree():
    params = mi.traverse(load(sphere_surfels(10)))
    params["object.centers"] = mi.TensorXf(np.zeros((7, 3), np.float32))
    with pytest.raises(UserError, match="centers 7, rotations 10"):
        params.update()
    with pytest.raises(RuntimeError, match="centers 10, rotations 0"):
        mi.load_dict({"type": "surfels", "centers": sphere_surfels(10).centers})
    with pytest.raises(RuntimeError, match=r"'sh' has shape \(10, 5\)"):
        load(Surfels.from_numpy({**sphere_surfels(10).numpy(), "sh": np.zeros((10, 5))}))


def test_surfels_may_be_added():
    scene = load(sphere_surfels(10))
    params = mi.traverse(scene)
    more = sphere_surfels(25, seed=1)
    for name in CHANNELS:
        params[f"object.{name}"] = getattr(more, name)
    params.update()
    assert np.allclose(mi.render(scene).numpy(), mi.render(load(more)).numpy(), atol=1e-6)
    for name in CHANNELS:
        dr.enable_grad(params[f"object.{name}"])
    dr.backward(dr.mean(mi.render(scene, params), axis=None))
    for name in CHANNELS:
        gradient = dr.grad(params[f"object.{name}"])
        assert gradient.shape == getattr(more, name).shape and dr.any(gradient != 0, axis=None), name


# ---- Gradients ----

KEYS = [f"object.{name}" for name in CHANNELS] + ["environment.data", "environment.scale"]


def weights(image):
    return np.random.default_rng(1).normal(size=image.shape).astype(np.float32)


def backward_gradients(scene):
    params = mi.traverse(scene)
    for key in KEYS:
        dr.enable_grad(params[key])
    image = mi.render(scene, params, spp=1)
    dr.backward(dr.sum(image * mi.TensorXf(weights(image)), axis=None))
    gradients = {key: dr.grad(params[key]).numpy().astype(np.float64) for key in KEYS}
    for key in KEYS:
        dr.disable_grad(params[key])
    return gradients


@pytest.fixture(scope="module")
def smooth():
    """A smooth scene with all AOVs, and its gradients."""
    rgs_mi.set_variant(VARIANT)
    scene = smooth_scene(pixel_format="rgba", integrator={"aovs": ALL_AOVS}, texels=smooth_environment(64))
    return scene, backward_gradients(scene)


@pytest.mark.parametrize("key", KEYS)
def test_backward_equals_finite_differences(key, smooth):
    scene, gradients = smooth
    params = mi.traverse(scene)
    base = dr.detach(params[key]).numpy().astype(np.float64)
    direction = np.random.default_rng(2).normal(size=base.shape)
    if key == "environment.data":
        direction[:, [0, -1]] = 0  # copies that Mitsuba makes

    def value(step):
        params[key] = type(params[key])((base + step * direction).astype(np.float32))
        params.update()
        image = mi.render(scene, spp=1).numpy()
        return (image.astype(np.float64) * weights(image)).sum()

    curved = key.removeprefix("object.") in ("centers", "rotations", "roughness", "delta_normal", "opacities")
    h = 3e-3 if curved else 5e-2 if key.startswith("environment") else 1e-2
    central = lambda h: (value(h) - value(-h)) / (2 * h)
    expected = (4 * central(h) - central(2 * h)) / 3  # Richardson
    value(0)
    measured = (gradients[key] * direction).sum()
    size = np.linalg.norm(gradients[key]) * np.linalg.norm(direction)
    rounded = 1e-3 if VARIANT.startswith("llvm") else 4e-3  # a GPU's divisions, roots and exponentials are approximate
    bound = 5e-3 if key == "object.rotations" else rounded  # reflections pass kinks between texels of the light
    assert abs(measured - expected) < bound * max(abs(expected), 0.05 * size)


def test_forward_equals_backward(smooth):
    scene, gradients = smooth
    params, rng = mi.traverse(scene), np.random.default_rng(3)
    expected = 0.0
    for key in KEYS:
        tangent = rng.normal(size=gradients[key].shape).astype(np.float32)
        expected += (tangent * gradients[key]).sum()
        dr.enable_grad(params[key])
        dr.set_grad(params[key], type(params[key])(tangent))
    image = mi.render(scene, params, spp=1)
    tangent = dr.forward_to(image).numpy()
    for key in KEYS:
        dr.disable_grad(params[key])
    assert (tangent.astype(np.float64) * weights(image)).sum() == pytest.approx(expected, rel=1e-3)


def test_gradients_are_averaged_over_samples(smooth):
    scene, _ = smooth
    params = mi.traverse(scene)
    dr.enable_grad(params["object.base_color"])
    image = mi.render(scene, params, spp=4)
    dr.backward(dr.sum(image[:, :, :3], axis=None))
    fine = dr.grad(params["object.base_color"]).numpy()
    dr.set_grad(params["object.base_color"], 0)
    dr.backward(dr.sum(mi.render(scene, params, spp=1)[:, :, :3], axis=None))
    coarse = dr.grad(params["object.base_color"]).numpy()
    dr.disable_grad(params["object.base_color"])
    assert np.allclose(fine, coarse, rtol=0.02)


def test_environment_change_is_seen(smooth):
    scene, _ = smooth
    params = mi.traverse(scene)
    before, scale = mi.render(scene).numpy(), float(params["environment.scale"][0])
    params["environment.scale"] = 2 * scale
    params.update()
    after = mi.render(scene).numpy()
    params["environment.scale"] = scale
    params.update()
    specular = slice(4 + 10, 4 + 13)
    assert np.allclose(after[..., specular], 2 * before[..., specular], rtol=1e-4)
    assert np.allclose(mi.render(scene).numpy(), before)


def test_optimisation_with_nothing_but_mitsuba():
    target = mi.render(smooth_scene())
    scene = smooth_scene()
    params = mi.traverse(scene)
    start = {"object.base_color": 0.5, "object.metallic": 0.5, "environment.data": 1.0}
    optimizer = mi.ad.Adam(lr=0.03)
    for key, value in start.items():
        optimizer[key] = dr.full(mi.TensorXf, value, params[key].shape)
    params.update(optimizer)
    losses = []
    for _ in range(40):
        loss = dr.mean(dr.square(mi.render(scene, params, spp=1) - target), axis=None)
        dr.backward(loss)
        optimizer.step()
        for key in start:
            optimizer[key] = dr.clip(optimizer[key], 0.01, 1 if key.startswith("object") else 100)
        params.update(optimizer)
        losses.append(float(loss.array[0]))
    assert losses[-1] < 0.02 * losses[0]


def test_gradients_reach_what_parameters_are_made_of():
    scene = smooth_scene()
    params = mi.traverse(scene)
    x = {
        "object.metallic": mi.TensorXf(np.zeros((6, 1), np.float32)),
        "environment.data": mi.TensorXf(np.zeros(params["environment.data"].shape, np.float32)),
    }
    dr.enable_grad(x)
    for key, value in x.items():
        params[key] = dr.exp(value - 0.5)
    params.update()
    dr.backward(dr.sum(mi.render(scene, params, spp=1), axis=None))
    metallic, data = (dr.grad(value).numpy() for value in x.values())
    assert np.all(metallic != 0)
    assert (data[:, 1:-1] != 0).any() and not data[:, [0, -1]].any()  # Mitsuba overwrites the outer columns


# ---- Orientation ----


@pytest.mark.parametrize("row, column", [(16, 12), (22, 30), (12, 20)])
def test_reflections_lie_where_mitsuba_sees_them(row, column):
    texels = np.full((32, 64, 3), 0.02)
    texels[row - 1 : row + 2, column - 1 : column + 2] = 5
    to_world = mi.ScalarTransform4f().rotate([2 / 3, -1 / 3, 2 / 3], 70)
    setting = dict(camera=orbit_camera(size=(48, 48), fov=32), texels=texels, to_world=to_world, pixel_format="rgba")
    mine = scene_dict(mirror_sphere(30000, 0.011), integrator={"hide_emitters": True}, **setting)
    stock = scene_dict(None, integrator={"type": "path", "hide_emitters": True, "max_depth": 2}, **setting)
    stock["object"] = {
        "type": "sphere",
        "bsdf": {"type": "principled", "base_color": {"type": "rgb", "value": 1.0}, "roughness": 0.05, "metallic": 1.0},
    }
    grid, centroid, power = np.indices((48, 48)), [], []
    for scene, spp in ((mine, 16), (stock, 64)):
        image = mi.render(mi.load_dict(scene), spp=spp).numpy()
        weight = np.maximum(image[..., :3].mean(-1) / np.maximum(image[..., 3], 0.1) - 0.2, 0)
        power.append(weight.sum())
        centroid.append((grid * weight).sum((1, 2)) / weight.sum())
    assert np.linalg.norm(centroid[0] - centroid[1]) < 0.2  # pixels
    assert power[0] == pytest.approx(power[1], rel=0.05)

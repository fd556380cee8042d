"""Tables, prefilter and split-sum against independent integrals of Mitsuba's principled BSDF."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rgs_mi.shading import deferred, prefilter, split_sum, tables
from rgs_mi.shading.environment import Environment
from rgs_mi.shading.lighting import Lighting
from rgs_mi.surfels.surfels import CHANNELS, Surfels

from scenes import layered_surfels, orbit_camera


def unit(rng, n):
    d = rng.normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def vector(array):
    return mi.Vector3f(np.ascontiguousarray(np.asarray(array, np.float32).T))


@pytest.mark.parametrize("roughness", [0.3, 0.5, 0.8])
@pytest.mark.parametrize("cosine", [0.15, 0.6, 1.0])
@pytest.mark.parametrize("metallic, base_color", [(0.0, 0.0), (1.0, 0.0), (1.0, 0.7)])
def test_albedo_equals_bsdf_sampling(roughness, cosine, metallic, base_color):
    """The table against the BSDF's own sampling routine, by its standard error."""
    n = 1 << 18
    bsdf = tables.principled(roughness, metallic, base_color, 1.5)
    wi = mi.Vector3f(float(np.sqrt(1 - cosine**2)), 0, cosine) + dr.zeros(mi.Vector3f, n)
    rng = mi.PCG32(size=n)
    sample, weight = bsdf.sample(
        mi.BSDFContext(), tables.interaction(wi), rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
    )
    weight = dr.select(sample.pdf > 0, weight.x, 0).numpy()
    one = lambda v: mi.Float(v)
    mine = split_sum.albedo(one(cosine), one(roughness), one(metallic), mi.Color3f(base_color), one(0.5))[0].x[0]
    error = weight.std() / np.sqrt(n)
    assert abs(mine - weight.mean()) < 4 * error + 0.004  # and what bilinear interpolation of the table may cost


def test_shipped_albedos_are_those_of_the_plugin():
    """Also between the nodes of specular."""
    nodes = tables.specular_nodes()
    between = ((np.sqrt(nodes[:-1]) + np.sqrt(nodes[1:])) / 2) ** 2
    expected = tables.integrated(between[4::5])
    cosines, roughnesses = (
        mi.Float(v.ravel()) for v in np.meshgrid(tables.cosine_nodes(), tables.roughness_nodes(), indexing="ij")
    )
    shape = tables.COSINES, tables.ROUGHNESSES
    for specular, table in zip(between[4::5], expected):
        found = tables.dielectric(cosines, roughnesses, mi.Float(specular)).numpy().reshape(shape)
        np.testing.assert_allclose(found, table, rtol=0.012, atol=3e-4)
    for k, table in zip((tables.BLACK, tables.WHITE, tables.DIFFUSE), expected[-3:]):
        np.testing.assert_allclose(tables.albedos(cosines, roughnesses, [k])[0].numpy().reshape(shape), table, atol=2e-4)


def test_specular_is_another_scale_for_the_index_of_refraction():
    bsdf = lambda **more: mi.load_dict({"type": "principled", **more})
    for specular in (0.1, 0.5, 0.9):
        eta = tables.eta_of(specular)
        assert tables.specular_of(eta) == pytest.approx(specular)
        one, other = bsdf(specular=specular), bsdf(eta=eta)
        si, wo = tables.interaction(mi.Vector3f(0.6, 0, 0.8)), mi.Vector3f(-0.6, 0, 0.8)
        assert one.eval(mi.BSDFContext(), si, wo).x[0] == pytest.approx(other.eval(mi.BSDFContext(), si, wo).x[0], rel=1e-4)


def test_the_derivative_by_specular():
    rng = np.random.default_rng(0)
    cosine, roughness = (mi.Float(rng.uniform(low, 1, 2000)) for low in (0.02, 0))
    total = lambda s: dr.sum(split_sum.albedo(cosine, roughness, mi.Float(0.2), mi.Color3f(0.3), s)[0].x)
    x = mi.Float(0.62)
    dr.enable_grad(x)
    dr.backward(total(x))
    assert dr.grad(x)[0] == pytest.approx(100 * (total(mi.Float(0.625)) - total(mi.Float(0.615)))[0], rel=0.01)


def test_prefilter_is_the_lobe_integral():
    """Against a direct quadrature over the sphere, without Fourier space, at every level."""
    rng = np.random.default_rng(0)
    rows, columns = 16, 32
    texels = rng.uniform(0, 1, (rows, columns, 3)).astype(np.float32) ** 3
    operator = prefilter.prefilter(rows, columns, mi.variant())
    levels = np.split(operator.apply(texels), operator.offsets[1:].astype(int))
    fine = 40
    theta = (np.arange(rows * fine * 2) + 0.5) / (rows * fine * 2) * np.pi
    phi = (np.arange(columns * fine) + 0.5) / (columns * fine) * 2 * np.pi
    t, p = np.meshgrid(theta, phi, indexing="ij")
    d = np.stack([np.sin(t) * np.sin(p), np.cos(t), -np.sin(t) * np.cos(p)], -1).reshape(-1, 3)
    environment = Environment(mi.TensorXf(texels), np.eye(3)).filtered()
    radiance = environment.eval(vector(d)).numpy().T
    weight = np.sin(t).ravel()
    for (roughness, _), (r, c), level in zip(prefilter.LEVELS[1:], operator.maps[1:], levels[1:]):
        for i, j in [(0, 0), (r // 3, c // 2), (r // 2, 1), (r - 2, c - 1)]:
            a, b = np.pi * i / (r - 1), 2 * np.pi * (j + 0.5) / c
            axis = np.array([np.sin(a) * np.sin(b), np.cos(a), -np.sin(a) * np.cos(b)])
            angle = np.arccos(np.clip(d @ axis, -1, 1))
            kernel = np.where(angle < np.pi / 2, tables.lobe(roughness, np.minimum(angle, np.pi / 2)), 0) * weight
            if kernel.max() / kernel.sum() > 2e-3:
                continue  # the quadrature, not the filter, is too coarse for this lobe
            expected = (kernel[:, None] * radiance).sum(0) / kernel.sum()
            assert np.allclose(level.reshape(r, c, 3)[i, j], expected, atol=0.01), (roughness, i, j)


@pytest.mark.parametrize("rows", [16, 33, 64])
def test_prefilter_transpose_and_constants(rows):
    rng = np.random.default_rng(rows)
    operator = prefilter.prefilter(rows, 2 * rows, mi.variant())
    x = rng.normal(size=(rows, 2 * rows, 3)).astype(np.float32)
    y = rng.normal(size=(operator.texels, 3)).astype(np.float32)
    forward = (y.astype(np.float64) * operator.apply(x)).sum()
    backward = (x.astype(np.float64) * operator.transpose(y)).sum()
    assert forward == pytest.approx(backward, rel=1e-4, abs=1e-3)
    assert np.allclose(operator.apply(np.full_like(x, 2.5)), 2.5, atol=1e-4)


def test_environment_equals_the_envmap_emitter():
    """Orientation and interpolation, the seam included, for a map that is turned. (At the very poles any longitude is
    right, and the texels of a pole's row differ.)"""
    rng = np.random.default_rng(1)
    texels = rng.uniform(0, 1, (16, 32, 3)).astype(np.float32)
    emitter = mi.load_dict(
        {
            "type": "envmap",
            "bitmap": mi.Bitmap(texels),
            "scale": 1.5,
            "to_world": mi.ScalarTransform4f().rotate([0.6, 0.8, 0], 90).rotate([0, 1, 0], 40),
        }
    )
    environment = Environment.from_emitter(emitter)
    d = vector(np.concatenate([unit(rng, 4000), environment.rotation.T[[0, 2]], -environment.rotation.T[[0, 2]]]))
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(d))
    si.wi = -d
    assert np.allclose(environment.filtered().eval(d).numpy(), emitter.eval(si).numpy(), atol=texture_error())


def texture_error():
    """Of what Mitsuba interpolates between texels of [0, 1.5]: a GPU's texture units do it with eight bits."""
    return 2e-4 if mi.variant().startswith("llvm") else 2**-7


def test_a_finer_environment_is_the_same():
    """Its texels are what Mitsuba's emitter shows there. (At the poles all texels of a row lie in one direction.)"""
    texels = np.random.default_rng(3).uniform(0, 1, (16, 32, 3)).astype(np.float32)
    finer = Environment(mi.TensorXf(texels), np.eye(3)).finer().texels.numpy()
    assert finer.shape == (32, 64, 3)
    theta, phi = np.meshgrid(np.pi * np.arange(32) / 31, 2 * np.pi * (np.arange(64) + 0.5) / 64, indexing="ij")
    d = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], -1)[1:-1]
    si = dr.zeros(mi.SurfaceInteraction3f, d.size // 3)
    si.wi = -vector(d.reshape(-1, 3))
    shown = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(texels)}).eval(si).numpy().T
    np.testing.assert_allclose(finer[1:-1], shown.reshape(d.shape), atol=texture_error())


@pytest.mark.parametrize("entry", [5, 15, 24])
def test_gradients_equal_finite_differences(entry):
    """Of the shaded image in the environment and every field. All roughness lies in the middle between two ``entry`` of the
    table, which is also between two levels of the prefilter: there are no kinks near."""
    rng = np.random.default_rng(2)
    camera = orbit_camera(size=(20, 20))
    surfels = layered_surfels(camera, seed=0)
    theta, phi = np.meshgrid(np.linspace(0, np.pi, 128), np.arange(256) / 256 * 2 * np.pi, indexing="ij")
    smooth = 0.6 + 0.3 * np.sin(theta) * np.sin(phi) + 0.1 * np.cos(2 * theta)  # bilinear lookups have kinks at texels
    base = surfels.numpy() | {
        "roughness": np.full((len(surfels), 1), (entry + 0.5) / (tables.ROUGHNESSES - 1), np.float32),
        "texels": np.stack([smooth, smooth**2, 1 / smooth], -1).astype(np.float32),
    }
    weights = rng.uniform(0.5, 1.5, (3, 400)).astype(np.float32)  # of one sign, or what they add would cancel

    def render(arrays):
        surfels = Surfels.from_numpy(arrays)
        texels = mi.TensorXf(arrays["texels"])
        for value in [*(getattr(surfels, n) for n in CHANNELS), texels]:
            dr.enable_grad(value)
        estimator = split_sum.SplitSum(Environment(texels, np.eye(3)).filtered())
        image = deferred.render(surfels, camera, Lighting(estimator))
        return image, surfels, texels

    image, surfels, texels = render(base)
    dr.backward(sum(dr.sum(c * mi.Float(w)) for c, w in zip(image.color, weights)))
    for name in ("texels", "base_color", "roughness", "metallic", "delta_normal", "curvature", "sh"):
        gradient = dr.grad(texels if name == "texels" else getattr(surfels, name)).numpy().astype(np.float64)
        # Uphill in every number, or what they add would cancel and leave the kinks between table entries to compare
        direction = np.copysign(rng.normal(size=gradient.shape), gradient) * max(np.abs(base[name]).mean(), 0.3)
        moved = lambda h: render(base | {name: base[name] + h * direction})[0].color.numpy().astype(np.float64)
        value = lambda h: (moved(h) * weights).sum()
        central = lambda h: (value(h) - value(-h)) / (2 * h)
        expected = (4 * central(1e-3) - central(2e-3)) / 3
        kinked = name in ("delta_normal", "curvature", "roughness")  # between cosines; a hundredth of the others
        rel = 1e-2 if kinked else 1e-3
        assert (gradient * direction).sum() == pytest.approx(expected, rel=rel), name

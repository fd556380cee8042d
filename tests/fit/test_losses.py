"""Losses against NumPy twins, and their gradients against finite differences."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import ndimage

from rgs_mi.core.arrays import as_float as aligned
from rgs_mi.core.camera import Camera
from rgs_mi.core.color import srgb_encode
from rgs_mi.fit import losses
from rgs_mi.splat.gbuffer import GBuffer, render_gbuffer
from rgs_mi.splat.tiles import Cutoffs
from rgs_mi.surfels.surfels import Surfels, rotation_from_normal

from scenes import orbit_camera, sphere_surfels

SIZE = (23, 17)  # width, height


def images(seed):
    rng = np.random.default_rng(seed)
    return [rng.uniform(0, 0.9, (SIZE[1], SIZE[0], 3)).astype(np.float32) for _ in range(2)]


def lanes(image):
    return mi.Color3f(np.ascontiguousarray(image.reshape(-1, 3).T))


def ssim_twin(x, y):
    kernel = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    kernel /= kernel.sum()
    blur = lambda v: ndimage.correlate1d(ndimage.correlate1d(v, kernel, 0, mode="constant"), kernel, 1, mode="constant")
    mx, my = blur(x), blur(y)
    vx, vy, c = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    return (((2 * mx * my + 1e-4) * (2 * c + 9e-4)) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))).mean(-1)


def test_ssim_equals_its_twin():
    x, y = images(0)
    expected = ssim_twin(x.astype(float), y.astype(float)).ravel()
    mine = losses.ssim(lanes(x), lanes(y), SIZE).numpy()
    np.testing.assert_allclose(mine, expected, atol=1e-4)
    assert mine.mean() == pytest.approx(expected.mean(), abs=1e-5)
    np.testing.assert_allclose(losses.ssim(lanes(x), lanes(x), SIZE).numpy(), 1, atol=1e-5)


def test_photometric_gradient():
    x, y = images(1)
    direction = np.random.default_rng(2).normal(size=x.shape)
    image = lanes(x)
    dr.enable_grad(image)
    dr.backward(dr.mean(losses.photometric(image, lanes(y), SIZE, 0.3)))
    gradient = dr.grad(image).numpy().T.reshape(x.shape).astype(np.float64)
    loss = lambda z: 0.7 * np.abs(z - y).mean() + 0.15 * (1 - ssim_twin(z, y.astype(float)).mean())
    value = lambda h: loss(x + h * direction)
    assert (gradient * direction).sum() == pytest.approx((value(1e-5) - value(-1e-5)) / 2e-5, rel=2e-3)


def test_saturated_photographs_accept_anything_brighter():
    x, y = images(3)
    y[:, :5], x[:, :5] = 1.0, 3.0  # a highlight that the photograph clips
    x[:, 5:10] = 1.4  # too bright where the photograph is not clipped: must be felt
    image = lanes(x)
    dr.enable_grad(image)
    dr.backward(dr.mean(losses.photometric(image, lanes(y), SIZE, 0.0)))
    gradient = dr.grad(image).numpy().T.reshape(x.shape)
    assert np.all(gradient[:, :5] == 0) and np.all(gradient[:, 5:10] > 0)


def test_display_is_the_srgb_curve_of_the_straight_colour():
    color, alpha = np.array([0.0, 0.001, 0.2, 0.5]), np.array([1.0, 1.0, 0.5, 0.0])
    value = losses.display(mi.Color3f(mi.Float(color)), mi.Float(alpha), 1.0).numpy()[0]
    assert np.allclose(value, [0, srgb_encode(0.001), srgb_encode(0.4) * 0.5 + 0.5, 1], atol=1e-5)


def test_depth_normals_agree_on_a_smooth_surface():
    """A densely covered sphere: depth normals are its normals, whichever way the camera turns."""
    surfels = sphere_surfels(4000, scale=1.0, opacity_shift=3)
    arrays = surfels.numpy()
    arrays |= {
        "rotations": rotation_from_normal(arrays["centers"]),
        "delta_normal": 0 * arrays["delta_normal"],
        "curvature": 0 * arrays["curvature"],
    }
    camera = orbit_camera(size=(96, 96))
    good = losses.depth_normal_consistency(render_gbuffer(Surfels.from_numpy(arrays, two_sided=False), camera), camera)[0]
    tilted = arrays | {"delta_normal": np.full((4000, 3), 0.7, np.float32)}
    bad = losses.depth_normal_consistency(render_gbuffer(Surfels.from_numpy(tilted, two_sided=False), camera), camera)[0]
    assert 0 <= good < 0.01 < bad


def test_nothing_covered_costs_nothing():
    surfels, camera = sphere_surfels(5), orbit_camera(size=(32, 32))
    arrays = surfels.numpy()
    arrays["centers"] = arrays["centers"] + 100
    gbuffer = render_gbuffer(Surfels.from_numpy(arrays), camera)
    assert losses.depth_normal_consistency(gbuffer, camera)[0] == 0
    assert losses.normal_smoothness(gbuffer, np.ones((32, 32), bool))[0] == 0


@pytest.mark.parametrize("crease", [0.0, 0.1])
def test_normal_smoothness_equals_numpy(crease):
    """Pairs of covered pixels, both of them smooth, in both directions."""
    surfels, camera = sphere_surfels(400, scale=1.0, opacity_shift=3), orbit_camera(size=(48, 40))
    gbuffer = render_gbuffer(surfels, camera)
    image = lambda v: v.numpy().T.reshape(40, 48, -1)
    normal, alpha, roughness = (image(v) for v in (gbuffer.all.normal, gbuffer.all.alpha, gbuffer.all.roughness))
    covered = np.pad(alpha[..., 0] > 0.5, 1)
    inner = covered[1:-1, 1:-1] & covered[:-2, 1:-1] & covered[2:, 1:-1] & covered[1:-1, :-2] & covered[1:-1, 2:]
    inner[[0, -1]] = inner[:, [0, -1]] = False
    smooth = (roughness <= 0.5 * alpha)[..., 0]
    limited = lambda d2: d2 / (1 + d2 / crease**2) if crease else d2
    pairs = np.concatenate(
        [
            limited(((np.roll(normal, -1, axis) - normal) ** 2).sum(-1))[inner & smooth & np.roll(smooth, -1, axis)]
            for axis in (0, 1)
        ]
    )
    expected = 2 * pairs.mean()
    assert len(pairs) > 100
    assert losses.normal_smoothness(gbuffer, smooth, crease)[0] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(
    "loss",
    [
        losses.depth_normal_consistency,
        lambda gbuffer, camera: losses.normal_smoothness(gbuffer, np.ones((40, 48), bool), 0.3),
    ],
    ids=["consistency", "smoothness"],
)
def test_gradients_by_neighbours_equal_finite_differences(loss):
    surfels, camera = sphere_surfels(400, scale=1.0, opacity_shift=3), orbit_camera(size=(48, 40))
    image = render_gbuffer(surfels, camera).image.numpy().astype(np.float32)
    value = lambda numbers: loss(GBuffer(camera.size, numbers, mi.Bool(True)), camera)
    leaf = mi.Float(image)
    dr.enable_grad(leaf)
    dr.backward(value(leaf))
    gradient = dr.grad(leaf).numpy().astype(np.float64)
    alpha = image.reshape(-1, 16)[:, 12]
    counted = np.repeat((alpha == 0) | (np.abs(alpha - 0.5) > 0.05), 16)  # no step takes a pixel over the bound
    direction = np.where(counted, np.sign(gradient) * np.random.default_rng(0).uniform(0.5, 1, len(image)), 0)
    h = 1e-4
    ahead, behind = (float(value(mi.Float(image + k * h * direction.astype(np.float32)))[0]) for k in (1, -1))
    assert np.abs(gradient).max() > 0
    assert (ahead - behind) / (2 * h) == pytest.approx((gradient * direction).sum(), rel=5e-3)


def test_minimum_variation_equals_numpy():
    """Value and gradient, on a cylinder that wobbles, with an edge."""
    width, height, apart, rng = 120, 50, 2, np.random.default_rng(5)
    angle = np.linspace(0, 0.8, width) + 0.7 * (np.arange(width) > 75) + rng.normal(0, 0.01, (height, width))
    image = rng.random((height, width, 16))
    image[..., 3:6] = 1.5 * np.stack([np.sin(angle), rng.normal(0, 0.01, angle.shape), np.cos(angle)], -1)
    reflective, reflectance = rng.random((height, width)) > 0.1, 0.04 + 0.96 * image[..., 10]

    def twin(image):
        N = image[..., 3:6] / np.linalg.norm(image[..., 3:6], axis=-1, keepdims=True)
        total = count = 0
        for y, x in np.ndindex(height, width):
            for dy, dx in ((0, apart), (apart, 0)):
                inside = dy <= y < height - dy and dx <= x < width - dx and (y % 2, x % 2) == (1, 0)
                if inside and reflective[y, x] and reflective[y - dy, x - dx] and reflective[y + dy, x + dx]:
                    d2 = ((N[y + dy, x + dx] - 2 * N[y, x] + N[y - dy, x - dx]) ** 2).sum()
                    total += reflectance[y, x] * d2 / (1 + d2 / 0.015**2)
                    count += 1
        return total / count

    maps = aligned(image)
    dr.enable_grad(maps)
    gbuffer = GBuffer((width, height), maps, seen=None)
    value = losses.minimum_variation(gbuffer, reflective, corner=(1, 0))
    dr.backward(value)
    assert value[0] == pytest.approx(twin(image), rel=1e-4)
    along = rng.normal(size=image.shape)
    change = (twin(image + 1e-6 * along) - twin(image - 1e-6 * along)) / 2e-6
    assert (dr.grad(maps).numpy() * along.ravel()).sum() == pytest.approx(change, rel=1e-3)
    assert losses.minimum_variation(gbuffer, np.zeros_like(reflective))[0] == 0


def test_distortion_is_the_sum_over_pairs():
    """Three wide surfels, one behind the other, turned to the camera."""
    camera = Camera.look_at([0, 0, -4], [0, 0, 0], [0, 1, 0], 30, (8, 8))
    z, opacity = np.array([-0.3, 0.1, 0.2]), np.array([0.3, 0.5, 0.9])
    fields = sphere_surfels(3).numpy() | {
        "centers": np.stack([0 * z, 0 * z, z], 1),
        "rotations": rotation_from_normal(np.tile([0.0, 0, -1], (3, 1))),
        "scales": np.full((3, 2), 1e3),
        "opacities": opacity[:, None],
    }
    maps = render_gbuffer(Surfels.from_numpy(fields), camera, full=True).all
    w = opacity * np.concatenate([[1], np.cumprod(1 - opacity)[:-1]])
    expected = (w[:, None] * w * (z[:, None] - z) ** 2).sum()
    assert losses.distortion(maps, extent=2.0)[0] == pytest.approx(expected / 4, rel=1e-3)


def test_delta_normal_is_its_mean_length():
    surfels, camera = sphere_surfels(50), orbit_camera(size=(32, 32))
    gbuffer = render_gbuffer(surfels, camera, full=True)
    expected = np.linalg.norm(gbuffer.all.delta_normal.numpy(), axis=0).mean()
    assert losses.delta_normal(gbuffer)[0] == pytest.approx(expected, rel=1e-5)


# ---- The depth prior ----


def depths(seed, n=400):
    """Rendered depths, a prior correlated with them, and where both are known."""
    rng = np.random.default_rng(seed)
    depth = 4 + 0.3 * rng.normal(size=n)
    return depth, 17 - 5 * depth + rng.normal(size=n), rng.random(n) < 0.7


def pearson(depth, prior, valid, **options):
    """(value, gradient) of the loss."""
    depth = aligned(depth)
    dr.enable_grad(depth)
    loss = losses.pearson_depth(depth, aligned(prior), aligned(valid) > 0, **options)
    dr.backward(loss)
    return loss[0], dr.grad(depth).numpy()


@pytest.mark.parametrize("inverse", [False, True])
def test_pearson_depth_equals_numpy_and_finite_differences(inverse):
    depth, prior, valid = depths(0)

    def twin(z):
        return 1 - np.corrcoef(1 / z[valid] if inverse else z[valid], prior[valid])[0, 1]

    noise = np.where(valid, 0, np.nan)  # what is unknown must not matter, whatever it is
    value, gradient = pearson(depth + noise, prior + noise, valid, inverse=inverse)
    assert value == pytest.approx(twin(depth), abs=1e-5)
    direction = np.random.default_rng(1).normal(size=depth.shape)
    difference = (twin(depth + 1e-5 * direction) - twin(depth - 1e-5 * direction)) / 2e-5
    assert (gradient * direction).sum() == pytest.approx(difference, rel=1e-3)
    assert np.all(gradient[~valid] == 0)


@pytest.mark.parametrize("scale, shift", [(3.0, 0.0), (1e-3, 0.5), (40.0, 1000.0)])
def test_pearson_depth_knows_neither_scale_nor_shift(scale, shift):
    depth, prior, valid = depths(2, 50_000)
    reference, _ = pearson(depth, prior, valid)
    assert pearson(scale * depth + shift, prior, valid)[0] == pytest.approx(reference, abs=2e-4)
    assert pearson(depth, scale * prior + shift, valid)[0] == pytest.approx(reference, abs=2e-4)
    assert pearson(depth, scale * depth + shift, valid)[0] == pytest.approx(0, abs=1e-5)
    assert pearson(depth, 1 / depth, valid, inverse=True)[0] == pytest.approx(0, abs=1e-5)


@pytest.mark.parametrize("case", ["flat depth", "flat up to rounding", "flat prior", "none", "one", "no prior"])
def test_pearson_depth_of_nothing_is_nothing(case):
    depth, prior, valid = depths(3, 100_000)
    if case == "flat depth":
        depth[:] = 4.1
    elif case == "flat up to rounding":
        depth = 4.1 * (1 + 1e-7 * np.sign(depth - 4))
    elif case == "flat prior":
        prior[:] = 0.3
    elif case == "no prior":
        prior[:] = np.nan
    else:
        valid[:] = False
        valid[: 1 if case == "one" else 0] = True
    for inverse in (False, True):
        value, gradient = pearson(depth, prior, valid, inverse=inverse)
        assert value == 0 and np.all(gradient == 0)


def test_pearson_depth_compiles_once():
    pearson(*depths(0))
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        depth, prior, valid = depths(4)
        pearson(depth, prior, valid & (np.arange(400) > 100))
        pearson(*depths(5, 333))
        history = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    assert len(history) > 5 and all(k["cache_hit"] for k in history)


def environment_total_variation_twin(x):
    """Derivatives of log radiance ``x`` [rows, columns, 3] on the sphere, one after another."""
    rows, columns, _ = x.shape
    polar, azimuthal = np.pi / (rows - 1), 2 * np.pi / columns
    total = 0
    length = lambda d: (np.sqrt(d * d + 16) - 4).sum()
    for r in range(rows):
        for c in range(columns):
            if 0 < r < rows - 1:
                sine = np.sin(r * polar)
                total += sine * length((x[r, (c + 1) % columns] - x[r, c]) / (azimuthal * sine))
            if r < rows - 1:
                total += np.sin((r + 0.5) * polar) * length((x[r + 1, c] - x[r, c]) / polar)
    return total * polar * azimuthal / (4 * np.pi)


def test_residual_equals_numpy():
    rng = np.random.default_rng(0)
    radiance, lit, shown = rng.uniform(0, 1, (3, 50)), rng.uniform(0, 1, (3, 50)), rng.uniform(0, 2, 50)
    radiance[:, :5] = lit[:, :5]  # explained
    own = mi.Color3f(*map(aligned, radiance))
    dr.enable_grad(own)
    loss = losses.residual(own, mi.Color3f(*map(aligned, lit)), aligned(shown))
    dr.backward(loss)
    weights = shown / shown.sum()
    assert np.isclose(loss[0], (weights * abs(radiance - lit).mean(0)).sum(), rtol=1e-5)
    assert np.allclose(dr.grad(own).numpy(), weights * np.sign(radiance - lit) / 3, atol=1e-7)
    nothing = losses.residual(own, own, dr.zeros(mi.Float, 50))
    assert nothing[0] == 0


def test_environment_total_variation_and_its_gradient():
    x = np.random.default_rng(5).normal(size=(5, 8, 3))
    leaf = mi.TensorXf(x.astype(np.float32))
    dr.enable_grad(leaf)
    value = losses.environment_total_variation(leaf)
    assert value[0] == pytest.approx(environment_total_variation_twin(x), rel=1e-5)
    dr.backward(value)
    direction = np.random.default_rng(6).normal(size=x.shape)
    expected = (
        environment_total_variation_twin(x + 1e-5 * direction) - environment_total_variation_twin(x - 1e-5 * direction)
    ) / 2e-5
    assert (dr.grad(leaf).numpy() * direction).sum() == pytest.approx(expected, rel=1e-4)


def test_environment_total_variation_does_not_depend_on_resolution():
    def waves(rows):
        theta, phi = np.meshgrid(np.linspace(0, np.pi, rows), (np.arange(2 * rows) + 0.5) / rows * np.pi, indexing="ij")
        value = 20 * np.sin(theta) * np.cos(phi)
        return losses.environment_total_variation(mi.TensorXf(np.repeat(value[..., None], 3, -1).astype(np.float32)))[0]

    assert waves(128) == pytest.approx(waves(256), rel=1e-2)
    assert losses.environment_total_variation(mi.TensorXf(np.full((16, 32, 3), 7.0, np.float32)))[0] == pytest.approx(
        0, abs=1e-5
    )


def test_pixels_that_are_ended_early_have_no_hole():
    """Surfels behind one another, of one colour: nothing of a bright background shines through them."""
    truth = Surfels.from_numpy(sphere_surfels(300, seed=2, scale=0.9, opacity_shift=4).numpy(), two_sided=True)
    camera, background, shown = orbit_camera(0, size=(40, 36), distance=9.0), 5.0, []
    for cutoffs in (Cutoffs(), Cutoffs(transmittance_min=0.1)):
        maps = render_gbuffer(truth, camera, cutoffs=cutoffs).all
        grey = mi.Color3f(0.3) * maps.alpha
        shown.append(
            [
                losses.display(*pixels, background).numpy()[0]
                for pixels in ((grey, maps.alpha), losses.completed(grey, maps.alpha, cutoffs.transmittance_min))
            ]
        )
    (whole, _), (ended, completed) = shown
    opaque = whole < background * 1e-3 + srgb_encode(np.float32(0.3))
    assert opaque.sum() > 100 and np.abs(ended - whole)[opaque].mean() > 0.05
    assert np.abs(completed - whole)[opaque].mean() < 5e-3

"""The Monte Carlo estimator: its derivatives, its limits, and the diffuse part, which both estimators have."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import rgs_mi
from rgs_mi.shading import split_sum
from rgs_mi.shading.environment import Environment
from rgs_mi.shading.monte_carlo import MonteCarlo
from rgs_mi.shading.surface import Surface

from variants import VARIANT

ROUGHNESS = np.float32([0.04, 0.2, 0.4, 0.8])
BASE = {
    "roughness": ROUGHNESS,
    "metallic": np.float32([1, 0.5, 0.3, 0.8]),
    "base_color": np.random.default_rng(1).uniform(0.2, 0.9, (3, 4)).astype(np.float32),
    "normal": np.float32([[0, 0.3, -0.2, 0.1], [0.1, 0.2, 0.5, -0.4], [1, 1, 1, 1]]),
}


def texels(rows=64):
    """Smooth radiance with a bright window, soft at its edges."""
    theta, phi = np.meshgrid(np.linspace(0, np.pi, rows), np.pi * (np.arange(2 * rows) + 0.5) / rows, indexing="ij")
    d = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], -1)
    window = 8 * np.exp(20 * (d @ [0.6, 0.0, 0.8] - 1))
    return np.stack([0.5 + 0.4 * d[..., k] + window for k in range(3)], -1).astype(np.float32)


def estimator(pixels, samples, seed=0, **options):
    environment = pixels if isinstance(pixels, Environment) else Environment(mi.TensorXf(pixels), np.eye(3))
    return MonteCarlo(environment.unfiltered(), environment.emitter(), 1.5, samples, dr.opaque(mi.UInt32, seed), **options)


def surfaces(values=BASE, differentiate=()):
    """({name: array}, the `Surface` that they make)."""
    view = dr.normalize(mi.Vector3f([0.3, 0, 0.2, 0.6], [0, 0.3, 0.5, 0.1], [1, 1, 1, 1]))
    kinds = {"roughness": mi.Float, "metallic": mi.Float, "base_color": mi.Color3f, "normal": mi.Vector3f}
    arrays = {name: kinds[name](values[name]) for name in BASE}
    for name in differentiate:
        dr.enable_grad(arrays[name])
    return arrays, Surface(
        dr.normalize(arrays["normal"]), view, *(arrays[n] for n in ("roughness", "metallic", "base_color"))
    )


def reflected(integrator, lobe, values=BASE):
    return getattr(integrator, lobe)(surfaces(values)[1])


@pytest.fixture(scope="module", params=["specular", "diffuse"])
def gradients(request):
    """(lobe, name -> derivatives [batches, ...] of independent estimates)."""
    rgs_mi.set_variant(VARIANT)
    found = {}
    for seed in range(12):
        pixels = mi.TensorXf(texels())
        dr.enable_grad(pixels)
        arrays, arguments = surfaces(differentiate=BASE)
        integral = getattr(estimator(Environment(pixels, np.eye(3)), 1 << 12, seed), request.param)
        dr.backward(dr.sum(dr.sum(integral(arguments))))
        for name, value in (arrays | {"texels": pixels}).items():
            found.setdefault(name, []).append(dr.grad(value).numpy().astype(np.float64))
    return request.param, found


@pytest.mark.parametrize(
    "name, step", [("roughness", 4e-3), ("metallic", 0.05), ("base_color", 0.05), ("normal", 2e-3), ("texels", 0.05)]
)
def test_derivatives_equal_finite_differences(gradients, name, step):
    """By their standard errors, and within 2 % of the largest; the differences are of many samples with equal numbers."""
    lobe, found = gradients
    whole = BASE | {"texels": texels()}
    direction = np.random.default_rng(3).uniform(0.5, 1.5, whole[name].shape) if name == "texels" else None

    def total(h):
        moved = whole | {name: whole[name] + np.float32(h) * np.float32(1 if direction is None else direction)}
        values = reflected(estimator(moved.pop("texels"), 1 << 17, 99), lobe, moved).numpy().astype(np.float64)
        return values.sum() if direction is not None else values.sum(0)

    expected = (total(step) - total(-step)) / (2 * step)
    batches = np.array(found[name])
    if direction is not None:
        batches = (batches * direction).sum((1, 2, 3))
    elif batches.ndim == 3:
        batches = batches.sum(1)  # all channels, or axes, at once
    mean, error = batches.mean(0), batches.std(0, ddof=1) / np.sqrt(len(batches))
    assert np.all(abs(mean - expected) < 5 * error + 0.02 * np.abs(expected).max() + 1e-4), (mean, expected, error)


def test_mirror_reflects_the_environment():
    """At the least roughness, and below it."""
    smooth = texels()
    normal, view, *_ = surfaces()[1]
    cosine = dr.dot(normal, view)
    environment = Environment(mi.TensorXf(smooth), np.eye(3))
    truth = environment.unfiltered().eval(2 * cosine * normal - view)
    for roughness in (0.0, 0.032):
        values = BASE | {"roughness": np.full(4, roughness, np.float32), "metallic": np.ones(4, np.float32)}
        E, _ = split_sum.albedo(
            cosine, mi.Float(values["roughness"]), mi.Float(1), mi.Color3f(BASE["base_color"]), mi.Float(0.5)
        )
        assert np.allclose(reflected(estimator(smooth, 4096), "specular", values).numpy(), (truth * E).numpy(), rtol=0.01)


def test_many_samples_are_taken_in_parts(monkeypatch):
    """The same numbers, whatever fits into memory at a time."""
    from rgs_mi.shading import monte_carlo

    whole = reflected(estimator(texels(), 40), "specular").numpy()
    monkeypatch.setattr(monte_carlo, "_WAVEFRONT", 4 * 7)
    assert np.allclose(reflected(estimator(texels(), 40), "specular").numpy(), whole, rtol=1e-5)


def test_seeds():
    render = lambda seed: reflected(estimator(texels(), 8, seed), "specular").numpy()
    assert np.array_equal(render(3), render(3)) and not np.allclose(render(3), render(4), rtol=1e-4)


def test_nothing_comes_from_below_the_horizon():
    """A view from behind the surface sees nothing, and no NaN."""
    values = BASE | {"normal": -BASE["normal"]}
    for lobe in ("specular", "diffuse"):
        assert np.array_equal(reflected(estimator(texels(), 16), lobe, values).numpy(), np.zeros((3, 4)))


def test_emitter_of_a_few_steps_ago_costs_no_bias():
    """Sampling by another environment's table."""
    other = estimator(np.roll(texels(), 40, axis=1), 1 << 15)
    stale = estimator(texels(), 1 << 15)
    stale.emitter = other.emitter
    truth = reflected(estimator(texels(), 1 << 15, 5), "specular").numpy()
    assert np.allclose(reflected(stale, "specular").numpy(), truth, rtol=0.01)


def test_paired_estimates_free_the_squared_error_of_noise_bias():
    """The derivative of E[(C − t)²] is that of (E[C] − t)² with pairs, and off by that of C's variance without."""
    n, count = 3, 4000  # a mirror has no noise to speak of: the other three surfaces, so many times
    environment = Environment(mi.TensorXf(texels()), np.eye(3))

    def derivative(paired, samples, copies):
        arrays, arguments = surfaces(differentiate=("roughness",))
        index = dr.arange(mi.UInt32, n * copies) % n + 1
        roughness = dr.gather(mi.Float, arrays["roughness"], index)
        dr.eval(roughness)
        leaf = mi.Float(dr.detach(roughness))
        dr.enable_grad(leaf)
        normal, view, _, metallic, color = (dr.detach(v) for v in arguments[:5])
        spread = lambda v: dr.gather(type(v), v, index)
        C = estimator(environment, samples, 1, paired=paired).specular(
            Surface(spread(normal), spread(view), leaf, spread(metallic), spread(color))
        )
        dr.backward(dr.sum(dr.sum(dr.square(C - spread(target)))))
        return dr.grad(leaf).numpy().reshape(copies, n).astype(np.float64)

    target = mi.Color3f(reflected(estimator(environment, 1 << 15, 7), "specular").numpy() * 0.9)
    truth = derivative(True, 1 << 15, 1)
    off = {paired: derivative(paired, 2, count) - truth for paired in (True, False)}
    z = {paired: abs(v.mean(0)) / (v.std(0) / np.sqrt(count)) for paired, v in off.items()}
    assert z[True].max() < 4.5 < z[False].max()


def test_split_sum_diffuse_equals_monte_carlo():
    exact = reflected(estimator(texels(), 1 << 15), "diffuse").numpy()
    environment = Environment(mi.TensorXf(texels()), np.eye(3)).filtered()
    assert np.allclose(reflected(split_sum.SplitSum(environment), "diffuse").numpy(), exact, rtol=0.03)


def test_other_scenes_render_after_it():
    """The materials of many lanes that it leaves in Mitsuba's registry must not disturb whoever else calls BSDFs."""
    reflected(estimator(texels(), 16), "specular")
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path"},
            "light": {"type": "constant"},
            "sphere": {"type": "sphere", "bsdf": {"type": "principled"}},
            "sensor": {"type": "perspective", "to_world": mi.ScalarTransform4f().look_at([3, 0, 0], [0, 0, 0], [0, 0, 1])},
        }
    )
    assert np.isfinite(mi.render(scene, spp=1).numpy()).all()

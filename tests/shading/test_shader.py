"""The shader f_φ: the network against a twin in NumPy, trained along, saved with the scene and read back."""

import io
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rgs_mi.commands.optimize import optimize
from rgs_mi.core.arrays import as_float
from rgs_mi.core.errors import UserError
from rgs_mi.core.scene_files import load_scene
from rgs_mi.export.render import render_scene
from rgs_mi.fit.model import Model
from rgs_mi.fit.trainer import Fit
from rgs_mi.settings.settings import Density
from rgs_mi.shading.shader import SHAPES, WEIGHTS, Shader, initial_weights

from fits import SETTINGS, model
from runs import SMALL, assert_renders_as_written, make_inputs

PIXELS = 37


def trained_weights(seed=1):
    """Weights of a shader that does something."""
    weights = initial_weights(seed)
    weights[-36:] = np.random.default_rng(seed).normal(size=36)
    return weights


def pixels(seed=0, n=PIXELS):
    """[5, n]: C_s, black in one pixel and bright in another, roughness, and cosine."""
    rng = np.random.default_rng(seed)
    values = np.concatenate([rng.exponential(size=(3, n)), rng.uniform(size=(1, n)), rng.uniform(-0.1, 1, (1, n))])
    values[:3, 0], values[:3, 1] = 0, 800
    return values.astype(np.float32)


def reference(weights, values):
    """[3, n] of equation (6), pixel by pixel, in double precision."""
    out = np.empty((3, values.shape[1]))
    for i, (*C_s, roughness, cosine) in enumerate(values.astype(np.float64).T):
        x, first = np.array([*np.log1p(C_s), roughness, cosine, 1.0]), 0
        for k, (rows, columns) in enumerate(SHAPES):
            x = weights[first : first + rows * columns].reshape(rows, columns) @ x
            x = np.where(x > 0, x, 0.01 * x) if k + 1 < len(SHAPES) else np.tanh(x)
            first += rows * columns
        out[:, i] = C_s * np.exp(np.log(4) * x)
    return out


def evaluate(weights, values):
    """(f_φ, the arrays it was computed from: weights, C_s, roughness, cosine), which have gradients enabled."""
    inputs = (mi.TensorXf(weights), mi.Color3f(*map(as_float, values[:3])), as_float(values[3]), as_float(values[4]))
    dr.enable_grad(inputs)
    return Shader(inputs[0])(*inputs[1:]), inputs


def test_starts_as_the_identity():
    values = pixels()
    assert np.array_equal(evaluate(initial_weights(5), values)[0].numpy(), values[:3])
    assert not np.array_equal(initial_weights(5), initial_weights(6)) and initial_weights(5).shape == (WEIGHTS,)


def test_equals_its_twin():
    weights, values = trained_weights(), pixels()
    out = evaluate(weights, values)[0].numpy()
    np.testing.assert_allclose(out, reference(weights, values), rtol=1e-4)
    assert (out >= 0).all() and not np.allclose(out, values[:3], rtol=0.2)


def test_gradients_equal_finite_differences_of_the_twin():
    """With respect to weights and inputs, backward and forward."""
    weights, values = trained_weights(), pixels()
    values = values[:, 1:]  # in the black pixel log(1 + max(C_s, 0)) has a kink
    rng = np.random.default_rng(3)
    factor = rng.normal(size=(3, PIXELS - 1)) / (1 + values[:3])
    loss = lambda w, x: (reference(w, x) * factor).sum()
    out, inputs = evaluate(weights, values)
    dr.backward(sum(dr.sum(c * as_float(f)) for c, f in zip(out, factor)))
    gradients = [dr.grad(v).numpy().astype(np.float64) for v in inputs]
    gradients = [gradients[0], np.concatenate([gradients[1], *(g[None] for g in gradients[2:])])]
    normal_derivatives = 0.0
    for k, base in enumerate((weights, values)):
        expected, h = np.empty(base.size), 1e-6
        for i in range(base.size):
            step = np.zeros(base.size)
            step[i] = h
            moved = [base + s * step.reshape(base.shape) for s in (1, -1)]
            high, low = (loss(*((m, values) if k == 0 else (weights, m))) for m in moved)
            expected[i] = (high - low) / (2 * h)
        np.testing.assert_allclose(gradients[k].ravel(), expected, rtol=2e-3, atol=2e-4 * abs(expected).max())
        tangent = np.sign(expected).reshape(base.shape)  # uphill: nothing cancels
        normal_derivatives += (tangent.ravel() * expected).sum()
        for value, t in zip((inputs[0],) if k == 0 else inputs[1:], (tangent,) if k == 0 else (tangent[:3], *tangent[3:])):
            dr.set_grad(value, mi.Color3f(*map(as_float, t)) if t.ndim == 2 else type(value)(as_float(t)))
    out = Shader(inputs[0])(*inputs[1:])
    dr.forward_to(out)
    assert (dr.grad(out).numpy() * factor).sum() == pytest.approx(normal_derivatives, rel=1e-3)


def test_no_kernel_is_compiled_for_another_number_of_pixels():
    def step(n):
        out, inputs = evaluate(trained_weights(), pixels(n=n))
        dr.backward(dr.sum(dr.squared_norm(out)))
        dr.eval(dr.grad(inputs))

    for n in (900, 700, 800):
        step(n)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        step(650)
        history = dr.kernel_history((dr.KernelType.JIT,))
    assert len(history) > 5 and all(k["cache_hit"] for k in history)


# ---- In a fit ----


def mlp_model():
    plain = model()
    parameters = {name: plain.numpy(name) for name in plain.names()}
    return Model(parameters | {"shader": initial_weights(0)}, np.eye(3), two_sided=False)


def test_trained_along_and_resumed(dataset):
    density = Density(start=0.0, stop=1.0, refine_every=4, grow_grad2d=1e-5, max_surfels=400)
    fits = [Fit(dataset, mlp_model(), replace(SETTINGS, density=density), 1.0) for _ in range(2)]
    for _ in range(3):
        fits[0].step()
    fits[0] = Fit.resume(dataset, fits[0].settings, *fits[0].state())
    first = initial_weights(0)
    for fit, steps in zip(fits, (3, 6)):
        for _ in range(steps):
            fit.step()
    moved = [np.abs(fit.model.numpy("shader") - first) for fit in fits]
    assert len(fits[0].model) > 300 and moved[0].shape == (WEIGHTS,)
    assert moved[0][-36:].min() > 1e-4 and moved[0][:-36].max() > 1e-4  # hidden layers follow the last one
    assert np.abs(moved[0] - moved[1]).max() < 2e-3 and fits[0].psnr == pytest.approx(fits[1].psnr, abs=0.1)


def test_a_shader_learns_what_the_identity_cannot(dataset):
    """All else frozen at a light of half the brightness: the gain makes up for it."""
    still = {name: (1e-9, 1e-9) for name in vars(SETTINGS.learning_rates)}
    psnr = {}
    for shaded in (model(), mlp_model()):
        shaded.set("log_environment", shaded.numpy("log_environment") - np.log(2))
        settings = replace(SETTINGS, learning_rates=replace(SETTINGS.learning_rates, **still | {"shader": (2e-2, 2e-2)}))
        fit = Fit(dataset, shaded, settings, 1.0)
        while fit.progress < 1:
            fit.step()
        psnr[shaded.shader() is not None] = fit.psnr
    assert psnr[True] > psnr[False] + 0.3


# ---- In files ----


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """(the folder of a run with a shader, the scene and the photographs that it fitted)."""
    import rgs_mi

    rgs_mi.set_variant()
    scene, data = make_inputs(tmp_path_factory.mktemp("inputs"))
    overrides = [*SMALL, "shader=mlp", "learning_rates.shader=[5e-2,5e-2]"]
    return optimize(scene, data=data, out=tmp_path_factory.mktemp("runs"), overrides=overrides, quiet=True), scene, data


def test_exported_scene_renders_the_same(run, tmp_path):
    folder, _, _ = run
    scene = mi.load_file(str(folder / "scene.xml"), parallel=False)
    assert_renders_as_written(scene, folder)
    weights = scene.integrator().shader.weights.numpy()
    assert np.abs(weights - initial_weights(0)).max() > 0.02
    with_maps, without = (
        render_scene(folder, out=tmp_path / f"{aovs}.png", aovs=aovs)[0].read_bytes() for aovs in (True, False)
    )
    assert with_maps == without
    plain = (folder / "scene.xml").read_text().replace('<string name="shader" value="shader.npz" />', "")
    (folder / "plain.xml").write_text(plain)
    difference = np.abs(
        np.array(mi.render(scene)) - np.array(mi.render(mi.load_file(str(folder / "plain.xml"), parallel=False)))
    )
    assert difference.max() > 1e-2


def test_a_checkpoint_keeps_to_its_shader(run):
    folder, scene, data = run
    with pytest.raises(UserError, match="shader is mlp in the checkpoint and can't change"):
        optimize(scene, data=data, out=folder, overrides=SMALL, resume=True, quiet=True)


def npz(save=np.savez, **changes):
    """The bytes of a shader's file with other arrays in it."""
    stream = io.BytesIO()
    save(stream, **{f"weights_{k}": np.zeros(shape, np.float32) for k, shape in enumerate(SHAPES)} | changes)
    return stream.getvalue()


def test_round_trip(tmp_path):
    weights = trained_weights()
    Shader(mi.TensorXf(weights)).save(tmp_path / "shader.npz")
    assert np.array_equal(Shader.load(tmp_path / "shader.npz").weights.numpy(), weights)


@pytest.mark.parametrize(
    "content, message",
    [
        (None, "can't be read .*: check the path"),
        (b"", "is no shader"),
        (b"words", "is no shader"),
        (npz()[:-30], "is no shader"),
        (npz(weights_1=np.array([{}])), "is no shader"),
        (npz(weights_1=np.zeros((12, 7))), r"'weights_1' is float64 of shape \(12, 7\), needs floats of shape \(12, 12\)"),
        (npz(weights_2=np.full((3, 12), "a")), "'weights_2' is <U1"),
        (npz(weights_0=np.full((12, 6), np.nan)), "'weights_0' is not finite"),
        (npz(weights_0=np.zeros((12, 6)), more=np.zeros(1 << 14)), "can't be read .*65536 are the most"),
        (npz(np.savez_compressed, weights_0=np.zeros((12, 6)), more=np.zeros(1 << 17)), "is no shader"),
    ],
)
def test_malformed_files(tmp_path, content, message):
    if content is not None:
        (tmp_path / "shader.npz").write_bytes(content)
    (tmp_path / "scene.xml").write_text(
        '<scene version="3.0.0"> <integrator type="rgs_deferred"> '
        '<string name="shader" value="shader.npz"/> </integrator> </scene>'
    )
    with pytest.raises(UserError, match=f"shader.npz: {message}") as error:
        load_scene(tmp_path / "scene.xml", {})
    assert "\n" not in str(error.value) and str(tmp_path) in str(error.value)

"""Density control: who is cloned, split and pruned, and that the optimiser's moments follow."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rgs_mi.fit.density import Statistics, densify
from rgs_mi.fit.model import ENVIRONMENT, SURFEL_PARAMETERS, Model, logit
from rgs_mi.settings.settings import Density

N = 12


def model():
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(N, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    m = Model.start(normals, normals, rng.uniform(0, 1, (N, 3)), np.full(N, 0.005), np.full((8, 16, 3), 0.5), np.eye(3), 2)
    m.set_rates(dict.fromkeys(m.names(), 1e-6))
    dr.set_grad(m[ENVIRONMENT], dr.ones(mi.TensorXf, m[ENVIRONMENT].shape))
    floats = dr.arange(mi.UInt32, dr.width(m.rows.values))
    own = 1 + mi.Float(floats // (dr.width(floats) // N))  # moments that tell the surfels apart
    m.step(dr.arange(mi.UInt32, N), own)
    return m


def gradients(values, seen=None):
    g = Statistics(N)
    g.gradient = mi.Float(np.asarray(values, np.float32))
    g.count = mi.Float(np.ones(N, np.float32) if seen is None else seen)
    return g


def moment(m, name):
    return m.rows.numpy(name, "m")[:, 0]


def test_small_surfels_are_cloned_and_moments_follow():
    m = model()
    before = {name: m.numpy(name) for name in SURFEL_PARAMETERS}
    hot = np.zeros(N)
    hot[[2, 7]] = 1.0
    old = moment(m, "centers")
    parents = densify(m, gradients(hot), 1.0, Density(), np.random.default_rng(0), 1000)
    assert len(m) == N + 2 and parents.tolist() == sorted([*range(N), 2, 7])
    assert np.allclose(moment(m, "centers"), np.insert(old, [3, 8], 0))  # each beside its parent
    assert np.allclose(m.numpy("centers")[[3, 9]], before["centers"][[2, 7]])
    # both twins together cover what the parent did
    o = 1 / (1 + np.exp(-m.numpy("logit_opacities")[[2, 3], 0]))
    parent = 1 / (1 + np.exp(-before["logit_opacities"][2, 0]))
    assert 1 - np.prod(1 - o) == pytest.approx(parent, abs=1e-4)


def test_large_surfels_are_split_in_their_plane():
    m = model()
    scales = m.numpy("log_scales")
    scales[3] = np.log(0.1)
    m.set("log_scales", scales)
    normal = m.numpy("centers")[3]
    hot = np.zeros(N)
    hot[3] = 1.0
    densify(m, gradients(hot), 1.0, Density(), np.random.default_rng(0), 1000)
    assert len(m) == N + 1
    halves = m.numpy("centers")[[3, 4]]
    assert np.allclose(np.exp(m.numpy("log_scales")[[3, 4]]), 0.1 / 1.6, rtol=1e-4)
    assert np.abs((halves - normal) @ normal).max() < 1e-3 and np.linalg.norm(halves[0] - halves[1]) > 1e-3


@pytest.mark.parametrize("others", [{2: 0.5}, {2: 2.0}, {8: 2.0}, {2: 2.0, 8: 0.5, 9: 3.0}])
def test_where_a_surfel_is_split_hangs_on_no_other(others):
    """Sums of floats differ from run to run, and with them who is split."""
    halves = []
    for hot in ({3: 1.0}, {3: 1.0} | others):
        m = model()
        m.set("log_scales", np.full((N, 2), np.log(0.1)))
        densify(m, gradients([hot.get(i, 0) for i in range(N)]), 1.0, Density(), np.random.default_rng(0), 1000)
        assert len(m) == N + len(hot)
        first = 3 + sorted(hot).index(3)
        halves.append(m.numpy("centers")[[first, first + 1]])
    np.testing.assert_array_equal(*halves)


def test_halves_have_the_normals_that_a_curved_surfel_had_there():
    m = model()
    scales, curvature = m.numpy("log_scales"), m.numpy("curvature")
    scales[3], curvature[3] = np.log([0.1, 0.05]), [0.2, -0.1, 0.3]
    m.set("log_scales", scales)
    m.set("curvature", curvature)
    t_u, t_v, _ = (v.numpy().T[3] for v in m.surfels(0).frames())
    tensors = lambda: m.surfels(0).curvature.numpy() / np.sqrt(m.surfels(0).scales.numpy().prod(1, keepdims=True))
    tensor = tensors()[3]
    center, residual = m.numpy("centers")[3], m.numpy("delta_normal")[3]
    hot = np.zeros(N)
    hot[3] = 1.0
    densify(m, gradients(hot), 1.0, Density(), np.random.default_rng(0), 1000)
    assert len(m) == N + 1
    assert tensors()[[3, 4]] == pytest.approx(np.tile(tensor, (2, 1)), rel=1e-4)
    for half in (3, 4):
        away = m.numpy("centers")[half] - center
        x, y = away @ t_u, away @ t_v
        assert np.hypot(x, y) > 0.01
        turned = (tensor[0] * x + tensor[1] * y) * t_u + (tensor[1] * x + tensor[2] * y) * t_v
        assert m.numpy("delta_normal")[half] - residual == pytest.approx(turned, abs=1e-5)


def test_transparent_unseen_and_huge_surfels_go():
    m = model()
    opacity, scales, seen = m.numpy("logit_opacities"), m.numpy("log_scales"), np.ones(N, np.float32)
    opacity[0], scales[1], seen[2] = logit(0.01), np.log(0.9), 0
    m.set("logit_opacities", opacity)
    m.set("log_scales", scales)
    centers = m.numpy("centers")
    densify(m, gradients(np.zeros(N), seen), 1.0, Density(), np.random.default_rng(0), 1000)
    assert np.allclose(m.numpy("centers"), centers[3:])


def test_surfels_that_hardly_show_go_where_that_is_asked():
    """Judged by what they make of the pictures that list them: one that few list stays."""
    m, weight, count = model(), np.ones(N, np.float32), np.full(N, 4, np.float32)
    weight[0], weight[1], count[1] = 0.01, 0.25, 1
    centers = m.numpy("centers")
    found = gradients(np.zeros(N), count)
    found.weight = mi.Float(weight)
    densify(m, found, 1.0, Density(), np.random.default_rng(0), 1000)
    assert len(m) == N
    densify(m, found, 1.0, Density(prune_weight=0.05), np.random.default_rng(0), 1000)
    assert np.allclose(m.numpy("centers"), centers[1:])


def test_budget_goes_to_the_largest_gradients():
    m = model()
    centers = m.numpy("centers")
    densify(m, gradients(np.arange(N)), 1.0, Density(), np.random.default_rng(0), N + 3)
    assert len(m) == N + 3
    assert np.allclose(m.numpy("centers"), np.repeat(centers, [1] * (N - 3) + [2] * 3, axis=0))


def test_budget_goes_to_the_largest_shares():
    m, found = model(), gradients(np.zeros(N))
    centers = m.numpy("centers")
    found.share = mi.Float(np.arange(N))
    densify(m, found, 1.0, Density(grow_by="loss"), np.random.default_rng(0), N + 3)
    assert len(m) == N + 3
    near = np.linalg.norm(m.numpy("centers")[:, None] - centers, axis=2).argmin(1)
    assert (near == np.repeat(np.arange(N), [1] * (N - 3) + [2] * 3)).all()


def test_none_but_those_with_more_than_their_share_grow():
    """In the mean over the views that list them."""
    m, found = model(), gradients(np.ones(N), np.full(N, 2))
    share, count = np.ones(N, np.float32), np.full(N, 2, np.float32)
    share[[4, 7]], count[5], share[6] = 3, 1, 1.2
    found.share, found.count = mi.Float(share), mi.Float(count)
    centers = m.numpy("centers")
    densify(m, found, 1.0, Density(grow_by="loss"), np.random.default_rng(0), 1000)
    assert len(m) == N + 3 and (mean := (share / count).mean()) > 0.6
    stay = np.isclose(m.numpy("centers")[:, None], centers).all(2).any(0)  # those that are split do not
    assert (stay == (share / count <= mean)).all()


def test_state_round_trip():
    m = model()
    again = Model.from_state(m.state())
    for name in m.names():
        assert np.array_equal(m.numpy(name), again.numpy(name))
    for name in SURFEL_PARAMETERS:
        for of in ("m", "v"):
            assert m.rows.numpy(name, of).any() and np.array_equal(m.rows.numpy(name, of), again.rows.numpy(name, of))
    assert m.rows.steps == again.rows.steps == 1
    for a, b in zip(m.optimizer.state[ENVIRONMENT][3][:3], again.optimizer.state[ENVIRONMENT][3][:3]):
        assert np.array_equal(np.array(a).ravel(), np.array(b).ravel())
    assert not again.two_sided

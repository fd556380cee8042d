"""Surfels whose columns are read all at once, against those that are read one by one."""

import drjit as dr
import mitsuba as mi
import numpy as np

from rgs_mi.surfels.surfels import CHANNELS, Surfels

KINDS = {1: "Float", 2: "Vector2f", 3: "Vector3f", 4: "Vector4f"}


def random_surfels(count=37):
    rng = np.random.default_rng(0)
    arrays = {name: rng.uniform(0.5, 1.5, size=(count, channels or 12)) for name, channels in CHANNELS.items()}
    return Surfels.from_numpy(arrays)


def weighted_sum(surfels):
    """A number to which every entry of every field contributes, some by two ways."""
    rng, total = np.random.default_rng(1), mi.Float(0)
    for name, channels in CHANNELS.items():
        if channels is None:
            values = list(surfels.radiance(dr.normalize(mi.Vector3f(0.3, 0.5, 0.8))))
        else:
            value = surfels.column(getattr(mi, KINDS[channels]), name)
            values = [value] if channels == 1 else list(value)
        for value in values:
            total += dr.sum(value * value * mi.Float(rng.normal(size=len(surfels)).astype(np.float32)))
    return total + dr.sum(dr.squared_norm(surfels.frames()[0] + surfels.normal_derivatives()[0]))


def test_columns_read_together_are_those_read_alone():
    results = []
    for prepared in (lambda s: s, Surfels.split):
        surfels = random_surfels()
        for name in CHANNELS:
            dr.enable_grad(getattr(surfels, name))
        value = weighted_sum(prepared(surfels))
        dr.backward(value)
        results.append([dr.detach(value).numpy(), *(dr.grad(getattr(surfels, name)).numpy() for name in CHANNELS)])
    for alone, together in zip(*results):
        np.testing.assert_allclose(together, alone, rtol=1e-4, atol=1e-5)
        assert np.abs(alone).max() > 0


def test_columns_read_together_have_their_tangents():
    tangents = []
    for prepared in (lambda s: s, Surfels.split):
        surfels = random_surfels()
        dr.enable_grad(surfels.scales)
        dr.set_grad(surfels.scales, 1)
        value = weighted_sum(prepared(surfels))
        tangents.append(dr.forward_to(value).numpy())
    np.testing.assert_allclose(*tangents, rtol=1e-4)
    assert tangents[0] != 0

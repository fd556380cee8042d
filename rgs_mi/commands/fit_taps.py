"""How ``taps.npy`` was made: split-sum's taps fitted to the Monte Carlo estimator under random environments."""

from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import as_float
from ..core.files import atomic_file
from ..core.progress import Progress
from ..evaluation.metrics import relative_error
from ..shading.environment import Environment, FilteredEnvironment
from ..shading.monte_carlo import MonteCarlo
from ..shading.split_sum import DEFAULT_ETA, SplitSum
from ..shading.surface import Surface
from ..shading.taps import COUNT, SHAPE

_ROWS = 256  # of the environments
_SURFACES, _SAMPLES = 12_000, 1024
_RATES = (0.03, 1e-3)  # first and last
#: What the taps are tabled for, at both ends of φ and between: (metallic, base colour).
_MATERIALS = ((0.0, 0.0), (1.0, 1.0), (0.0, 0.0), (1.0, 0.5), (0.0, 0.0), (1.0, 0.95), (0.0, 0.0), (1.0, 0.2))


@dataclass
class Samples:
    """A ``surface`` in one ``environment``, and the linear radiance that it truly reflects."""

    environment: FilteredEnvironment
    surface: Surface
    ground_truth: "mi.Color3f"

    def estimate(self, entries: "mi.Float | None" = None) -> "mi.Color3f":
        """Return split-sum's linear radiance with a table of taps (None: the shipped one)."""
        return SplitSum(self.environment, DEFAULT_ETA, entries).specular(self.surface)


def fit_taps(path: str | Path, environments: int, steps: int, seed: int) -> None:
    """Fit a table of taps to so many random ``environments``, write it to ``path``, and print the error in environments that
    it was not fitted to.

    Raises: UserError where the file can't be written.
    """
    with Progress(None, False, "sampling") as progress:
        data = []
        for k in range(environments + 2):
            texels = random_environment(np.random.default_rng((seed, k)))
            data.append(sampled(texels, *_MATERIALS[k % len(_MATERIALS)], seed + k))
            progress.update((k + 1) / (environments + 2))
    data, held_out = data[:environments], data[environments:]
    start = np.zeros((*SHAPE, 4), np.float32)
    for k in range(COUNT):
        start[k, ..., 0] = 0.1 * (k - (COUNT - 1) / 2)
    optimizer = mi.ad.Adam(lr=_RATES[0])
    optimizer["taps"] = as_float(start)
    with Progress(None, False, "fitting") as progress:
        for step in range(steps):
            optimizer.set_learning_rate(_RATES[0] * (_RATES[1] / _RATES[0]) ** (step / steps))
            some = data[step % len(data)]
            level = dr.opaque(mi.Float, float(0.2 * dr.sum(some.ground_truth.y)[0] / _SURFACES))
            relative = (some.estimate(optimizer["taps"]) - some.ground_truth) / (some.ground_truth + level)
            dr.backward(dr.sum(dr.sum(dr.sqrt(dr.square(relative) + 1e-4))) / _SURFACES)
            optimizer.step()
            progress.update((step + 1) / steps)
    with atomic_file(path) as stream:
        np.save(stream, optimizer["taps"].numpy().reshape(*SHAPE, 4))
    with dr.suspend_grad():
        estimates = [some.estimate(optimizer["taps"]).numpy() for some in held_out]
        errors = [relative_error(found, some.ground_truth.numpy()) for found, some in zip(estimates, held_out)]
    print(f"{path}: error in environments that were held out {', '.join(f'{e:.2%}' for e in errors)}")


def sampled(texels: np.ndarray, metallic: float, base_color: float, seed: int) -> Samples:
    """Return what random surfaces of all roughness, seen as a distant sphere's, reflect of ``texels`` [rows, columns, 3]."""
    rng = np.random.default_rng(seed)
    normal = _unit(rng.normal(size=(_SURFACES, 3)))
    across = rng.normal(size=(_SURFACES, 3))
    across = _unit(across - (across * normal).sum(1, keepdims=True) * normal)
    sine = np.sqrt(rng.uniform(0, 0.998, (_SURFACES, 1)))
    view = np.sqrt(1 - sine**2) * normal + sine * across
    vector = lambda v: mi.Vector3f(as_float(v[:, 0]), as_float(v[:, 1]), as_float(v[:, 2]))
    constant = lambda v: as_float(np.full(_SURFACES, v))
    surface = Surface(
        vector(normal),
        vector(view),
        as_float(rng.uniform(0, 1, _SURFACES)),
        constant(metallic),
        mi.Color3f(*3 * (constant(base_color),)),
    )
    environment = Environment(mi.TensorXf(texels), np.eye(3))
    with dr.suspend_grad():
        estimator = MonteCarlo(
            environment.unfiltered(), environment.emitter(), DEFAULT_ETA, _SAMPLES, dr.opaque(mi.UInt32, seed)
        )
        ground_truth = estimator.specular(surface)
        dr.eval(ground_truth)
    return Samples(environment.filtered(), surface, ground_truth)


def random_environment(rng: np.random.Generator) -> np.ndarray:
    """Return an environment of mean radiance 1, [rows, columns, 3]: waves of all lengths, and a few bright windows."""
    theta, phi = np.meshgrid(np.linspace(0, np.pi, _ROWS), np.pi * (np.arange(2 * _ROWS) + 0.5) / _ROWS, indexing="ij")
    d = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], -1)
    image = np.zeros((_ROWS, 2 * _ROWS, 3))
    for octave in range(1, 7):
        for _ in range(6):
            wave = np.sin(d @ (1.5 * 2**octave * _unit(rng.normal(size=3))) + rng.uniform(0, 2 * np.pi))
            image += wave[..., None] * rng.uniform(0.3, 1, 3) / 1.6**octave
    image = np.exp(image)
    for _ in range(rng.integers(4, 14)):
        axis = _unit(rng.normal(size=3))
        right = _unit(np.cross(axis, rng.normal(size=3)))
        depth = np.maximum(d @ axis, 1e-6)
        width, height = rng.uniform(0.03, 0.5, 2)
        inside = (d @ axis > 0) & (abs(d @ right) < width * depth) & (abs(d @ np.cross(axis, right)) < height * depth)
        image[inside] = rng.uniform(0.5, 1, 3) * np.exp(rng.uniform(-2, 3))
    return (image / image.mean()).astype(np.float32)


def _unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)

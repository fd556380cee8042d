"""Textures and environment finished by Mitsuba's differentiable path tracer, against photographs.

`prb` renders the stock scene as it will be looked at, with several bounces, and Adam follows the gradient of

    Σ (s'(y) (x − y))²                                                                                  (20)

over the pixels that the mesh fills, with the radiance x of a few samples, the photograph's linear value y and the slope s' of the
sRGB curve there: the squared error of display values, to first order, whose gradient the samples' noise leaves without bias,
since those of the derivative are others. Where the photograph is white a brighter x is no error.

What is learned is a correction at each vertex of the mesh, which is added to the textures in between, and a factor of the
environment on a coarse grid. Detail is in both already; what path tracing changes is as smooth as light is, and a texel alone
sees too few samples to tell an error from their noise.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from skimage.transform import downscale_local_mean

from ...core.arrays import as_float, as_tensor
from ...core.interrupt import GracefulInterrupt
from ...core.progress import Progress
from .photographs import SATURATED, Photograph
from .stock_scene import LIGHT
from .surface import UVMesh, coverage
from .textures import Texels

_DEPTH, _SPP, _SPP_GRADIENT = 4, 8, 2
_LONGEST = 256  # pixels along a photograph's longer side, at most
_RATES = {"base_color": 5e-4, "roughness": 5e-4, "metallic": 5e-4, "radiance": 5e-4, "environment": 2e-3}  # or noise leads
_LAST = 0.1  # learning rates at the end, over those at the start
_LIGHTS = (16, 32)  # rows and columns of the environment's factors
_DARK = 0.02  # linear value up to which the slope is that
_GRID = 4  # rays along a pixel's side that say whether the mesh fills it


def refine(
    path: str | Path,
    mesh: UVMesh,
    texels: Texels,
    photographs: Sequence[Photograph],
    names: Sequence[str],
    seconds: float,
    quiet: bool = False,
) -> dict[str, np.ndarray]:
    """Fit the textures ``names`` and the environment of the stock scene in the file ``path``, which shows the ``mesh`` with
    ``texels``, to ``photographs`` for some ``seconds``, or until it is interrupted; return them, [H, W, channels] each."""
    scene = mi.load_file(str(path), parallel=False)
    params = mi.traverse(scene)
    learned = [_Texture(name, params, mesh, texels) for name in names] + [_Light(params)]
    params.keep([part.key for part in learned])
    integrator = mi.load_dict({"type": "prb", "max_depth": _DEPTH})
    optimizer = mi.ad.Adam(lr=1.0)
    for part in learned:
        optimizer[part.name] = part.start()
    targets = [_target(scene, photograph) for photograph in photographs]
    rng, begin, step, errors = np.random.default_rng(0), time.monotonic(), 0, []
    with Progress(seconds, quiet, "refining") as progress, GracefulInterrupt() as interrupt:
        while (spent := time.monotonic() - begin) < seconds and interrupt.signal is None:
            if step % len(targets) == 0:
                order = rng.permutation(len(targets))
            optimizer.set_learning_rate({p.name: _RATES[p.name] * _LAST ** (spent / seconds) for p in learned})
            _assign(params, learned, optimizer)
            errors.append(_step(scene, params, integrator, targets[order[step % len(targets)]], step))
            optimizer.step()
            step += 1
            mean = float(np.mean(errors[-len(targets) :]))
            progress.update(min(spent / seconds, 1), psnr=-10 * np.log10(max(mean, 1e-10)), steps=step)
        progress.update(1)
    _assign(params, learned, optimizer)
    return {part.name: part.image(params[part.key].numpy()) for part in learned}


class _Texture:
    """A texture that is what it was plus what vertices are corrected by."""

    def __init__(self, name, params, mesh, texels):
        self.name, self.key = name, next(key for key in params.keys() if key.endswith(f"{name}.data"))
        self.before = as_tensor(params[self.key].numpy())  # a copy: what is assigned is written into the scene's own
        self.vertices = len(mesh.vertices)
        near = texels.near
        self.corners = mi.Vector3u(np.ascontiguousarray(mesh.faces[texels.face[near]].T))
        self.weights = mi.Vector3f(*(as_float(texels.barycentric[near, k]) for k in range(3)))

    def start(self):
        return dr.zeros(mi.TensorXf, (self.vertices, self.before.shape[2]))

    def value(self, correction):
        channels = self.before.shape[2]
        sums = []
        for c in range(channels):
            at = lambda corner: dr.gather(mi.Float, correction.array, channels * corner + c, mode=dr.ReduceMode.Local)
            sums.append(sum(w * at(corner) for w, corner in zip(self.weights, self.corners)))
        texel = dr.arange(mi.UInt32, dr.width(sums)) * channels
        added = dr.zeros(mi.Float, dr.width(sums) * channels)
        for c, values in enumerate(sums):
            dr.scatter(added, values, texel + c)
        value = dr.maximum(self.before + mi.TensorXf(added, self.before.shape), 0)
        return value if self.name == "radiance" else dr.minimum(value, 1)

    def image(self, data):
        return data


class _Light:
    """An environment that is what it was times factors on a coarse grid."""

    name = LIGHT

    def __init__(self, params):
        self.key = f"{LIGHT}.data"
        self.before = as_tensor(params[self.key].numpy())

    def start(self):
        return dr.zeros(mi.TensorXf, (*_LIGHTS, 3))

    def value(self, logarithm):
        rows, columns = self.before.shape[:2]
        k = dr.arange(mi.UInt32, rows * columns)
        x = (mi.Float(k % columns) - 0.5) / (columns - 2)  # a column on either side repeats
        y = (mi.Float(k // columns) + 0.5) / rows
        grid = mi.Texture2f(logarithm, wrap_mode=dr.WrapMode.Repeat)
        factor = dr.exp(mi.Color3f(*grid.eval(mi.Point2f(x, dr.clip(y, 0.5 / _LIGHTS[0], 1 - 0.5 / _LIGHTS[0])))))
        return self.before * mi.TensorXf(dr.ravel(factor), (rows, columns, 3))

    def image(self, data):
        return data[:, 1:-1]


def _assign(params, learned, optimizer):
    for part in learned:
        params[part.key] = part.value(optimizer[part.name])
    params.update()


@dataclass(frozen=True)
class _Target:
    sensor: "mi.Sensor"
    linear: "mi.TensorXf"  # [H, W, 3]
    weight: "mi.TensorXf"  # [H, W, 1]: 1 where the mesh fills the pixel, else 0
    gain: "mi.TensorXf"  # [1, 1, 3]
    filled: float  # part of the pixels


def _target(scene, photograph):
    side = -(-max(photograph.camera.size) // _LONGEST)
    width, height = (n // side for n in photograph.camera.size)
    camera = photograph.camera.cropped(0, 0, width * side, height * side).resized(width, height)
    smaller = lambda values: downscale_local_mean(values[: height * side, : width * side], (side, side, 1))
    filled = (smaller(photograph.object[..., None]) == 1) & (coverage(scene, camera, _GRID)[..., None] == 1)
    return _Target(
        mi.load_dict(camera.to_sensor_dict()),
        as_tensor(smaller(photograph.radiance)),
        as_tensor(filled),
        as_tensor(np.reshape(photograph.exposure, (1, 1, 3))),
        float(filled.mean()),
    )


def _step(scene, params, integrator, target, seed):
    """Add the gradient of (20) of one photograph to what is learned; returns its mean squared error."""
    image = mi.render(
        scene,
        params,
        sensor=target.sensor,
        integrator=integrator,
        spp=_SPP,
        spp_grad=_SPP_GRADIENT,
        seed=2 * seed,
        seed_grad=2 * seed + 1,
    )
    error = image[..., :3] * target.gain - target.linear
    white = (target.linear >= SATURATED) & (error > 0)
    slope = 1.055 / 2.4 * dr.maximum(target.linear, _DARK) ** (1 / 2.4 - 1)
    error = dr.select(white, 0, error) * slope * target.weight  # cut off, noise would be a bias
    loss = dr.sum(dr.square(error), axis=None) / dr.opaque(mi.Float, len(error.array) * max(target.filled, 1e-3))
    dr.backward(loss)
    return float(loss.array[0])

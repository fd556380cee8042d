"""f_φ, the shader that RGS puts between the specular integral and the pixel and leaves unspecified (docs/method.md §3): here
a gain per channel that a tiny `drjit.nn` network m_φ gives.

    f_φ(C_s) = C_s · exp(ρ tanh m_φ(log(1 + C_s), roughness, n·ω_o, 1)),   ρ = log 4                       (6)

It is positive wherever C_s is, and begins as the identity, to the last bit: the last layer of m_φ starts from zero.

The layers have no biases: the input that is always 1 stands for them. This is `drjit.nn` in its tensor mode, in single
precision, whose matrix products are compiled beforehand for any number of pixels; biases would be broadcast by kernels with
that number in them, so that each view would compile its own. Cooperative vectors take the same time here, and on CUDA only
half precision.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit import nn

from ..core.errors import UserError
from ..core.files import atomic_file
from ..core.inputs import opened

#: [outputs, inputs] of each layer: two hidden ones of 12.
SHAPES = ((12, 6), (12, 12), (3, 12))
WEIGHTS = sum(rows * columns for rows, columns in SHAPES)
_REACH = float(np.log(4))  # ρ
_MOST = 1 << 16  # bytes of a file; it is some 2 KB
_REMEDY = "export the scene again, or remove 'shader' from its integrator"


@dataclass
class Shader:
    """f_φ of (6). ``weights`` [WEIGHTS] are the layers of `SHAPES` one after the other, row-major."""

    weights: "mi.TensorXf"

    def __call__(self, C_s: "mi.Color3f", roughness: "mi.Float", cosine: "mi.Float") -> "mi.Color3f":
        """Return f_φ of ``C_s`` (linear radiance ≥ 0) for ``roughness`` and ``cosine`` = n·ω_o, one entry per pixel;
        differentiable in all of them and in the weights, in both modes."""
        values = [*dr.log(1 + dr.maximum(C_s, 0)), roughness, cosine, mi.Float(1)]
        n = dr.width(values)
        pixel, row = dr.arange(mi.UInt32, n), dr.opaque(mi.UInt32, n)
        flat = dr.empty(mi.Float, n * len(values))
        for k, value in enumerate(values):
            dr.scatter(flat, value, pixel + k * row, mode=dr.ReduceMode.Permute)
        out = self._network()(mi.TensorXf(flat, (len(values), n))).array
        gain = mi.Color3f(*[dr.gather(mi.Float, out, pixel + k * row, mode=dr.ReduceMode.Permute) for k in range(3)])
        return C_s * dr.exp(_REACH * gain)

    def _network(self):
        layers, first = [], 0
        for rows, columns in SHAPES:
            layer = nn.Linear(columns, rows, bias=False)
            layer.weights = dr.reshape(self.weights[first : first + rows * columns], (rows, columns))
            layers += [layer, nn.LeakyReLU()]
            first += rows * columns
        return nn.Sequential(*layers[:-1], nn.Tanh())

    # ---- Files ----

    def save(self, path: str | Path) -> None:
        """Write an ``.npz`` with ``weights_0``, ``weights_1``, …, float32 of `SHAPES`, whole or not at all.

        Raises: UserError where the disk is full or the folder can't be written.
        """
        parts = np.split(dr.detach(self.weights).numpy(), np.cumsum([rows * columns for rows, columns in SHAPES])[:-1])
        arrays: dict[str, Any] = {name: part.reshape(shape) for (name, shape), part in zip(_arrays().items(), parts)}
        with atomic_file(path) as stream:
            np.savez(stream, **arrays)

    @classmethod
    def load(cls, path: str | Path) -> "Shader":
        """Return the shader that `save` wrote. Raises: UserError where the file is missing, damaged, or holds another
        network."""
        path = Path(path)
        try:
            with opened(path, _MOST) as stream, np.load(stream, allow_pickle=False) as file:
                if max(info.file_size for info in file.zip.infolist()) > _MOST:
                    raise ValueError("it unpacks to more than any shader is")
                arrays = {name: file[name] for name in _arrays()}
        except OSError as error:
            raise UserError(f"{path}: can't be read ({error.strerror or error}): check the path") from error
        except Exception as error:  # a damaged zip fails in a dozen ways, and each means the same here
            raise UserError(f"{path}: is no shader, or damaged: {_REMEDY}") from error
        for name, shape in _arrays().items():
            if arrays[name].shape != shape or arrays[name].dtype.kind != "f":
                raise UserError(
                    f"{path}: '{name}' is {arrays[name].dtype} of shape {arrays[name].shape}, "
                    f"needs floats of shape {shape}: {_REMEDY}"
                )
            if not np.isfinite(arrays[name]).all():
                raise UserError(f"{path}: '{name}' is not finite: {_REMEDY}")
        return cls(mi.TensorXf(np.concatenate([array.ravel() for array in arrays.values()]).astype(np.float32)))


def _arrays():
    """name -> shape of what a file holds."""
    return {f"weights_{k}": shape for k, shape in enumerate(SHAPES)}


def initial_weights(seed: int) -> np.ndarray:
    """Return the weights [WEIGHTS] of a shader that is the identity: random hidden layers, and zeros."""
    rng = dr.rng(seed)
    layers = [nn.Linear(columns, rows, bias=False).alloc(mi.TensorXf, rng=rng).weights.numpy() for rows, columns in SHAPES]
    return np.concatenate([*(layer.ravel() for layer in layers[:-1]), np.zeros(layers[-1].size, np.float32)])

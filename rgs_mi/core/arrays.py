"""NumPy arrays for Dr.Jit kernels."""

import mitsuba as mi
import numpy as np

_ALIGNMENT = 64  # bytes: an AVX-512 register


def as_float(values: np.ndarray):
    """``values``, flattened, as a ``mi.Float``, in memory aligned as Dr.Jit's own.

    Dr.Jit's LLVM backend uses a NumPy array's memory where it lies and compiles its alignment into the kernels that read it:
    since NumPy's varies from array to array, so would the kernels.
    """
    values = np.asarray(values, np.float32).ravel()
    memory = np.empty(values.size + _ALIGNMENT // 4, np.float32)
    first = -memory.ctypes.data % _ALIGNMENT // 4
    memory[first : first + values.size] = values
    return mi.Float(memory[first : first + values.size])


def as_tensor(values: np.ndarray):
    """``values`` as a ``mi.TensorXf``, in memory aligned as Dr.Jit's own; see `as_float`."""
    return mi.TensorXf(as_float(values), np.shape(values))

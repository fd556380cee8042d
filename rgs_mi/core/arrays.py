"""NumPy arrays for Dr.Jit kernels."""

import mitsuba as mi
import numpy as np

_ALIGNMENT = 64  # bytes: an AVX-512 register


def as_float(values: np.ndarray) -> "mi.Float":
    """Return ``values`` (any shape) flattened, in single precision, in memory aligned as Dr.Jit's own.

    Dr.Jit's LLVM backend uses a NumPy array's memory where it lies and compiles its alignment into the kernels that read it:
    since NumPy's varies from array to array, so would the kernels.
    """
    values = np.asarray(values, np.float32)
    memory = aligned(values.size)
    memory[:] = values.ravel()
    return mi.Float(memory)


def aligned(*shape: int) -> np.ndarray:
    """Return zeros of this ``shape`` in single precision, in memory aligned as Dr.Jit's own, in which it lets them lie."""
    size = int(np.prod(shape))
    memory = np.zeros(size + _ALIGNMENT // 4, np.float32)
    first = -memory.ctypes.data % _ALIGNMENT // 4
    return memory[first : first + size].reshape(shape)


def as_tensor(values: np.ndarray) -> "mi.TensorXf":
    """Return ``values`` as a tensor of the same shape, in memory aligned as Dr.Jit's own (see `as_float`)."""
    return mi.TensorXf(as_float(values), np.shape(values))

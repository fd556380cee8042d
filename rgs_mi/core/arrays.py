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


def as_half(values: np.ndarray) -> "mi.Float16":
    """Return ``values`` (any shape) flattened, in half precision, in memory aligned as Dr.Jit's own (see `as_float`)."""
    memory = aligned(*np.shape(values), kind=np.float16)
    memory[:] = values
    return mi.Float16(memory.ravel())


def aligned(*shape: int, kind: type = np.float32) -> np.ndarray:
    """Return zeros of this ``shape`` and ``kind``, single precision as a rule, in memory aligned as Dr.Jit's own, in which it
    lets them lie."""
    size, each = int(np.prod(shape)), np.dtype(kind).itemsize
    memory = np.zeros(size + _ALIGNMENT // each, kind)
    first = -memory.ctypes.data % _ALIGNMENT // each
    return memory[first : first + size].reshape(shape)


def as_tensor(values: np.ndarray) -> "mi.TensorXf":
    """Return ``values`` as a tensor of the same shape, in memory aligned as Dr.Jit's own (see `as_float`)."""
    return mi.TensorXf(as_float(values), np.shape(values))

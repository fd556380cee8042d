"""Pickles of NumPy arrays, read without running what else a pickle can hold.

A pickle is a program: it may call any function that it names. Here it may name what rebuilds arrays and scalars of numbers
and ordered dictionaries, each by a function of this file; containers, numbers and text need no name.
"""

import io
import pickle
from collections import OrderedDict
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from .errors import UserError
from .inputs import MOST, read_file


def load(source: str | Path | BinaryIO, most: int = MOST) -> Any:
    """Return what the pickle ``source`` (a path or a binary stream) holds: containers, numbers, text and NumPy arrays of
    numbers. A file may have ``most`` bytes. Containers may hold one another so often that to print or convert them takes for
    ever: types are to be asked first.

    Raises: UserError for a file that is missing, damaged or holds anything else.
    """
    name = getattr(source, "name", source)
    try:
        data = read_file(source, most) if isinstance(source, str | Path) else source.read()
        return _Unpickler(io.BytesIO(data)).load()
    except OSError as error:
        raise UserError(f"{name}: can't be read ({error.strerror or error}): check the path") from None
    except Exception as error:  # a damaged pickle fails in a dozen ways, and each means the same here
        reason = " ".join(str(error).split()) or type(error).__name__
        raise UserError(f"{name}: not a pickle of NumPy arrays, or damaged ({reason}): get the file again") from None


def _dtype(kind, *_):
    if np.dtype(kind).kind not in "biufcU":
        raise pickle.UnpicklingError(f"it holds an array of {np.dtype(kind)}, neither numbers nor text")
    return np.dtype(kind, copy=True)  # the byte order follows as its state


def _array(*_):
    return np.ndarray(0)  # shape, type and content follow as its state


def _from_buffer(data, dtype, shape, order, axis_order=None):
    """Protocol 5; ``axis_order``: of NumPy 2.3 and later, None but for order 'K'."""
    array = np.frombuffer(data, dtype)
    return array.reshape(shape, order=order) if axis_order is None else array.reshape(shape).transpose(axis_order)


def _scalar(dtype, data):
    return np.frombuffer(data, dtype, 1)[0]


def _bytes(text="", *_):
    """Protocols 0 to 2 have no bytes: text in Latin-1 stands for them, nothing for none."""
    return text.encode("latin1")


_ADMITTED = {
    ("numpy", "ndarray"): _array,
    ("numpy", "dtype"): _dtype,
    ("_codecs", "encode"): _bytes,
    ("__builtin__", "bytes"): _bytes,
    ("collections", "OrderedDict"): OrderedDict,
}
for _core in ("numpy.core", "numpy._core"):  # before NumPy 2, and since
    _ADMITTED |= {
        (f"{_core}.multiarray", "_reconstruct"): _array,
        (f"{_core}.multiarray", "scalar"): _scalar,
        (f"{_core}.numeric", "_frombuffer"): _from_buffer,
    }


class _Unpickler(pickle._Unpickler):  # the one in Python: a damaged number makes that in C fill the memory
    stack: list  # which typeshed does not declare, nor `load_build`

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ADMITTED:
            raise pickle.UnpicklingError(f"it names {module}.{name}")
        return _ADMITTED[module, name]

    def load_build(self) -> None:
        """Give an object its state: an array, or a type of numbers or text, whose state is no more than the byte order."""
        *_, target, state = self.stack
        plain = isinstance(target, np.dtype) and state[2:] == target.__reduce__()[2][2:]  # of text: its length, which stays
        if not (plain or isinstance(target, np.ndarray)):
            raise pickle.UnpicklingError(f"it sets the state of a {type(target).__name__}")
        super().load_build()  # type: ignore[misc]  # typeshed has none

    dispatch: dict = pickle._Unpickler.dispatch | {pickle.BUILD[0]: load_build}

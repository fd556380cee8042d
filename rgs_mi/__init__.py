"""Reflection-aware Gaussian splatting inside Mitsuba 3. Importing the package finds LLVM and registers the plugins."""

from .core import runtime as _runtime

_runtime.find_llvm()

from . import plugins as _plugins  # noqa: E402  (Dr.Jit must not be imported before LLVM is found)
from .core.runtime import set_variant  # noqa: E402

_plugins.register()

__all__ = ["set_variant"]
__version__ = "0.1.0"

"""The machine: finds an LLVM that works, sets Mitsuba's variant, says where caches lie and how much memory was used.

Dr.Jit's CPU backend loads libLLVM at run time. Version 15 loads and then aborts the process in ``dr.clip``; older ones
are refused with a misleading message. On Linux x86-64 the wheel ``karellen-llvm-core`` brings a recent one into the
environment's ``lib`` folder; elsewhere a system library of version 16 or later is used.
"""

import ctypes
import ctypes.util
import os
import sys
from pathlib import Path

from .errors import UserError

MIN_LLVM = 16
VARIANTS = ("llvm_ad_rgb", "cuda_ad_rgb")
CACHE_VARIABLE = "RGS_MI_CACHE"
#: Where the page of a window is, unless someone says otherwise.
HOST, PORT = "localhost", 8080
_VARIABLE = "DRJIT_LIBLLVM_PATH"
_REMEDY = (
    f"install one (Debian: `apt install libllvm19`, macOS: `brew install llvm`, Linux x86-64: "
    f"`pip install karellen-llvm-core`) or set {_VARIABLE} to its file"
)


def llvm_version(path: str | Path) -> int | None:
    """Return the major version of the LLVM library at ``path``, or None where it can't be loaded or isn't one."""
    try:
        library = ctypes.CDLL(str(path))
        numbers = [ctypes.c_uint() for _ in range(3)]
        library.LLVMGetVersion(*map(ctypes.byref, numbers))
        return numbers[0].value
    except (OSError, AttributeError):
        return None


def _candidates():
    """Paths of LLVM libraries, the preferred first: the wheel's, then the system's, newest first."""
    folder = Path(sys.prefix) / "lib"
    yield from sorted(folder.glob("libLLVM.so.*"), reverse=True)
    found = []
    for root in ("/usr/lib", "/usr/lib64", "/usr/local/lib", "/opt/homebrew/opt/llvm/lib", "/usr/local/opt/llvm/lib"):
        for pattern in ("libLLVM*.so*", "*/libLLVM*.so*", "llvm-*/lib/libLLVM*.so*", "libLLVM*.dylib"):
            found += Path(root).glob(pattern)
    yield from sorted(found, key=lambda p: llvm_version(p) or 0, reverse=True)
    if name := ctypes.util.find_library("LLVM"):
        yield name


def find_llvm() -> None:
    """Point Dr.Jit at an LLVM of version 16 or later; must run before ``import drjit``.

    A path that the user has set is respected. Where no library is found nothing is set: the CUDA variants do not need one,
    and ``set_variant`` reports the remedy for those that do.
    """
    if os.environ.get(_VARIABLE):
        return
    for path in _candidates():
        if (llvm_version(path) or 0) >= MIN_LLVM:
            os.environ[_VARIABLE] = str(path)
            return


def set_variant(name: str = "llvm_ad_rgb") -> None:
    """Activate the Mitsuba variant ``name``, one of `VARIANTS`.

    Raises: UserError for an unknown variant, a missing or too old LLVM, or a machine without the backend.
    """
    if name not in VARIANTS:
        raise UserError(f"variant '{name}' is not supported: choose one of {', '.join(VARIANTS)}")
    if name.startswith("llvm"):
        path = os.environ.get(_VARIABLE)
        if not path:
            raise UserError(f"no LLVM of version {MIN_LLVM} or later was found: {_REMEDY}")
        version = llvm_version(path)
        if version is None:
            raise UserError(f"{_VARIABLE}={path} is not an LLVM library: {_REMEDY}")
        if version < MIN_LLVM:
            raise UserError(f"{path} is LLVM {version}, which is too old (need {MIN_LLVM}): {_REMEDY}")
    import drjit as dr
    import mitsuba as mi

    if mi.variant() == name:
        return
    try:
        mi.set_variant(name)
    except (ImportError, RuntimeError) as error:
        raise UserError(f"variant '{name}' does not run on this machine: {str(error).splitlines()[0]}") from error
    if dr.thread_count() < 2:
        dr.set_thread_count(2)  # on one core Mitsuba waits forever for an EXR file that it reads or writes (mitsuba3#21)
    if name.startswith("llvm") and dr.detail.llvm_version()[0] < MIN_LLVM:
        raise UserError(
            f"Dr.Jit had loaded LLVM {dr.detail.llvm_version()[0]} before rgs_mi could choose one: "
            "import rgs_mi before drjit and mitsuba"
        )


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def cache_folder(kind: str = "") -> Path:
    """The folder ``kind`` of what takes long to compute and is kept, path-traced photographs, depth priors and undistorted
    photographs: below the one that the environment variable `CACHE_VARIABLE` names, or ``data`` in the current folder."""
    return Path(os.environ.get(CACHE_VARIABLE) or "data") / kind


def release_memory() -> None:
    """Return to the system what was freed: arrays that Dr.Jit keeps for others of their size, and, where the C library can, the
    holes in its heap, which are some 250 MB once a capture of fifty photographs is read."""
    import drjit as dr

    dr.flush_malloc_cache()
    if trim := getattr(ctypes.CDLL(None) if os.name == "posix" else None, "malloc_trim", None):
        trim(0)


def peak_rss_mb() -> float | None:
    """Most memory that this process has held, in MiB; None where the system does not say (Windows)."""
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1 << 20 if sys.platform == "darwin" else 1 << 10)  # macOS counts bytes, Linux KiB

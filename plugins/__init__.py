"""Mitsuba plugins of rgs_mi, one a file. `register()` makes them known now and after every change of variant."""

import functools
import importlib
import sys

import mitsuba as mi

_MODULES = ("procedural", "lanes", "surfels", "rgs_deferred", "rgs_path")


def _load(_old, new):
    """Import each plugin module, again where an earlier variant has: its classes derive from the variant's own."""
    if new.startswith("scalar"):
        return
    for name in _MODULES:
        path = f"{__name__}.{name}"
        importlib.reload(sys.modules[path]) if path in sys.modules else importlib.import_module(path)


@functools.cache
def register():
    """Register all plugins with Mitsuba; calling it again does nothing."""
    mi.detail.add_variant_callback(_load)
    if mi.variant():
        _load(None, mi.variant())

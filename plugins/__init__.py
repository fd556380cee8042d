"""Mitsuba plugins of rgs_mi, one a file. `register()` makes them known now and after every change of variant."""

import functools
import importlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import mitsuba as mi

from rgs_mi.core.errors import UserError

if TYPE_CHECKING:
    from rgs_mi.shading.lighting import Lighting
    from rgs_mi.surfels.surfels import Surfels

    from .rgs_deferred import DeferredIntegrator
    from .surfels import SurfelShape

_MODULES = ("procedural", "wavefront", "surfels", "rgs_deferred", "rgs_path")


def _load(_old, new):
    """Import each plugin module, again where an earlier variant has: its classes derive from the variant's own."""
    if new.startswith("scalar"):
        return
    for name in _MODULES:
        path = f"{__name__}.{name}"
        importlib.reload(sys.modules[path]) if path in sys.modules else importlib.import_module(path)


@functools.cache
def register() -> None:
    """Register all plugins with Mitsuba; calling it again does nothing."""
    mi.detail.add_variant_callback(_load)
    if mi.variant():
        _load(None, mi.variant())


def surfels_of(scene: "mi.Scene", path: str | Path) -> "SurfelShape":
    """Return the scene's one `surfels` shape. Raises: UserError where there is none, or more."""
    from .surfels import SurfelShape  # of the variant that is active now

    found = [shape for shape in scene.shapes() if isinstance(shape, SurfelShape)]
    if len(found) != 1:
        raise UserError(f"{path}: has {len(found)} shapes of type 'surfels': a scene to fit has exactly one")
    return found[0]


def is_deferred(integrator: "mi.Integrator") -> bool:
    """Return whether the integrator is an 'rgs_deferred'."""
    from .rgs_deferred import DeferredIntegrator

    return isinstance(integrator, DeferredIntegrator)


def deferred_of(scene: "mi.Scene", path: str | Path) -> "DeferredIntegrator":
    """Return the scene's integrator. Raises: UserError where it is another than 'rgs_deferred'."""
    integrator = scene.integrator()
    if not is_deferred(integrator):
        raise UserError(f"{path}: its integrator is a {integrator.class_name()}: surfels need 'rgs_deferred'")
    return integrator


def lit_surfels(scene: "mi.Scene", path: str | Path) -> "tuple[Surfels, Lighting | None]":
    """Return the scene's `Surfels`, and the `Lighting` by which its integrator shades them (None: diffuse radiance alone).

    Raises: UserError where there are no surfels, more than one shape of them, or another integrator than 'rgs_deferred'.
    """
    shape, integrator = surfels_of(scene, path), deferred_of(scene, path)
    environment = integrator.environment(scene)
    return shape.surfels, integrator.lighting(scene, shape.surfels, shape.eta, environment, seed=0)

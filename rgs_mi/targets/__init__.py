"""Objects and environments of our own, made by code: what the path-traced data sets show.

A model is a module of this package with `PARTS`, a dict from a part's name to a function that returns its
`meshes.Mesh`; it is listed in `MODELS` below. Parts are bodies, or the pieces of one that differ in material.
Environments, a module each but for streets, are listed in `environments.ENVIRONMENTS`.
Models are centered at the origin, z up, front towards +x, within a radius of about 1. Needs NumPy only.
"""

import functools
import importlib
from collections.abc import Callable
from typing import TypeVar

from ..core.errors import UserError
from .meshes import Mesh

MODELS = ("ball", "car", "coffee", "helmet", "teapot", "toaster")
_Entry = TypeVar("_Entry")


def pick(table: dict[str, _Entry], name: str, what: str) -> _Entry:
    """Return ``table[name]``. Raises: UserError that lists the known names of ``what`` this is."""
    if name not in table:
        raise UserError(f"unknown {what} '{name}': known are {', '.join(sorted(table))}")
    return table[name]


@functools.cache
def mesh(model: str, part: str) -> Mesh:
    """Return the mesh of one part of a model. Raises: UserError for an unknown model or part."""
    return pick(parts(model), part, f"part of the model '{model}'")()


def parts(model: str) -> dict[str, Callable[[], Mesh]]:
    """Return all parts of a model: name -> function that makes the mesh. Raises: UserError for an unknown model."""
    pick(dict.fromkeys(MODELS), model, "model")
    return importlib.import_module(f"{__name__}.{model}").PARTS

"""Objects and environments of our own, made by code: what the path-traced data sets show.

A model is a module of this package with `PARTS`, a dict from a part's name to a function that returns its
`meshes.Mesh`; it is listed in `MODELS` below. Parts are bodies, or the pieces of one that differ in material.
Environments, a module each but for streets, are listed in `environments.ENVIRONMENTS`.
Models are centred at the origin, z up, front towards +x, within a radius of about 1. Needs NumPy only.
"""

import functools
import importlib

from ..core.errors import UserError

MODELS = ("ball", "car", "coffee", "helmet", "teapot", "toaster")


def pick(table: dict, name: str, what: str):
    """``table[name]``. Raises: UserError that lists the known names."""
    if name not in table:
        raise UserError(f"unknown {what} '{name}': known are {', '.join(sorted(table))}")
    return table[name]


@functools.cache
def mesh(model: str, part: str):
    """The `meshes.Mesh` of one part of a model. Raises: UserError for an unknown model or part."""
    return pick(parts(model), part, f"part of the model '{model}'")()


def parts(model: str) -> dict:
    """Name -> function that returns the `meshes.Mesh`, of all parts of a model. Raises: UserError for an unknown model."""
    pick(dict.fromkeys(MODELS), model, "model")
    return importlib.import_module(f"{__name__}.{model}").PARTS

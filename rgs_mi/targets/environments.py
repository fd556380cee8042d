"""High-dynamic-range environments painted by code, with crisp detail for mirrors to show.

A painter maps unit directions [N, 3] (z up) to linear radiance [N, 3]. Sources are large and a few times brighter than
what is around them (the sun, small, is brightest), so that path tracing converges quickly. Random choices come from
fixed seeds.
"""

import functools

import numpy as np
from skimage.transform import downscale_local_mean

from ..core.errors import UserError
from .cafe import cafe
from .kitchen import kitchen
from .outdoors import city, night
from .softboxes import softboxes
from .studio import studio

SUPERSAMPLING = 2
ENVIRONMENTS = {"cafe": cafe, "city": city, "kitchen": kitchen, "night": night, "softboxes": softboxes, "studio": studio}


def directions(height: int, width: int) -> np.ndarray:
    """Return the unit directions [height, width, 3] of the texels of a latitude-longitude map, in a z-up world.

    Mitsuba's ``envmap`` is y-up; these are its directions after ``<rotate x="1" angle="90"/>``.
    """
    theta = np.pi * (np.arange(height) + 0.5)[:, None] / height
    phi = 2 * np.pi * (np.arange(width) + 0.5)[None] / width
    return np.stack(np.broadcast_arrays(np.sin(phi) * np.sin(theta), np.cos(phi) * np.sin(theta), np.cos(theta)), -1)


@functools.cache
def environment(name: str, height: int = 512) -> np.ndarray:
    """Return the linear radiance [height, 2 · height, 3], float32, of an environment in the layout of Mitsuba's ``envmap``.

    Raises: UserError for an unknown name or a height below 2.
    """
    from . import pick

    painter = pick(ENVIRONMENTS, name, "environment")
    if height < 2:
        raise UserError(f"environment '{name}': resolution is {height}, needs at least 2")
    s = SUPERSAMPLING
    fine = painter(directions(s * height, 2 * s * height).reshape(-1, 3)).reshape(s * height, 2 * s * height, 3)
    return downscale_local_mean(fine, (s, s, 1)).astype(np.float32)


def constant(radiance: float, height: int) -> np.ndarray:
    """Return a map of one radiance, [height, 2 · height, 3] float32. Raises: UserError for a height below 2."""
    if height < 2:
        raise UserError(f"environment 'constant': height is {height}, needs at least 2")
    return np.full((height, 2 * height, 3), radiance, np.float32)

"""What cameras see of surfels: how far away they are."""

import drjit as dr
import mitsuba as mi

from ...core.camera import Camera
from ...splat.composite import median_depth
from ...splat.intersect import isect_tiles
from ...splat.project import project
from ...splat.tiles import Cutoffs
from ...surfels.surfels import Surfels


def depth_map(surfels: Surfels, camera: Camera) -> "mi.Float":
    """Return the `median_depth` of what ``camera`` sees of ``surfels``."""
    with dr.suspend_grad():
        projected = project(surfels, camera)
        dr.eval(projected.geometry)
        return median_depth(projected, isect_tiles(projected, camera.size, Cutoffs()), camera.size)

"""What cameras see of surfels: how far away they are, and how much of a pixel they fill."""

import drjit as dr
import mitsuba as mi

from ...core.camera import Camera
from ...splat.composite import median_depth
from ...splat.intersect import isect_tiles
from ...splat.project import project
from ...splat.tiles import Cutoffs
from ...surfels.surfels import SurfelColumns


def depth_map(surfels: SurfelColumns, camera: Camera) -> "tuple[mi.Float, mi.Float]":
    """Return the `median_depth` of what ``camera`` sees of ``surfels``, and how much of each pixel they cover."""
    with dr.suspend_grad():
        projected = project(surfels, camera)
        dr.eval(projected.geometry)
        return median_depth(projected, isect_tiles(projected, camera.size, Cutoffs()), camera.size)

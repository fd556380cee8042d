"""What cameras see of surfels: how far away they are, and how much of a pixel they fill."""

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.camera import Camera
from ...splat.composite import median_depth
from ...splat.gbuffer import render_gbuffer
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


def coverage_map(surfels: Surfels, camera: Camera) -> np.ndarray:
    """Return the coverage [H, W] of what ``camera`` sees of ``surfels``, in [0, 1]."""
    with dr.suspend_grad():
        return render_gbuffer(surfels, camera).all.alpha.numpy().reshape(camera.size[::-1])

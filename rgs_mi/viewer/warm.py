"""All kernels that pictures of one size may need, compiled beforehand."""

from collections.abc import Iterator
from dataclasses import replace

import drjit as dr
import numpy as np

from ..core.camera import Camera
from ..core.color import to_8bit
from ..shading import deferred
from .look import Look
from .passes import measure
from .subject import Subject
from .window import picture_of


def draw(subject: Subject, grid: int) -> None:
    """Draw a picture in motion of ``grid`` × ``grid`` points, as the first camera sees it."""
    look, camera = Look(subject.cameras[0]), subject.cameras[0].resized(grid, grid)
    to_8bit(picture_of(subject, look, camera, measure(subject, look, camera, settled=False)))


def warm(subject: Subject, grid: int) -> Iterator[None]:
    """Compile what pictures of ``grid`` × ``grid`` points need, whatever they show, bit by bit: from two places, for what is the
    same in both is compiled in; with the light behind the object; where no reflected ray meets it; where nothing else is seen,
    and where it is not seen at all. Under another light what is relightable needs others. Of a fit in progress, which changes
    what it needs, one picture, at once."""
    if subject.changing:
        draw(subject, grid)
        return
    first, last = subject.cameras[0], subject.cameras[-1]
    cameras = first, _behind(subject, first), last, _turned_away(first), _close(subject, first, grid)
    looks = [Look(first)] + [Look(first, rotate=90)] * (subject.shading.diffuse == "relightable")
    for look in looks:
        for camera in cameras:
            for background in ("white", "light"):
                seen = replace(look, camera=camera, background=background)
                measure(subject, seen, camera.resized(grid, grid), settled=False)
                yield
        lit = subject.lit(look, settled=False)
        if lit.lighting is not None and lit.lighting.indirect is not None:
            alone = replace(lit.lighting, indirect=replace(lit.lighting.indirect, kind="visibility"))
            with dr.suspend_grad():
                image = deferred.render(lit.surfels, first.resized(grid, grid), alone)
                dr.eval(image.color, image.diffuse, image.specular)


def _behind(subject, camera):
    """The camera that looks from the other side, from farther away."""
    to_world = np.diag([-1.0, -1.0, 1.0, 1.0])
    around = np.eye(4)
    around[:3, 3] = subject.center
    pose = around @ to_world @ np.linalg.inv(around) @ camera.to_world
    pose[:3, 3] += 0.5 * (pose[:3, 3] - subject.center)
    return replace(camera, to_world=pose)


def _close(subject, camera, grid):
    """The camera that sees but the point of a picture where the object hides most of what is behind it."""
    camera = camera.resized(grid, grid)
    alpha = measure(subject, Look(camera, map="alpha"), camera, settled=False)["alpha"][..., 0]
    row, column = np.unravel_index(alpha.argmax(), alpha.shape)
    return camera.cropped(int(column), int(row), 1, 1)


def _turned_away(camera: Camera) -> Camera:
    """The camera that looks the other way."""
    return replace(camera, to_world=camera.to_world @ np.diag([-1.0, 1.0, -1.0, 1.0]))

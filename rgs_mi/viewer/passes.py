"""One pass over a picture, and the means of several."""

from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.camera import Camera
from ..export.render import sensor_dict
from ..shading import deferred
from ..splat.tiles import TILE
from .look import Look
from .maps import GBUFFER, MAPS, SHADED
from .subject import Subject

SIDE = 4  # of the grid of samples in each pixel of a picture at rest


def measure(subject: Subject, look: Look, camera: Camera, settled: bool) -> dict[str, np.ndarray]:
    """Return what the map of ``look`` needs, ``alpha`` and ``depth`` of what ``camera`` sees: [H, W, channels] each,
    premultiplied, and what of the light shows ``behind`` it, where it is to be seen.
    ``settled`` is that of `Subject.lit`."""
    lit, name, (width, height) = subject.lit(look, settled), MAPS[look.map], camera.size
    turntable = subject.turntable(look)
    with dr.suspend_grad():
        image = deferred.render(lit.surfels, camera, lit.lighting if name in SHADED else None)
        rows = lambda array: array.numpy().reshape(height, width, -1)
        measured = {}
        if name in SHADED:
            dr.eval(image.color, image.diffuse, image.specular)  # one kernel for all maps
            measured[name] = rows(mi.TensorXf(dr.ravel(getattr(image, name))))
        gbuffer = rows(image.gbuffer.image)
        measured |= {key: gbuffer[..., GBUFFER[key]] for key in {name, "alpha", "depth"} & GBUFFER.keys()}
        if look.background == "light" and look.map == "picture" and lit.environment is not None:
            radiance = rows(mi.TensorXf(dr.ravel(deferred.behind(camera, lit.environment, turntable))))
            measured["behind"] = (1 - measured["alpha"]) * radiance
    return measured


@dataclass
class Refined:
    """A picture at rest, by and by: first with one sample a pixel, and then, band by band from above, with ``side`` × ``side`` on
    the very grid of `rgs_deferred`: complete, it is what that renders. Every pass has about as many samples as there are
    pixels. What the scene's own integrator renders instead has another sample in each pixel after each pass.

    ``passes``: that were made, of `total`; ``means``: what they measured, [H, W, channels].
    """

    side: int = SIDE
    passes: int = 0
    means: dict[str, np.ndarray] = field(default_factory=dict)
    _sensor: "mi.Sensor | None" = None

    @property
    def total(self) -> int:
        """Passes of a complete picture."""
        return self.side**2 + 1

    @property
    def complete(self) -> bool:
        """Whether there is nothing to add."""
        return self.passes >= self.total

    def add(self, subject: Subject, look: Look) -> None:
        """Make the next pass over the picture of ``look``, always the same one."""
        if subject.still is not None and look.map == "picture":
            measured = self._traced(subject, look.camera)
            part = 1 / (self.passes + 1)
            self.means = {name: values * part + self.means.get(name, 0) * (1 - part) for name, values in measured.items()}
        elif self.passes == 0:
            self.means = {name: np.array(v) for name, v in measure(subject, look, look.camera, settled=True).items()}
        else:
            self._band(subject, look)
        self.passes += 1

    def _band(self, subject, look):
        """All samples of a band of pixels; the last one may reach below the picture, so that all are of one size."""
        fine, side = look.camera.subdivided(self.side**2)
        bands = self.side**2
        rows = -(-fine.size[1] // (bands * TILE[1])) * TILE[1]  # whole tiles, whose grid is that of all of the picture
        top = (self.passes - 1) * rows
        if top >= fine.size[1]:
            return
        measured = measure(subject, look, fine.cropped(0, top, fine.size[0], rows), settled=True)
        for name, values in measured.items():
            samples = values.reshape(rows // side, side, look.camera.size[0], side, -1)
            before = self.means[name][top // side : (top + rows) // side]
            before[:] = samples.mean((1, 3))[: len(before)]

    def _traced(self, subject, camera):
        """One sample a pixel by the scene's own integrator."""
        (scene, integrator), self._sensor = subject.still, self._sensor or mi.load_dict(sensor_dict(camera))
        image = np.array(mi.render(scene, sensor=self._sensor, integrator=integrator, spp=1, seed=self.passes))
        return {"color": image[..., :3], "alpha": image[..., 3:4]}


def point_at(subject: Subject, look: Look, camera: Camera, x: float, y: float) -> np.ndarray | None:
    """Return the world-space point [3] of the surfels that ``camera`` sees at (x, y), parts of its width and height; None where
    it sees none."""
    measured = measure(subject, look, camera, settled=False)
    column, row = (min(int(part * n), n - 1) for part, n in zip((x, y), camera.size))
    alpha, depth = (float(measured[name][row, column, 0]) for name in ("alpha", "depth"))
    if alpha < 0.1:
        return None
    return camera.origin + camera.rays()[row, column] * depth / alpha

"""One pass over a picture, and the means of several."""

from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.camera import Camera
from ..export.render import sensor_dict
from ..shading import deferred
from ..splat.tiles import Cutoffs
from .look import Look, shifted
from .maps import GBUFFER, MAPS, SHADED
from .subject import Subject

SIDE = 4
SAMPLES = SIDE * SIDE  # of a picture at rest: a grid in each pixel
_STRIDE = 7  # between places of the grid that follow each other: means of a few are centered, too


def offset(sample: int, side: int = SIDE) -> tuple[float, float]:
    """Return how far the ``sample`` of ``side`` × ``side`` lies from the middle of its pixel, x and y in pixels."""
    row, column = divmod(_STRIDE * sample % side**2, side)
    return (column + 0.5) / side - 0.5, (row + 0.5) / side - 0.5


def measure(subject: Subject, look: Look, camera: Camera, settled: bool, side: int = 1) -> dict[str, np.ndarray]:
    """Return what the map of ``look`` needs, ``alpha`` and ``depth`` of what ``camera`` sees: [H, W, channels] each,
    premultiplied, and what of the light shows ``behind`` it, where it is to be seen.
    ``settled`` is that of `Subject.lit`; a pixel is one of ``side`` × ``side`` samples."""
    lit, name, (width, height) = subject.lit(look, settled), MAPS[look.map], camera.size
    turntable = subject.turntable(look)
    with dr.suspend_grad():
        image = deferred.render(
            lit.surfels, camera, lit.lighting if name in SHADED else None, cutoffs=Cutoffs().of_sample(side)
        )
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
    """The means of ``samples`` passes over a picture, of ``side`` × ``side`` that make it complete."""

    side: int = SIDE
    samples: int = 0
    means: dict[str, np.ndarray] = field(default_factory=dict)
    _sensor: "mi.Sensor | None" = None

    def add(self, subject: Subject, look: Look) -> None:
        """Add another sample to each pixel of the picture of ``look``, always the same one."""
        if subject.still is not None and look.map == "picture":
            measured = self._traced(subject, look.camera)
        else:
            shift = offset(self.samples, self.side)
            measured = measure(subject, look, shifted(look.camera, *shift), settled=True, side=self.side)
        self.samples += 1
        for name, values in measured.items():
            before = self.means.get(name)
            self.means[name] = values if before is None else before + (values - before) / self.samples

    def _traced(self, subject, camera):
        """One sample a pixel by the scene's own integrator."""
        (scene, integrator), self._sensor = subject.still, self._sensor or mi.load_dict(sensor_dict(camera))
        image = np.array(mi.render(scene, sensor=self._sensor, integrator=integrator, spp=1, seed=self.samples))
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

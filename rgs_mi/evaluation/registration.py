"""Held-out photographs find their place: pose and exposure fitted to a part of each, everything else fixed.

Where a fit learns cameras its world is its own, and a held-out photograph's pose is off in it by as much as the fit has
corrected those that it saw. So nine numbers are fitted to every other square of each, and the whole is scored. Others take the
left half (NeRF in the Wild), which tells exposures but hardly a turn about itself, or all of it (NeRF--, BARF).
"""

from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.camera import Camera
from ..core.color import display, srgb_encode
from ..core.learned_camera import POSE, learned_camera
from ..datasets.photographs import shrink
from ..datasets.types import View
from ..shading import deferred
from ..shading.lighting import Lighting
from ..surfels.surfels import Surfels

PARTS = 4  # of a photograph along a side, on every other of which it is fitted
_LEVELS = 4, 2, 1  # pixels of a photograph's side that make one of a level's
_STEPS = 12  # of Levenberg and Marquardt's method at a level, at most
_LEAST, _MOST = 24, 500  # pixels of a level's height, and of its longer side: more tell a pose hardly better
_PROBE = 0.5  # pixels that differences of poses move a picture by
_STILL = 0.02  # pixels: a step that moves a picture by less is the last
_DAMPING = 1e-3  # of the diagonal, at first


@dataclass(frozen=True)
class Registered:
    """A view's ``camera``, and the ``gain`` [3] of its photograph against the fit's mean exposure (None: one)."""

    camera: Camera
    gain: np.ndarray | None = None


@dataclass(frozen=True)
class Registration:
    """Which numbers of held-out views are fitted: poses where cameras were learned, gains where exposures were; ``cameras``
    {view's name: where it starts, which has the intrinsics that were learned}; ``found`` {view's name: what came out}, of views
    that have been fitted before."""

    poses: bool
    exposure: bool
    cameras: dict[str, Camera] = field(default_factory=dict)
    found: dict[str, Registered] = field(default_factory=dict)

    @property
    def words(self) -> str:
        """What is fitted to what, as metrics.json says it."""
        what = {(True, True): "pose and exposure", (True, False): "pose", (False, True): "exposure"}
        return f"{what[self.poses, self.exposure]} fitted to every other of {PARTS} x {PARTS} parts"


def register(
    registration: Registration, surfels: Surfels, lighting: Lighting | None, view: View, background: float
) -> Registered:
    """Fit pose and exposure of ``view`` to every other of `PARTS` × `PARTS` parts of its photograph (`chessboard`), coarse to
    fine, in least squares of display values over the grey level ``background``, or return what was found before.

    Each level goes on from the one before, or from the pose as given where that is nearer. The pose is that of `learned_camera`
    about the middle of the surfels. Its derivatives are central differences of half a pixel: what is that far off is what
    counts, and no derivative kernels are compiled for it.
    """
    if view.name in registration.found:
        return registration.found[view.name]
    whole = registration.cameras.get(view.name, view.camera)
    pivot = np.median(surfels.numpy()["centers"], axis=0)
    numbers = np.zeros(len(POSE) + 3)
    for downscale in _LEVELS:
        small = downscale > 1 and view.camera.size[1] < _LEAST * downscale
        large = downscale < max(_LEVELS) and max(view.camera.size) > _MOST * downscale
        if small or large:
            continue
        problem = _Problem(registration, surfels, lighting, view, whole, pivot, background, downscale)
        # A coarse level may lead astray: surfels are hardly seen there as photographs are shrunk
        starts = np.unique([numbers, np.r_[np.zeros(len(POSE)), numbers[len(POSE) :]]], axis=0)
        seen = [(problem.rendered(start), start) for start in starts]
        numbers = _minimized(problem, *min(seen, key=lambda start: np.square(problem.residuals(*start)).sum()))
    camera = _moved(whole, whole, pivot, numbers[: len(POSE)]).baked() if registration.poses else whole
    return Registered(camera, np.exp(numbers[len(POSE) :]) if registration.exposure else None)


def chessboard(width: int, height: int) -> np.ndarray:
    """Return which pixels of a photograph of this size are fitted, [H, W] bool: every other of `PARTS` × `PARTS` parts."""
    row, column = np.mgrid[:height, :width]
    return (column * PARTS // width + row * PARTS // height) % 2 == 0


def _moved(camera, whole, pivot, pose):
    """The window ``camera`` of ``whole`` after the correction ``pose`` (6 numbers)."""
    opaque = [dr.opaque(mi.Float, float(v)) for v in pose]
    return replace(camera, learned=learned_camera(whole, pivot, opaque))


class _Problem:
    """The least-squares problem of one level: residuals [P] of numbers [9], and their derivatives."""

    def __init__(self, registration, surfels, lighting, view, whole, pivot, background, downscale):
        self.registration, self.surfels, self.lighting, self.background = registration, surfels, lighting, background
        self.whole, self.pivot = whole, pivot
        target = shrink(display(view.pixels, background), downscale)
        height, width = target.shape[:2]
        used = (
            whole
            if target.shape[:2] == view.pixels.shape[:2]
            else whole.cropped(0, 0, width * downscale, height * downscale)
        )
        self.camera = used.resized(width, height)
        self.fitted = chessboard(width, height).ravel()
        self.target = target.reshape(-1, 3)[self.fitted]
        self.probe = _PROBE / float(np.mean(self.camera.focal))

    def rendered(self, numbers):
        """(linear radiance [P, 3], premultiplied; coverage [P, 1])."""
        camera = self.camera
        if self.registration.poses:
            camera = _moved(camera, self.whole, self.pivot, numbers[: len(POSE)])
        with dr.suspend_grad():
            image = deferred.render(self.surfels, camera, self.lighting)
            return image.color.numpy().T[self.fitted], image.gbuffer.all.alpha.numpy()[self.fitted, None]

    def residuals(self, picture, numbers):
        """[3 P]: the ``picture`` of `rendered`, as exposed, less the photograph."""
        color, alpha = picture
        straight = color * np.exp(numbers[len(POSE) :]) / np.maximum(alpha, 1e-6)
        shown = srgb_encode(np.clip(straight, 0, 1)) * alpha + self.background * (1 - alpha)
        return (np.clip(shown, 0, 1) - self.target).ravel()

    def jacobian(self, numbers):
        """[3 P, 6] derivatives by the pose, central differences of renderings; zero where it is not fitted."""
        columns = np.zeros((self.target.size, len(POSE)))
        for k in range(len(POSE) if self.registration.poses else 0):
            h = np.zeros(len(numbers))
            h[k] = self.probe
            ahead, behind = (self.residuals(self.rendered(n), n) for n in (numbers + h, numbers - h))
            columns[:, k] = (ahead - behind) / (2 * self.probe)
        return columns

    def by_gains(self, picture, numbers):
        """[3 P, 3] derivatives by the logarithms of the gains; zero where they are not fitted."""
        columns = np.zeros((self.target.size, 3))
        for k in range(3 if self.registration.exposure else 0):
            h = np.zeros(len(numbers))
            h[len(POSE) + k] = 1e-3
            columns[:, k] = (self.residuals(picture, numbers + h) - self.residuals(picture, numbers - h)) / 2e-3
        return columns


def _minimized(problem, picture, numbers):
    """`_STEPS` of Levenberg and Marquardt's method at most, from ``numbers``, which have this ``picture``. Twelve renderings
    make a Jacobian, so each step corrects that of the one before by what it has seen (Broyden 1965). Only where one leads
    nowhere, or hardly anywhere, is it taken anew, to see whether that is the end."""
    residuals, jacobian, damping, fresh = problem.residuals(picture, numbers), problem.jacobian(numbers), _DAMPING, True
    for left in reversed(range(_STEPS)):
        both = np.hstack([jacobian, problem.by_gains(picture, numbers)])
        normal, right = both.T @ both, both.T @ residuals
        for _ in range(4 if fresh else 1):
            step = -np.linalg.solve(normal + np.diag(damping * np.diag(normal) + 1e-9), right)
            ahead = problem.rendered(numbers + step)
            lower = problem.residuals(ahead, numbers + step)
            if better := lower @ lower < residuals @ residuals:
                break
            damping *= 10
        missed, still = lower - residuals - both @ step, not better or np.abs(step).max() < _STILL * problem.probe / _PROBE
        if better:
            numbers, picture, residuals, damping = numbers + step, ahead, lower, damping / 10
        if not left or (still and fresh):
            break
        pose, fresh = step[: len(POSE)], still
        if fresh:
            jacobian, damping = problem.jacobian(numbers), _DAMPING
        elif moved := pose @ pose:
            jacobian += np.outer(missed, pose / moved)
    return numbers

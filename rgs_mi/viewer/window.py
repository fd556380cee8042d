"""One browser's window: what it looks at by now, what was drawn of that, and what is to be drawn next."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..core.camera import Camera
from ..core.color import to_8bit
from . import maps
from .look import Look, same
from .pace import Pace
from .passes import Refined, measure
from .subject import Subject

REST = 0.2  # seconds without an event
_MOVING, _AT_REST = 40, 80  # quality of JPEGs; a picture that is complete is sent without loss
_EVERY = 4  # passes from one picture that is shown at rest to the next
_FAR = 160.0  # world units: depth where nothing is


@dataclass(frozen=True)
class Picture:
    """What is sent: ``pixels`` [H, W, 3] uint8, as a JPEG of ``quality`` (None: without loss), and where objects stand among
    the surfels their z ``depth`` [H, W], world units. ``part``: how far it is refined, None in motion."""

    pixels: np.ndarray
    quality: int | None
    depth: np.ndarray | None = None
    part: float | None = None


class Window:
    """What one browser sees. Its handlers, in the server's thread, only replace ``look``; what is drawn is drawn by `work`, in
    the one thread that renders.

    ``generation`` counts changes of ``look``: a picture of an older one is worth nothing. ``hurried``: pictures are those in
    motion, also at rest.
    """

    def __init__(self, look: Look, wake: Callable[[], None] = lambda: None) -> None:
        self.look, self.generation, self.moved = look, 0, time.monotonic()
        self.refined = Refined()
        self.hurried = False
        self._overlays: set[str] = set()
        self._lock, self._wake = threading.Lock(), wake
        self._moving, self._refining = -1, -1  # generations that were drawn, and that are being refined

    def change(self, **fields: object) -> None:
        """Replace these ``fields`` of the look; what stays the same is no change. From any thread."""
        with self._lock:
            look = replace(self.look, **fields)
            if same(look, self.look):
                return
            self.look, self.generation, self.moved = look, self.generation + 1, time.monotonic()
        self._wake()

    def overlay(self, name: str, shown: bool) -> None:
        """Take note of an object that the browser draws among the surfels, which hide it: pictures then have a depth."""
        (self._overlays.add if shown else self._overlays.discard)(name)
        self.redraw()

    def redraw(self) -> None:
        """Draw anew: what is looked at has changed."""
        with self._lock:
            self.generation += 1
        self._wake()

    @property
    def moving(self) -> bool:
        """Whether the last event was a moment ago, or there is no picture yet."""
        return self.blank or time.monotonic() - self.moved < REST

    @property
    def blank(self) -> bool:
        """Whether nothing was drawn yet."""
        return max(self._moving, self._refining) < 0

    def due(self) -> float:
        """Return in how many seconds there is something to draw: 0 for now, infinity for never, unless something happens."""
        if self._moving != self.generation and (self.moving or self.hurried):
            return 0.0
        if self.hurried:
            return float("inf")
        if self._refining != self.generation or not self.refined.complete:
            return max(0.0, self.moved + REST - time.monotonic())
        return float("inf")

    def work(self, subject: Subject, pace: Pace, windows: int = 1) -> Picture | None:
        """Draw what is due by now, one pass; None where it was outdated before it was done."""
        with self._lock:
            look, generation = self.look, self.generation
        if self.moving or self.hurried:
            return self._in_motion(subject, look, generation, pace, windows)
        return self._at_rest(subject, look, generation)

    def _in_motion(self, subject, look, generation, pace, windows):
        start, grid = time.perf_counter(), pace.choose(windows, max(look.camera.size))
        camera = seen(subject, look).resized(grid, grid)
        measured = measure(subject, look, camera, settled=False)
        picture = Picture(to_8bit(picture_of(subject, look, camera, measured)), _MOVING, self._depth(measured))
        pace.note(grid, time.perf_counter() - start)
        self._moving = generation
        return picture  # late or not: the next one is no earlier without it

    def _at_rest(self, subject, look, generation):
        if self._refining != generation:
            self._refining, self.refined = generation, Refined()
        look = replace(look, camera=seen(subject, look))
        self.refined.add(subject, look)
        if self.generation != generation:
            return None
        if (self.refined.passes - 1) % _EVERY and not self.refined.complete:
            return None
        refined = self.refined
        pixels = to_8bit(picture_of(subject, look, look.camera, refined.means))
        quality = None if refined.complete else _AT_REST
        return Picture(pixels, quality, self._depth(refined.means), refined.passes / refined.total)

    def _depth(self, measured):
        if not self._overlays or "depth" not in measured:
            return None
        alpha, depth = measured["alpha"][..., 0], measured["depth"][..., 0]
        return np.where(alpha > 0.5, depth / np.maximum(alpha, 1e-6), _FAR)


def seen(subject: Subject, look: Look) -> Camera:
    """Return the camera of the picture: that of the ``look``, which stands where the photograph does that it is compared with."""
    if look.map != "error" and look.through is None or not subject.views:
        return look.camera
    return replace(look.camera, to_world=subject.nearest(look).camera.to_world)


def picture_of(subject: Subject, look: Look, camera: Camera, measured: dict[str, np.ndarray]) -> np.ndarray:
    """Return what the window shows of the means that were ``measured`` of what ``camera`` sees: [H, W, 3] display values."""
    distance, reach = float(np.linalg.norm(camera.origin - subject.center)), subject.radius
    shown = maps.Shown(look.exposure, look.tone, look.background, (distance - reach, distance + reach))
    if look.map == "error":
        if not subject.views:
            return np.ones((*camera.size[::-1], 3), np.float32)
        photograph = maps.photograph(subject.nearest(look), camera, look.background)
        return maps.error(maps.display("picture", measured, shown), photograph)
    picture = maps.display(look.map, measured, shown)
    if look.through is not None and look.wipe > 0:
        return maps.wiped(picture, maps.photograph(subject.nearest(look), camera, look.background), look.wipe)
    return picture

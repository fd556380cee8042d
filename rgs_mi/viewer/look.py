"""What one window looks at, and how: all that its picture depends on, beside what there is to see."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..core.camera import Camera
from ..export.render import pose

OWN = "as in the scene"  # the light that is not replaced
BACKGROUNDS = ("white", "black", "light")  # the last is the environment
_MOST_PIXELS = 1 << 21  # of a window's picture: larger ones are scaled by the browser


@dataclass(frozen=True)
class Material:
    """Factors of the `roughness`, `metallic` and `base_color` of surfels."""

    roughness: float = 1.0
    metallic: float = 1.0
    base_color: float = 1.0

    def changes(self, where: str = "") -> tuple[str, ...]:
        """Return what `relight.edited` takes for them, with ``where`` ('@X,Y,Z,R' or '') at the end of each."""
        factors = ((name, getattr(self, name)) for name in self.__dataclass_fields__)
        return tuple(f"{name}*={factor:.6g}{where}" for name, factor in factors if factor != 1)


@dataclass(frozen=True)
class Look:
    """What is seen of a scene.

    camera      the window's: its size is that of a picture at rest, its pixels are square
    map         what is shown, of `MAPS`
    light       the environment's name (`Lights`); rotate, degrees about the vertical; brighten, stops
    background  behind the object, of `BACKGROUNDS`
    material    of all surfels; after it, ``region_material`` of those in the ball ``region`` (x, y, z, radius; None: none)
    exposure, tone  of what is radiance: `core.color.exposed`
    through     the name of the photograph whose place the camera has taken, or None; that far from the left, a part of the
                width, it shows: ``wipe``
    """

    camera: Camera = field(compare=False)  # arrays: see `same`
    map: str = "picture"
    background: str = "white"
    light: str = OWN
    rotate: float = 0.0
    brighten: float = 0.0
    material: Material = field(default_factory=Material)
    region: tuple[float, float, float, float] | None = None
    region_material: Material = field(default_factory=Material)
    exposure: float = 0.0
    tone: str = "clip"
    through: str | None = None
    wipe: float = 0.0

    def changes(self) -> tuple[str, ...]:
        """Return what ``--set`` takes for the materials."""
        where = "" if self.region is None else "@" + ",".join(f"{v:.6g}" for v in self.region)
        return self.material.changes() + (self.region_material.changes(where) if where else ())

    @property
    def changed(self) -> bool:
        """Whether light or materials are others than those of the scene."""
        return self.light != OWN or bool(self.rotate or self.brighten or self.changes())

    def options(self, distance: float, keys: Sequence[Camera] = (), frames: int = 0) -> list[str]:
        """Return what `rgs-mi render` takes behind a scene's name to make the same picture, with 16 samples a pixel, or a video
        of so many ``frames`` through the cameras ``keys``, with 4; they look at points at that ``distance``, world units. What is
        no radiance comes with ``--aovs``."""
        cameras = list(keys) or [self.camera]
        width, height = cameras[0].size
        options = [f"--camera={pose(camera, distance)}" for camera in cameras] + [f"--size={width}x{height}"]
        options += [f"--path={frames}", "--video", "--spp=4"] if keys else ["--spp=16"]
        options += [f"--envmap={self.light}"] if self.light != OWN else []
        numbers = {"rotate": self.rotate, "brighten": self.brighten, "exposure": self.exposure}
        options += [f"--{name}={value:g}" for name, value in numbers.items() if value]
        options += [f"--set={change}" for change in self.changes()]
        options += [f"--tone={self.tone}"] if self.tone != "clip" else []
        options += ["--background" if self.background == "light" else "--no-background"]
        return options + (["--aovs"] if self.map != "picture" else [])

    def command(self, scene: str, *what: Any) -> str:
        """Return the command line of `options`, of ``what`` these take, for the scene or run that is called ``scene``, as a shell
        reads it."""
        return shlex.join(["rgs-mi", "render", scene, *self.options(*what)])


def same(a: Look, b: Look) -> bool:
    """Return whether two looks show the same."""
    numbers = lambda camera: (*camera.to_world.ravel(), *camera.focal, *camera.principal, *camera.size)
    return a == b and numbers(a.camera) == numbers(b.camera)


def window_camera(
    wxyz: np.ndarray, position: np.ndarray, fov: float, size: tuple[int, int], pixels: int = _MOST_PIXELS
) -> Camera | None:
    """Return the camera of a browser's window of ``size`` (width, height), with no more than so many ``pixels``.

    Args:
      wxyz:     unit quaternion of the rotation from camera space (x right, y down, z forward) to the world's
      position: [3] of the pinhole, world space
      fov:      vertical field of view, radians

    Returns: None where the numbers make no camera. They come from a page.
    """
    numbers = np.array([*wxyz, *position, fov, *size], np.float64)
    length = np.linalg.norm(numbers[:4]) if np.isfinite(numbers).all() else 0.0
    width, height = size
    if not (length > 1e-6 and 1e-3 < fov < 3 and 1 <= width <= 1 << 14 and 1 <= height <= 1 << 14):
        return None
    to_world = np.eye(4)
    to_world[:3, 3] = numbers[4:7]
    to_world[:3, :3] = Rotation.from_quat(np.roll(numbers[:4], -1)).as_matrix()
    scale = min(1.0, (pixels / (width * height)) ** 0.5)
    width, height = max(1, round(width * scale)), max(1, round(height * scale))
    focal = 0.5 * height / np.tan(fov / 2)
    return Camera(to_world, (focal, focal), (width / 2, height / 2), (width, height))


def quaternion(to_world: np.ndarray) -> np.ndarray:
    """Return the unit quaternion (w, x, y, z) of the rotation in ``to_world`` [4, 4], camera space to world space."""
    return np.roll(Rotation.from_matrix(to_world[:3, :3]).as_quat(), 1)

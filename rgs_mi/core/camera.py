"""Cameras: one small value type between data sets, Mitsuba sensors and the splatter.

Frames. World space is whatever the scene uses. Camera space here is the computer-vision one: x right, y down, z along
the viewing direction, so that depth is z and pixel = focal * (x/z, y/z) + principal point, after what a lens does to
(x/z, y/z) where there is one. Mitsuba's own camera space (x left, y up, z forward) appears only in `from_sensor` and
`to_sensor_dict`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from .errors import UserError
from .learned_camera import LearnedCamera
from .lens import Lens

if TYPE_CHECKING:
    import mitsuba as mi

_MITSUBA_TO_CV = np.diag([-1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True)
class Camera:
    """A pinhole camera, perhaps with a lens.

    Attributes
      to_world:  [4, 4] float64, camera space (x right, y down, z forward) to world space, rigid
      focal:     (fx, fy) in pixels
      principal: (cx, cy) in pixels, from the upper left corner of the image; (width/2, height/2) is the centre
      size:      (width, height) in pixels
      lens:      distortion of the photograph, or None
      learned:   what a fit has in place of these numbers, or None. Functions on Dr.Jit arrays see it, those on NumPy arrays
                 do not: see `baked`
    """

    to_world: np.ndarray
    focal: tuple[float, float]
    principal: tuple[float, float]
    size: tuple[int, int]
    lens: Lens | None = None
    learned: LearnedCamera | None = None

    @property
    def origin(self) -> np.ndarray:
        """The position of the pinhole in world space, [3]."""
        return self.to_world[:3, 3]

    @property
    def rotation(self) -> np.ndarray:
        """The world-to-camera rotation, [3, 3]."""
        return self.to_world[:3, :3].T

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project world ``points`` [N, 3]; return pixels [N, 2] and depths z [N]. Pixels mean nothing where z ≤ 0."""
        p = (np.asarray(points) - self.origin) @ self.rotation.T
        z = p[:, 2]
        plane = p[:, :2] / np.where(z == 0, 1e-9, z)[:, None]
        if self.lens is not None:
            plane = np.stack(self.lens.distort(*plane.T), -1)
        return plane * self.focal + self.principal, z

    def image_plane(self) -> tuple[np.ndarray, np.ndarray]:
        """Return x/z and y/z, each [H, W], of the camera-space rays through the pixel centers."""
        width, height = self.size
        x = (np.arange(width) + 0.5 - self.principal[0]) / self.focal[0]
        y = (np.arange(height) + 0.5 - self.principal[1]) / self.focal[1]
        x, y = np.meshgrid(x, y)
        return (x, y) if self.lens is None else self.lens.undistort(x, y)

    def rays(self) -> np.ndarray:
        """Return the world-space rays through the pixel centers, [H, W, 3], of unit camera-space z: origin + depth · ray is
        the point that a pixel shows. `pixel_rays` is the same on Dr.Jit arrays."""
        x, y = self.image_plane()
        return np.stack([x, y, np.ones_like(x)], -1) @ self.rotation

    def resized(self, width: int, height: int) -> "Camera":
        """Return the same camera with another pixel grid over the same image plane."""
        sx, sy = width / self.size[0], height / self.size[1]
        return replace(
            self,
            focal=(self.focal[0] * sx, self.focal[1] * sy),
            principal=(self.principal[0] * sx, self.principal[1] * sy),
            size=(width, height),
        )

    def subdivided(self, spp: int) -> tuple["Camera", int]:
        """Return the same camera with a pixel for each of ``spp`` samples of a pixel, rounded up to a square, and how many of
        them lie along its side."""
        side = math.ceil(math.sqrt(spp))
        return self.resized(*(side * n for n in self.size)), side

    def cropped(self, x: int, y: int, width: int, height: int) -> "Camera":
        """Return the same camera, restricted to the window of ``width`` × ``height`` pixels whose corner is pixel (x, y)."""
        return replace(self, principal=(self.principal[0] - x, self.principal[1] - y), size=(width, height))

    def baked(self) -> "Camera":
        """Return the same camera with numbers in place of what was ``learned``."""
        if self.learned is None:
            return self
        rotation, origin, zoom, shift, lens = np.split(self.learned.values.numpy().astype(np.float64), [9, 12, 14, 16])
        u, _, vh = np.linalg.svd(rotation.reshape(3, 3))  # single precision leaves it a ten-millionth short of rigid
        to_world = np.eye(4)
        to_world[:3, :3], to_world[:3, 3] = (u @ vh).T, origin
        (fx, fy), principal = zoom * self.focal, self.principal + shift * self.focal
        lens = Lens(*lens.tolist(), reach=self.learned.reach)
        return Camera(to_world, (float(fx), float(fy)), (float(principal[0]), float(principal[1])), self.size, lens)

    @classmethod
    def look_at(
        cls, origin: npt.ArrayLike, target: npt.ArrayLike, up: npt.ArrayLike, fov_x: float, size: tuple[int, int]
    ) -> "Camera":
        """Return a camera at ``origin`` that looks at ``target``, both [3] in world space, as is ``up``; ``fov_x`` is the
        horizontal field of view in degrees, ``size`` (width, height) in pixels."""
        z = np.subtract(target, origin).astype(float)
        z /= np.linalg.norm(z)
        x = np.cross(z, np.asarray(up, float))
        x /= np.linalg.norm(x)
        to_world = np.eye(4)
        to_world[:3] = np.stack([x, np.cross(z, x), z, np.asarray(origin, float)], 1)
        focal = 0.5 * size[0] / np.tan(np.radians(fov_x) / 2)
        return cls(to_world, (focal, focal), (size[0] / 2, size[1] / 2), (size[0], size[1]))

    @classmethod
    def from_sensor(cls, sensor: "mi.Sensor") -> "Camera":
        """Return the camera of a Mitsuba `perspective` sensor, over the film's crop window.

        Raises: UserError when the sensor is not a perspective pinhole.
        """
        import mitsuba as mi

        if sensor.class_name() != "PerspectiveCamera":
            raise UserError(f"sensor '{sensor.id()}' is a {sensor.class_name()}: surfels need a 'perspective' sensor")
        params, film = mi.traverse(sensor), sensor.film()
        width, height = np.array(film.size()).ravel()
        crop, offset = np.array(film.crop_size()).ravel(), np.array(film.crop_offset()).ravel()
        scalar = lambda key: float(np.array(params[key]).ravel()[0])
        focal = 0.5 * width / np.tan(np.radians(scalar("x_fov")) / 2)
        # A positive principal point offset shifts the optical center by that fraction of the film, see the plugin's docs.
        principal = (
            width * (0.5 - scalar("principal_point_offset_x")) - offset[0],
            height * (0.5 - scalar("principal_point_offset_y")) - offset[1],
        )
        to_world = np.array(params["to_world"].matrix, np.float64).reshape(4, 4) @ _MITSUBA_TO_CV
        return cls(to_world, (focal, focal), principal, (int(crop[0]), int(crop[1])))

    def to_sensor_dict(self) -> dict:
        """Return a Mitsuba `perspective` sensor (as for ``mi.load_dict``) with this camera's view, whose pixels must be
        square. It has no lens."""
        import mitsuba as mi

        width, height = self.size
        return {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f((self.to_world @ _MITSUBA_TO_CV).tolist()),
            "fov_axis": "x",
            "fov": float(np.degrees(2 * np.arctan(0.5 * width / self.focal[0]))),
            "principal_point_offset_x": 0.5 - self.principal[0] / width,
            "principal_point_offset_y": 0.5 - self.principal[1] / height,
            "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}},
        }


# ---- On Dr.Jit arrays ----


class Projection(NamedTuple):
    """A camera as kernels see it: ``rotation`` (world to camera), ``origin`` (world space), ``focal`` length and ``principal``
    point (pixels), Dr.Jit values, and the ``lens``, None for a pinhole's."""

    rotation: "mi.Matrix3f"
    origin: "mi.Point3f"
    focal: "mi.Vector2f"
    principal: "mi.Vector2f"
    lens: Lens | None


def opaque(camera: Camera, width: int = 1) -> Projection:
    """Return the camera's numbers as opaque Dr.Jit values (literals would recompile the kernels at every pose), and what is
    learned of it in their place, differentiable; that is of the ``width`` of what the kernel works on."""
    import drjit as dr
    import mitsuba as mi

    scalar = lambda v: dr.opaque(mi.Float, float(v))
    focal, principal = mi.Vector2f(*map(scalar, camera.focal)), mi.Vector2f(*map(scalar, camera.principal))
    if camera.learned is not None:
        rotation, origin, zoom, shift, lens = camera.learned.numbers(width)
        return Projection(rotation, origin, focal * zoom, principal + focal * shift, lens)
    return Projection(
        mi.Matrix3f([[scalar(v) for v in row] for row in camera.rotation]),
        mi.Point3f(*map(scalar, camera.origin)),
        focal,
        principal,
        camera.lens and Lens(*map(scalar, camera.lens.coefficients), reach=scalar(camera.lens.reach)),
    )


def pixel_rays(camera: Camera, index: "mi.UInt32") -> "mi.Vector3f":
    """Return the world-space rays through the centers of the pixels ``index`` (row-major), of unit camera-space z; see
    `Camera.rays`, their twin on NumPy arrays."""
    import drjit as dr
    import mitsuba as mi

    R, _, f, principal, lens = opaque(camera, dr.width(index))
    width = camera.size[0]
    x = (mi.Float(index % width) + 0.5 - principal.x) / f.x
    y = (mi.Float(index // width) + 0.5 - principal.y) / f.y
    if lens is not None:
        x, y = lens.undistort(x, y)
    return R.T @ mi.Vector3f(x, y, 1)


def pixels_of(camera: Camera, point: "mi.Point3f") -> "tuple[mi.Float, mi.Float, mi.Float]":
    """Return (x, y, z) of world-space points: where on the image they are seen, in pixels from its upper left corner, and their
    camera-space z, which must be positive; see `Camera.project`, its twin on NumPy arrays."""
    R, origin, f, principal, lens = opaque(camera)
    p = R @ (point - origin)
    x, y = p.x / p.z, p.y / p.z
    if lens is not None:
        x, y = lens.distort(x, y)
    return x * f.x + principal.x, y * f.y + principal.y, p.z


def pixel_directions(camera: Camera, index: "mi.UInt32") -> "mi.Vector3f":
    """Return `pixel_rays` of unit length."""
    import drjit as dr

    return dr.normalize(pixel_rays(camera, index))


# ---- Of several cameras ----


def focus_point(cameras: Sequence[Camera]) -> tuple[np.ndarray, float]:
    """Return the world-space point [3] nearest to all optical axes, in least squares, and the greatest distance of a camera
    from it (at least 1e-3)."""
    origins = np.stack([c.origin for c in cameras])
    axes = np.stack([c.to_world[:3, 2] for c in cameras])
    away = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # [C, 3, 3] projects onto the plane across each axis
    # Where all axes are parallel the depth is free: the faint pull keeps it near the cameras.
    pull = 1e-6 * len(cameras) * np.eye(3)
    center = np.linalg.solve(away.sum(0) + pull, (away @ origins[:, :, None]).sum((0, 2)) + pull @ origins.mean(0))
    return center, max(float(np.linalg.norm(origins - center, axis=1).max()), 1e-3)

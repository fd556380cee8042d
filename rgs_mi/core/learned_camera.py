"""A camera as small corrections of the one that was given, differentiable (docs/method.md §2)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from .lens import Lens

if TYPE_CHECKING:
    import mitsuba as mi

    from .camera import Camera

POSE = ("turn_x", "turn_y", "turn_z", "shift_x", "shift_y", "shift_z")
INTRINSICS = ("log_fx", "log_fy", "cx", "cy", "k1", "k2", "p1", "p2")
_COUNT = 20  # of `Numbers`
_BEYOND = 1.2  # a lens holds so much farther than to the picture's corner


class Numbers(NamedTuple):
    """The numbers of a camera that take the place of its own: ``rotation`` (world to camera), ``origin`` (world space), ``zoom``,
    factors of the focal lengths, ``shift`` of the principal point in units of the focal lengths, and ``lens``."""

    rotation: "mi.Matrix3f"
    origin: "mi.Point3f"
    zoom: "mi.Vector2f"
    shift: "mi.Vector2f"
    lens: Lens


@dataclass(frozen=True)
class LearnedCamera:
    """What a fit learns of a camera: `Numbers` that `Camera.resized` and `Camera.cropped` leave as they are, one after another
    in ``values``, a differentiable Dr.Jit array; ``reach`` is that of the lens."""

    values: "mi.Float"
    reach: float

    def numbers(self, width: int = 1) -> Numbers:
        """Return the numbers, ``width`` times each. Kernels that see a camera from so many pixels or surfels add its gradients
        up as they go; of numbers of width 1 each use would cost a kernel that sums."""
        import drjit as dr
        import mitsuba as mi

        at = lambda k: dr.gather(mi.Float, self.values, dr.full(mi.UInt32, k, width), mode=dr.ReduceMode.Expand)
        v = [at(k) for k in range(_COUNT)]
        lens = Lens(*v[16:20], reach=dr.opaque(mi.Float, self.reach))
        return Numbers(
            mi.Matrix3f(v[0:3], v[3:6], v[6:9]), mi.Point3f(*v[9:12]), mi.Vector2f(*v[12:14]), mi.Vector2f(*v[14:16]), lens
        )


def learned_camera(
    camera: "Camera",
    pivot: np.ndarray,
    pose: "Sequence[mi.Float]",
    intrinsics: "Sequence[mi.Float] | None" = None,
) -> LearnedCamera:
    """Return ``camera`` with its corrections, evaluated.

    ``pose`` are the six numbers (ω, τ) of `POSE`: with x a point in world space, c the ``pivot`` ([3], world space), R and o
    the camera's rotation and origin, and d = |c − o|, the point is in camera space at

        exp(ω) R (x − c) + R (c − o) + d τ                                                          (12)

    so that ω turns the scene about the pivot and τ moves its picture, by f τ pixels and by the part τ_z of its size: six
    numbers that do much the same each, in radians, where turning and moving the camera would do almost the same. exp is of
    third order here: a rotation by 2 atan(|ω|/2).

    ``intrinsics`` are the eight numbers of `INTRINSICS` (None: as given): logarithms of factors of the focal lengths, the
    shift of the principal point in units of these, and what is added to the coefficients of `Lens`, each in units of what it
    moves where the lens ends, relative to the radius there.
    """
    import drjit as dr
    import mitsuba as mi

    scalar = lambda v: dr.opaque(mi.Float, float(v))
    given = mi.Matrix3f([[scalar(v) for v in row] for row in camera.rotation])
    to_pivot = camera.rotation @ (np.asarray(pivot) - camera.origin)
    turn, move = mi.Vector3f(*pose[:3]), mi.Vector3f(*pose[3:])
    quaternion = mi.Quaternion4f(*(0.5 * turn), 1)
    rotation = dr.quat_to_matrix(mi.Matrix3f, quaternion / dr.norm(quaternion)) @ given
    moved = mi.Vector3f(*map(scalar, to_pivot)) + scalar(np.linalg.norm(to_pivot)) * move
    origin = mi.Point3f(*map(scalar, pivot)) - rotation.T @ moved
    numbers, lens = intrinsics or [scalar(0)] * len(INTRINSICS), camera.lens or Lens(reach=lens_reach(camera))
    coefficients = [
        scalar(k) + n / scalar(lens.reach**power) for k, n, power in zip(lens.coefficients, numbers[4:], (2, 4, 1, 1))
    ]
    zoom, shift = dr.exp(mi.Vector2f(*numbers[:2])), mi.Vector2f(*numbers[2:4])
    values = dr.zeros(mi.Float, _COUNT)
    rows = [rotation[i, j] for i in range(3) for j in range(3)]
    for k, value in enumerate([*rows, *origin, *zoom, *shift, *coefficients]):
        dr.scatter(values, value, mi.UInt32(k))
    dr.eval(values)
    return LearnedCamera(values, float(lens.reach))


def correction(camera: "Camera", moved: "Camera", pivot: np.ndarray) -> np.ndarray:
    """Return the six numbers (ω, τ) by which `learned_camera` takes the pose of ``camera`` to that of ``moved``, about the
    ``pivot`` ([3], world space): (12) the other way round."""
    turn = Rotation.from_matrix(moved.rotation @ camera.rotation.T).as_quat(canonical=True)
    before, after = (c.rotation @ (np.asarray(pivot) - c.origin) for c in (camera, moved))
    return np.concatenate([2 * turn[:3] / turn[3], (after - before) / np.linalg.norm(before)])


def lens_reach(camera: "Camera") -> float:
    """Return the radius in x/z units up to which a lens of this camera holds: a little farther than the whole picture's
    corner."""
    far = np.maximum(camera.principal, np.subtract(camera.size, camera.principal)) / camera.focal
    return _BEYOND * float(np.linalg.norm(far))

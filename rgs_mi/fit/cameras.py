"""Cameras and exposures that are learned with the surfels (docs/method.md §4)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.camera import Camera, focus_point
from ..core.learned_camera import INTRINSICS, POSE, correction, learned_camera
from ..datasets.exif import log_gains
from ..datasets.types import Dataset
from ..settings.settings import Settings, Weights

#: Names of what is learned: a row per view, per camera, and per view.
POSES, LENSES, EXPOSURE = "poses", "intrinsics", "exposure"
_POINTS, _NEAREST, _DAMPING = 500, 0.8, 0.02  # of `_whitening`: points; the ball's radius over its distance, at most; λ
_HOLD = 0.02  # of drift that a step takes out: all at once, surfels could not follow, and poses would fight for it
_BETA = 0.8, 0.99  # of Adam; a row moves but some ten times in a fit, so its first moment forgets sooner than surfels'


class Rows:
    """Rows of numbers [N, K] that Adam moves one by one: a row without a gradient stays where it is. All share one second
    moment (as the numbers of a vector do in VectorAdam, Ling et al. 2022): what has little gradient, a number or a row that is
    right already, moves little, where Adam's own would make a random walk of it. On NumPy arrays: there are few."""

    def __init__(self, count: int, width: int) -> None:
        self.value, self.m, self.v = np.zeros((count, width)), np.zeros((count, width)), np.zeros(())
        self.steps = np.zeros(count, np.int64)

    def step(self, gradients: Mapping[int, np.ndarray], rate: float, bases: np.ndarray | None = None) -> None:
        """Move the rows that ``gradients`` {row: [K]} names, where these are finite; each in coordinates of its own where
        there are ``bases`` [N, K, K]: a row is its basis times these."""
        for row, gradient in gradients.items():
            if not np.isfinite(gradient).all():
                continue
            basis = np.eye(len(gradient)) if bases is None else bases[row]
            gradient = basis.T @ gradient
            self.steps[row] += 1
            self.m[row] += (1 - _BETA[0]) * (gradient - self.m[row])
            self.v = self.v + (1 - _BETA[1]) * (np.mean(gradient**2) - self.v)
            m, v = self.m[row] / (1 - _BETA[0] ** self.steps[row]), self.v / (1 - _BETA[1] ** self.steps.sum())
            self.value[row] -= rate * basis @ (m / max(np.sqrt(v), 1e-15))

    def state(self) -> dict[str, np.ndarray]:
        """Return all arrays, for a checkpoint."""
        return dict(vars(self))

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take the arrays of `state`."""
        for name in vars(self):
            setattr(self, name, np.array(arrays[name]))


def mean_rows(parts: Sequence[Mapping[int, np.ndarray]]) -> dict[int, np.ndarray]:
    """Return the mean of gradients {row: [K]} that several processes have; what one of them does not have is zero there."""
    rows = dict.fromkeys(row for part in parts for row in part)
    return {row: np.sum([part[row] for part in parts if row in part], 0) / len(parts) for row in rows}


@dataclass(frozen=True)
class Seen:
    """How a step sees a view: through ``camera``, brightened by ``gain`` (None: as it is); ``prior`` is the loss of corrections
    that are large, of width 1."""

    camera: Camera
    gain: "mi.Color3f | None"
    prior: "mi.Float"


class Cameras:
    """Corrections of the cameras of ``views``, and their exposures, zero at first, but for exposures that EXIF tells.

    ``rows``: `POSES` [V, 6] and `LENSES` [C, 8], the numbers of `learned_camera`, where cameras are learned, and `EXPOSURE`
    [V, 3], natural logarithms of gains, where exposures are. Views whose intrinsics are the same share a camera. ``pivot``
    [3] is the point that the cameras look at, about which they turn; ``extent`` is the object's radius in world units; ``pixel``
    is how many radians a pixel of the photographs is, in the mean.
    """

    def __init__(self, cameras: Sequence[Camera], extent: float, learn_cameras: bool, learn_exposure: bool) -> None:
        self.given = list(cameras)
        self.pixel = float(np.mean([1 / np.mean(camera.focal) for camera in self.given]))  # radians, of whole photographs
        self.pivot, _ = focus_point(self.given)
        kinds = list(dict.fromkeys(map(_kind, self.given)))
        self._kinds = {kind: k for k, kind in enumerate(kinds)}
        self.rows: dict[str, Rows] = {}
        if learn_cameras:
            self.rows |= {POSES: Rows(len(self.given), len(POSE)), LENSES: Rows(len(kinds), len(INTRINSICS))}
        if learn_exposure:
            self.rows[EXPOSURE] = Rows(len(self.given), 3)
        self._modes = _similarities(self.given, self.pivot)
        self._bases = _whitening(self.given, self.pivot, extent)
        self._leaves: list[tuple[str, int, list[mi.Float]]] = []

    @classmethod
    def of(cls, dataset: Dataset, settings: Settings, extent: float) -> "Cameras | None":
        """The corrections that ``settings`` ask for, of photographs of an object of radius ``extent`` in world units; None
        where nothing is learned."""
        cameras, exposure = settings.cameras == "learned", settings.exposure == "learned"
        if not (cameras or exposure):
            return None
        fitted = cls([view.camera for view in dataset.train], extent, cameras, exposure)
        if exposure:
            fitted.rows[EXPOSURE].value += log_gains([view.path for view in dataset.train])[:, None]
        return fitted

    def begin(self, cameras: Sequence[Camera]) -> None:
        """Begin with the poses of these ``cameras``, one for each view, where cameras are learned."""
        if POSES in self.rows:
            pairs = zip(self.given, cameras, strict=True)
            self.rows[POSES].value[:] = [correction(given, moved, self.pivot) for given, moved in pairs]

    # ---- A step ----

    def see(self, view: int, camera: Camera, weights: Weights, started: bool = True) -> Seen:
        """Return how a step sees the ``view`` of this index through ``camera``, a window or another size of its own, with
        gradients for the next `step`. Cameras stay as they begin until they have ``started``."""
        gain, prior = None, mi.Float(0)
        if POSES in self.rows:
            kind = self._kinds[_kind(self.given[view])]
            pose, intrinsics = (self._leaf(name, row, started) for name, row in ((POSES, view), (LENSES, kind)))
            camera = replace(camera, learned=learned_camera(self.given[view], self.pivot, pose, intrinsics))
            squares = lambda values: sum((dr.square(v) for v in values), mi.Float(0))
            prior += dr.opaque(mi.Float, weights.poses) * squares(pose)
            prior += dr.opaque(mi.Float, weights.intrinsics) * squares(intrinsics)
        if EXPOSURE in self.rows:
            gain = dr.exp(mi.Color3f(*self._leaf(EXPOSURE, view)))
            dr.eval(gain)
        return Seen(camera, gain, prior)

    def _leaf(self, name, row, learned=True):
        leaf = [dr.opaque(mi.Float, v) for v in self.rows[name].value[row].tolist()]
        if learned:
            dr.enable_grad(leaf)
            self._leaves.append((name, row, leaf))
        return leaf

    def gradients(self) -> dict[str, dict[int, np.ndarray]]:
        """Return what the views seen since the last call have gradients for, {name: {row: [K]}}."""
        gradients: dict[str, dict[int, np.ndarray]] = {name: {} for name in self.rows}
        found = [[dr.grad(v) for v in leaf] for _, _, leaf in self._leaves]
        dr.eval(found)
        for (name, row, _), leaf in zip(self._leaves, found):
            gradient = np.array([float(v[0]) for v in leaf])
            gradients[name][row] = gradients[name].get(row, 0) + gradient
        self._leaves.clear()
        return gradients

    def step(self, gradients: Mapping[str, Mapping[int, np.ndarray]], rates: Mapping[str, float]) -> None:
        """Move what has `gradients`, at the ``rates`` of `POSES`, `LENSES` and `EXPOSURE`; then take out some of what surfels and
        light can follow: a similarity of the world, and a gain of all."""
        for name, rows in gradients.items():
            self.rows[name].step(rows, rates.get(name, 0.0), self._bases if name == POSES else None)
        if POSES in self.rows:
            poses = self.rows[POSES].value
            poses -= _HOLD * (self._modes @ (self._modes.T @ poses.ravel())).reshape(poses.shape)
        if EXPOSURE in self.rows:
            self.rows[EXPOSURE].value -= _HOLD * self.rows[EXPOSURE].value.mean(0)

    # ---- What came out ----

    def camera(self, view: int) -> Camera:
        """Return the camera of the training ``view`` of this index as it is learned by now."""
        return self._camera(self.given[view], self.rows[POSES].value[view]) if POSES in self.rows else self.given[view]

    def calibrated(self, camera: Camera) -> Camera:
        """Return any view's ``camera`` with what was learned of its intrinsics, where training views have the same."""
        return self._camera(camera, np.zeros(len(POSE))) if POSES in self.rows and _kind(camera) in self._kinds else camera

    def gain(self, view: int) -> np.ndarray:
        """Return the gain of the training ``view`` of this index, [3]."""
        return np.exp(self.rows[EXPOSURE].value[view]) if EXPOSURE in self.rows else np.ones(3)

    def _camera(self, given, pose):
        values = self.rows[LENSES].value[self._kinds[_kind(given)]]
        opaque = lambda numbers: [dr.opaque(mi.Float, float(v)) for v in numbers]
        return replace(given, learned=learned_camera(given, self.pivot, opaque(pose), opaque(values))).baked()

    # ---- State ----

    def state(self) -> dict[str, np.ndarray]:
        """Return everything that a checkpoint needs, as NumPy arrays."""
        return {f"cameras.{name}.{k}": v for name, rows in self.rows.items() for k, v in rows.state().items()}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take the `state` that a checkpoint has; what it knows nothing of begins at zero."""
        for name, rows in self.rows.items():
            prefix = f"cameras.{name}."
            if f"{prefix}value" in arrays:
                rows.restore({k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)})


def _kind(camera):
    """What cameras have in common whose intrinsics are learned together."""
    return (*camera.focal, *camera.principal, *camera.size)


def _similarities(cameras, pivot) -> np.ndarray:
    """[6 V, M] orthonormal columns: what small similarities of the world, which nothing can see, add to the poses of
    `learned_camera`. With θ a rotation about the pivot, t a translation and s a scale they are ω = −R θ and
    τ = (s R (c − o) − R t) / d."""
    modes = np.zeros((len(cameras), len(POSE), 7))
    for k, camera in enumerate(cameras):
        to_pivot = camera.rotation @ (pivot - camera.origin)
        distance = np.linalg.norm(to_pivot)
        modes[k, :3, :3] = modes[k, 3:, 3:6] = camera.rotation
        modes[k, 3:, 3:6] /= distance
        modes[k, 3:, 6] = to_pivot / distance
    flat = modes.reshape(-1, 7)
    u, size, _ = np.linalg.svd(flat / np.maximum(np.linalg.norm(flat, axis=0), 1e-12), full_matrices=False)
    return u[:, size > 1e-6]


def _whitening(cameras, pivot, extent) -> np.ndarray:
    """[V, 6, 6]: bases of poses in which coordinates move what is seen of the object by much the same, a unit by 1 in x/z units
    (root mean square), and none does what others do (CamP, Park et al. 2023): (C + λ)^(−1/2), with C the mean of JᵀJ over the
    visible side of a sphere of radius ``extent`` and J the derivatives of x/z and y/z by the pose. What hardly shows is no
    farther off than what does, so λ keeps the steps short that look for it.

    A camera sees the near side of the object alone, which turning about its middle shifts as well: without this the shift
    would have to be found before the turn shows.
    """
    k = np.arange(_POINTS) + 0.5
    z, azimuth = 1 - 2 * k / _POINTS, np.pi * (1 + 5**0.5) * k
    sphere = np.stack([np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z], -1)
    bases = []
    for camera in cameras:
        to_pivot = camera.rotation @ (pivot - camera.origin)
        distance = float(np.linalg.norm(to_pivot))
        offset = min(extent, _NEAREST * distance) * sphere
        point = offset + to_pivot
        cosine = np.maximum(-(point * sphere).sum(1), 0)
        x, y, depth = point.T
        zero, one = np.zeros_like(x), np.ones_like(x)
        dx, dy = np.stack([one, zero, -x / depth], -1), np.stack([zero, one, -y / depth], -1)
        # A turn ω moves a point by ω × offset, and (ω × offset)·d = ω·(offset × d)
        jacobian = np.stack([np.concatenate([np.cross(offset, d), distance * d], -1) for d in (dx, dy)]) / depth[:, None]
        weight = np.where(depth > 0, cosine, 0)
        covariance = np.einsum("cni,cnj,n->ij", jacobian, jacobian, weight) / max(weight.sum(), 1e-9)
        size, vectors = np.linalg.eigh(covariance)
        bases.append((vectors / np.sqrt(size + _DAMPING * size[-1])) @ vectors.T)
    return np.array(bases)

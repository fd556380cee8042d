"""Cameras from silhouettes: poses as someone has estimated them are moved to where the masks agree.

Two cameras see one object within the same wedge: of the planes through both of them, the first and the last that touch the
object touch its silhouette in both pictures (Wong and Cipolla 2001; Sinha and Pollefeys 2004). So each pair of photographs
tells two numbers, whatever their surfaces reflect, where points that are matched lie on mirrors; of 60 photographs that is
ten times what their poses have. Least squares of them all take seconds, and need no surface yet.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation
from skimage.measure import find_contours

from ..core.camera import Camera, focus_point
from ..datasets.types import View

_LEAST = 8  # views with silhouettes
_WIDEST = 2.5  # radians of a wedge: where the other camera stands in front of the object, or nearly, there is none
_APART = 0.01  # of their distance from the object that two cameras are apart at least, to have a baseline
_FRAME = 1.0  # pixels: a silhouette that touches the frame so nearly ends there, not where the object does
_STEPS, _STILL = 20, 1e-4  # of Gauss and Newton's method at most; radians: a step that is shorter is the last
_PROBE = 1e-5  # radians, of differences
_OUTLIER = 2.5  # robust deviations at which a contact counts half
_PRIOR = 0.01  # radians that poses are off as they are given
_TOGETHER = 3  # errors of contacts are alike in so many directions that they tell as if they were so many times as large
_BETTER = 0.5  # of the disagreement is left, at most, where poses are taken


@dataclass(frozen=True)
class Agreement:
    """``cameras`` as silhouettes have them, and how far contours of pairs of photographs are from one another, medians in
    pixels: with the cameras as ``given``, and ``now``."""

    cameras: list[Camera]
    given: float
    now: float

    @property
    def better(self) -> bool:
        """Whether silhouettes agree so much better that these cameras are nearer to the true ones. Masks are off, too: where
        cameras were right, errors of the masks are all there is, and moving cameras takes little of them."""
        return self.now <= _BETTER * self.given


def agreement(views: Sequence[View]) -> Agreement | None:
    """Return the cameras, in the order of ``views``, that bring the silhouettes of their masks into agreement; None where fewer
    than eight have any that tells. Intrinsics stay as they are, and so does a similarity of the world, of which silhouettes
    know nothing."""
    outlines = [_outline(view) if view.masked else None for view in views]
    seen = [k for k, outline in enumerate(outlines) if outline is not None]
    if len(seen) < _LEAST:
        return None
    problem = _Problem([views[k].camera for k in seen], [outline for outline in outlines if outline is not None])
    poses = np.zeros((len(seen), 6))
    contacts = problem.contacts(poses)
    if len(contacts.first) < 6 * len(seen):
        return None
    given = float(np.median(np.abs(problem.residuals(poses, contacts))))
    for _ in range(_STEPS):
        step = problem.step(poses, contacts)
        poses = poses + step
        contacts = problem.contacts(poses)
        if np.abs(step).max() < _STILL:
            break
    now = float(np.median(np.abs(problem.residuals(poses, contacts))))
    moved = dict(zip(seen, problem.cameras(poses)))
    return Agreement([moved.get(k, view.camera) for k, view in enumerate(views)], given, now)


# ---- Silhouettes ----


def _outline(view):
    """(unit rays [K, 3] in camera space to the corners of the silhouette's convex hull, which of them lie on the frame [K]), or
    None for a mask in which nothing is, or that fills the photograph."""
    width, height = view.camera.size
    lines = find_contours(np.pad(view.alpha, 1), 0.5)
    try:
        points = np.concatenate(lines)[:, ::-1] - 0.5  # of the array, padded by one, to pixels, whose first center is at 0.5
        points = points[ConvexHull(points).vertices]
    except (ValueError, QhullError):
        return None
    on_frame = (np.minimum(points, np.array([width, height]) - points) < _FRAME).any(1)
    if on_frame.all():
        return None
    rays = np.concatenate([(points - view.camera.principal) / view.camera.focal, np.ones((len(points), 1))], -1)
    if view.camera.lens is not None:
        rays[:, :2] = np.stack(view.camera.lens.undistort(*rays[:, :2].T), -1)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True), on_frame


@dataclass(frozen=True)
class _Contacts:
    """Planes through pairs of cameras that touch the object: indices of the ``first`` and the ``second`` camera [N], and the
    rays ``a`` and ``b`` [N, 3], in their camera spaces, at which each sees it touch."""

    first: np.ndarray
    second: np.ndarray
    a: np.ndarray
    b: np.ndarray


class _Problem:
    """Poses [V, 6], corrections (ω, τ) of the given cameras as in `core.learned_camera` (12), and how far contacts are apart."""

    def __init__(self, cameras, outlines):
        self.given, self.outlines = cameras, outlines
        self.pivot, _ = focus_point(cameras)
        self.rotation = np.stack([camera.rotation for camera in cameras])
        self.to_pivot = np.stack([camera.rotation @ (self.pivot - camera.origin) for camera in cameras])
        self.distance = np.linalg.norm(self.to_pivot, axis=1)
        self.focal = np.array([np.mean(camera.focal) for camera in cameras])

    def placed(self, poses):
        """(rotations [V, 3, 3] world to camera, origins [V, 3])."""
        rotation = Rotation.from_rotvec(poses[:, :3]).as_matrix() @ self.rotation
        moved = self.to_pivot + self.distance[:, None] * poses[:, 3:]
        return rotation, self.pivot - np.einsum("vji,vj->vi", rotation, moved)

    def cameras(self, poses):
        """The cameras so corrected."""
        return [
            replace(camera, to_world=np.block([[r.T, o[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]]))
            for camera, r, o in zip(self.given, *self.placed(poses))
        ]

    def contacts(self, poses):
        """The contacts as they are seen from cameras there: of each ordered pair, of which the planes' angles are counted in
        opposite directions, the plane that the first one sees last and the second one first."""
        rotation, origin = self.placed(poses)
        count = len(origin)
        last, first = np.zeros((count, count), int), np.zeros((count, count), int)
        apart = np.linalg.norm(origin[:, None] - origin, axis=-1) > _APART * self.distance[:, None]
        good_last, good_first = apart.copy(), apart.copy()
        for k, (rays, on_frame) in enumerate(self.outlines):
            _, toward, across = _pencil(origin[k], origin[:, None], self.pivot)
            angle = _angle(rays @ rotation[k], toward, across)  # [V, K]
            last[k], first[k] = angle.argmax(1), angle.argmin(1)
            narrow = np.ptp(angle, axis=1) < _WIDEST
            good_last[k] &= narrow & ~on_frame[last[k]]
            good_first[k] &= narrow & ~on_frame[first[k]]
        i, j = np.nonzero(good_last & good_first.T)
        rays = [outline[0] for outline in self.outlines]
        a = np.array([rays[v][k] for v, k in zip(i, last[i, j])]).reshape(-1, 3)
        b = np.array([rays[v][k] for v, k in zip(j, first[j, i])]).reshape(-1, 3)
        return _Contacts(i, j, a, b)

    def residuals(self, poses, contacts, other=None):
        """[N]: by how many pixels of one contour contacts are apart,

            (φᵢ − φⱼ) / √(1/(fᵢ sᵢ)² + 1/(fⱼ sⱼ)²)                                                              (15)

        since an error of σ pixels turns the plane by σ/(f s), with s the sine of the angle between ray and baseline. ``other``:
        poses of the second cameras, where they differ."""
        (r1, o1), (r2, o2) = self.placed(poses), self.placed(poses if other is None else other)
        i, j = contacts.first, contacts.second
        baseline, toward, across = _pencil(o1[i], o2[j], self.pivot)
        a, b = (np.einsum("nji,nj->ni", r[k], rays) for r, k, rays in ((r1, i, contacts.a), (r2, j, contacts.b)))
        gap = _angle(a, toward, across) - _angle(b, toward, across)
        variance = sum(
            1 / (self.focal[k] * np.linalg.norm(np.cross(rays, baseline), axis=1)) ** 2 for k, rays in ((i, a), (j, b))
        )
        return gap / np.sqrt(variance)

    def step(self, poses, contacts):
        """[V, 6]: Gauss and Newton's next step to the poses that are most likely, with errors of contacts in Cauchy's
        distribution. Of a similarity of the world the prior alone says something: that there is none."""
        residuals = self.residuals(poses, contacts)
        columns, data = [], []
        for k in range(6):
            ahead = poses.copy()
            ahead[:, k] += _PROBE
            for member, (p, q) in ((contacts.first, (ahead, poses)), (contacts.second, (poses, ahead))):
                data.append((self.residuals(p, contacts, q) - residuals) / _PROBE)
                columns.append(6 * member + k)
        index = np.tile(np.arange(len(residuals)), len(columns)), np.concatenate(columns)
        jacobian = sparse.csr_matrix((np.concatenate(data), index), shape=(len(residuals), poses.size))
        sigma = 1.4826 * np.median(np.abs(residuals)) + 1e-3
        weights = 1 / (1 + (residuals / (_OUTLIER * sigma)) ** 2)
        normal = (jacobian.T @ jacobian.multiply(weights[:, None])).toarray()
        prior = (_TOGETHER * sigma / _PRIOR) ** 2
        right = jacobian.T @ (weights * residuals) + prior * poses.ravel()
        return -np.linalg.solve(normal + prior * np.eye(len(normal)), right).reshape(poses.shape)


def _pencil(first, second, pivot):
    """Frames of the planes through cameras at ``first`` and ``second`` [..., 3]: the baseline's direction, at right angles to it
    the one to the ``pivot``, and their cross product; angle 0 is the plane through the pivot. The other way round the last one
    is reversed."""
    unit = lambda v: v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)
    baseline = unit(second - first)
    toward = unit(pivot - first - np.sum((pivot - first) * baseline, -1, keepdims=True) * baseline)
    return baseline, toward, np.cross(baseline, toward)


def _angle(rays, toward, across):
    """[...]: angles of the planes through ``rays`` [..., 3], in world space, in their pencils."""
    return np.arctan2(np.sum(rays * across, -1), np.sum(rays * toward, -1))

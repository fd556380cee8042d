"""Did the object turn, or the camera go round it? What poses tell of a turntable, and what the background does."""

from collections.abc import Sequence

import numpy as np
from skimage.transform import resize

from ..core.camera import Camera, focus_point
from ..core.turntable import Turntable
from ..datasets.types import View

_MEMBERS, _PART = 6, 0.9  # cameras of a ring at least; the part of all that lie on rings about one axis
_LINK, _SPREAD = 0.5, 1.5  # degrees: from one camera of a ring to the next in elevation, and from their mean
_OFF = 0.03  # distances of the camera from the object that one may be off its ring by
_PAIRS, _LEAST_ANGLE, _MOST_ANGLE = 200, 10, 170  # of cameras, whose rotations into each other, in degrees, propose axes
_SMALL = 48  # pixels of the side of the pictures whose backgrounds are compared
_FEW, _FLAT = (
    40,
    2.0,
)  # pixels of background that are enough to tell; grey levels that they vary by where there is nothing in it
_STILL, _MOVING = 0.3, 0.7  # of what a background varies by within a picture: so much from picture to picture


def rings(cameras: Sequence[Camera]) -> Turntable | None:
    """Return the turntable on which ``cameras`` would have seen an object that turned, its rings without a turn; None where they
    do not stand on circles about one axis, each looking at it from its height as all of its ring do.

    Between two cameras of a ring lies a rotation about the axis a. With R a camera's rotation to its own space, R a is the same
    for all of a ring, and so is R (o − p), with o where it stands and p on the axis.
    """
    if len(cameras) < _MEMBERS:
        return None
    rotations, origins = np.stack([c.rotation for c in cameras]), np.stack([c.origin for c in cameras])
    center, _ = focus_point(cameras)
    up = -rotations[:, 1].mean(0)  # mostly: cameras are held upright
    best = max(_axes(rotations), key=lambda axis: _members(rotations, axis)[1].sum(), default=None)
    if best is None:
        return None
    axis = best if best @ up >= 0 else -best
    for _ in range(3):  # refined by all of its rings
        labels, on_ring = _members(rotations, axis)
        axis = _refined(rotations, labels, on_ring, axis)
    labels, on_ring = _members(rotations, axis)
    if on_ring.mean() < _PART:
        return None
    point, off = _center(rotations, origins, labels, on_ring, axis, center)
    if np.mean(off < _OFF) < _PART:
        return None
    table = Turntable.of([*axis, *point])
    elevations = np.array([table.elevation(camera) for camera in cameras])
    found = sorted(float(np.median(elevations[on_ring & (labels == k)])) for k in np.unique(labels[on_ring]))
    return Turntable(table.axis, table.point, tuple((e, 0.0) for e in found))


def _axes(rotations):
    """Axes [3] of rotations between pairs of cameras."""
    n, rng = len(rotations), np.random.default_rng(0)
    near = [(k, k + step) for step in (1, 2, 5) for k in range(n - step)]
    pairs = np.array(near + rng.integers(0, n, (_PAIRS, 2)).tolist())
    pairs = pairs[rng.permutation(len(pairs))[:_PAIRS]]
    between = np.einsum("kji,kjl->kil", rotations[pairs[:, 1]], rotations[pairs[:, 0]])  # world to world
    angle = np.degrees(np.arccos(np.clip((np.trace(between, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    skew = between - between.transpose(0, 2, 1)
    axes = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], -1)[(angle > _LEAST_ANGLE) & (angle < _MOST_ANGLE)]
    return axes / np.linalg.norm(axes, axis=1, keepdims=True)


def _members(rotations, axis):
    """(ring of each camera, whether it is of one) about an ``axis``: those whose pictures show the axis alike, in steps of
    `_LINK` of its slant, and within `_SPREAD` of their mean."""
    shown = rotations @ axis
    slant = np.degrees(np.arcsin(np.clip(shown[:, 2], -1, 1)))
    order = np.argsort(slant)
    labels = np.empty(len(slant), int)
    labels[order] = np.cumsum(np.diff(slant[order], prepend=slant[order[0]]) > _LINK)
    on_ring = np.zeros(len(slant), bool)
    for k in np.flatnonzero(np.bincount(labels) >= _MEMBERS):
        of = labels == k
        mean = shown[of].mean(0)
        angle = np.degrees(np.arccos(np.clip(shown[of] @ mean / np.linalg.norm(mean), -1, 1)))
        if np.percentile(angle, 90) < _SPREAD:
            on_ring[np.flatnonzero(of)] = angle < 2 * _SPREAD
    return labels, on_ring


def _refined(rotations, labels, on_ring, axis):
    """The axis that the cameras of each ring show most alike: Σ |R a − mean R a|² is least."""
    scatter = np.zeros((3, 3))
    for k in np.unique(labels[on_ring]):
        R = rotations[on_ring & (labels == k)]
        scatter += np.einsum("kji,kjl->il", R - R.mean(0), R - R.mean(0))
    if not scatter.any():
        return axis
    found = np.linalg.eigh(scatter)[1][:, 0]
    return found if found @ axis >= 0 else -found


def _center(rotations, origins, labels, on_ring, axis, center):
    """(the point [3] on the axis that is nearest to ``center``; how far off its ring each camera is, in distances from that)."""
    kinds = np.unique(labels[on_ring])
    chosen = np.flatnonzero(on_ring)
    matrix, right = np.zeros((len(chosen), 3, 3 + 3 * len(kinds))), origins[chosen]
    for row, k in enumerate(chosen):
        column = 3 + 3 * int(np.searchsorted(kinds, labels[k]))
        matrix[row, :, :3], matrix[row, :, column : column + 3] = np.eye(3), rotations[k].T
    solution = np.linalg.lstsq(matrix.reshape(-1, matrix.shape[2]), right.ravel(), rcond=None)[0]
    residual = (right.ravel() - matrix.reshape(-1, matrix.shape[2]) @ solution).reshape(-1, 3)
    off = np.full(len(origins), np.inf)
    off[chosen] = np.linalg.norm(residual, axis=1) / np.linalg.norm(origins[chosen] - center, axis=1)
    # along the axis anything will do
    return solution[:3] + axis * (axis @ (center - solution[:3])), off


def background_stands_still(views: Sequence[View], table: Turntable) -> bool | None:
    """Return whether what ``views`` show beside the object stays where it is in the pictures of a ring of ``table``; None where
    they show nothing there, or where it is hard to tell."""
    ring = np.array([table.ring(view.camera) or 0 for view in views])
    ratios = []
    for k in np.unique(ring):
        chosen = [view for view, own in zip(views, ring) if own == k]
        if len(chosen) >= _MEMBERS and (ratio := _movement(chosen)) is not None:
            ratios.append(ratio)
    if not ratios:
        return None
    ratio = float(np.median(ratios))
    return True if ratio < _STILL else False if ratio > _MOVING else None


def _movement(views):
    """By how much the background varies from picture to picture, over how much it does within one; None where it is empty."""
    small = lambda image: np.asarray(resize(np.float32(image), (_SMALL, _SMALL), anti_aliasing=True))
    pictures = np.stack([small(view.pixels[..., :3]) for view in views])
    if views[0].pixels.dtype != np.uint8:
        pictures = 255 * np.clip(pictures, 0, 1)
    covered = np.max([small(view.alpha) if view.masked else np.zeros((_SMALL, _SMALL)) for view in views], axis=0)
    free = covered < 0.01
    if not all(view.masked for view in views):  # the object is somewhere in the middle
        row, column = np.mgrid[:_SMALL, :_SMALL]
        free &= np.minimum.reduce([row, column, _SMALL - 1 - row, _SMALL - 1 - column]) < _SMALL // 10
    if free.sum() < _FEW:
        return None
    background = pictures[:, free].mean(-1)
    within = float(np.median(background, 0).std())
    if within < _FLAT:
        return None
    return float(np.median(np.abs(background - np.median(background, 0)), 0).mean() * 1.4826 / within)

"""Where the first surfels stand: on the visual hull, where photographs agree on a depth, on a sparse point cloud, or anywhere in
view."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import spatial

from ..core.camera import focus_point
from ..datasets.types import Dataset, View
from . import hull, stereo
from .openings import COPIES, openings, seen_through
from .photometric_variation import Appearance, appearance
from .sampling import sample_surface
from .surface_points import oriented_points

_FAR = 10
_DEEPER = 2  # area of what lies below the hull, over that of the hull that is seen through
_A_WRONG_MASK = 32  # in so many photographs one mask may be wrong at any point
_COMPARED = 120  # photographs at most that are compared: more say little more, and half a second goes into each
_BESIDE = 1.5  # steps of the hull's grid that a point lies off it at least, which counts as beside it
_FEW = 0.1  # of the points that are wanted: fewer that photographs agree on are no start


class Points(NamedTuple):
    """Where surfels start: ``positions`` [N, 3] and unit ``normals`` [N, 3] (None: points of no surface), world space;
    ``spacing`` [N], the mean distance to the three nearest neighbours (at least 1e-7); and their ``appearance``. All float32."""

    positions: np.ndarray
    normals: np.ndarray | None
    spacing: np.ndarray
    appearance: Appearance

    def joined_with(self, others: "Points") -> "Points":
        """Return these points and ``others``."""
        assert self.normals is not None and others.normals is not None, "either both are on surfaces or none"
        positions = np.concatenate([self.positions, others.positions])
        normals = np.concatenate([self.normals, others.normals])
        spacing = np.concatenate([self.spacing, others.spacing])
        look = (np.concatenate(pair) for pair in zip(self.appearance, others.appearance))
        return Points(positions, normals, spacing, Appearance._make(look))

    def chosen(self, index: np.ndarray) -> "Points":
        """Return the points of an ``index`` [M], or those for which it says True [N]."""
        normals = None if self.normals is None else self.normals[index]
        look = Appearance._make(values[index] for values in self.appearance)
        return Points(self.positions[index], normals, self.spacing[index], look)

    def in_places(self) -> "Points":
        """Return the same points in an order in which those that follow one another are near one another: what a pixel sees then
        lies together in memory, too."""
        return self.chosen(spatial.KDTree(self.positions).indices)


def initial_points(
    dataset: Dataset, count: int, seed: int = 0, on_hull: bool = True, compare: bool = True, quiet: bool = True
) -> Points:
    """Return the starting points of a fit to ``dataset.train`` (docs/method.md §5).

    Where images have masks and ``on_hull`` is set, ``count`` points on the visual hull (of photographs' masks few are
    outvoted); with ``compare`` less those that
    photographs look through, plus what they agree on below it. Where they have none, about ``count`` points that photographs
    agree on, with ``compare``; else, or where these are few, ``dataset.points`` (a random ``count`` of them where there are
    more), else ``count`` points at random in the ball that the cameras look into. ``quiet``: no progress.
    """
    rng, views = np.random.default_rng(seed), dataset.train
    if any(view.masked for view in views):
        if on_hull:
            return _on_hull(views, count, rng, compare, len(views) // _A_WRONG_MASK if dataset.photographed else 0, quiet)
    elif compare:
        compared = _spread(views)
        maps = stereo.verified(stereo.depth_maps(compared, quiet=quiet))
        positions, normals = oriented_points(maps, count, rng)
        if len(positions) > _FEW * count:
            look = appearance(positions, compared, _seen_in(maps, compared))
            return Points(positions, normals, spacing_of(positions), look)
    if dataset.points is not None and len(dataset.points):
        chosen = np.sort(rng.permutation(len(dataset.points))[:count])
        positions = np.asarray(dataset.points, np.float32)[chosen]
        if dataset.point_colors is not None:
            colors = np.asarray(dataset.point_colors, np.float32)[chosen]
            return Points(positions, None, spacing_of(positions), Appearance.of(colors))
    else:
        center, reach = focus_point([view.camera for view in views])
        # Half a frame's extent at the center, for the typical camera: inside that ball all of them see something.
        half = np.median([min(v.camera.size[k] / v.camera.focal[k] for k in (0, 1)) / 2 for v in views])
        ball = rng.normal(size=(count, 3))
        ball *= rng.random((count, 1)) ** (1 / 3) / np.linalg.norm(ball, axis=1, keepdims=True)
        positions = (center + reach * min(half, 1.0) * ball).astype(np.float32)
    return Points(positions, None, spacing_of(positions), _unhidden(positions, views))


def _on_hull(views, count, rng, compare, outvoted, quiet) -> Points:
    """`initial_points` of an object with masks."""
    mesh = hull.surface(hull.visual_hull(views, outvoted=outvoted))
    positions, normals = sample_surface(*mesh, count, rng)
    if compare:
        compared = _spread(views)
        maps = stereo.verified(stereo.depth_maps(compared, mesh[:2], quiet))
        opened = openings(stereo.depth_maps(compared, mesh[:2], quiet, COPIES))
        gone, tree = seen_through(positions, opened, maps), spatial.KDTree(positions)
        below = oriented_points(
            opened + maps, _DEEPER * int(gone.sum()), rng, lambda above: gone[tree.query(above, workers=-1)[1]]
        )
        if not gone.all():
            positions, normals = (np.concatenate([on[~gone], new]) for on, new in zip((positions, normals), below))
    return _seen_on(mesh, positions, normals, views)


def around_hull(
    points: Points, views: Sequence[View], field: hull.SignedField, over: float, least: float, rng: np.random.Generator
) -> Points:
    """Return those of ``points`` that lie beside the hull that ``field`` is of, and on it as many as the others were, or a
    ``least`` part of all if that is more, with normals that are smoothed ``over`` so many steps; ``views`` show them without
    masks."""
    inside = field.at(points.positions) > -_BESIDE * field.step
    mesh = hull.surface(field, over)
    positions, normals = sample_surface(*mesh, max(int(inside.sum()), int(least * len(inside))), rng)
    return points.chosen(~inside).joined_with(_seen_on(mesh, positions, normals, views))


def _seen_on(mesh, positions, normals, views) -> Points:
    """Points on a hull's ``mesh``, or below it, as the ``views`` show them."""
    spacing = spacing_of(positions)
    vertices, faces, _ = mesh
    depths = hull.depth_maps(vertices, faces, [view.camera for view in views])
    reach = 2 * float(np.median(spacing))
    seen = lambda index, z, column, row: z < depths[index][row, column] + reach  # NaN: nothing is there
    return Points(positions, normals, spacing, appearance(positions, views, seen))


def _spread(views):
    """At most `_COMPARED` of ``views``, evenly from first to last: neighbours in a capture are alike."""
    return [views[i] for i in np.linspace(0, len(views) - 1, min(len(views), _COMPARED)).round().astype(int)]


def _unhidden(positions, views) -> Appearance:
    """The mean color of points that may hide each other, which tells nothing of how one of them varies."""
    return Appearance.of(appearance(positions, views, lambda *_: True).color)


def _seen_in(maps, views):
    """Which points their ``maps`` have, for the `appearance` in the ``views``: no others, before or behind."""

    def seen(index, z, column, row):
        m, size = maps[index], views[index].camera.size
        x, y = column * m.camera.size[0] // size[0], row * m.camera.size[1] // size[1]
        return np.abs(z - m.depth[y, x]) < m.tolerance[y, x]

    return seen


def surroundings(dataset: Dataset, count: int, seed: int = 0) -> Points:
    """Return points far away for what lies behind an object without a mask, as `initial_points` does: on a sphere about it,
    `_FAR` times as far as the cameras; the normals point inwards."""
    center, reach = focus_point([view.camera for view in dataset.train])
    outward = np.random.default_rng((seed, 1)).normal(size=(count, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    positions = (center + _FAR * reach * outward).astype(np.float32)
    return Points(positions, -outward.astype(np.float32), spacing_of(positions), _unhidden(positions, dataset.train))


def spacing_of(positions: np.ndarray) -> np.ndarray:
    """Return the mean distance [N] of ``positions`` [N, 3] to the three nearest neighbours, 1e-7 at least; 1 for a lone point."""
    neighbours = min(3, len(positions) - 1)
    if neighbours < 1:
        return np.ones(len(positions), np.float32)
    distance, _ = spatial.KDTree(positions).query(positions, neighbours + 1, workers=-1)
    return np.maximum(distance[:, 1:].mean(1), 1e-7).astype(np.float32)

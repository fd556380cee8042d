"""How far the walls of a near room stand, told by what several photographs show reflected.

As if surfaces were mirrors, a pixel that shows C, of which C_d is diffuse, shows of the environment

    L = (C − C_d) / E,                                                                                                 (27)

E the albedo of (4) in `shading/tables.py`. Walls put it into the texel t of ω' of (14) in `shading/room.py`. Where they stand
right all that was seen of a spot of a wall is alike, so that those are sought which have the least

    V = Σ_i w_i (y_i − ȳ_t(i))² n_t(i) / (n_t(i) − 1) / Σ_i w_i,   y = log(ε + L),   w = E,                            (28)

with n_t how many pixels show t. No environment is in it that was fitted among other walls, and with which gradients would stay.
Normals have to be those of the start on the hull: a fit to light at infinity bends them until they explain what they show by it.

Photographs without masks show the walls themselves. Points p of what surrounds the object, seen from its middle along ω in so
many directions, tell those walls, d_a along the axis a, that have the least

    Σ_ω | log |p| − log min_a d_a / |ω_a| |,                                                                              (29)

and (28) is asked of the others alone.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.color import srgb_decode
from ..core.progress import Progress
from ..core.runtime import release_memory
from ..datasets.photographs import Photographs
from ..datasets.types import Dataset
from ..settings.settings import Settings
from ..shading import deferred
from ..shading.environment import FilteredEnvironment
from ..shading.room import SIDES, Room
from ..shading.split_sum import albedo
from ..shading.tables import specular_of
from .light import short
from .trainer import Fit

_ROUNDS = 2  # short fits, the first to light at infinity
_ROWS, _A_TEXEL = (16, 64), 20  # rows, at least and at most, of the map whose texels are compared; pixels in one of them
_SHARP, _LEAST_ALBEDO, _WHITE, _OPAQUE = 0.25, 0.1, 0.99, 0.98  # of what counts: rougher, darker, whiter is left out
_ENOUGH = _A_TEXEL * 2 * _ROWS[0] ** 2  # pixels that show reflections, to tell walls
_EPSILON, _FEWEST = 0.05, 3  # ε, and the pixels of a texel that counts
_FACTORS = 1.5, 1.2, 1.1, 1.05  # from one distance to the next, finer and finer
_ALL = 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 12.0, 16.0  # radii of the object, of all walls at first
_BOUNDS = 0.5, 32.0  # the least and the largest
_BEYOND = 1.2  # radii of the object from which on points are surroundings
_CELLS = 24  # of directions, along a side of a cube
_AGREE = 0.1  # of the distance, that a spot of a wall is off it at most
_CLEAR = 0.95  # of the variance of light at infinity that walls may have


@dataclass(frozen=True)
class Reflections:
    """What pixels show of the environment: ``log_radiance`` and ``weight`` are y and w of (28); ``direction`` and ``q`` those
    of (14). ``reach`` [6] is how far cameras stand from the center towards each wall (`SIDES`), in world units: they are among
    them."""

    direction: "mi.Vector3f"
    q: "mi.Vector3f"
    log_radiance: "mi.Color3f"
    weight: "mi.Float"
    reach: np.ndarray

    @classmethod
    def seen_by(cls, fit: Fit) -> "Reflections":
        """Those that the training photographs of a ``fit`` show at its resolution."""
        s = fit.settings
        photographs = Photographs(fit.dataset.train, fit.stage.downscale, s.background, rim=s.mask_rim)
        with dr.suspend_grad():
            surfels = fit.model.surfels(fit.sh_order)
            lighting = fit.lighting(surfels)
            assert lighting is not None, "something is specular"
            found = [_shown(fit, surfels, lighting, photographs.tile(k)) for k in range(len(fit.dataset.train))]
        direction, q, light, weight, eye = (
            np.ascontiguousarray(np.concatenate(parts, -1), np.float32) for parts in zip(*found)
        )
        log_radiance = mi.Color3f(np.log(_EPSILON + light))
        return cls(mi.Vector3f(direction), mi.Vector3f(q), log_radiance, mi.Float(weight), _reach(eye))

    def __len__(self) -> int:
        return dr.width(self.weight)

    @property
    def rows(self) -> int:
        """Of the map, twice as wide, whose texels are compared."""
        return int(np.clip(np.sqrt(len(self) / (2 * _A_TEXEL)), *_ROWS))

    def variance(self, distances: np.ndarray) -> float:
        """V of (28) for walls at six ``distances`` from the center (`SIDES`), in world units."""
        room, rows = Room((0.0, 0.0, 0.0), mi.Float([float(1 / d) for d in distances])), self.rows
        longitude, colatitude = FilteredEnvironment.coordinates(room.seen(self.direction, self.q)[0])
        row = dr.minimum(mi.UInt32(colatitude * rows), rows - 1)
        texel = row * (2 * rows) + dr.minimum(mi.UInt32(longitude * (2 * rows)), 2 * rows - 1)
        n, weight = self._sum(texel, mi.Float(1)), self._sum(texel, self.weight)
        mean = [self._sum(texel, self.weight * y) / dr.maximum(weight, 1e-9) for y in self.log_radiance]
        off = [dr.square(y - dr.gather(mi.Float, m, texel)) for y, m in zip(self.log_radiance, mean)]
        squares = self._sum(texel, self.weight * (off[0] + off[1] + off[2]) / 3) * n / dr.maximum(n - 1, 1)
        counts = n >= _FEWEST
        return float((dr.sum(dr.select(counts, squares, 0)) / dr.sum(dr.select(counts, weight, 0)))[0])

    def _sum(self, texel, values):
        sums = dr.zeros(mi.Float, 2 * self.rows**2)
        dr.scatter_reduce(dr.ReduceOp.Add, sums, values, texel)
        return sums


def _shown(fit, surfels, lighting, photograph):
    """Of one photograph ω [3, n] and q [3, n] of (14), L [3, n] and w [n], and where its camera is [3, 1], as q."""
    camera = photograph.camera
    image = deferred.render(surfels, camera, lighting)
    inside = deferred.within(image.gbuffer, camera, lighting.box) & (image.gbuffer.all.alpha > _OPAQUE)
    index = dr.compress(inside & (dr.max(photograph.color) < _WHITE))
    surface = deferred.surface(image.gbuffer, camera, index)
    environment = lighting.seen_by(camera, dr.width(index)).estimator.environment.environment
    specular = dr.opaque(mi.Float, specular_of(fit.shading.eta))
    E, _ = albedo(surface.cosine, surface.roughness, surface.metallic, surface.base_color, specular)
    direction = environment.to_local(2 * surface.cosine * surface.normal - surface.view)
    center = mi.Point3f(*map(float, fit.model.center))
    q, eye = (environment.to_local(point - center) for point in (surface.point, mi.Point3f(*map(float, camera.origin))))
    at = lambda image: np.array(dr.gather(mi.Color3f, image, index))
    E, weight = np.array(E), np.array(dr.mean(E))
    light = (srgb_decode(at(photograph.color)) - at(image.diffuse)) / np.maximum(E, _EPSILON)
    counts = (np.array(surface.roughness) < _SHARP) & (weight > _LEAST_ALBEDO)
    shown = [a[..., counts] for a in (np.array(direction), np.array(q), np.maximum(light, 0), weight)]
    return [*shown, np.array(eye).reshape(3, 1)]


def nearest(reflections: Reflections, extent: float, known: np.ndarray | None = None) -> tuple[np.ndarray, float]:
    """Return (distances [6], part): of the walls (`SIDES`), in world units, that have the least variance (28), and what part of
    that of light at infinity it is. ``extent`` is the object's radius; ``known`` distances [6] stay (NaN: is looked for). All at
    once, then each by itself, closer and closer, but no closer than cameras stand."""
    known = np.full(len(SIDES), np.nan) if known is None else known
    far = reflections.variance(np.full(len(SIDES), np.inf))
    distances, least = _searched(reflections.variance, known, reflections.reach, extent)
    return distances, least / far


def _searched(cost, known, reach, extent):
    """(distances [6], cost) of the least ``cost`` that a pattern search (Hooke and Jeeves 1961) finds, from all walls at one
    distance on, but for those that are ``known``, and no nearer than cameras ``reach`` [6]."""
    lower, free = np.maximum(reach, _BOUNDS[0] * extent), np.isnan(known)
    distances = min((np.where(free, np.maximum(d * extent, lower), known) for d in _ALL), key=cost)
    least = cost(distances)
    for factor in _FACTORS:
        moved = True
        while moved:
            moved = False
            for side in np.flatnonzero(free):
                for times in (factor, 1 / factor):
                    other = distances.copy()
                    other[side] *= times
                    if lower[side] <= other[side] <= _BOUNDS[1] * extent and (v := cost(other)) < least:
                        distances, least, moved = other, v, True
    return distances, least


def _reach(eyes):
    """How far cameras at ``eyes`` [3, M] stand from the center towards each wall (`SIDES`), [6]."""
    return np.maximum(np.stack([-eyes.min(1), eyes.max(1)], 1).ravel(), 0)


def surrounding(points: np.ndarray, extent: float, eyes: np.ndarray) -> np.ndarray:
    """Return the distances [6] of the walls (`SIDES`) that ``points`` [N, 3] of the surroundings tell by (29), in the units of
    all, NaN where they do not. Points, and cameras, which stand among the walls, at ``eyes`` [M, 3], are relative to the middle
    of the object, whose radius is ``extent``, in the environment's frame; what lies closer to the object is no wall."""
    radius = np.linalg.norm(points, axis=1)
    points, radius = points[radius > _BEYOND * extent], radius[radius > _BEYOND * extent]
    direction = points / radius[:, None]
    cell = np.floor((direction + 1) / 2 * _CELLS).astype(np.intp) @ (1, _CELLS + 1, (_CELLS + 1) ** 2)
    _, cell, count = np.unique(cell, return_inverse=True, return_counts=True)
    group = [np.flatnonzero(cell == k) for k in np.flatnonzero(count >= _FEWEST)]
    if not group:
        return np.full(len(SIDES), np.nan)
    logs = np.array([np.median(np.log(radius[k])) for k in group])
    along = np.array([direction[k].mean(0) for k in group])
    ahead = 2 * np.arange(3) + (along > 0)  # [cells, 3] the wall along each axis
    across = np.maximum(np.abs(along), 1e-9)
    cost = lambda d: float(np.abs(logs - np.log((d[ahead] / across).min(1))).mean())
    distances, _ = _searched(cost, np.full(len(SIDES), np.nan), _reach(eyes.T), extent)
    there = distances[ahead] / across
    agree = np.abs(logs - np.log(there.min(1))) < _AGREE
    met = ahead[agree, there.argmin(1)[agree]]
    return np.where(np.bincount(met, minlength=len(SIDES)) >= _FEWEST, distances, np.nan)


def near_room(
    fit_of: Callable[[Dataset, Settings], Fit],
    dataset: Dataset,
    settings: Settings,
    quiet: bool,
    seen: Callable[[], np.ndarray] | None = None,
) -> Settings:
    """Return ``settings`` with a `room` in the place of 'auto'. It tells of it.

    Where photographs show the surroundings, the callback ``seen`` returns the walls that these tell (`surrounding`), in radii of
    the object; those that they do not tell are looked for by `Reflections` of a short fit among the others, as ``fit_of`` starts
    one. Else all are, of a short fit to light at infinity, then of another among the walls so found; and there are none where
    what is reflected is not clearly more alike among them.
    """
    if settings.room != "auto":
        return settings
    if settings.specular_start >= 1:
        return replace(settings, room=None)
    known = np.full(len(SIDES), np.nan) if seen is None else seen()
    if np.isnan(known).all():
        walls, found = _mirrored(fit_of, dataset, settings, quiet)
    else:
        walls, found = _completed(fit_of, dataset, settings, known, quiet), "photographs show what surrounds the object"
    listing = ", ".join(f"{side} {d:.1f}" for side, d in zip(SIDES, walls or ()))
    chosen = f"a room, walls at {listing} radii of the object" if walls else "light at infinity"
    if not quiet:
        print(f"{found}: {chosen} (--set room=… changes it)", file=sys.stderr)
    return replace(settings, room=walls)


def _mirrored(fit_of, dataset, settings, quiet):
    """The walls that mirrors tell, or None, and what was found."""
    walls, part = None, 1.0
    with Progress(quiet=quiet, label="walls of the room") as progress:
        for k in range(_ROUNDS):
            done = lambda part, k=k: progress.update((k + part) / _ROUNDS)
            reflections, extent = _reflections(fit_of, dataset, settings, walls, done)
            if len(reflections) < _ENOUGH:
                break
            distances, part = nearest(reflections, extent)
            walls = tuple(float(d) for d in distances / extent)
            if part > _CLEAR:
                break
    found = f"among walls what is reflected differs {part:.2f} times as much from view to view as under light at infinity"
    return walls if part <= _CLEAR else None, found


def _completed(fit_of, dataset, settings, known, quiet):
    """The walls, some of which are ``known``, in radii of the object."""
    walls = np.where(np.isnan(known), np.nanmedian(known), known)
    if np.isnan(known).any():
        with Progress(quiet=quiet, label="walls of the room") as progress:
            reflections, extent = _reflections(fit_of, dataset, settings, tuple(map(float, walls)), progress.update)
            if len(reflections) >= _ENOUGH:
                walls = nearest(reflections, extent, known * extent)[0] / extent
    return tuple(map(float, walls))


def _reflections(fit_of, dataset, settings, walls, done):
    """Those of a short fit among ``walls`` with the normals that it starts with, and the object's radius."""
    rates = replace(settings.learning_rates, rotations=(0, 0), delta_normal=(0, 0), curvature=(0, 0), room=(0, 0))
    trial = replace(short(settings, settings.light), exposure="fixed", turns=settings.turns)
    fit = fit_of(dataset, replace(trial, learning_rates=rates, room=walls))
    while fit.progress < 1:
        fit.step()
        done(fit.progress)
    reflections, extent = Reflections.seen_by(fit), fit.extent
    del fit
    release_memory()
    return reflections, extent

"""What surfels radiate, baked into colours that splat viewers show: diffuse and specular radiance, in display sRGB.

A viewer knows no light. So each surfel is shaded, by the scene's own `Lighting`, in K directions ω_k that are spread evenly over
the sphere, seen from all of those in front of it, and its clipped display colours c_k are fitted by spherical harmonics of third
degree (`splats.py`), in weighted and regularised least squares:

    min Σ_k w_k |½ + Σ_j h_j Y_j(−ω_k) − c_k|² / Σ_k w_k + λ Σ_{j>0} |h_j|²                        (15)

w_k is the area that the surfel shows, times how densely cameras look from there, times next to nothing where other surfels hide
it. So (15) is the error of pictures, but for how surfels blend. The penalty keeps coefficients small, also where nobody looks
from: viewers hold them in eight bits, for numbers from −1 to 1, and cut off the rest.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.camera import Camera
from ..core.color import srgb_encode
from ..core.errors import UserError
from ..core.progress import Progress
from ..plugins import lit_surfels
from ..surfels.proxies import Proxies
from .splats import COEFFICIENTS, Splats, fibonacci_sphere, sh_basis

DIRECTIONS = 192  # K
_LANES = 2**19  # surfels times directions at a time
_HIDDEN = 0.01  # part of its weight that a direction keeps where other surfels hide a surfel
_PENALTY = 1e-3  # λ
_TINY = 1e-8  # the constant's, so that a surfel that nothing is known of has a colour
_ELSEWHERE = 0.1  # part of the weight that is spread over all directions, whatever the cameras


def bake(scene: "mi.Scene", path: str | Path, quiet: bool = False) -> Splats:
    """Return the surfels of the ``scene`` that was loaded from ``path`` as `Splats` in its world, shown as its integrator shades
    them: diffuse and specular radiance, with reflections of each other where it has them. What lies outside its box shows its
    diffuse radiance alone. On a turntable, whose light depends on the camera, the light is that of azimuth 0, and a line on
    stderr says so.

    Raises: UserError where there are no surfels, and for another integrator than 'rgs_deferred'.
    """
    surfels, lighting = lit_surfels(scene, path)
    if not len(surfels):
        raise UserError(f"{path}: its shape of surfels is empty: there is nothing to export")
    if lighting is not None and lighting.turntable is not None:
        print(f"{path}: the light goes round with the camera, which no viewer does: baked for azimuth 0", file=sys.stderr)
    origins = np.array([Camera.from_sensor(sensor).origin for sensor in scene.sensors()]).reshape(-1, 3)
    sh, done = [], 0
    with Progress(None, quiet, "baking") as progress, dr.suspend_grad():
        for colors, weights in _seen(surfels, lighting, mi.Point3f(np.float32(origins.T)), len(origins)):
            sh.append(fit(colors, weights))
            done += len(colors)
            progress.update(done / len(surfels))
    fields = surfels.numpy()
    centers, rotations, scales = (fields[name] for name in ("centers", "rotations", "scales"))
    return Splats(centers, rotations, scales, fields["opacities"][:, 0], np.concatenate(sh))


def fit(colors: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the coefficients [n, 16, 3] float32 of (15), of display ``colors`` [n, K, 3] seen from the directions ω_k of
    `fibonacci_sphere` with ``weights`` [n, K]. Where all of these are zero the colour is a middle grey."""
    basis = sh_basis(-fibonacci_sphere(weights.shape[1]))
    weights = weights / np.maximum(weights.sum(1, keepdims=True), 1e-12)
    products = (basis[:, :, None] * basis[:, None]).reshape(len(basis), -1)
    normal = (weights @ products).reshape(-1, COEFFICIENTS, COEFFICIENTS)
    normal += np.diag([_TINY] + [_PENALTY] * (COEFFICIENTS - 1))
    moments = np.moveaxis((weights[:, :, None] * (colors - 0.5)).swapaxes(1, 2) @ basis, 1, 2)
    return np.linalg.solve(normal, moments).astype(np.float32)


def _seen(surfels, lighting, cameras, count) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(colours [n, K, 3], weights [n, K] of (15)), of some surfels after others; ``cameras`` are ``count`` positions."""
    proxies = Proxies(surfels, box=None if lighting is None else lighting.box)
    directions = mi.Vector3f(np.float32(fibonacci_sphere(DIRECTIONS).T))
    dr.eval(directions, cameras)
    step = max(1, _LANES // DIRECTIONS)
    for first in range(0, len(surfels), step):
        n = min(step, len(surfels) - first)
        lane = dr.arange(mi.UInt32, n * DIRECTIONS)
        surfel, view = (
            lane // DIRECTIONS + dr.opaque(mi.UInt32, first),
            dr.gather(mi.Vector3f, directions, lane % DIRECTIONS),
        )
        cosine = dr.dot(dr.gather(mi.Vector3f, proxies.normal, surfel), view)
        area = dr.abs(cosine) if surfels.two_sided else dr.maximum(cosine, 0)
        index = dr.compress(area > 0)
        surfel, view, area, cosine = (dr.gather(type(v), v, index) for v in (surfel, view, area, cosine))
        some = surfels.take(surfel)
        dr.eval(some.centers, view, area)
        center = some.column(mi.Point3f, "centers")
        hidden, _, _ = proxies.intersect(center, dr.mulsign(some.frames()[2], cosine), view)
        weight = area * dr.select(hidden, _HIDDEN, 1) * _density(view, center, cameras, count)
        color = _radiance(some, surfel, view, lighting)
        colors, weights = dr.zeros(mi.Color3f, n * DIRECTIONS), dr.zeros(mi.Float, n * DIRECTIONS)
        dr.scatter(colors, color, index)
        dr.scatter(weights, weight, index)
        linear = np.array(colors).T.reshape(n, DIRECTIONS, 3)
        yield srgb_encode(np.clip(linear, 0, 1)), np.array(weights).reshape(n, DIRECTIONS)


def _radiance(surfels, index, view, lighting):
    """The linear radiance that ``surfels``, those of the numbers ``index``, send along ``view`` from their centers."""
    if lighting is None:
        return surfels.radiance(-view)
    visibility = None if lighting.indirect is None or not lighting.lit else lighting.indirect.irradiance_visibility
    visibility = 1 if visibility is None else dr.gather(mi.Color3f, visibility, index)
    return lighting.radiance(surfels, dr.zeros(mi.Point2f, len(surfels)), view, visibility)


def _density(view, center, cameras, count):
    """How densely ``count`` ``cameras`` look from the directions ``view``, about 1 in the mean over the sphere: von Mises and
    Fisher's distribution about each, as wide as so many are apart on a hemisphere."""
    if not count:
        return mi.Float(1)
    focus = dr.opaque(mi.Float, count / (2 * np.pi))
    near = lambda k: dr.exp(focus * (dr.dot(view, dr.normalize(dr.gather(mi.Point3f, cameras, k) - center)) - 1))
    _, total = dr.while_loop(
        (dr.zeros(mi.UInt32, dr.width(view)), dr.zeros(mi.Float, dr.width(view))),
        lambda k, _: k < dr.opaque(mi.UInt32, count),
        lambda k, total: (k + 1, total + near(k)),
        label="cameras",
    )
    return _ELSEWHERE + (1 - _ELSEWHERE) * 2 * focus * total / dr.opaque(mi.Float, count)

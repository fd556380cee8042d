"""Our estimators of what a principled BSDF reflects, against Mitsuba's path tracer.

The geometry is Mitsuba's own, and so are the rays: one through the centre of each pixel, traced by Mitsuba, for all. So what
differs is the shading alone. A *case* is a shape of one material in an environment. For each:

- the `path` integrator of two segments (direct light) is the truth of the BSDF's integral, and a deeper one tells what
  interreflection adds; both are sampled in independent batches, whose spread gives the standard error of each pixel;
- `monte_carlo`, in batches as well, must be equal to it: by the Z-test of `mitsuba.testing`, pixel by pixel, and over all
  pixels together, where a small bias that no pixel shows adds up;
- `split_sum` has an error of its own, Σ|difference| / Σ truth over all pixels, whose bound on a sphere is the case's own
  (`bounds`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import targets
from ..core.camera import Camera
from ..core.errors import UserError
from ..evaluation.metrics import relative_error
from ..shading.environment import Environment
from ..shading.monte_carlo import MonteCarlo
from ..shading.split_sum import DEFAULT_ETA, SplitSum
from ..shading.surface import Surface
from ..targets import environments as _suite
from .bounds import ROUGHNESS, bound
from .statistics import GLOBAL, SUCCESS, Difference, Estimate

METALS = ((0.95, 0.95, 0.95), (0.9, 0.6, 0.2))
DIELECTRICS = ((0.0, 0.0, 0.0), (0.8, 0.8, 0.8), (0.1, 0.3, 0.7))  # without a diffuse lobe, and with one
ENVIRONMENTS = ("studio", "kitchen", "city")
BATCHES = 16
_ENVIRONMENT_HEIGHT = 256
_DEEP = 8


@dataclass(frozen=True)
class Case:
    """A ``shape``, 'sphere' or a model of `targets`, of one principled material in an ``environment`` of
    `targets.environments`."""

    shape: str
    environment: str
    roughness: float
    metallic: float
    base_color: tuple[float, float, float]

    @property
    def material(self) -> str:
        """The material in words."""
        return f"{'metal' if self.metallic else 'dielectric'} {'/'.join(f'{c:g}' for c in self.base_color)}"

    @property
    def name(self) -> str:
        """The name of the case in names of files."""
        return f"{self.shape}_{self.environment}_{self.material}_{self.roughness:g}".replace(" ", "_").replace("/", "-")

    @property
    def lit(self) -> bool:
        """Whether there is a diffuse lobe."""
        return not self.metallic and any(self.base_color)


def grid(
    shapes: Sequence[str] = ("sphere",),
    environments: Sequence[str] = ENVIRONMENTS,
    roughness: Sequence[float] = ROUGHNESS,
) -> list[Case]:
    """Return all cases: every shape, environment, material and roughness, the last fastest.

    Raises: UserError for a shape or environment that does not exist, and for roughness out of [0, 1].
    """
    for shape in shapes:
        if shape != "sphere":
            targets.parts(shape)
    for name in environments:
        targets.pick(_suite.ENVIRONMENTS, name, "environment")
    for r in roughness:
        if not 0 <= r <= 1:
            raise UserError(f"roughness is {r:g}: needs a number from 0 to 1")
    materials = [(1.0, c) for c in METALS] + [(0.0, c) for c in DIELECTRICS]
    return [
        Case(shape, environment, r, metallic, color)
        for shape in shapes
        for environment in environments
        for metallic, color in materials
        for r in roughness
    ]


@dataclass
class Result:
    """What came out for a case: linear radiance [pixels, 3] each, for the indices ``pixels`` [pixels], row by row in an
    image of ``size`` (width, height), of those that see the shape."""

    case: Case
    size: tuple[int, int]
    pixels: np.ndarray
    path: Estimate
    deep: Estimate
    monte_carlo: Estimate
    split_sum: np.ndarray

    @property
    def difference(self) -> Difference:
        """The difference of monte_carlo and path."""
        return Difference(self.monte_carlo, self.path)

    @property
    def error(self) -> float:
        """The error of split_sum, Σ|difference| / Σ truth."""
        return relative_error(self.split_sum, self.truth)

    @property
    def noise(self) -> float:
        """The part of `error` that the noise of `truth` itself makes."""
        a, b = self._weights()
        spread = np.sqrt(a**2 * self.path.variance + b**2 * self.monte_carlo.variance)
        return float(np.sqrt(2 / np.pi) * spread.sum() / self.path.mean.sum())

    @property
    def bound(self) -> float | None:
        """The bound of `error`: the case's own, and what noise adds; None where there is none."""
        own = bound(self.case.shape, self.case.environment, self.case.material, self.case.roughness)
        return None if own is None else own + self.noise

    @property
    def truth(self) -> np.ndarray:
        """The best estimate of the integral, [pixels, 3]: both together, weighted by their variances over all pixels."""
        a, b = self._weights()
        return a * self.path.mean + b * self.monte_carlo.mean

    def _weights(self):
        a, b = self.path.variance.mean(), self.monte_carlo.variance.mean()
        return (b / (a + b), a / (a + b)) if a + b > 0 else (0.5, 0.5)

    @property
    def interreflection(self) -> float:
        """The radiance that more bounces add, relative to that of one."""
        return float(self.deep.mean.sum() / self.path.mean.sum() - 1)

    def failures(self) -> list[str]:
        """Return what broke its bound, in words."""
        found = []
        if self.difference.passed < SUCCESS:
            found.append(f"monte_carlo differs from path in {1 - self.difference.passed:.1%} of the pixels")
        if self.difference.global_z > GLOBAL:
            found.append(f"monte_carlo differs from path by {self.difference.global_z:.1f} standard errors over all pixels")
        if self.bound is not None and self.error > self.bound:
            found.append(f"split_sum is off by {self.error:.2%} (bound: {self.bound:.2%})")
        return found

    def picture(self, values: np.ndarray) -> np.ndarray:
        """Return values [pixels, 3] as an image [H, W, 3], zero where the shape is not."""
        width, height = self.size
        image = np.zeros((height * width, 3), np.float32)
        image[self.pixels] = values
        return image.reshape(height, width, 3)


class Validator:
    """The validator compares cases with ``size`` pixels along a side, ``samples`` per pixel and batch of the path tracer,
    and twice as many of ours, which cost less. Raises: UserError where these are too few."""

    def __init__(self, size: int = 64, samples: int = 64, seed: int = 0) -> None:
        if size < 2 or samples < 2:
            raise UserError(f"{size} pixels and {samples} samples are too few: needs at least 2 of both")
        self.size, self.samples, self.seed = (size, size), samples, seed

    def run(self, case: Case) -> Result:
        """Render one case in all ways and return the estimates. A variant must be active."""
        light = {
            "type": "procedural_envmap",
            "name": case.environment,
            "height": _ENVIRONMENT_HEIGHT,
            "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90),
        }
        scene = mi.load_dict({"type": "scene", "light": light} | _shapes(case))
        si, pixels, rays = self._hits(scene)
        n = len(pixels)
        view, normal = si.to_world(si.wi), mi.Vector3f(si.sh_frame.n)
        surface = Surface(
            normal,
            view,
            dr.opaque(mi.Float, case.roughness, n),
            dr.opaque(mi.Float, case.metallic, n),
            mi.Color3f(*(dr.opaque(mi.Float, c, n) for c in case.base_color)),
        )
        incident_radiance = None if case.shape == "sphere" else _Visibility(scene, si)
        environment = Environment.from_emitter(scene.environment())

        def sampled(seed):
            estimator = MonteCarlo(
                environment.unfiltered(), scene.environment(), DEFAULT_ETA, 2 * self.samples, dr.opaque(mi.UInt32, seed)
            )
            return _radiance(estimator, case, surface, incident_radiance)

        batches = range(self.seed + 1, self.seed + 1 + BATCHES)
        return Result(
            case,
            self.size,
            pixels,
            Estimate.of([self._path(scene, rays, 2, k) for k in batches]),
            Estimate.of([self._path(scene, rays, _DEEP, BATCHES + k) for k in batches]),
            Estimate.of([sampled(k) for k in batches]),
            _radiance(SplitSum(environment.filtered(), DEFAULT_ETA), case, surface, incident_radiance),
        )

    def _hits(self, scene):
        """(surface interactions, their pixels [pixels], their rays) of a view of the shape."""
        camera = Camera.look_at((2.6, 1.2, 1.1), (0, 0, 0), (0, 0, 1), 41.0, self.size)
        directions = mi.Vector3f(camera.rays().reshape(-1, 3).T.astype(np.float32))
        rays = mi.Ray3f(mi.Point3f(*camera.origin.tolist()), dr.normalize(directions))
        si = scene.ray_intersect(rays)
        pixels = dr.compress(si.is_valid() & (dr.dot(si.sh_frame.n, rays.d) < 0))
        rays = mi.Ray3f(rays.o, dr.gather(mi.Vector3f, rays.d, pixels))
        si = scene.ray_intersect(rays)
        dr.eval(si, rays)
        return si, pixels.numpy(), rays

    def _path(self, scene, rays, depth, seed):
        """[pixels, 3] radiance along ``rays`` as Mitsuba's `path` sees it."""
        n = dr.width(rays)
        pixel = dr.arange(mi.UInt32, n * self.samples) // self.samples
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed, n * self.samples)
        integrator = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": 1000})
        radiance, _, _ = integrator.sample(scene, sampler, mi.RayDifferential3f(dr.gather(mi.Ray3f, rays, pixel)))
        return np.stack([dr.block_sum(c, self.samples).numpy() for c in radiance], -1) / self.samples


class _Visibility:
    """Light along a direction that the ``scene`` lets through."""

    def __init__(self, scene, si):
        self.scene, self.si = scene, si

    def __call__(self, light, direction, index):
        si = self.si if index is None else dr.gather(mi.SurfaceInteraction3f, self.si, index)
        return dr.select(self.scene.ray_test(si.spawn_ray(direction)), 0, light)


def _shapes(case):
    """The shape of a case for `mi.load_dict`."""
    bsdf = {
        "type": "principled",
        "roughness": case.roughness,
        "metallic": case.metallic,
        "eta": DEFAULT_ETA,
        "base_color": {"type": "rgb", "value": list(case.base_color)},
    }
    if case.shape == "sphere":
        return {"shape": {"type": "sphere", "bsdf": bsdf}}
    return {
        part: {"type": "procedural_mesh", "model": case.shape, "part": part, "bsdf": bsdf}
        for part in targets.parts(case.shape)
    }


def _radiance(estimator, case, surface, incident_radiance):
    """[pixels, 3] what ``estimator`` gives for a `Surface`."""
    with dr.suspend_grad():
        radiance = estimator.specular(surface, incident_radiance)
        if case.lit:
            radiance += estimator.diffuse(surface, incident_radiance)
        return radiance.numpy().T

"""What a fit learns: surfels, environment and shader in unconstrained form, and the optimizer that moves them."""

import functools
from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ..core.arrays import as_float, as_tensor
from ..core.camera import Camera
from ..shading.environment import Environment
from ..shading.room import SIDES, Room
from ..shading.shader import Shader, initial_weights
from ..splat.intersect import in_view
from ..splat.project import Projected, project
from ..splat.tiles import Cutoffs
from ..surfels.surfels import SH_0, SurfelColumns, Surfels
from .rows import EPSILON, Rows

#: Unconstrained parameters, one row per surfel.
SURFEL_PARAMETERS = (
    "centers",
    "rotations",
    "log_scales",
    "logit_opacities",
    "sh_dc",
    "sh_rest",
    "logit_base_color",
    "logit_roughness",
    "logit_metallic",
    "delta_normal",
    "curvature",
)
ENVIRONMENT, SHADER, ROOM, SPECULAR = "log_environment", "shader", "log_nearness", "logit_specular"
_LOG_RADIANCE = (-9.0, 8.0)  # texels that no ray tells apart would else drift to overflow
_LEAST_SCALE = 1e-6  # world units: smaller surfels overflow on the screen


def logit(p: np.ndarray | float, margin: float = 1e-4) -> np.ndarray:
    """Invert the logistic function, for NumPy arrays of any shape; ``p`` is kept ``margin`` away from 0 and 1."""
    p = np.clip(p, margin, 1 - margin)
    return np.log(p / (1 - p))


def _sigmoid(x):
    return 1 / (1 + dr.exp(-x))


class Model:
    """Surfels, environment and shader as Adam sees them: ``rows`` are the surfels', ``optimizer`` has all else.

    ``parameters`` are NumPy arrays [N, channels] named as `SURFEL_PARAMETERS`, `ENVIRONMENT` [rows, columns, 3], the
    logarithm of radiance, `SHADER` [weights], unless f_φ is the identity, `ROOM` [6], the logarithm of how near the walls
    of a `Room` around ``center`` ([3], world space) are, unless the light is at infinity, and `SPECULAR` [1], that of all
    surfels, unless it is given. ``rotation`` [3, 3] takes the environment's frame to the world's. ``two_sided`` is that of
    `Surfels`.
    """

    def __init__(
        self,
        parameters: dict[str, np.ndarray],
        rotation: np.ndarray,
        two_sided: bool = True,
        center: np.ndarray | Sequence[float] = (0, 0, 0),
    ) -> None:
        self.rotation, self.two_sided = np.asarray(rotation, np.float64), bool(two_sided)
        self.center = np.asarray(center, np.float64)
        self.rows = Rows({name: parameters[name] for name in SURFEL_PARAMETERS})
        self.optimizer = mi.ad.Adam(lr=1e-3, epsilon=EPSILON)
        for name, value in parameters.items():
            if name not in SURFEL_PARAMETERS:
                self.optimizer[name] = as_tensor(value)
        # What a step has asked for: which surfels, their rows, and whether none is there twice
        self._taken: list[tuple[mi.UInt32, mi.Float, bool]] = []

    @classmethod
    def start(
        cls,
        positions: np.ndarray,
        normals: np.ndarray | None,
        diffuse: np.ndarray,
        spacing: np.ndarray,
        environment: np.ndarray,
        rotation: np.ndarray,
        sh_order: int,
        seed: int = 0,
        scale: float = 1.0,
        opacity: float = 0.7,
        roughness: float = 0.3,
        metallic: np.ndarray | float = 0.4,
        shader: str = "identity",
        two_sided: bool | None = None,
        center: np.ndarray | Sequence[float] = (0, 0, 0),
        room: npt.ArrayLike | None = None,
        specular: float | None = None,
    ) -> "Model":
        """Make the model that a fit starts with.

        Args:
          positions:   [N, 3] centers of the surfels, world space
          normals:     [N, 3] what they face, unit vectors (None: random ones)
          diffuse:     [N, 3] their diffuse radiance, linear
          spacing:     [N] distances to their neighbors; ``scale`` times these are their standard deviations
          environment: [rows, columns, 3] linear radiance; ``rotation`` [3, 3] takes its frame to the world's
          sh_order:    order of the spherical harmonics
          opacity, roughness, metallic: of all surfels; metallic may be [N], of each
          shader:      'identity' or 'mlp', as in `Settings`
          two_sided:   see `Surfels` (None: where normals are random; others point outwards)
          center:      [3] where walls are seen from, world space
          room:        distance of all walls or of each, on which the environment is painted (None: it is at infinity)
          specular:    (22) of `shading/tables.py`, which is learned (None: it is given)
        """
        from ..surfels.surfels import rotation_from_normal

        n, rng = len(positions), np.random.default_rng(seed)
        two_sided = normals is None if two_sided is None else two_sided
        if normals is None:
            drawn = rng.normal(size=(n, 3))
            facing = drawn / np.linalg.norm(drawn, axis=1, keepdims=True)
        else:
            facing = normals
        return cls(
            {
                "centers": positions,
                "rotations": rotation_from_normal(facing, rng.uniform(0, 2 * np.pi, n)),
                "log_scales": np.log(scale * np.repeat(spacing[:, None], 2, 1)),
                "logit_opacities": np.full((n, 1), logit(opacity)),
                "sh_dc": (diffuse - 0.5) / SH_0,
                "sh_rest": np.zeros((n, 3 * ((sh_order + 1) ** 2 - 1))),
                "logit_base_color": np.full((n, 3), logit(0.5)),
                "logit_roughness": np.full((n, 1), logit(roughness)),
                "logit_metallic": np.broadcast_to(logit(metallic), n)[:, None],
                "delta_normal": np.zeros((n, 3)),
                "curvature": np.zeros((n, 3)),
                ENVIRONMENT: np.log(np.maximum(environment, 1e-3)),
                **({SHADER: initial_weights(seed)} if shader == "mlp" else {}),
                **({} if room is None else {ROOM: np.broadcast_to(-np.log(room), len(SIDES)).copy()}),
                **({} if specular is None else {SPECULAR: np.full(1, logit(specular))}),
            },
            rotation,
            two_sided,
            center,
        )

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, name: str) -> "mi.TensorXf":
        """Return the parameter ``name``, which is none of the surfels'; differentiable."""
        return self.optimizer[name]

    def names(self) -> list[str]:
        """Return the names of all parameters."""
        return [*self.rows.names(), *self.optimizer.keys()]

    # ---- Surfels ----

    def surfels(self, sh_order: int) -> Surfels:
        """Return the surfels as they are by now, with spherical harmonics up to ``sh_order``; not differentiated."""
        rows = self.rows.at(dr.arange(mi.UInt32, len(self)))
        return SurfelColumns(self._columns(rows, sh_order), self.two_sided).joined()

    def scene(self, sh_order: int) -> SurfelColumns:
        """Return all surfels as a step meets some of them: `take` returns those that are asked for, whose gradients `gradients`
        then has."""
        return _Scene(self, sh_order)

    def in_view(
        self, camera: Camera, cutoffs: Cutoffs, projected: "Callable[[SurfelColumns, Camera], Projected]" = project
    ) -> "mi.UInt32":
        """Return which surfels ``camera`` sees, as they are ``projected``, as far as none hides another, in their order; the
        first where it sees none."""
        with dr.suspend_grad():
            columns = self._columns(self.rows.values, 0) | {"curvature": [mi.Float(0)] * 3}
            index = dr.compress(in_view(projected(SurfelColumns(columns, self.two_sided), camera), camera.size, cutoffs))
        return index if dr.width(index) else dr.zeros(mi.UInt32, 1)

    def take(self, index: "mi.UInt32", sh_order: int, once: bool) -> SurfelColumns:
        """Return the surfels ``index``, with spherical harmonics up to ``sh_order``; differentiable: `gradients` has the
        derivatives of what is computed of them. ``once`` says that none is there twice."""
        rows = self.rows.at(index)
        dr.enable_grad(rows)
        if dr.grad_enabled(rows):
            self._taken.append((index, rows, once))
        return SurfelColumns(self._columns(rows, sh_order), self.two_sided, index)

    def _columns(self, rows, sh_order):
        """The fields of surfels, column by column, from ``rows`` of what is learned of them."""
        p, more = self.rows.split(rows), 3 * ((sh_order + 1) ** 2 - 1)
        return {
            "centers": p["centers"],
            "rotations": p["rotations"],
            "scales": [dr.maximum(dr.exp(v), _LEAST_SCALE) for v in p["log_scales"]],
            "opacities": [_sigmoid(v) for v in p["logit_opacities"]],
            "sh": p["sh_dc"] + p["sh_rest"][:more],
            "base_color": [_sigmoid(v) for v in p["logit_base_color"]],
            "roughness": [_sigmoid(v) for v in p["logit_roughness"]],
            "metallic": [_sigmoid(v) for v in p["logit_metallic"]],
            "delta_normal": p["delta_normal"],
            "curvature": p["curvature"],
        }

    # ---- Steps ----

    def gradients(self, every: bool = False) -> "tuple[mi.UInt32, mi.Float]":
        """Return (index, gradient) of the surfels that were taken since the last call, or of ``every`` one, as `step` wants
        them."""
        taken, self._taken = self._taken, []
        return self.rows.together([(index, dr.grad(rows), once) for index, rows, once in taken], every)

    def set_rates(self, rates: dict[str, float]) -> None:
        """Set the learning rate of each of the parameters `names`."""
        self.rows.rates = {name: rates[name] for name in self.rows.names()}
        self.optimizer.set_learning_rate({name: rates[name] for name in self.optimizer.keys()})

    def step(self, index: "mi.UInt32", gradient: "mi.Float") -> None:
        """Move the surfels ``index`` by the ``gradient`` of their rows, and all else by what it has."""
        self.rows.step(index, gradient)
        self.optimizer.step()

    def environment(self) -> Environment:
        """Return the environment, non-negative by construction; differentiable."""
        x, y, z = map(float, self.center)
        room = Room((x, y, z), dr.exp(self.optimizer[ROOM]).array) if ROOM in self.optimizer else None
        return Environment(dr.exp(dr.clip(self.optimizer[ENVIRONMENT], *_LOG_RADIANCE)), self.rotation, room=room)

    def shader(self) -> Shader | None:
        """Return f_φ; None: the identity."""
        return Shader(self.optimizer[SHADER]) if SHADER in self.optimizer else None

    def specular(self) -> "mi.Float | None":
        """Return specular of all surfels, in [0, 1], of width 1, differentiable; None: it is not learned."""
        return _sigmoid(self.optimizer[SPECULAR]).array if SPECULAR in self.optimizer else None

    # ---- Surgery ----

    def numpy(self, name: str) -> np.ndarray:
        """Return the parameter ``name`` as a NumPy array, detached."""
        return self.rows.numpy(name) if name in SURFEL_PARAMETERS else dr.detach(self.optimizer[name]).numpy()

    def set(self, name: str, value: np.ndarray, reset: bool = True) -> None:
        """Replace the parameter ``name``; its moments start again from zero, or stay where ``reset`` is off. Its shape must stay,
        where it is one of the surfels' or keeps its moments."""
        if name in SURFEL_PARAMETERS:
            self.rows.set(name, value, *(0 if reset else self.rows.numpy(name, of) for of in ("m", "v")))
            return
        moments = self.optimizer.state[name][3]
        del self.optimizer[name]
        self.optimizer[name] = as_tensor(value)
        if not reset:
            self._set_moments(name, *moments[:3])

    def select(self, index: np.ndarray, changes: dict[str, np.ndarray]) -> None:
        """Keep the surfels ``index`` (any order, repeats allowed) with their moments, then overwrite parameters by
        ``changes`` {name: array}. Surfels that ``fresh`` marks get zero moments."""
        fresh = changes.pop("fresh", np.zeros(len(index), bool))
        self.rows.select(index, changes, fresh)

    def refine_environment(self) -> None:
        """Give the environment twice as many rows and columns, on which the logarithm of radiance and its moments are as
        before: a texel is a quarter of the old one, and so is its derivative."""
        value = self.optimizer[ENVIRONMENT]
        t, m, v, _ = self.optimizer.state[ENVIRONMENT][3]
        finer = lambda texels: Environment(mi.TensorXf(texels, value.shape), self.rotation).finer().texels
        m, v = (as_float(finer(moment).numpy().ravel() * part) for moment, part in ((m, 1 / 4), (v, 1 / 16)))
        self.set(ENVIRONMENT, finer(dr.detach(value).array).numpy())
        self._set_moments(ENVIRONMENT, t, m, v)

    def _set_moments(self, name, t, m, v):
        value, promoted, lr, _ = self.optimizer.state[name]
        self.optimizer.state[name] = value, promoted, lr, (t, m, v, None)

    # ---- State ----

    def state(self) -> dict[str, np.ndarray]:
        """Return everything that a checkpoint needs, as NumPy arrays."""
        arrays = {"rotation": self.rotation, "two_sided": np.array(self.two_sided), "center": self.center}
        arrays |= self.rows.state()
        for name in self.optimizer.keys():
            t, m, v, _ = self.optimizer.state[name][3]
            arrays |= {
                name: self.numpy(name),
                f"{name}.m": m.numpy(),
                f"{name}.v": v.numpy(),
                f"{name}.t": np.array(t).ravel()[0],
            }
        return arrays

    @classmethod
    def from_state(cls, arrays: dict[str, np.ndarray]) -> "Model":
        """Make the model whose `state` these ``arrays`` are."""
        names = [name for name in (*SURFEL_PARAMETERS, ENVIRONMENT, SHADER, ROOM, SPECULAR) if name in arrays]
        parameters = {name: arrays[name] for name in names}
        model = cls(parameters, arrays["rotation"], bool(arrays["two_sided"]), arrays.get("center", (0, 0, 0)))
        model.rows = Rows.from_state(arrays, SURFEL_PARAMETERS)
        for name in model.optimizer.keys():
            model._set_moments(name, mi.UInt32(int(arrays[f"{name}.t"])), *(as_float(arrays[f"{name}.{k}"]) for k in "mv"))
        return model


class _Scene(SurfelColumns):
    """The surfels of a model, which are read as a whole only where someone asks for that, and then are not differentiated."""

    def __init__(self, model: Model, sh_order: int) -> None:
        self._model, self._sh_order, self.two_sided = model, sh_order, model.two_sided

    @functools.cached_property
    def _whole(self):
        return self._model.surfels(self._sh_order)

    def __len__(self) -> int:
        return len(self._model)

    def channels(self, name: str) -> int:
        return self._whole.channels(name)

    def _column(self, name, k):
        return self._whole._column(name, k)

    def take(self, index: "mi.UInt32") -> SurfelColumns:
        return self._model.take(index, self._sh_order, once=False)

"""What a fit learns: surfels, environment and shader in unconstrained form, and the optimizer that moves them."""

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import as_float, as_tensor
from ..shading.environment import Environment
from ..shading.room import SIDES, Room
from ..shading.shader import Shader, initial_weights
from ..surfels.surfels import SH_0, Surfels

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
#: The step of 3DGS's optimizers is relative to the gradient's own size, however small.
_EPSILON = 1e-15
_LOG_RADIANCE = (-9.0, 8.0)  # texels that no ray tells apart would else drift to overflow
_LEAST_SCALE = 1e-6  # world units: smaller surfels overflow on the screen


def logit(p: np.ndarray | float, margin: float = 1e-4) -> np.ndarray:
    """Invert the logistic function, for NumPy arrays of any shape; ``p`` is kept ``margin`` away from 0 and 1."""
    p = np.clip(p, margin, 1 - margin)
    return np.log(p / (1 - p))


def _sigmoid(x):
    return 1 / (1 + dr.exp(-x))


class Model:
    """Surfels, environment and shader as Adam sees them.

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
        self.optimizer = mi.ad.Adam(lr=1e-3, epsilon=_EPSILON)
        for name, value in parameters.items():
            self.optimizer[name] = as_tensor(value)

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
        room: tuple[np.ndarray | Sequence[float], float] | None = None,
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
          room:        center and distance of the walls on which the environment is painted (None: it is at infinity)
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
                **({ROOM: np.full(len(SIDES), -np.log(room[1]))} if room else {}),
                **({} if specular is None else {SPECULAR: np.full(1, logit(specular))}),
            },
            rotation,
            two_sided,
            room[0] if room else (0, 0, 0),
        )

    def __len__(self) -> int:
        return self.optimizer["centers"].shape[0]

    def __getitem__(self, name: str) -> "mi.TensorXf":
        return self.optimizer[name]

    def surfels(self, sh_order: int) -> Surfels:
        """Return the surfels, with spherical harmonics up to ``sh_order``; differentiable."""
        p = self.optimizer
        sh, rest, used = p["sh_dc"], p["sh_rest"], 3 * ((sh_order + 1) ** 2 - 1)
        if used:
            # a slice of all of it would be a copy, and another one in the derivative
            sh = dr.concat((sh, rest if used == rest.shape[1] else rest[:, :used]), axis=1)
        scales = dr.maximum(dr.exp(p["log_scales"]), _LEAST_SCALE)
        return Surfels(
            p["centers"],
            p["rotations"],
            scales,
            _sigmoid(p["logit_opacities"]),
            sh,
            _sigmoid(p["logit_base_color"]),
            _sigmoid(p["logit_roughness"]),
            _sigmoid(p["logit_metallic"]),
            p["delta_normal"],
            p["curvature"],
            self.two_sided,
        )

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
        return dr.detach(self.optimizer[name]).numpy()

    def set(self, name: str, value: np.ndarray, reset: bool = True) -> None:
        """Replace the parameter ``name``; its moments start again from zero, or stay where ``reset`` is off (same shape)."""
        moments = self.optimizer.state[name][3]
        del self.optimizer[name]
        self.optimizer[name] = as_tensor(value)
        if not reset:
            self._set_moments(name, *moments[:3])

    def select(self, index: np.ndarray, changes: dict[str, np.ndarray]) -> None:
        """Keep the surfels ``index`` (any order, repeats allowed) with their moments, then overwrite parameters by
        ``changes`` {name: array}. Surfels that ``fresh`` marks get zero moments."""
        fresh = changes.pop("fresh", np.zeros(len(index), bool))
        for name in SURFEL_PARAMETERS:
            value = self.numpy(name)
            t, m, v, _ = self.optimizer.state[name][3]
            moments = [x.numpy().reshape(value.shape)[index] * ~fresh[:, None] for x in (m, v)]
            self.set(name, changes.get(name, value[index]))
            self._set_moments(name, t, *map(as_float, moments))

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
        for name in names:
            model._set_moments(name, mi.UInt32(int(arrays[f"{name}.t"])), *(as_float(arrays[f"{name}.{k}"]) for k in "mv"))
        return model

"""Flat Gaussians that carry a principled material: the fields, their frames and their radiance (docs/method.md §1).

A surfel is the primitive of 2DGS (Huang et al. 2024): a center, two tangents with a standard deviation each, and an opacity.
Its material has the names of Mitsuba's principled BSDF, so that a cloud of surfels is a principled material.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

#: Channels of each field; `sh` has 3 (L+1)² of them, coefficient-major: sh[:, 3 k + c] is coefficient k of colour c.
CHANNELS = {
    "centers": 3,
    "rotations": 4,
    "scales": 2,
    "opacities": 1,
    "sh": None,
    "base_color": 3,
    "roughness": 1,
    "metallic": 1,
    "delta_normal": 3,
    "curvature": 3,
}
SH_0 = 0.28209479  # the spherical harmonic of order 0


class SurfelColumns:
    """N surfels, column by column, and what follows from these: the fields of `Surfels` by their names, a list of arrays of
    width N each. ``index`` says which of a scene's surfels they are (None: all, in their order); ``two_sided`` is that of
    `Surfels`."""

    two_sided: bool
    index: "mi.UInt32 | None" = None

    def __init__(
        self, columns: "dict[str, list[mi.Float]]", two_sided: bool = True, index: "mi.UInt32 | None" = None
    ) -> None:
        self._columns, self.two_sided, self.index = columns, two_sided, index

    def __len__(self) -> int:
        return dr.width(self._columns["centers"])

    def channels(self, name: str) -> int:
        """Return how many columns the field ``name`` has."""
        return len(self._columns[name])

    def column(self, kind: type, name: str) -> Any:
        """Return the field ``name`` as a Dr.Jit array of type ``kind`` and width N, e.g. ``column(mi.Point3f, "centers")``;
        differentiable."""
        return self._column(name, 0) if kind is mi.Float else kind(*self.all_columns(name))

    def all_columns(self, name: str) -> "list[mi.Float]":
        """Return the columns of the field ``name``, of width N each; differentiable."""
        return [self._column(name, k) for k in range(self.channels(name))]

    def _column(self, name, k):
        return self._columns[name][k]

    def split(self) -> "SurfelColumns":
        """Return the same surfels as columns that have been read."""
        return self

    def joined(self) -> "Surfels":
        """Return the same surfels with a tensor for each field, as `Surfels.split` takes them; not differentiated."""
        with dr.suspend_grad():
            n, shapes = len(self), {name: (len(self), self.channels(name)) for name in CHANNELS}
            tensors = {name: mi.TensorXf(_rows_of(self.all_columns(name), n), shape) for name, shape in shapes.items()}
            dr.eval(tensors)
        return Surfels(**tensors, two_sided=self.two_sided, index=self.index)

    def with_columns(self, columns: "dict[str, list[mi.Float]]") -> "SurfelColumns":
        """Return the same surfels with other ``columns`` in place of those that these name."""
        own = {name: self.all_columns(name) for name in CHANNELS if name not in columns}
        return SurfelColumns(own | columns, self.two_sided, self.index)

    def take(self, index: "mi.UInt32") -> "SurfelColumns":
        """Return the surfels ``index``, of which some may repeat; differentiable."""
        columns = {name: [dr.gather(mi.Float, column, index) for column in self.all_columns(name)] for name in CHANNELS}
        return SurfelColumns(columns, self.two_sided, self._of_scene(index))

    def _of_scene(self, index):
        """Which of a scene's surfels those with this ``index`` are."""
        return index if self.index is None else dr.gather(mi.UInt32, self.index, index)

    def frames(self) -> "tuple[mi.Vector3f, mi.Vector3f, mi.Vector3f]":
        """Return (t_u, t_v, n), the unit tangents and normal of every surfel in world space, each of width N."""
        x, y, z, w = dr.normalize(self.column(mi.Vector4f, "rotations"))
        t_u = mi.Vector3f(1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w))
        t_v = mi.Vector3f(2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w))
        n = mi.Vector3f(2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y))
        return t_u, t_v, n

    def normal_derivatives(self) -> "tuple[mi.Vector3f, mi.Vector3f]":
        """Return (∂n/∂u, ∂n/∂v) in world space, each of width N. At (u, v) standard deviations from the center the normal is
        n + u ∂n/∂u + v ∂n/∂v, as on a surface whose curvature tensor is K / √(s_u s_v). The surfel itself stays flat.

            ∂n/∂u = √(s_u/s_v) (K_uu t_u + K_uv t_v),   ∂n/∂v = √(s_v/s_u) (K_uv t_u + K_vv t_v)
        """
        t_u, t_v, _ = self.frames()
        scales, K = self.column(mi.Vector2f, "scales"), self.column(mi.Vector3f, "curvature")
        ratio = dr.sqrt(scales.x / scales.y)
        return ratio * (K.x * t_u + K.y * t_v), (K.y * t_u + K.z * t_v) / ratio

    def normals(self, uv: "mi.Point2f | None" = None) -> "mi.Vector3f":
        """Return the unit normals n + Δn in world space, of width N, at the centers of the surfels, or at ``uv`` in standard
        deviations from these."""
        normal = self.frames()[2] + self.column(mi.Vector3f, "delta_normal")
        if uv is not None:
            dn_du, dn_dv = self.normal_derivatives()
            normal = normal + uv.x * dn_du + uv.y * dn_dv
        return dr.normalize(normal)

    def points(self, uv: "mi.Point2f") -> "mi.Point3f":
        """Return the points ``uv`` of the surfels, in standard deviations from their centers, in world space, of width N."""
        t_u, t_v, _ = self.frames()
        scale = self.column(mi.Vector2f, "scales")
        return self.column(mi.Point3f, "centers") + uv.x * scale.x * t_u + uv.y * scale.y * t_v

    def radiance(self, direction: "mi.Vector3f") -> "mi.Color3f":
        """Return the diffuse radiance (linear) of every surfel seen along the world-space unit ``direction`` from the camera,
        of width N."""
        basis = dr.sh_eval(direction, sh_order(self.channels("sh")))
        value = mi.Color3f(0.5)
        for k, Y in enumerate(basis):
            value += Y * mi.Color3f(*[self._column("sh", 3 * k + c) for c in range(3)])
        return dr.maximum(value, 0)


@dataclass
class Surfels(SurfelColumns):
    """N surfels. Every field is a tensor of shape [N, channels] in its physical range.

    centers       positions, world space
    rotations     unit quaternions (x, y, z, w), the order of Mitsuba and Dr.Jit, while 3DGS's PLY columns rot_0 … rot_3 are
                  (w, x, y, z); the columns of their matrix are the tangents t_u, t_v and the normal, world space
    scales        standard deviations along t_u and t_v, world units, > 0
    opacities     in (0, 1)
    sh            diffuse radiance, linear: max(0, 1/2 + Σ_k sh_k Y_k(d)), d from the camera to the center (3DGS)
    base_color, roughness, metallic   principled BSDF parameters in [0, 1]
    delta_normal  the residual Δn that is added to the normal (RGS), world space
    curvature     K_uu, K_uv, K_vv: how the normal turns across the surfel, radians per √(s_u s_v); see `normal_derivatives`
    two_sided     whether surfels show from behind, with the normal turned to the camera (2DGS); one-sided ones, whose
                  normals point outwards, keep the far side of a closed object from bending its silhouette's normals
    index         which of a scene's surfels they are (None: all, in their order)
    """

    centers: "mi.TensorXf"
    rotations: "mi.TensorXf"
    scales: "mi.TensorXf"
    opacities: "mi.TensorXf"
    sh: "mi.TensorXf"
    base_color: "mi.TensorXf"
    roughness: "mi.TensorXf"
    metallic: "mi.TensorXf"
    delta_normal: "mi.TensorXf"
    curvature: "mi.TensorXf"
    two_sided: bool = True
    index: "mi.UInt32 | None" = None

    def __len__(self) -> int:
        return self.centers.shape[0]

    @classmethod
    def from_numpy(cls, arrays: dict[str, np.ndarray], two_sided: bool = True) -> "Surfels":
        """Make surfels of arrays [N, channels] by the names of the fields; without ``curvature`` normals are the same all
        over each surfel."""
        arrays = {"curvature": np.zeros((len(arrays["centers"]), 3))} | arrays
        return cls(
            **{name: mi.TensorXf(np.ascontiguousarray(arrays[name], np.float32)) for name in CHANNELS}, two_sided=two_sided
        )

    def numpy(self) -> dict[str, np.ndarray]:
        """Return each field as a float32 array [N, channels], detached."""
        return {name: dr.detach(getattr(self, name)).numpy() for name in CHANNELS}

    def channels(self, name: str) -> int:
        """Return how many columns the field ``name`` has."""
        return getattr(self, name).shape[1]

    def split(self) -> SurfelColumns:
        """Return the same surfels as columns that have been read: the derivative of that is one kernel for all, and copies what
        it has where that of each `column` adds number by number. Differentiable; to be called where gradients are as they are
        where columns are used."""
        tensors = [getattr(self, name) for name in CHANNELS]
        values = iter(columns_of([t.array for t in tensors], [t.shape[1] for t in tensors]))
        columns = {name: [next(values) for _ in range(t.shape[1])] for name, t in zip(CHANNELS, tensors)}
        return SurfelColumns(columns, self.two_sided, self.index)

    def _column(self, name, k):
        """Column ``k``. Each number is read once, so that the derivative needs no atomics, nor copies for each thread: these
        would compile the number of surfels into the kernel."""
        tensor = getattr(self, name)
        index = dr.arange(mi.UInt32, len(self)) * tensor.shape[1] + k
        return dr.gather(mi.Float, tensor.array, index, mode=dr.ReduceMode.NoConflicts)

    def take(self, index: "mi.UInt32") -> "Surfels":
        """Return the surfels ``index``, of which some may repeat; differentiable."""

        def rows(tensor):
            count, channels = dr.width(index), tensor.shape[1]
            entry = dr.arange(mi.UInt32, count * channels)
            source = dr.gather(mi.UInt32, index, entry // channels) * channels + entry % channels
            return mi.TensorXf(dr.gather(mi.Float, tensor.array, source, mode=dr.ReduceMode.Local), (count, channels))

        fields = {name: rows(getattr(self, name)) for name in CHANNELS}
        return Surfels(**fields, two_sided=self.two_sided, index=self._of_scene(index))


def columns_of(arrays: "list[mi.Float]", channels: list[int]) -> "list[mi.Float]":
    """Return the columns of ``arrays``, whose rows have so many ``channels`` each, one after the other; differentiable, in one
    kernel for all of them."""
    return dr.custom(_Split, arrays, channels)


class _Split(dr.CustomOp):
    """The custom operation of `columns_of`."""

    def eval(self, arrays, channels):
        self.channels, self.rows = channels, dr.width(arrays[0]) // channels[0]
        return self._apply(arrays)

    def forward(self):
        self.set_grad_out(self._apply(self.grad_in("arrays")))

    def backward(self):
        adjoint = list(self.grad_out())
        dr.eval(adjoint)  # otherwise every scatter below would compute them again
        columns = iter(adjoint)
        self.set_grad_in("arrays", [_rows_of([next(columns) for _ in range(n)], self.rows) for n in self.channels])

    def _apply(self, arrays):
        row = dr.arange(mi.UInt32, self.rows)
        return [dr.gather(mi.Float, array, row * n + k) for array, n in zip(arrays, self.channels) for k in range(n)]

    def name(self):
        return "rgs_mi.surfels.Split"


def _rows_of(columns, count):
    """The ``count`` rows that have these ``columns``, one after the other; columns of one number have it in each row."""
    rows, first = dr.empty(mi.Float, count * len(columns)), dr.arange(mi.UInt32, count) * len(columns)
    for k, column in enumerate(columns):
        dr.scatter(rows, column, first + k)
    return rows


def sh_order(channels: int) -> int:
    """Return the order L of spherical harmonics stored in ``channels`` = 3 (L+1)² numbers."""
    return round((channels / 3) ** 0.5) - 1


def rotation_from_normal(normal: np.ndarray, spin: np.ndarray | float = 0.0) -> np.ndarray:
    """Return quaternions [N, 4] (x, y, z, w) that turn +z to unit ``normal`` [N, 3], after a turn by ``spin`` radians ([N] or
    one number) about z."""
    x, y, z = np.asarray(normal, np.float64).T
    half = np.stack([-y, x, np.zeros_like(x), 1 + z], 1)
    half[z < -0.999999] = [1, 0, 0, 0]
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    c, s = np.cos(np.asarray(spin) / 2) * np.ones_like(x), np.sin(np.asarray(spin) / 2) * np.ones_like(x)
    # half * (0, 0, s, c), with half.z = 0
    hx, hy, _, hw = half.T
    return np.stack([hx * c + hy * s, hy * c - hx * s, hw * s, hw * c], 1).astype(np.float32)

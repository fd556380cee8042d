"""Lookups in a latitude-longitude environment, with the conventions of Mitsuba's `envmap` emitter.

Texel column c lies at longitude 2π (c + 1/2)/W, row r at colatitude π r/(H − 1): the first and last rows are the poles.
A direction d in the emitter's frame has longitude atan2(d_x, −d_z) and colatitude acos(d_y).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.errors import UserError
from ..splat.hit import adding
from . import prefilter as _prefilter
from .room import Room

#: Callback ``(radiance, direction, index)`` that returns incident radiance after occlusion along the world-space unit
#: ``direction`` at the surfaces ``index`` (None: one direction for each surface), where the unoccluded environment has
#: ``radiance``.
IncidentRadiance = Callable[["mi.Color3f", "mi.Vector3f", "mi.UInt32 | None"], "mi.Color3f"]


@dataclass
class Environment:
    """A learned or loaded environment.

    texels    [rows, columns, 3], linear radiance (scale included), without the emitter's halo columns
    rotation  [3, 3] emitter frame to world frame
    turn      rotation of world-space directions that comes before, of a light that stands elsewhere than in that frame by now
              (see `Turntable.to_lamps`; None: none)
    room      walls on which it is painted, near enough that it depends on the place what is seen of them (None: it is at
              infinity)
    """

    texels: "mi.TensorXf"
    rotation: np.ndarray
    turn: "mi.Matrix3f | None" = None
    room: Room | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of texels."""
        return self.texels.shape[:2]

    @classmethod
    def from_emitter(cls, emitter: "mi.Emitter") -> "Environment":
        """Take the radiance of a Mitsuba `envmap` (gradients of its ``data`` and ``scale`` are kept) or of a `constant`
        emitter (those of its ``radiance``), which becomes a small map.

        Raises: UserError for another kind of emitter.
        """
        params = mi.traverse(emitter)
        if emitter.class_name() == "ConstantBackgroundEmitter" and "radiance.value" in params:
            radiance = mi.Color3f(params["radiance.value"])
            return cls(dr.zeros(mi.TensorXf, (8, 16, 3)) + mi.TensorXf(dr.ravel(radiance), (1, 1, 3)), np.eye(3))
        if emitter.class_name() != "EnvironmentMapEmitter":
            raise UserError(f"emitter '{emitter.id()}' is a {emitter.class_name()}: surfels need an 'envmap' or 'constant'")
        texels = params["data"][:, 1:-1, :] * params["scale"]
        rotation = np.array(params["to_world"].matrix, np.float64).reshape(4, 4)[:3, :3]
        return cls(texels, rotation)

    def to_local(self, d: "mi.Vector3f") -> "mi.Vector3f":
        """Turn world-space directions into the emitter's frame."""
        return _matrix(np.linalg.inv(self.rotation)) @ (d if self.turn is None else self.turn @ d)

    def to_world(self, d: "mi.Vector3f") -> "mi.Vector3f":
        """Turn directions in the emitter's frame into those of world space before the `turn`."""
        return _matrix(self.rotation) @ d

    def seen(self, d: "mi.Vector3f", point: "mi.Point3f | None") -> "tuple[mi.Vector3f, mi.Float, mi.Float]":
        """Return where in the emitter's frame the map has what comes to ``point`` along world-space ``d``, how much farther from
        the room's center than from the point that is, and the density of those directions over these; see `Room.seen`. Without
        a room, or a point, the point sees what the center sees."""
        local = self.to_local(d)
        if self.room is None or point is None:
            return local, mi.Float(1), mi.Float(1)
        return self.room.seen(local, self.to_local(self.room.from_center(point)))

    def seen_from(self, d: "mi.Vector3f", point: "mi.Point3f | None") -> "mi.Vector3f":
        """Return along which world-space directions ``point`` sees what the emitter, which knows neither turn nor room, has
        along ``d``."""
        if self.room is not None and point is not None:
            local = _matrix(np.linalg.inv(self.rotation)) @ d
            d = self.to_world(self.room.seen_from(local, self.to_local(self.room.from_center(point))))
        return d if self.turn is None else self.turn.T @ d

    def filtered(self) -> "FilteredEnvironment":
        """Return the environment convolved with the BSDF's lobe at every level of roughness (docs/method.md §3)."""
        operator = _prefilter.prefilter(*self.size, mi.variant())
        return FilteredEnvironment(_prefilter.apply(self.texels.array, operator), operator, self)

    def unfiltered(self) -> "FilteredEnvironment":
        """Return the environment itself, for lookups: the level of roughness 0 alone."""
        mirror = _prefilter.Prefilter(self.size, (self.size,), ())
        return FilteredEnvironment(_prefilter.apply(self.texels.array, mirror), mirror, self)

    def finer(self) -> "Environment":
        """Return the same environment, interpolated, on twice as many rows and columns."""
        rows, columns = (2 * size for size in self.size)
        index = dr.arange(mi.UInt32, rows * columns)
        longitude = (mi.Float(index % columns) + 0.5) / columns
        radiance = self.unfiltered()._level(longitude, mi.Float(index // columns) / (rows - 1), mi.UInt32(0))
        return Environment(mi.TensorXf(dr.ravel(radiance), (rows, columns, 3)), self.rotation)

    def emitter(self) -> "mi.Emitter":
        """Return Mitsuba's own `envmap` of the same radiance, for its sampling; not differentiable."""
        to_world = np.eye(4)
        to_world[:3, :3] = self.rotation
        emitter = {
            "type": "envmap",
            "bitmap": mi.Bitmap(dr.detach(self.texels).numpy()),
            "to_world": mi.ScalarTransform4f(to_world),
        }
        return mi.load_dict({"type": "scene", "emitter": emitter}).environment()


def _matrix(rows):
    return mi.Matrix3f([[dr.opaque(mi.Float, float(v)) for v in row] for row in rows])


@dataclass
class FilteredEnvironment:
    """An ``environment`` filtered by an ``operator``: ``texels`` are the maps of all its levels, padded to four floats a
    texel."""

    texels: "mi.Float"
    operator: _prefilter.Prefilter
    environment: Environment

    def turned(self, turn: "mi.Matrix3f") -> "FilteredEnvironment":
        """Return the same environment with `Environment.turn`."""
        return replace(self, environment=replace(self.environment, turn=turn))

    def learned(self) -> list:
        """Return the arrays that a fit changes: the texels of all levels, and how near walls are where there is a room."""
        room = self.environment.room
        return [self.texels, *([room.nearness] if room else [])]

    def with_learned(self, arrays: list) -> "FilteredEnvironment":
        """Return the same environment with other ``arrays`` in place of `learned`."""
        environment = self.environment
        if environment.room:
            environment = replace(environment, room=replace(environment.room, nearness=arrays[1]))
        return replace(self, texels=arrays[0], environment=environment)

    def _level(self, longitude, colatitude, level):
        """Bilinear lookup in the map ``level`` (``mi.UInt32``); longitude and colatitude in [0, 1]."""
        # from lists: a NumPy array's memory is not aligned (see `core.arrays`), and one of a single number is read, not gathered
        constant = lambda values: dr.gather(mi.UInt32, mi.UInt32([int(v) for v in values]), level)
        rows, columns = (constant([size[i] for size in self.operator.maps]) for i in (0, 1))
        first = constant(self.operator.offsets)
        x = longitude * mi.Float(columns) - 0.5
        y = colatitude * mi.Float(rows - 1)
        column, row = dr.floor(x), dr.minimum(dr.floor(y), mi.Float(rows) - 2)
        fx, fy = x - column, y - row
        # no integer division by `columns`: idle lanes hold zero there, and the processor traps
        left = dr.select(column < 0, columns - 1, mi.UInt32(dr.maximum(column, 0)))
        right = dr.select(left + 1 < columns, left + 1, 0)
        above = first + mi.UInt32(row) * columns
        mode = adding(dr.width(self.texels))  # of the derivative
        fetch = lambda i: dr.gather(mi.Vector4f, self.texels, i, mode=mode)
        top = dr.lerp(fetch(above + left), fetch(above + right), fx)
        bottom = dr.lerp(fetch(above + columns + left), fetch(above + columns + right), fx)
        value = dr.lerp(top, bottom, fy)
        return mi.Color3f(value.x, value.y, value.z)

    @staticmethod
    def coordinates(d: "mi.Vector3f") -> "tuple[mi.Float, mi.Float]":
        """Return (longitude, colatitude) of a unit vector in the emitter's frame, in [0, 1]."""
        # atan2 and acos have no derivative at the poles, where longitude does not matter: stay clear of them
        horizontal = dr.maximum(dr.square(d.x) + dr.square(d.z), 1e-10)
        longitude = dr.atan2(d.x, dr.select(dr.abs(d.z) + dr.abs(d.x) > 1e-5, -d.z, 1e-5)) / dr.two_pi
        longitude -= dr.floor(longitude)
        colatitude = dr.atan2(dr.sqrt(horizontal), d.y) / dr.pi
        return longitude, colatitude

    def eval(
        self,
        direction: "mi.Vector3f",
        roughness: "mi.Float | None" = None,
        point: "mi.Point3f | None" = None,
    ) -> "mi.Color3f":
        """Return linear radiance that comes to ``point`` (world space) along world-space unit ``direction``, averaged over the
        lobe of ``roughness`` (None: unfiltered), whose width on the map is that on the wall, as the map's center sees it:
        r² becomes r²/s of (14) in `room.py`. ``point`` None is the room's center."""
        local, farther, _ = self.environment.seen(direction, point)
        longitude, colatitude = self.coordinates(local)
        if roughness is None:
            return self._level(longitude, colatitude, mi.UInt32(0))
        seen = roughness if self.environment.room is None else roughness * dr.rsqrt(farther)
        nodes = [r for r, _ in _prefilter.LEVELS]
        position = mi.Float(0)
        for low, high in zip(nodes[:-1], nodes[1:]):
            position += dr.clip((seen - low) / (high - low), 0, 1)
        level = dr.minimum(mi.UInt32(dr.detach(position)), len(nodes) - 2)
        return dr.lerp(
            self._level(longitude, colatitude, level),
            self._level(longitude, colatitude, level + 1),
            position - mi.Float(level),
        )

    def eval_diffuse(self, normal: "mi.Vector3f", point: "mi.Point3f | None" = None) -> "mi.Color3f":
        """Return radiance averaged over the cosine lobe around world-space unit ``normal`` at ``point`` (see `eval`):
        irradiance by π."""
        local, _, _ = self.environment.seen(normal, point)
        return self._level(*self.coordinates(local), mi.UInt32(len(_prefilter.LEVELS)))

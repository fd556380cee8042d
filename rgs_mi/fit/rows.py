"""What is learned of surfels, a row of numbers each, and Adam, for which a surfel rests while no gradient reaches it.

Adam (Kingman and Ba 2015) moves all that is learned in every step, by its moments where there is no gradient. But a step of a fit
sees a part of the surfels: a window of one photograph, and of the object's sides one. What k steps without a gradient do to the
parameters p and moments m, v of the others is known beforehand:

    p ← p − η (ρ + ρ² + … + ρᵏ) m / √v,   m ← β₁ᵏ m,   v ← β₂ᵏ v,   ρ = β₁ / √β₂                  (25)

but for what the rate η, with its correction of m and v that begin at zero, changes by in these k steps: it is that of now. So a
row stays as it is until someone asks for it, and goes through (25) then. The first steps, in which that correction falls fast,
move all rows.
"""

import math
from collections.abc import Mapping, Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import as_float
from ..splat.hit import PACKET, FetchAll, padded

_BETA_1, _BETA_2 = 0.9, 0.999
_RHO = _BETA_1 / math.sqrt(_BETA_2)
#: The step of 3DGS's optimizers is relative to the gradient's own size, however small.
EPSILON = 1e-15
_YOUNG = 200  # steps before any row rests: from then on the correction changes by a fifth of a percent a step, or less
LAST = "rows_last"  # its name in a checkpoint


class Rows:
    """N rows of parameters that Adam moves, of so many numbers under each name.

    ``fields`` are NumPy arrays [N, channels]. ``rates`` has the learning rate of each name; ``steps`` is how many have been made;
    ``values`` are the rows, some of which may be of some steps ago. ``moments`` are the first and the second of Adam, like fields
    (None: zeros), and ``last`` [N] is the step of which each row is (None: the last).
    """

    def __init__(
        self,
        fields: Mapping[str, np.ndarray],
        moments: Sequence[Mapping[str, np.ndarray]] | None = None,
        steps: int = 0,
        last: np.ndarray | None = None,
    ) -> None:
        self._channels = {name: np.shape(value)[1] for name, value in fields.items()}
        self._stride = padded(sum(self._channels.values()))
        self.rates, self.steps = dict.fromkeys(fields, 0.0), steps
        values = self._interleaved(fields)
        m, v = map(self._interleaved, moments) if moments else (np.zeros_like(values), np.zeros_like(values))
        self._keep(*map(as_float, (values, m, v)))
        if last is not None:
            self._last, self._resting = mi.UInt32(as_float(last)), True
            dr.make_opaque(self._last)

    def __len__(self) -> int:
        return dr.width(self._last)

    def names(self) -> list[str]:
        """Return the names of the parameters."""
        return list(self._channels)

    # ---- A step ----

    def at(self, index: "mi.UInt32") -> "mi.Float":
        """Return the rows ``index``, one after the other, by (25); not differentiated, but a leaf of what may be."""
        row, packet, column, lane = self._packets(index)
        rows = dr.empty(mi.Float, dr.width(index) * self._stride)
        dr.scatter(rows, self._rested(row, packet, column)[0], lane)
        dr.eval(rows)
        return rows

    def split(self, rows: "mi.Float") -> "dict[str, list[mi.Float]]":
        """Return the columns of ``rows`` under each name; differentiable."""
        columns = iter(dr.custom(_Columns, rows, self._stride))
        return {name: [next(columns) for _ in range(n)] for name, n in self._channels.items()}

    def together(
        self, parts: "Sequence[tuple[mi.UInt32, mi.Float, bool]]", every: bool = False
    ) -> "tuple[mi.UInt32, mi.Float]":
        """Return (index, gradient): the rows of which any of ``parts`` has gradients, or ``every`` one, as in the first steps,
        and their sums, row by row. A part is (index, gradient, whether no row is in it twice). What overflowed counts as zero."""
        n = len(self)
        if every or self.steps < _YOUNG:
            index = place = dr.arange(mi.UInt32, n)
        else:
            found, place = dr.zeros(mi.UInt32, n), dr.empty(mi.UInt32, n)
            for rows, _, _ in parts:
                dr.scatter(found, mi.UInt32(1), rows)
            index = dr.compress(found > 0)
            dr.scatter(place, dr.arange(mi.UInt32, dr.width(index)), index)
        total = dr.zeros(mi.Float, max(dr.width(index), 1) * self._stride)
        for rows, gradient, once in parts:
            row, _, column, lane = self._packets(rows)
            values = dr.gather(mi.Vector4f, gradient, lane)
            values = dr.select(dr.isfinite(values), values, 0)
            to = dr.gather(mi.UInt32, place, row) * (self._stride // PACKET) + column
            mode = dr.ReduceMode.NoConflicts if once else dr.ReduceMode.Local
            dr.scatter_reduce(dr.ReduceOp.Add, total, values, to, mode=mode)
        dr.eval(total)
        return index, total

    def step(self, index: "mi.UInt32", gradient: "mi.Float") -> None:
        """Move the rows ``index``, none of them twice, by their ``gradient``, row by row. No gradient reaches the others."""
        if dr.width(index) == 0:
            self.steps, self._resting = self.steps + 1, True
            return
        row, packet, column, lane = self._packets(index)
        p, m, v = self._rested(row, packet, column)
        g = dr.gather(mi.Vector4f, gradient, lane)
        m, v = dr.lerp(g, m, _BETA_1), dr.lerp(g * g, v, _BETA_2)
        self.steps, self._resting = self.steps + 1, True
        p -= self._rate(column) * m * dr.rsqrt(v + EPSILON**2)
        dr.eval(p, m, v)  # they could not be written in place of what they are still computed from
        for array, value in zip((self.values, self._m, self._v), (p, m, v)):
            dr.scatter(array, value, packet)
        dr.scatter(self._last, dr.opaque(mi.UInt32, self.steps), index)
        dr.eval(self.values, self._m, self._v, self._last)

    def _packets(self, index):
        """(row, packet in the rows of all, packet in a row, packet in the rows of these alone) of each packet of ``index``."""
        n = self._stride // PACKET
        lane = dr.arange(mi.UInt32, dr.width(index) * n)
        row, column = dr.gather(mi.UInt32, index, lane // n), lane % n
        return row, row * n + column, column, lane

    def _rested(self, row, packet, column):
        """(p, m, v) of packets, by (25)."""
        p, m, v = (dr.gather(mi.Vector4f, array, packet) for array in (self.values, self._m, self._v))
        k = mi.Float(dr.opaque(mi.UInt32, self.steps) - dr.gather(mi.UInt32, self._last, row))
        decay = lambda base: dr.exp(k * math.log(base))
        sum_of_powers = _RHO / (1 - _RHO) * (1 - decay(_RHO))
        return p - self._rate(column) * sum_of_powers * m * dr.rsqrt(v + EPSILON**2), decay(_BETA_1) * m, decay(_BETA_2) * v

    def _rate(self, column):
        """Adam's η of each packet of a row."""
        t = max(self.steps, 1)
        correction = np.sqrt(1 - _BETA_2**t) / (1 - _BETA_1**t)
        rates = np.repeat([self.rates[name] for name in self._channels], list(self._channels.values()))
        return dr.gather(mi.Vector4f, as_float(np.pad(rates * correction, (0, self._stride - len(rates)))), column)

    def clip(self, most: Mapping[str, float]) -> None:
        """Keep the parameters of these names from going beyond ± so ``most``, in all rows as they are kept."""
        bounds = np.full(self._stride, np.finfo(np.float32).max)
        for name, bound in most.items():
            bounds[self._slice(name)] = bound
        packet = dr.arange(mi.UInt32, dr.width(self.values) // PACKET)
        bound = dr.gather(mi.Vector4f, as_float(bounds), packet % (self._stride // PACKET))
        clipped = dr.clip(dr.gather(mi.Vector4f, self.values, packet), -bound, bound)
        dr.eval(clipped)  # it could not be written in place of what it is still computed from
        dr.scatter(self.values, clipped, packet)
        dr.eval(self.values)

    def catch_up(self) -> None:
        """Bring all rows to where they are by now."""
        if not self._resting:
            return
        self._renew(dr.arange(mi.UInt32, len(self)))

    def _renew(self, index, old=1):
        """Keep the rows ``index`` as they are by now, with their moments times ``old`` (of each of them, or of all)."""
        row, packet, column, lane = self._packets(index)
        p, m, v = self._rested(row, packet, column)
        old = dr.gather(mi.Float, mi.Float(old), lane // (self._stride // PACKET)) if dr.is_array_v(old) else old
        arrays = [dr.empty(mi.Float, dr.width(index) * self._stride) for _ in range(3)]
        for array, value in zip(arrays, (p, m * old, v * old)):
            dr.scatter(array, value, lane)
        self._keep(*arrays)

    # ---- As a whole ----

    def state(self) -> dict[str, np.ndarray]:
        """Return everything that a checkpoint needs: each name's parameters, its moments as name.m and name.v, all as they are
        kept, the number of steps as name.t, and the step of which each row is as `LAST`."""
        arrays = {LAST: self._last.numpy().copy()} | {f"{name}.t": np.array(self.steps) for name in self._channels}
        for suffix, of in (("", "value"), (".m", "m"), (".v", "v")):
            arrays |= {name + suffix: self._columns_of(name, of) for name in self._channels}
        return arrays

    @classmethod
    def from_state(cls, arrays: Mapping[str, np.ndarray], names: Sequence[str]) -> "Rows":
        """Make the rows whose `state`, with parameters of these ``names``, is among ``arrays``."""
        fields, *moments = ({name: arrays[name + of] for name in names} for of in ("", ".m", ".v"))
        return cls(fields, moments, int(arrays[f"{names[0]}.t"]), arrays.get(LAST))

    def numpy(self, name: str, of: str = "value") -> np.ndarray:
        """Return the parameters ``name`` of all rows, or their first or second moments, where ``of`` is 'm' or 'v',
        [N, channels]."""
        self.catch_up()
        return self._columns_of(name, of)

    def set(self, name: str, value: np.ndarray, m: np.ndarray | float = 0.0, v: np.ndarray | float = 0.0) -> None:
        """Replace the parameters ``name`` of all rows, [N, channels], and their moments."""
        self.catch_up()
        matrices = [array.numpy().reshape(-1, self._stride).copy() for array in (self.values, self._m, self._v)]
        for matrix, new in zip(matrices, (value, m, v)):
            matrix[:, self._slice(name)] = new
        self._keep(*map(as_float, matrices))

    def select(self, index: np.ndarray, changes: Mapping[str, np.ndarray], fresh: np.ndarray) -> None:
        """Keep the rows ``index`` (any order, repeats allowed) with their moments, but for those that are ``fresh``, and then
        overwrite parameters by ``changes`` {name: [rows, channels]}."""
        self._renew(mi.UInt32(as_float(index)), as_float(~fresh))
        row = dr.arange(mi.UInt32, len(index)) * self._stride
        for name, value in changes.items():
            for k, column in enumerate(np.transpose(value), self._slice(name).start):
                dr.scatter(self.values, as_float(column), row + k)
        dr.eval(self.values)

    def _columns_of(self, name, of):
        """[N, channels], a copy, of the rows as they are kept: steps write into these in place."""
        array = {"value": self.values, "m": self._m, "v": self._v}[of]
        return array.numpy().reshape(-1, self._stride)[:, self._slice(name)].copy()

    def _keep(self, values, m, v):
        """Have these floats as all rows, of now, and their moments."""
        self.values, self._m, self._v = values, m, v
        self._last, self._resting = dr.full(mi.UInt32, self.steps, dr.width(values) // self._stride), False
        dr.make_opaque(self.values, self._m, self._v, self._last)

    def _slice(self, name):
        """The columns of ``name``."""
        names = list(self._channels)
        first = sum(self._channels[other] for other in names[: names.index(name)])
        return slice(first, first + self._channels[name])

    def _interleaved(self, fields):
        columns = [np.reshape(fields[name], (-1, n)) for name, n in self._channels.items()]
        matrix = np.concatenate(columns, 1).astype(np.float32)
        return np.pad(matrix, ((0, 0), (0, self._stride - matrix.shape[1])))


class _Columns(FetchAll):
    """The numbers of rows, column by column."""

    def name(self):
        return "rgs_mi.fit.Columns"

"""How far the lamps of a turntable's rings are turned, learned with the surfels: someone has moved the camera among them."""

from collections.abc import Mapping
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.camera import Camera
from ..core.turntable import Turntable
from .cameras import Rows


class Turns:
    """What is learned of the turns of ``given``, a turntable of several rings: radians that are added to those of all but the
    lowest ring, which the environment itself goes with."""

    def __init__(self, given: Turntable) -> None:
        self.given, self.rows = given, Rows(len(given.rings), 1)
        self._leaves: list[tuple[int, mi.Float]] = []

    @classmethod
    def of(cls, table: Turntable | None) -> "Turns | None":
        """The turns of ``table``; None where there is nothing to learn."""
        return cls(table) if table is not None and len(table.rings) > 1 else None

    def see(self, camera: Camera) -> "mi.Float | None":
        """Return the turn of the lamps in radians when ``camera`` sees the object, with a gradient for the next `step`; None
        for the lowest ring, whose turn is the given one."""
        if not (ring := self.given.ring(camera)):
            return None
        turn = dr.opaque(mi.Float, np.radians(self.given.rings[ring][1]) + float(self.rows.value[ring, 0]))
        dr.enable_grad(turn)
        self._leaves.append((ring, turn))
        return turn

    def gradients(self) -> dict[int, np.ndarray]:
        """Return those of the rings that were seen since the last call, {ring: [1]}."""
        gradients: dict[int, np.ndarray] = {}
        for ring, turn in self._leaves:
            gradients[ring] = gradients.get(ring, np.zeros(1)) + float(dr.grad(turn)[0])
        self._leaves.clear()
        return gradients

    def step(self, gradients: Mapping[int, np.ndarray], rate: float) -> None:
        """Move the rings that have `gradients`, at this ``rate``."""
        self.rows.step(gradients, rate)

    @property
    def table(self) -> Turntable:
        """The turntable as it is learned by now."""
        turns = np.degrees(self.rows.value[:, 0])
        rings = [(elevation, turn + float(more)) for (elevation, turn), more in zip(self.given.rings, turns)]
        return replace(self.given, rings=tuple(rings))

    # ---- State ----

    def state(self) -> dict[str, np.ndarray]:
        """Return everything that a checkpoint needs, as NumPy arrays."""
        return {f"turns.{name}": value for name, value in self.rows.state().items()}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take the `state` that a checkpoint has."""
        self.rows.restore({name.removeprefix("turns."): v for name, v in arrays.items() if name.startswith("turns.")})

"""How a fit went: what its steps measured, in a few hundred rows over its whole length.

curves.csv: step, seconds, surfels, pixels (width of the photographs) where a stretch of steps ends; psnr (dB, of the
            training views), ms (a step) and loss.NAME (each part of the loss, weighted), means over the stretch
"""

import csv
import io
import json
import math
from collections.abc import Iterable
from pathlib import Path

from ..core.errors import UserError
from ..core.files import atomic_file
from ..core.inputs import read_file

FILE = "curves.csv"
STRETCHES = 300  # of equal parts of the budget; a fit has that many rows, or one per step


class Curves:
    """The curves of a fit. ``rows`` are what a checkpoint keeps: a dictionary for each stretch, oldest first, JSON
    values."""

    def __init__(self, rows: Iterable[dict] = ()) -> None:
        self.rows = list(rows)
        self._stretch: int | None = None  # index of the one that has begun
        self._sums: dict[str, tuple[float, int]] = {}  # name -> sum and count over its steps

    def add(self, progress: float, state: dict, measured: dict) -> bool:
        """Note a step at the fit's ``progress`` in [0, 1]: ``state`` as it is now, and ``measured``, which is averaged (what
        is not finite is left out). Return whether a stretch is complete, and has become the last of the rows."""
        for name, value in measured.items():
            if math.isfinite(value):
                total, count = self._sums.get(name, (0.0, 0))
                self._sums[name] = total + float(value), count + 1
        stretch = int(STRETCHES * progress)
        if stretch == self._stretch:
            return False
        self.rows.append(state | {name: total / count for name, (total, count) in self._sums.items()})
        self._stretch, self._sums = stretch, {}
        return True

    def write(self, folder: Path) -> None:
        """Write ``FOLDER/curves.csv``. Raises: UserError where the disk is full or the folder can't be written."""
        text = io.StringIO()
        names = dict.fromkeys(name for row in self.rows for name in row)
        writer = csv.DictWriter(text, list(names), lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.rows)
        with atomic_file(folder / FILE) as stream:
            stream.write(text.getvalue().encode())

    @classmethod
    def read(cls, folder: Path) -> "Curves":
        """Read what `write` wrote; the curves are empty where there is none. Raises: UserError where it is damaged."""
        path = folder / FILE
        if not path.is_file():
            return cls()
        try:
            text = io.StringIO(read_file(path).decode(), newline="")
            return cls({k: json.loads(v) for k, v in row.items() if v} for row in csv.DictReader(text))
        except (OSError, ValueError, RecursionError, TypeError, csv.Error) as error:
            raise UserError(f"{path}: damaged ({error}): delete it, the report then has no curves") from error

    def column(self, name: str) -> list[float]:
        """Return the value of ``name`` in each row, NaN where a row has none."""
        return [row.get(name, math.nan) for row in self.rows]

    def losses(self) -> list[str]:
        """Return the names of the columns that are parts of the loss."""
        return list(dict.fromkeys(name for row in self.rows for name in row if name.startswith("loss.")))

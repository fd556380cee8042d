"""How large a picture in motion is: the largest of a few fixed sizes that the machine draws often enough."""

import time
from collections.abc import Callable

#: Points along both sides. The browser stretches them to its window, whose pixels are not square then.
GRIDS = (128, 200, 288, 400)
RATE = 15  # frames a second
_MARGIN = 0.9  # of a frame's time: the rest is for sending it
_HYSTERESIS = 0.92  # of that, for a larger grid than before
_SMOOTHING = 0.7


class Pace:
    """Which of `GRIDS` to draw next.

    ``seconds``: what a frame of each grid took when it was warm. Later frames say by how much the machine is slower, or
    faster, than it was then.
    """

    def __init__(self) -> None:
        self.seconds: dict[int, float] = {}  # a frame of each grid that is warm
        self._slower, self._last = 1.0, GRIDS[0]

    @property
    def cold(self) -> int | None:
        """The smallest grid that was not drawn yet; None once all are warm."""
        return next((grid for grid in GRIDS if grid not in self.seconds), None)

    def measure(self, grid: int, draw: Callable[[int], object]) -> None:
        """Measure ``draw(grid)``, for which all is compiled."""
        start = time.perf_counter()
        draw(grid)
        self.seconds[grid] = time.perf_counter() - start

    def note(self, grid: int, seconds: float) -> None:
        """Take note of a frame that took so many ``seconds``; those of a grid that is not warm yet say nothing."""
        if grid not in self.seconds:
            return
        ratio = seconds / self.seconds[grid]
        self._slower = _SMOOTHING * self._slower + (1 - _SMOOTHING) * min(max(ratio, 0.1), 10.0)

    def choose(self, windows: int = 1, side: int = GRIDS[-1]) -> int:
        """Return the grid for a window whose longer side has ``side`` pixels, where so many ``windows`` are in motion: at least
        the smallest."""
        time_left, chosen = _MARGIN / (RATE * windows), GRIDS[0]
        for grid in self.seconds:
            limit = time_left * (_HYSTERESIS if grid > self._last else 1)
            if self._slower * self.seconds[grid] <= limit and (grid <= side or chosen < side):
                chosen = max(chosen, grid)
        self._last = chosen
        return chosen

"""What a page sends is checked before it is believed."""

import math
from collections.abc import Sequence


def number(value: object, low: float, high: float) -> float | None:
    """Return what a page gives for a number, within its bounds; None where it is none."""
    if isinstance(value, int | float) and math.isfinite(value):
        return float(min(max(value, low), high))
    return None


def choice(value: object, options: Sequence[str]) -> str | None:
    """Return what a page chose, None where that was not offered."""
    return value if isinstance(value, str) and value in options else None

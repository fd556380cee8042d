"""What a page sends is checked before it is believed."""

import math
from collections.abc import Sequence
from urllib.parse import urlsplit


def number(value: object, low: float, high: float) -> float | None:
    """Return what a page gives for a number, within its bounds; None where it is none."""
    if isinstance(value, int | float) and math.isfinite(value):
        return float(min(max(value, low), high))
    return None


def choice(value: object, options: Sequence[str]) -> str | None:
    """Return what a page chose, None where that was not offered."""
    return value if isinstance(value, str) and value in options else None


def same_origin(origin: str, host: str | None) -> bool:
    """Return whether what opened a socket is no other site's page, which the same browser shows: its ``origin`` is the ``host``
    that it asked for (both as headers have them, RFC 6454)."""
    return host is not None and urlsplit(origin).netloc.lower() == host.lower()

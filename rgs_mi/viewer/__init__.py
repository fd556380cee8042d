"""A window on a scene of surfels: a page in a browser that is rendered here, to look at it, turn it and relight it."""

from .notebook import show

__all__ = ["show"]

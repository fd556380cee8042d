"""Everything of drjit.nn is Any."""

from typing import Any

def __getattr__(name: str) -> Any: ...

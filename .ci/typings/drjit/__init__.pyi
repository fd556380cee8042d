"""Everything of drjit is Any: its own stubs are written for one variant and reject arithmetic that runs."""

from typing import Any

def __getattr__(name: str) -> Any: ...

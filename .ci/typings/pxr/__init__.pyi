"""Everything of OpenUSD is Any: its own stubs lack most of what its modules have."""

from typing import Any

def __getattr__(name: str) -> Any: ...

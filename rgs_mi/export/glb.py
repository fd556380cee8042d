"""glTF 2.0 in one binary file: a JSON header, and arrays one after the other (Khronos 2021, §4.4)."""

import json
import struct
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from ..core.files import atomic_file

ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
_MAGIC, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
_COMPONENTS = {np.dtype("<f4"): 5126, np.dtype("<u4"): 5125}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


class Buffer:
    """The binary part of a file, and what the header says of it: ``views`` and ``accessors``."""

    def __init__(self) -> None:
        self.views: list[dict] = []
        self.accessors: list[dict] = []
        self._parts: list[bytes] = []
        self._length = 0

    def add(self, data: bytes, **properties: object) -> int:
        """Append ``data``, padded to four bytes, and return the index of its view, which has ``properties``."""
        self.views.append({"buffer": 0, "byteOffset": self._length, "byteLength": len(data), **properties})
        self._parts.append(data + b"\0" * (-len(data) % 4))
        self._length += len(self._parts[-1])
        return len(self.views) - 1

    def add_array(self, values: np.ndarray, target: int = ARRAY_BUFFER, bounds: bool = False) -> int:
        """Append ``values`` [N] or [N, 2 to 4], little-endian floats or 32-bit integers, and return the index of their accessor;
        ``bounds`` asks for their least and greatest."""
        values = np.ascontiguousarray(values)
        accessor = {"bufferView": self.add(values.tobytes(), target=target), "componentType": _COMPONENTS[values.dtype]}
        accessor |= {"count": len(values), "type": _TYPES[values.shape[1] if values.ndim > 1 else 1]}
        if bounds:
            accessor |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def document(
        self, primitive: dict, extensions: Iterable[str] = (), origin: Sequence[float] = (0, 0, 0), **properties: object
    ) -> dict:
        """Return the header of a file that shows one mesh of one ``primitive``, whose own origin is at ``origin`` [3], with
        further ``properties``."""
        placed = {"translation": [*origin]} if any(origin) else {}
        used = sorted(extensions)
        return {
            "asset": {"version": "2.0", "generator": "rgs_mi"},
            **({"extensionsUsed": used} if used else {}),
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0, **placed}],
            "meshes": [{"primitives": [primitive]}],
            **properties,
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": self._length}],
        }

    def write(self, path: str | Path, document: dict) -> None:
        """Write a GLB of the header ``document``. Raises: UserError where the disk is full or the folder can't be written."""
        header = json.dumps(document, separators=(",", ":")).encode()
        chunks = _chunk(_JSON, header, b" ") + _chunk(_BINARY, b"".join(self._parts), b"\0")
        with atomic_file(path) as stream:
            stream.write(struct.pack("<III", _MAGIC, 2, 12 + len(chunks)))
            stream.write(chunks)


def _chunk(kind, content, padding):
    """A chunk of a GLB, padded to four bytes."""
    content += padding * (-len(content) % 4)
    return struct.pack("<II", len(content), kind) + content

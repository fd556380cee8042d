"""The vertices of PLY files: ASCII and binary of either byte order are read, binary little-endian is written.

A PLY is a header in ASCII, which names elements and their properties, and the elements' values one after another, those of a
vertex in the header's order. What a file may hold behind its vertices, such as the faces of a mesh, is never looked at.
"""

import os
import re
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .files import atomic_file
from .inputs import opened

_HEADER_LIMIT = 1 << 20  # bytes
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float32": "f4", "float64": "f8"},
}
_NAMES = {_TYPES[name]: name for name in list(_TYPES)[:8]}


def read_vertices(path: str | Path) -> np.ndarray:
    """The vertices of a PLY file as a structured array [N], N > 0, with a field a property, in the file's types.

    Memory is taken for what the file holds, not for what its header promises.
    Raises: OSError; ValueError for a file that is damaged or has no vertices, with the reason alone as its message, which
    says 'it' of the file: a caller adds its name and the remedy.
    """
    with opened(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        form, elements, start = _header(stream.read(_HEADER_LIMIT))
        before = elements[: next((k for k, (name, *_) in enumerate(elements) if name == "vertex"), len(elements))]
        if len(before) == len(elements) or not elements[len(before)][1]:
            raise ValueError("it holds no points: no elements 'vertex'")
        _, count, properties = elements[len(before)]
        if any(kind == "list" for _, kind in properties):
            raise ValueError("its elements 'vertex' have lists")
        if not properties:
            raise ValueError("its vertices have no properties")
        if count * len(properties) > size:
            raise ValueError(f"it declares {count} elements 'vertex' in {size} bytes")
        stream.seek(start)
        read = _read_binary if _ORDERS[form] else _read_ascii
        vertices = read(stream, size - start, before, count, _record(properties, _ORDERS[form]))
    if len(vertices) < count:
        raise ValueError(f"it ends before the last of its {count} vertices")
    return np.asarray(vertices)


def names_of(vertices: np.ndarray) -> tuple[str, ...]:
    """The names of the properties of a structured array."""
    return vertices.dtype.names or ()


def write_vertices(path: str | Path, vertices: np.ndarray, comments: Sequence[str] = ()) -> None:
    """Write a structured array [N], with a field a property, as the vertices of a binary little-endian PLY, with ``comments``
    in its header; the file appears whole or not at all.

    Raises: UserError where the disk is full or the folder can't be written.
    """
    little = vertices.astype(vertices.dtype.newbyteorder("<"))
    properties = [f"property {_NAMES[little.dtype[name].str[1:]]} {name}" for name in names_of(little)]
    told = [f"comment {comment}" for comment in comments]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *told,
        f"element vertex {len(little)}",
        *properties,
        "end_header",
        "",
    ]
    with atomic_file(path) as stream:
        stream.write("\n".join(header).encode("ascii"))
        stream.write(little.tobytes())


# ---- Header ----


def _header(head: bytes):
    """(format, elements, bytes of the header) of a file that begins with ``head``; an element is (name, count, properties),
    a property (name, type), where the type may be 'list'."""
    first = re.match(rb"ply(\r\n|\n|\r)", head)
    end = head.find(first[1] + b"end_header" + first[1]) if first else -1
    if first is None or end < 0:
        raise ValueError("it has no PLY header")
    form, elements = None, []
    for line in head[first.end() : end].split(first[1]):
        if line.split(maxsplit=1)[:1] in ([], [b"comment"], [b"obj_info"]):
            continue
        match line.decode("ascii").split():
            case ["format", name, "1.0"] if form is None and name in _ORDERS:
                form = name
            case ["element", name, count]:
                elements.append((name, int(count), []))
                if int(count) < 0:
                    raise ValueError(f"it declares {int(count)} elements '{name}'")
            case ["property", "list", _, _, name] if elements:
                elements[-1][2].append((name, "list"))
            case ["property", kind, name] if elements:
                if kind not in _TYPES:
                    raise ValueError(f"its property '{name}' is of the unknown type '{kind}'")
                elements[-1][2].append((name, kind))
            case words:
                raise ValueError(f"its header has the line '{' '.join(words)[:60]}'")
    if form is None:
        raise ValueError("its header has no format")
    return form, elements, end + 2 * len(first[1]) + len(b"end_header")


def _record(properties, order):
    return np.dtype([(name, order + _TYPES[kind]) for name, kind in properties])


# ---- Values ----


def _read_binary(stream, size, before, count, record):
    skipped = 0
    for name, number, properties in before:
        if number and any(kind == "list" for _, kind in properties):
            raise ValueError(f"its elements '{name}', which come before the vertices, have lists")
        skipped += number * (_record(properties, "<").itemsize if number else 0)
    if skipped + count * record.itemsize > size:
        return ()
    stream.seek(skipped, os.SEEK_CUR)
    return np.fromfile(stream, record, count)


def _read_ascii(stream, size, before, count, record):
    """An element has a line of its own."""
    skipped = sum(number for _, number, properties in before if properties)
    lines = [line for line in stream.read(size).splitlines() if not line.isspace() and line][skipped : skipped + count]
    if len(lines) < count:
        return ()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of no data, which is counted below
        table = np.loadtxt([line.decode("ascii") for line in lines], comments=None, ndmin=2)
    if table.shape[1] != len(record):
        raise ValueError(f"its vertices have {table.shape[1]} values for {len(record)} properties")
    vertices = np.empty(len(table), record)
    for name, values in zip(record.names, table.T):
        if record[name].kind in "iu":
            limits = np.iinfo(record[name])
            whole = (values >= limits.min) & (values <= limits.max) & (values == np.trunc(values))
            if not whole.all():
                raise ValueError(f"'{name}' of vertex {whole.argmin()} is {values[whole.argmin()]:g}, no {limits.dtype}")
        with np.errstate(over="ignore"):
            vertices[name] = values
    return vertices

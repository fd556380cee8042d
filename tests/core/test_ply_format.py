"""PLY files of every form: what is around the vertices must not be in the way, nor what their header promises be believed."""

import struct
import tracemalloc

import numpy as np
import pytest

from rgs_mi.core.ply_format import read_vertices, write_vertices

from captures import PLY_TYPES, write_ply_rows

ROWS = np.array([(1.5, -3, 200), (-0.25, 7, 0), (1e-7, 32767, 255)], [("x", "f4"), ("label", "i2"), ("red", "u1")])
FORMS = [{"text": True}, {"byte_order": "<"}, {"byte_order": ">"}]


def face_list(order, text):
    header = b"element face 2\nproperty list uchar int vertex_indices\nproperty uchar flags\n"
    faces = [(0, 1, 2), (2, 1, 0, 1)]
    if text:
        return header, b"".join(b"%d %s 9\n" % (len(f), b" ".join(b"%d" % i for i in f)) for f in faces)
    return header, b"".join(struct.pack(f"{order}B{len(f)}iB", len(f), *f, 9) for f in faces)


def fixed(order, text):
    header = b"comment d\xe9j\xe0 vu\nelement camera 2\nproperty double focal\nproperty uchar kind\n"
    cameras = [(0.5, 1), (2.5, 3)]
    return header, b"".join(b"%g %d\n\n" % c if text else struct.pack(f"{order}dB", *c) for c in cameras)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("before, after", [(None, None), (fixed, None), (None, face_list), (fixed, face_list)])
def test_vertices_among_other_elements(tmp_path, form, before, after):
    text, order = form.get("text", False), form.get("byte_order", "<")
    others = {k: make(order, text) for k, make in (("before", before), ("after", after)) if make}
    found = read_vertices(write_ply_rows(tmp_path / "a.ply", ROWS, **form, **others))
    assert found.dtype.names == ROWS.dtype.names
    for name in ROWS.dtype.names:
        np.testing.assert_array_equal(found[name], ROWS[name])


def test_lists_before_the_vertices(tmp_path):
    """Each is a line in ASCII; in binary their lengths stand among the data."""
    path = write_ply_rows(tmp_path / "a.ply", ROWS, text=True, before=face_list("", True))
    np.testing.assert_array_equal(read_vertices(path)["label"], ROWS["label"])
    with pytest.raises(ValueError, match="'face', which come before the vertices, have lists"):
        read_vertices(write_ply_rows(path, ROWS, before=face_list("<", False)))


@pytest.mark.parametrize("newline", [b"\r", b"\r\n"])
def test_other_ends_of_lines(tmp_path, newline):
    path = write_ply_rows(tmp_path / "a.ply", ROWS, text=True)
    path.write_bytes(path.read_bytes().replace(b"\n", newline))
    np.testing.assert_array_equal(read_vertices(path)["x"], ROWS["x"])
    header, end, data = write_ply_rows(path, ROWS).read_bytes().partition(b"end_header\n")
    path.write_bytes((header + end).replace(b"\n", newline) + data)
    np.testing.assert_array_equal(read_vertices(path)["x"], ROWS["x"])


def test_every_type(tmp_path):
    rows = np.zeros(4, [(kind, kind) for kind in PLY_TYPES])
    for kind in PLY_TYPES:
        limits = np.finfo(kind) if kind[0] == "f" else np.iinfo(kind)
        rows[kind] = limits.min, limits.max, 0, 3
    for form in FORMS:
        np.testing.assert_array_equal(read_vertices(write_ply_rows(tmp_path / "a.ply", rows, **form)), rows)
    write_vertices(tmp_path / "b.ply", rows.astype(rows.dtype.newbyteorder(">")))
    assert (tmp_path / "b.ply").read_bytes() == write_ply_rows(tmp_path / "a.ply", rows).read_bytes()


@pytest.mark.parametrize(
    "old, new, message",
    [
        (b"200", b"256", "'red' of vertex 0 is 256, no uint8"),
        (b"200", b"0.5", "'red' of vertex 0 is 0.5, no uint8"),
        (b"200", b"nan", "'red' of vertex 0 is nan, no uint8"),
        (b"200", b"200 1", "columns|values"),
        (b"-0.25 7 0\n", b"", "ends before the last of its 3 vertices"),
        (b"-0.25", b"minus", "minus"),
    ],
)
def test_damaged_text(tmp_path, old, new, message):
    path = write_ply_rows(tmp_path / "a.ply", ROWS, text=True)
    path.write_bytes(path.read_bytes().replace(old, new))
    with pytest.raises(ValueError, match=message):
        read_vertices(path)


@pytest.mark.parametrize("form", FORMS)
def test_promises_take_no_memory(tmp_path, form):
    """Counts, and records of many properties, of which each fits the file and the product does not; a header without end."""
    path = write_ply_rows(tmp_path / "a.ply", ROWS, **form, after=(b"", bytes(100_000)))
    good = path.read_bytes()
    many = b"".join(b"property double p%d\n" % i for i in range(2000))
    large = b"element camera 2000000000\nproperty double f\n"
    tracemalloc.start()
    for bad in (
        good.replace(b"vertex 3", b"vertex 90000").replace(b"end_header", many + b"end_header"),
        good.replace(b"vertex 3", b"vertex 4000000000000"),
        good.replace(b"element vertex", large + b"element vertex"),
        good.replace(b"end_header", b"comment " + b"x" * (2 << 20) + b"\nend_header"),
    ):
        path.write_bytes(bad)
        with pytest.raises(ValueError):
            read_vertices(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 16 << 20

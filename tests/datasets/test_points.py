"""Sparse point clouds beside the photographs: every format, every way in which one can be bad, and a fit's start there."""

import json
import random
import re
import struct
import warnings

import numpy as np
import pytest
from PIL import Image

from rgs_mi.core.color import srgb_decode
from rgs_mi.core.errors import UserError
from rgs_mi.datasets import load_dataset
from rgs_mi.datasets.points import FILES, sparse_points
from rgs_mi.priors.initialization import initial_points

from captures import write_ply_rows

XYZ = np.array([[0, 0, 0], [0.5, -0.25, 1], [1, 2, 3], [-1.5, 0.125, 8]], np.float32)
RGB = np.array([[0, 128, 255], [10, 20, 30], [200, 0, 1], [255, 255, 255]], np.uint8)
LINEAR = srgb_decode(RGB / 255).astype(np.float32)


def ply(path, kind="u1", text=False, order="<", position="f4", xyz=XYZ):
    colors = (RGB / 255 if kind and kind[0] == "f" else RGB)[: len(xyz)]
    fields = [(n, position) for n in "xyz"] + [("nx", "f4")]
    fields += [(n, kind) for n in ("red", "green", "blue")] if kind else []
    rows = np.zeros(len(xyz), fields)
    for i, name in enumerate("xyz"):
        rows[name] = xyz[:, i]
    for i, name in enumerate(("red", "green", "blue") if kind else ()):
        rows[name] = colors[:, i]
    return write_ply_rows(path, rows, text, order)


def colmap_binary(path, xyz=XYZ):
    points = [
        struct.pack("<Q3d3BdQ", 7 + i, *p, *c, 0.5, i) + struct.pack("<ii", 3, 4) * i
        for i, (p, c) in enumerate(zip(xyz, RGB))
    ]
    path.write_bytes(struct.pack("<Q", len(points)) + b"".join(points))
    return path


def colmap_text(path, xyz=XYZ):
    lines = ["# 3D point list with one line of data per point:", "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]", ""]
    lines += [
        f"{7 + i} {' '.join(map(str, p))} {' '.join(map(str, c))} 0.5{' 3 4' * i}" for i, (p, c) in enumerate(zip(xyz, RGB))
    ]
    path.write_text("\n".join(lines) + "\n")
    return path


WRITERS = {".ply": ply, ".bin": colmap_binary, ".txt": colmap_text}


def expect(root, colors=LINEAR):
    found, linear = sparse_points(root)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, XYZ)
    if colors is None:
        assert linear is None
    else:
        assert linear.dtype == np.float32
        np.testing.assert_allclose(linear, colors, rtol=1e-5, atol=1e-6)


# ---- What comes out ----


@pytest.mark.parametrize("name", FILES)
def test_every_place(tmp_path, name):
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    WRITERS[(tmp_path / name).suffix](tmp_path / name)
    expect(tmp_path)


@pytest.mark.parametrize(
    "form",
    [{}, {"text": True}, {"order": ">"}, {"kind": "f4"}, {"kind": "f8", "text": True}, {"kind": "i4"}, {"position": "f8"}],
)
def test_every_kind_of_ply(tmp_path, form):
    ply(tmp_path / "points.ply", **form)
    expect(tmp_path)


def test_ply_without_colours(tmp_path):
    ply(tmp_path / "points.ply", kind=None)
    expect(tmp_path, None)


@pytest.mark.parametrize("more", [b"element face 0\nproperty list uchar int i\n", b"element nothing 3\n"])
def test_other_elements_without_data_are_no_obstacle(tmp_path, more):
    file = ply(tmp_path / "points.ply")  # MeshLab writes point clouds as meshes without faces
    file.write_bytes(file.read_bytes().replace(b"end_header", more + b"end_header"))
    expect(tmp_path)


def test_the_first_file_counts_and_none_is_no_error(tmp_path):
    (tmp_path / "points.ply").mkdir()
    assert sparse_points(tmp_path) is None
    colmap_text(tmp_path / "points3D.txt").write_text("damaged")
    ply(tmp_path / "points3d.ply")
    expect(tmp_path)


# ---- What goes wrong ----


def refused(path, message):
    """One line that names the file, the reason and the remedy."""
    with pytest.raises(UserError, match=message) as caught:
        sparse_points(path.parent)
    text = str(caught.value)
    assert text.startswith(str(path)) and "export it again" in text and "\n" not in text


@pytest.mark.parametrize("name", ["points.ply", "points3D.bin", "points3D.txt"])
def test_values_that_no_point_has(tmp_path, name):
    write = WRITERS[(tmp_path / name).suffix]
    for bad in (np.nan, np.inf, -1e9):
        refused(write(tmp_path / name, xyz=np.where(np.arange(12).reshape(4, 3) == 7, bad, XYZ)), "point 2 has a coordinate")
    refused(write(tmp_path / name, xyz=XYZ[:0]), "holds no points")
    (tmp_path / name).write_bytes(b"")
    refused(tmp_path / name, "no PLY header|holds no points|declares 0 points in 0 bytes")


@pytest.mark.parametrize(
    "old, new, message",
    [
        (b"ply\n", b"PLY\n", "no PLY header"),
        (b"ply\n", b"ply!", "no PLY header"),
        (b"end_header", b"comment x", "no PLY header"),
        (b"element vertex 4", b"element vertex 5", "ends before the last of its 5 vertices"),
        (b"element vertex 4", b"element vertex 4000000000", "declares 4000000000 elements"),
        (b"element vertex 4", b"\telement\x1fvertex +4_000_000_000", "declares 4000000000 elements"),
        (b"element vertex 4", b"element vertex -4", "declares -4 elements"),
        (b"element vertex 4", b"element vertex many", "invalid literal"),
        (b"element vertex 4", b"element vertices 4", "no elements 'vertex'"),
        (b"element vertex 4", b"comment end_header\nelement vertex 4000000000", "declares 4000000000"),
        (b"property float x", b"property float u", "no property 'x'"),
        (b"property float x", b"property half x", "half"),
        (b"property float x", b"property list uchar float x", "have lists"),
        (b"property float x", b"property float x\xff", "ascii"),
        (
            b"element vertex 4",
            b"element face 2\nproperty list uint double i\nelement vertex 4",
            "'face', which .* have lists",
        ),
        (b"element vertex 4", b"element vertex 0", "holds no points"),
        (b"element vertex 4", b"property float u\nelement vertex 4", "the line 'property float u'"),
        (b"format binary_little_endian 1.0\n", b"", "no format"),
        (b"format binary_little_endian 1.0", b"format binary 1.0", "the line 'format binary 1.0'"),
        (b"property float y", b"property float x", "more than once"),
    ],
)
def test_bad_ply(tmp_path, old, new, message):
    file = ply(tmp_path / "points.ply")
    file.write_bytes(file.read_bytes().replace(old, new))
    refused(file, message)


def test_many_properties_of_many_points(tmp_path):
    """Counts that each fit the file but whose product does not."""
    header = "ply\nformat ascii 1.0\nelement vertex 30000\n" + "".join(f"property double p{i}\n" for i in range(2000))
    (tmp_path / "points.ply").write_text(header + "end_header\n")
    refused(tmp_path / "points.ply", "declares 30000 elements")


def test_ply_colours_out_of_range(tmp_path):
    file = ply(tmp_path / "points.ply", kind="f4", text=True)
    file.write_text(re.sub(r"\n(\S+ \S+ \S+ \S+) \S+ (\S+ \S+)\s*$", r"\n\1 255 \2\n", file.read_text()))
    refused(file, r"colour of point 3 lies outside")
    file.write_text(ply(file, text=True).read_text().replace(" 128 ", " 300 "))
    refused(file, "300")


def test_bad_colmap_binary(tmp_path):
    file = colmap_binary(tmp_path / "points3D.bin")
    good = file.read_bytes()
    for bad, message in (
        (good[:-1], "the file has"),
        (good + b"\0", "the file has"),
        (good[:120], "declares 4 points"),
        (good[:-24], "the file has"),
        (good[: 51 + 8 + 51 + 8 + 10] + bytes(100), "the file has"),
        (b"\xff" * 8 + good[8:], "declares 18446744073709551615 points"),
        (good[:51] + b"\xff" * 8 + good[59:], "ends within point 1"),
        (good[:5], "declares 4 points in 5 bytes"),
    ):
        file.write_bytes(bad)
        refused(file, message)


@pytest.mark.parametrize(
    "line, message",
    [
        ("9 1 2 three 0 0 0 0.5", "three"),
        ("9 1 2 3 0 0", "invalid column index"),
        ("9 1 2 3 0 256 0 0.5", "colour of point 4"),
        ("9 1 2 3 0 -1 0 0.5", "colour of point 4"),
        ("9 1e999 2 3 0 0 0 0.5", "point 4 has a coordinate"),
        ("9 \0 2 3 0 0 0 0.5", "could not convert"),
    ],
)
def test_bad_colmap_text(tmp_path, line, message):
    file = colmap_text(tmp_path / "points3D.txt")
    with open(file, "a") as stream:
        stream.write(line + "\n")
    refused(file, message)


def test_colmap_text_that_is_no_text(tmp_path):
    (tmp_path / "points3D.txt").write_bytes(b"\xff\xfe\x00 1 2 3")
    refused(tmp_path / "points3D.txt", "utf-8")


@pytest.mark.parametrize(
    "name, form", [("points.ply", {}), ("points.ply", {"text": True}), ("points3D.bin", {}), ("points3D.txt", {})]
)
def test_mutated_bytes_never_give_a_traceback(tmp_path, name, form):
    rng, file = random.Random(0), tmp_path / name
    good = WRITERS[file.suffix](file, **form).read_bytes()
    for _ in range(100):
        bad = bytearray(good)
        for _ in range(rng.randint(1, 4)):
            i, n = rng.randrange(len(bad)), rng.choice([1, 1, 1, 8])
            bad[i : i + n] = rng.choice([bytes([rng.randrange(256)]), b"", b"9", b"\xff" * n, bad[i : i + n] * 2]) or b" "
        file.write_bytes(bad)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                found, linear = sparse_points(tmp_path)
                assert len(found) and np.isfinite(found).all()
                assert linear is None or (linear.shape == found.shape and (linear >= 0).all() and (linear <= 1).all())
            except UserError as error:
                assert "\n" not in str(error) and str(error).startswith(str(file))
                assert not isinstance(error.__cause__, Warning | MemoryError), bad


# ---- A fit's start ----


def capture(root, mode):
    """Two photographs, uniformly (128, 64, 32), of what stands at the origin."""
    (root / "train").mkdir()
    frames = []
    for name, x in (("a", 0.0), ("b", 0.5)):
        Image.new(mode, (24, 16), (128, 64, 32, 255)[: len(mode)]).save(root / "train" / f"{name}.png")
        frames.append(
            {"file_path": f"./train/{name}", "transform_matrix": [[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 20], [0, 0, 0, 1]]}
        )
    (root / "transforms_train.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))
    return root


@pytest.mark.parametrize("kind", ["u1", None])
def test_photographs_without_masks_start_at_the_points(tmp_path, kind):
    ply(capture(tmp_path, "RGB") / "points3d.ply", kind=kind)
    data = load_dataset(tmp_path)
    np.testing.assert_array_equal(data.points, XYZ)
    assert (data.point_colors is None) == (kind is None) and not any(view.masked for view in data.train)

    positions, normals, spacing, (colors, *_) = initial_points(data, 100)
    np.testing.assert_array_equal(positions, XYZ)
    assert normals is None and all(a.dtype == np.float32 for a in (positions, colors, spacing))
    seen = np.broadcast_to(srgb_decode(np.array([128, 64, 32]) / 255), (4, 3))
    np.testing.assert_allclose(colors, LINEAR if kind else seen, rtol=1e-5, atol=1e-6)
    distance = np.linalg.norm(XYZ[:, None] - XYZ, axis=-1)
    np.testing.assert_allclose(spacing, distance.sum(1) / 3, rtol=1e-5)

    fewer, _, _, (colors, *_) = initial_points(data, 2)
    rows = [np.flatnonzero((XYZ == point).all(1))[0] for point in fewer]
    assert len(set(rows)) == 2
    np.testing.assert_allclose(colors, LINEAR[rows] if kind else seen[:2], rtol=1e-5, atol=1e-6)


def test_points_at_one_place_and_a_lone_one_have_a_spacing(tmp_path):
    file = ply(capture(tmp_path, "RGBA") / "points3d.ply", xyz=0 * XYZ)  # opaque alpha is no mask
    assert (initial_points(load_dataset(tmp_path), 100).spacing > 0).all()
    file.unlink()
    file.with_name("points3D.txt").write_text("1 0 0 0 255 255 255 0")
    positions, _, spacing, (colors, *_) = initial_points(load_dataset(tmp_path), 100)
    assert positions.shape == (1, 3) and (colors == 1).all() and np.isfinite(spacing).all()


def test_a_damaged_cloud_stops_the_capture(tmp_path):
    (capture(tmp_path, "RGB") / "points3d.ply").write_text("ply\n")
    with pytest.raises(UserError, match="points3d.ply cannot be used as a point cloud"):
        load_dataset(tmp_path)

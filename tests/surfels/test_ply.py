"""PLY files: the round trip, the viewers' convention, and every kind of damage."""

import os

import numpy as np
import pytest

from rgs_mi.core.errors import UserError
from rgs_mi.core.ply_format import read_vertices
from rgs_mi.surfels.ply import read_ply, write_ply

from captures import write_ply_rows


def surfels(n=40, degree=3, seed=0):
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(n, 4))
    fields = {
        "centers": rng.normal(size=(n, 3)),
        "rotations": q / np.linalg.norm(q, axis=1, keepdims=True),
        "scales": np.exp(rng.normal(-4, 1, (n, 2))),
        "opacities": rng.uniform(0.001, 0.999, (n, 1)),
        "sh": rng.normal(size=(n, 3 * (degree + 1) ** 2)),
        "base_color": rng.uniform(size=(n, 3)),
        "roughness": rng.uniform(size=(n, 1)),
        "metallic": rng.uniform(size=(n, 1)),
        "delta_normal": rng.normal(size=(n, 3)),
        "curvature": rng.normal(size=(n, 3)),
    }
    return {name: value.astype(np.float32) for name, value in fields.items()}


def rewrite(source, target, keep=lambda name: True, dtype=None, change=None, **form):
    """Copy the vertices of a PLY with some properties left out, another type, or changed in place."""
    data = read_vertices(source)
    names = [name for name in data.dtype.names if keep(name)]
    copy = np.empty(len(data), [(name, dtype or data.dtype[name]) for name in names])
    for name in names:
        copy[name] = data[name]
    if change:
        change(copy)
    write_ply_rows(target, copy, **form)


@pytest.fixture
def ply(tmp_path):
    path = tmp_path / "object.ply"
    write_ply(path, surfels())
    return path


def assert_same(a, b, atol=1e-6):
    assert a.keys() == b.keys()
    for name in a:
        assert a[name].dtype == np.float32
        np.testing.assert_allclose(a[name], b[name], rtol=1e-6, atol=atol, err_msg=name)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_round_trip(tmp_path, degree):
    fields = surfels(degree=degree)
    write_ply(tmp_path / "new" / "object.ply", fields)
    assert_same(read_ply(tmp_path / "new" / "object.ply"), fields)
    assert os.listdir(tmp_path / "new") == ["object.ply"]


def test_viewer_convention(ply):
    fields, content = surfels(), ply.read_bytes()
    header, _, table = content.partition(b"end_header\n")
    first, form, element, *properties = header.decode().splitlines()
    assert (first, form, element) == ("ply", "format binary_little_endian 1.0", "element vertex 40")
    assert all(line.startswith("property float ") for line in properties)
    names = [line.split()[2] for line in properties]
    vertices = dict(zip(names, np.frombuffer(table, "<f4").reshape(40, -1).T))
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert names[54:62] == ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    np.testing.assert_array_equal(vertices["rot_0"], fields["rotations"][:, 3])
    for channel in range(3):
        for k in range(1, 16):
            name = f"f_rest_{15 * channel + k - 1}"
            np.testing.assert_array_equal(vertices[name], fields["sh"][:, 3 * k + channel])
    np.testing.assert_allclose(1 / (1 + np.exp(-vertices["opacity"])), fields["opacities"][:, 0], rtol=1e-5)
    assert (np.exp(vertices["scale_2"]) < 0.01 * fields["scales"].min(1)).all()


def test_normal_is_the_third_axis(ply):
    from scipy.spatial.transform import Rotation

    vertices = read_vertices(ply)
    normals = np.stack([vertices[name] for name in ("nx", "ny", "nz")], -1)
    expected = Rotation.from_quat(surfels()["rotations"]).as_matrix()[:, :, 2]
    np.testing.assert_allclose(normals, expected, atol=1e-6)


@pytest.mark.parametrize("form", [{"text": True}, {"byte_order": ">"}, {"dtype": "f8"}])
def test_other_encodings(ply, tmp_path, form):
    rewrite(ply, tmp_path / "other.ply", **form)
    assert_same(read_ply(tmp_path / "other.ply"), surfels(), atol=2e-6)


def test_plain_2dgs(ply, tmp_path):
    """No material, two scales, quaternions that are not normalised, a saturated opacity."""

    def change(data):
        data["opacity"][0], data["opacity"][1] = 1000, -1000
        for i in range(4):
            data[f"rot_{i}"] *= 3

    extra = ("base_color", "roughness", "metallic", "delta_normal", "curvature", "scale_2", "n")
    rewrite(ply, tmp_path / "2dgs.ply", keep=lambda name: not name.startswith(extra), change=change)
    fields = read_ply(tmp_path / "2dgs.ply")
    np.testing.assert_allclose(fields["rotations"], surfels()["rotations"], atol=1e-6)
    assert ((fields["opacities"] > 0) & (fields["opacities"] < 1)).all()
    assert (fields["base_color"] == 0.5).all() and (fields["roughness"] == 0.5).all()
    assert not fields["metallic"].any() and not fields["delta_normal"].any()
    assert not fields["curvature"].any()


def test_extreme_values_stay_finite(tmp_path):
    fields = surfels(n=4)
    fields["opacities"][:2, 0] = 0, 1
    fields["scales"][:2] = 0, 1e30
    write_ply(tmp_path / "object.ply", fields)
    back = read_ply(tmp_path / "object.ply")
    assert ((back["opacities"] > 0) & (back["opacities"] < 1)).all() and (back["scales"] > 0).all()


def refused(path, *words):
    with pytest.raises(UserError) as info:
        read_ply(path)
    message = str(info.value)
    assert "\n" not in message and str(path) in message
    assert all(word in message for word in words), message


@pytest.mark.parametrize("name", ["z", "f_dc_1", "f_rest_7", "opacity", "scale_1", "rot_3", "base_color_2"])
def test_missing_property(ply, tmp_path, name):
    rewrite(ply, tmp_path / "a.ply", keep=lambda n: n != name)
    refused(tmp_path / "a.ply", "f_rest" if "rest" in name else f"'{name}'")


@pytest.mark.parametrize("name, value", [("x", np.nan), ("roughness", np.inf), ("roughness", 1.5), ("scale_0", 500)])
def test_bad_values(ply, tmp_path, name, value):
    def change(data):
        data[name][7] = value

    rewrite(ply, tmp_path / "a.ply", change=change)
    refused(tmp_path / "a.ply", name.split("_")[0])


def test_zero_quaternion(ply, tmp_path):
    def change(data):
        for i in range(4):
            data[f"rot_{i}"][5] = 0

    rewrite(ply, tmp_path / "a.ply", change=change)
    refused(tmp_path / "a.ply", "rot", "vertex 5")


@pytest.mark.parametrize("count", ["0", "-3", "41", "99999999999999", "9" * 5000, "many"])
@pytest.mark.parametrize("text", [False, True])
def test_bad_counts(ply, tmp_path, count, text):
    rewrite(ply, tmp_path / "a.ply", text=text)
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(data.replace(b"vertex 40", b"vertex " + count.encode()))
    refused(tmp_path / "a.ply")


def test_not_surfels(tmp_path):
    path = tmp_path / "a.ply"
    refused(path)
    refused(tmp_path)
    for content in (
        b"",
        b"ply",
        b"hello\n",
        b"ply\nformat ascii 1.0\nend_header\n",
        b"ply\nformat ascii 1.0\nelement vertex 3\nend_header\n1\n2\n3\n",
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list int int x\nend_header\n1 1\n",
    ):
        path.write_bytes(content)
        refused(path)


def test_truncated(ply, tmp_path):
    with open(ply, "rb") as stream:
        data = stream.read()
    for length in np.linspace(0, len(data) - 1, 40).astype(int):
        (tmp_path / "a.ply").write_bytes(data[:length])
        refused(tmp_path / "a.ply")


@pytest.mark.parametrize("text", [False, True])
def test_fuzz(tmp_path, text):
    """A few random bytes changed, mostly in the header: a UserError or surfels that hold what the fields promise."""
    rng = np.random.default_rng(1)
    path = tmp_path / "a.ply"
    write_ply(path, surfels(n=3, degree=1))
    rewrite(path, tmp_path / "b.ply", text=text)
    data = (tmp_path / "b.ply").read_bytes()
    header = data.index(b"end_header") + 11
    for _ in range(150):
        mutated = bytearray(data)
        for _ in range(rng.integers(1, 4)):
            end = header if rng.random() < 0.7 else len(data)
            values = range(256) if rng.random() < 0.5 else b"0123456789-. \n"
            mutated[rng.integers(end)] = rng.choice(list(values))
        path.write_bytes(mutated)
        try:
            fields = read_ply(path)
        except UserError as error:
            assert "\n" not in str(error)
            continue
        assert all(np.isfinite(value).all() and len(value) == len(fields["sh"]) for value in fields.values())
        assert (fields["scales"] > 0).all() and ((fields["opacities"] > 0) & (fields["opacities"] < 1)).all()
        np.testing.assert_allclose(np.linalg.norm(fields["rotations"], axis=1), 1, atol=1e-6)


def test_failed_write_leaves_the_old_file(ply):
    fields = surfels()
    fields["roughness"] = fields["roughness"][:5]
    with pytest.raises(ValueError):
        write_ply(ply, fields)
    assert_same(read_ply(ply), surfels())

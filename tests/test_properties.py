"""What holds for any input, of which hypothesis thinks up some and keeps, in .hypothesis, those that failed: settings, surfels,
checkpoints, cameras and names come back as they went in, or are refused in a line; starts go with the world."""

import math
import os
import struct
import tempfile
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from rgs_mi.core.alignment import Similarity
from rgs_mi.core.errors import UserError
from rgs_mi.core.telling import one_line
from rgs_mi.datasets.colmap_files import CAMERA_MODELS, read_model
from rgs_mi.datasets.resolution import chosen
from rgs_mi.datasets.transforms import find_image
from rgs_mi.datasets.types import Dataset
from rgs_mi.datasets.world_frame import recentred
from rgs_mi.export.mitsuba_scene import sensor_ids
from rgs_mi.fit import checkpoint
from rgs_mi.priors.initialization import initial_points
from rgs_mi.settings.config import load_config, to_dict
from rgs_mi.settings.fields import walk
from rgs_mi.settings.settings import Settings
from rgs_mi.surfels.ply import read_ply, write_ply

SHORT = settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
TEXT = st.text(st.characters(codec="utf-8"), max_size=60)
KEYS = [setting.key for setting in walk(Settings)]


def loaded(text) -> Settings | None:
    """The settings that a file with ``text`` (bytes) gives; None where it is refused, in one line."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.yaml"
        path.write_bytes(text)
        try:
            found = load_config(Settings, [path])
            assert isinstance(found, Settings)
            return found
        except UserError as error:
            assert str(error) == one_line(error)
            return None


# ---- Settings ----


@SHORT
@given(st.one_of(st.binary(max_size=200), TEXT.map(str.encode)))
def test_any_bytes_are_settings_or_refused(content):
    loaded(content)


JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | TEXT,
    lambda x: st.lists(x, max_size=4) | st.dictionaries(TEXT, x, max_size=3),
)


@SHORT
@given(st.dictionaries(st.sampled_from(KEYS), JSON_VALUES, max_size=3), st.sampled_from([True, False]))
def test_any_values_of_known_keys_are_settings_or_refused(values, flow):
    tree = {}
    for key, value in values.items():
        place = tree
        *sections, name = key.split(".")
        for part in sections:
            place = place.setdefault(part, {})
        place[name] = value
    found = loaded(yaml.safe_dump(tree, default_flow_style=flow, allow_unicode=True).encode())
    if found is not None:
        assert loaded(yaml.safe_dump(to_dict(found)).encode()) == found  # all settings come back as they are
        assert all(math.isfinite(x) for x in numbers(to_dict(found)))


def numbers(tree):
    if isinstance(tree, dict | list | tuple):
        for value in tree.values() if isinstance(tree, dict) else tree:
            yield from numbers(value)
    elif isinstance(tree, int | float):
        yield tree


@SHORT
@given(TEXT)
def test_any_override_is_a_setting_or_refused(text):
    try:
        load_config(Settings, overrides=[text])
    except UserError as error:
        assert str(error) == one_line(error)


# ---- Files ----


@SHORT
@given(st.integers(1, 4), st.integers(0, 3), st.integers(0, 2**32 - 1))
def test_surfels_come_back(count, order, seed):
    rng = np.random.default_rng(seed)
    rotations = rng.normal(size=(count, 4))
    surfels = {
        "centers": rng.normal(size=(count, 3)) * 10.0 ** rng.integers(-3, 4),
        "rotations": rotations / np.linalg.norm(rotations, axis=1, keepdims=True),
        "scales": 10.0 ** rng.uniform(-6, 2, (count, 2)),
        "opacities": rng.uniform(0.001, 0.999, (count, 1)),
        "sh": rng.normal(size=(count, 3 * (order + 1) ** 2)),
        "base_color": rng.uniform(size=(count, 3)),
        "roughness": rng.uniform(size=(count, 1)),
        "metallic": rng.uniform(size=(count, 1)),
        "delta_normal": rng.normal(size=(count, 3)),
        "curvature": rng.normal(size=(count, 3)),
    }
    with tempfile.TemporaryDirectory() as folder:
        write_ply(Path(folder) / "a.ply", surfels)
        found = read_ply(Path(folder) / "a.ply")
    for name, values in surfels.items():
        np.testing.assert_allclose(found[name], values, rtol=2e-5, atol=2e-5, err_msg=name)


@SHORT
@given(
    st.dictionaries(
        st.from_regex(r"[a-z_]{1,12}", fullmatch=True),
        st.tuples(st.sampled_from("f4 f8 i4 u1 i8 ?".split()), st.lists(st.integers(0, 3), max_size=3)),
        max_size=4,
    ),
    st.dictionaries(TEXT.filter(lambda key: key not in ("step", "format")), JSON_VALUES, max_size=4),
    st.integers(0, 9_999_999),
)
def test_checkpoints_come_back(shapes, meta, step):
    arrays = {name: np.random.default_rng(step).integers(0, 2, shape).astype(kind) for name, (kind, shape) in shapes.items()}
    with tempfile.TemporaryDirectory() as folder:
        checkpoint.save(folder, arrays, meta | {"step": step})
        found, told = checkpoint.load_latest(folder)
    assert same(told, meta | {"step": step}) and found.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype


def same(one, other):
    """Equal, and NaN where the other is."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list):
        return len(one) == len(other) and all(map(same, one, other))
    return one == other or (one != one and other != other)


CAMERAS = st.lists(
    st.tuples(
        st.sampled_from([(name, count) for name, count in CAMERA_MODELS.items() if count]),
        st.integers(1, 10_000),
        st.integers(1, 10_000),
        st.lists(st.floats(-1e6, 1e6), min_size=12, max_size=12),
        st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.01),
        st.lists(st.floats(-1e5, 1e5), min_size=3, max_size=3),
        st.text(st.characters(categories=["L", "N"]), min_size=1, max_size=9),
    ),
    min_size=1,
    max_size=3,
)


@SHORT
@given(CAMERAS)
def test_text_and_binary_models_of_colmap_say_the_same(records):
    cameras, images = [[], []], [[], []]
    for k, ((model, count), width, height, parameters, q, t, name) in enumerate(records):
        cameras[0].append(f"{k} {model} {width} {height} {' '.join(map(repr, parameters[:count]))}\n")
        cameras[1].append(
            struct.pack(f"<iiQQ{count}d", k, list(CAMERA_MODELS).index(model), width, height, *parameters[:count])
        )
        images[0].append(f"{k} {' '.join(map(repr, [*q, *t]))} {k} {name}.png\n\n")
        images[1].append(struct.pack("<I7dI", k, *q, *t, k) + f"{name}.png".encode() + b"\0" + struct.pack("<Q", 0))
    with tempfile.TemporaryDirectory() as folder:
        for kind, (text, binary) in {"cameras": cameras, "images": images}.items():
            (Path(folder) / f"{kind}.txt").write_text("".join(text), "utf-8")
            (Path(folder) / f"{kind}.bin").write_bytes(struct.pack("<Q", len(binary)) + b"".join(binary))
        text, binary = (read_model(Path(folder), suffix) for suffix in (".txt", ".bin"))
    assert [(image.name, image.lens) for image in text] == [(image.name, image.lens) for image in binary]
    for one, other in zip(text, binary):
        np.testing.assert_array_equal(one.to_camera, other.to_camera)


# ---- Names ----

NAMES = st.text(st.characters(exclude_characters="/\0"), min_size=1, max_size=20)


@settings(parent=SHORT, max_examples=30)
@given(
    st.lists(NAMES | st.sampled_from(["object", "environment", "a.b", "a_b", "a_b_2", "$x", "$"]), min_size=1, max_size=6)
)
def test_any_names_of_views_give_a_scene_that_loads(names):
    names = list(dict.fromkeys(names))
    ids = sensor_ids(names, ["object", "environment"])
    assert len({*ids}) == len(names) and not {*ids} & {"object", "environment"}
    root = ET.Element("scene", version="3.0.0")
    ET.SubElement(root, "shape", type="sphere", id="object")
    for k, name in enumerate(ids):
        sensor = ET.SubElement(root, "sensor", type="perspective", id=name)
        ET.SubElement(sensor, "float", name="fov", value=str(k + 1))  # Mitsuba makes equal ones one
    with tempfile.TemporaryDirectory() as folder:
        ET.ElementTree(root).write(Path(folder) / "scene.xml", encoding="utf-8", xml_declaration=True)
        scene = mi.load_file(str(Path(folder) / "scene.xml"), parallel=False)
    assert [sensor.id() for sensor in scene.sensors()] == ids


@SHORT
@given(
    st.text(max_size=300) | st.sampled_from(["**a/v.png", "a" * 300, "*", "a\0b", "[", "../..", "~"]), st.integers(1, 10_000)
)
def test_any_name_of_an_image_is_looked_for(name, side):
    with tempfile.TemporaryDirectory() as folder:
        os.mkdir(f"{folder}/images")
        path = Path(folder) / name
        chosen(path.parent, side)
        try:
            found = find_image(path)
        except ValueError as error:  # of Path itself: a name that has none
            assert "empty name" in str(error)
        else:
            assert found is None or found.is_file()


@SHORT
@given(st.text(st.characters(), max_size=50))
def test_any_message_is_a_line(text):
    line = str(UserError(text))
    line.encode()
    assert len(line.splitlines()) <= 1 and line.isprintable()


# ---- Worlds ----

REAL = st.floats(-1, 1)
VECTORS = st.tuples(REAL, REAL, REAL).map(np.array)


@settings(SHORT, max_examples=15)
@given(VECTORS, VECTORS, st.floats(-3, 6))
def test_starts_go_with_the_world(dataset, turn, shift, magnitude):
    """A capture that is turned, moved and scaled has its first surfels where they were, but for the hull's grid, whose axes
    are the world's."""
    scale = 10**magnitude
    world = Similarity(scale, Rotation.from_rotvec(3 * turn).as_matrix(), 1e5 * scale * shift)
    views = [replace(v, camera=replace(v.camera, to_world=world.pose(v.camera.to_world))) for v in dataset.train]
    there = recentred(Dataset(views, []))
    expected, normals, spacing, look = initial_points(dataset, 2000, compare=False)
    found = initial_points(there, 2000, compare=False)
    assert np.median(found.spacing) == pytest.approx(scale * np.median(spacing), rel=0.1)
    back = (found.positions + there.origin - world.translation) @ world.rotation / scale
    away, nearest = KDTree(back).query(expected)
    assert np.quantile(away, 0.98) < 4 * np.median(spacing)
    facing = (normals * (found.normals @ world.rotation)[nearest]).sum(1)
    assert np.median(facing) > 0.97 and np.median(np.abs(look.color - found.appearance.color[nearest])) < 0.02

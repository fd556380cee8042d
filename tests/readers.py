"""Slow and plain readers of what is exported, which share no code with what writes it."""

import json
import struct

import numpy as np
import pytest
from scipy.special import sph_harm_y


def harmonics(direction):
    """The sixteen real harmonics of a unit direction by the textbook, from complex ones with the Condon–Shortley phase."""
    x, y, z = direction
    theta, phi = np.arccos(z), np.arctan2(y, x)
    values = []
    for degree in range(4):
        for m in range(-degree, degree + 1):
            Y = sph_harm_y(degree, abs(m), theta, phi)
            values.append(Y.real if m == 0 else np.sqrt(2) * (Y.real if m > 0 else Y.imag))
    return np.array(values)


def ply_splats(path):
    """(splats, header) of a PLY, read by a few lines of this test's own."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode().splitlines()
    names = [line.split()[2] for line in lines if line.startswith("property float")]
    values = np.frombuffer(body, "<f4").reshape(-1, len(names))
    of = lambda *wanted: values[:, [names.index(name) for name in wanted]]
    rest = of(*(f"f_rest_{k}" for k in range(45))).reshape(-1, 3, 15)  # colour after colour
    sh = np.concatenate([of("f_dc_0", "f_dc_1", "f_dc_2")[:, None], rest.transpose(0, 2, 1)], 1)
    rotations = of("rot_1", "rot_2", "rot_3", "rot_0")
    opacities = 1 / (1 + np.exp(-of("opacity")[:, 0]))
    return (of("x", "y", "z"), rotations, np.exp(of("scale_0", "scale_1", "scale_2")), opacities, sh), names, lines


def glb_splats(path):
    """(splats, JSON) of a GLB, likewise."""
    data = path.read_bytes()
    magic, version, length, size, kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    document = json.loads(data[20 : 20 + size])
    binary = data[28 + size :]

    def of(name):
        accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"][name]]
        view = document["bufferViews"][accessor["bufferView"]]
        columns = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        values = np.frombuffer(binary, "<f4", accessor["count"] * columns, view["byteOffset"])
        return values if columns == 1 else values.reshape(-1, columns)

    own = lambda name: of("KHR_gaussian_splatting:" + name)
    sh = np.stack([own(f"SH_DEGREE_{degree}_COEF_{k}") for degree in range(4) for k in range(2 * degree + 1)], 1)
    return (of("POSITION"), own("ROTATION"), own("SCALE"), own("OPACITY"), sh), document, of("COLOR_0")


def decoded(path):
    """Frames of a video: ([frames, H, W, 3] uint8, what the file says of itself)."""
    encoder = pytest.importorskip("imageio_ffmpeg")
    reader = encoder.read_frames(str(path))
    meta = next(reader)
    width, height = meta["size"]
    return np.array([np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]), meta

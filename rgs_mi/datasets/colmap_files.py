"""COLMAP's ``cameras`` and ``images`` files, binary and text (https://colmap.github.io/format.html).

    cameras.txt   CAMERA_ID MODEL WIDTH HEIGHT PARAMS...
    images.txt    IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of keypoints, which may be empty
    cameras.bin   uint64 count; each int32 id, int32 model, uint64 width, height, double params...
    images.bin    uint64 count; each uint32 id, double q[4], t[3], uint32 camera, name and \\0, uint64 n, n times 24 bytes

A pose is world to camera (x right, y down, z forward); the quaternion is (w, x, y, z). Little endian.
"""

import io
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ..core.errors import UserError
from ..core.inputs import opened, read_file
from .distortion import Distortion

# in the order of their numbers; how many parameters each has, None where the lens is not a perspective one with Brown's
# distortion
CAMERA_MODELS = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": None,
    "FULL_OPENCV": 12,
    "FOV": None,
    "SIMPLE_RADIAL_FISHEYE": None,
    "RADIAL_FISHEYE": None,
    "THIN_PRISM_FISHEYE": None,
    "RAD_TAN_THIN_PRISM_FISHEYE": None,
}
_KEYPOINT = 24  # bytes
_MOST_EXTREME = 1e8  # of a camera's numbers; what lies beyond is damage


@dataclass(frozen=True)
class Lens:
    """One camera of the model: ``focal`` (fx, fy), ``principal`` (cx, cy) and ``size`` (width, height) in pixels, and its
    ``distortion``."""

    focal: tuple[float, float]
    principal: tuple[float, float]
    size: tuple[int, int]
    distortion: Distortion


@dataclass(frozen=True)
class Image:
    """One registered image, its ``name`` and ``lens``; ``to_camera`` [4, 4] takes world to camera space (x right, y down, z
    forward)."""

    name: str
    lens: Lens
    to_camera: np.ndarray


def read_model(folder: Path, suffix: str) -> list[Image]:
    """Return the registered images of the model in ``folder``, whose files end in ``suffix`` (".bin" or ".txt").

    Raises: UserError for missing and damaged files, and for lenses that are no perspective ones.
    """
    readers = {".bin": (_cameras_binary, _images_binary), ".txt": (_cameras_text, _images_text)}[suffix]
    lenses, images = map(_read, (folder / f"cameras{suffix}", folder / f"images{suffix}"), readers)
    for name, camera, _ in images:
        if camera not in lenses:
            raise UserError(
                f"{folder / f'images{suffix}'}: image {name!r} has camera {camera}, which cameras{suffix} "
                "lacks: export the model again"
            )
    return [Image(name, lenses[camera], pose) for name, camera, pose in images]


def _read(path: Path, reader):
    try:
        records = reader(path)
        if not records:
            raise ValueError("it holds no records")
        return records
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror}): check the path") from error
    except _UnknownModel as error:
        raise UserError(f"{path}: {error}: run 'colmap image_undistorter', and give the folder that it writes") from error
    except (ValueError, OverflowError, struct.error) as error:
        reason = " ".join(str(error).split())[:200]
        raise UserError(f"{path} cannot be used as a file of COLMAP ({reason}): export the model again") from error


class _UnknownModel(Exception):
    pass


# ---- Records; a ValueError's message is the reason alone ----


def _lens(model: str, size, parameters) -> Lens:
    """The camera with a COLMAP model's parameters: focal length(s), principal point, distortion."""
    if CAMERA_MODELS.get(model) is None:
        known = ", ".join(name for name, count in CAMERA_MODELS.items() if count)
        raise _UnknownModel(f"its camera model {model} is none of {known}")
    if len(parameters) != CAMERA_MODELS[model]:
        raise ValueError(f"a camera has {len(parameters)} parameters, and {model} takes {CAMERA_MODELS[model]}")
    if not (np.abs(np.array([*size, *parameters], np.float64)) <= _MOST_EXTREME).all():  # False for NaN
        raise ValueError("a camera's size or parameter is not finite or absurdly large")
    split = 1 if model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL") else 2
    focal, (cx, cy, *k) = parameters[:split], parameters[split:]
    if model in ("OPENCV", "FULL_OPENCV"):
        distortion = Distortion((*k[:2], *k[4:5]), tuple(k[5:]), tuple(k[2:4]))
    else:
        distortion = Distortion(tuple(k))
    return Lens((focal[0], focal[-1]), (cx, cy), size, distortion)


def _pose(q, t) -> np.ndarray:
    """[4, 4] world to camera."""
    length = np.linalg.norm(q)
    if not 1e-3 < length < 1e3 or not np.isfinite(t).all():  # False for NaN
        raise ValueError(
            f"an image's pose is no rotation and translation: q = {' '.join(f'{x:g}' for x in q)}, "
            f"t = {' '.join(f'{x:g}' for x in t)}"
        )
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat([*q[1:], q[0]]).as_matrix()
    pose[:3, 3] = t
    return pose


def _once(records, what: str) -> dict:
    """(key, value) pairs as a dictionary."""
    found = {}
    for key, value in records:
        if key in found:
            raise ValueError(f"{what} {key!r} stands there twice")
        found[key] = value
    return found


# ---- Text ----


def _lines(path):
    with opened(path) as stream, io.TextIOWrapper(stream, "utf-8") as text:
        return [line.strip() for line in text]


def _cameras_text(path):
    def record(line):
        try:
            number, model, width, height, *parameters = line.split()
            return int(number), _lens(model, (int(width), int(height)), [float(p) for p in parameters])
        except ValueError as error:
            raise ValueError(f"in the line {line[:60]!r}: {error}") from error

    return _once((record(line) for line in _lines(path) if line and not line.startswith("#")), "camera")


def _images_text(path):
    images, lines = [], iter(_lines(path))
    for line in lines:
        if not line or line.startswith("#"):
            continue
        try:
            _, *pose, camera, name = line.split(maxsplit=9)
            pose = [float(p) for p in pose]
            images.append((name, int(camera), _pose(pose[:4], pose[4:])))
        except ValueError as error:
            raise ValueError(f"in the line {line[:60]!r}: {error}") from error
        next(lines, None)  # the keypoints
    return images


# ---- Binary ----


def _binary(path, record):
    """The records of a file, each read by ``record(content, at)``, which returns it and where it ends."""
    content = read_file(path)
    (count,), at, records = struct.unpack_from("<Q", content), 8, []
    for index in range(count):
        try:
            found, at = record(content, at)
        except struct.error as error:
            raise ValueError(f"it ends within record {index} of {count}") from error
        records.append(found)
    if at != len(content):
        raise ValueError(f"its {count} records take {at} bytes, the file has {len(content)}")
    return records


def _cameras_binary(path):
    names = list(CAMERA_MODELS)

    def record(content, at):
        number, model, width, height = struct.unpack_from("<iiQQ", content, at)
        name = names[model] if 0 <= model < len(names) else f"number {model}"
        count = CAMERA_MODELS.get(name) or 0
        parameters = struct.unpack_from(f"<{count}d", content, at + 24)
        return (number, _lens(name, (width, height), parameters)), at + 24 + 8 * count

    return _once(_binary(path, record), "camera")


def _images_binary(path):
    def record(content, at):
        _, *pose, camera = struct.unpack_from("<I7dI", content, at)
        start = at + 64
        end = content.find(b"\0", start)
        if end < 0:
            raise ValueError("an image's name has no end")
        (keypoints,) = struct.unpack_from("<Q", content, end + 1)
        return (content[start:end].decode("utf-8"), camera, _pose(pose[:4], pose[4:])), end + 9 + _KEYPOINT * keypoints

    return _binary(path, record)

"""JSON files of frames, as NeRF, instant-ngp and nerfstudio write them.

A frame's ``transform_matrix`` is camera to world in the OpenGL convention (x right, y up, looking along -z). Intrinsics
are ``camera_angle_x`` (horizontal field of view, radians) or ``fl_x``, ``fl_y``, ``cx``, ``cy`` in pixels of a ``w`` x
``h`` image, and the distortion ``k1`` … ``k4``, ``p1``, ``p2`` of a perspective lens (`distortion.py`; k4 goes with r⁸, as
nerfstudio has it). Each may stand in the file or in a frame.
"""

import json
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import UserError
from ..core.inputs import JSON, read_file
from .distortion import Distortion
from .frames import FOCAL_LIMITS, SIZE_LIMITS, Frame, pinhole, rigid
from .images import EXTENSIONS

PERSPECTIVE = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")
_GL_TO_CV = np.diag([1.0, -1.0, -1.0, 1.0])
_POINT_LIMITS = (-SIZE_LIMITS[1], SIZE_LIMITS[1])
_COEFFICIENT_LIMITS = (-1e4, 1e4)


def read_json(file: Path) -> dict:
    """Parse the file, of which only the shape of the outermost level is checked: an object with a list of frames, each an
    object. Raises: UserError for anything else."""
    try:
        meta = json.loads(read_file(file, JSON).decode("utf-8-sig"))
    except OSError as error:
        raise UserError(f"{file} cannot be read ({error.strerror}): the layout needs it") from error
    except json.JSONDecodeError as error:
        raise UserError(
            f"{file}: malformed JSON at line {error.lineno}, column {error.colno} ({error.msg}): fix it or export again"
        ) from error
    except (ValueError, RecursionError) as error:  # not UTF-8, an integer of thousands of digits, absurd nesting
        reason = str(error).splitlines()[0]
        raise UserError(f"{file}: not a JSON text file ({reason}): export it again") from error
    if not isinstance(meta, dict):
        raise UserError(f'{file}: the outermost value must be an object with "frames"')
    if not isinstance(meta.get("frames"), list):
        raise UserError(f'{file}: "frames" is missing or not a list')
    if not meta["frames"]:
        raise UserError(f'{file}: "frames" is empty: at least one frame is needed')
    for index, frame in enumerate(meta["frames"]):
        if not isinstance(frame, dict):
            raise UserError(f'{file}: frame {index} is not an object: write {{"file_path": ..., "transform_matrix": ...}}')
    return meta


def frame_of(file: Path, meta: dict, index: int, smaller: Callable[[Path], Path] | None = None) -> Frame:
    """Return frame ``index`` of the parsed ``file``; ``smaller`` maps an image's path to that of a smaller copy.

    Raises: UserError for bad entries; those of the focal length and the like follow with `Frame.camera`.
    """
    frame, where = meta["frames"][index], f"{file}: frame {index}"
    name = frame.get("file_path")
    if not isinstance(name, str) or not name.strip("./"):
        raise UserError(f'{where}: "file_path" is missing or not a file name')
    path = find_image(smaller(file.parent / name) if smaller else file.parent / name)
    missing = path is None
    return Frame(
        where,
        image_stem(Path(name)).name,
        Path(name) if missing else path,
        None if missing else partial(_camera, meta, frame, where, _pose(frame, where)),
        _distortion(meta, frame, where),
        missing=missing,
    )


def image_stem(path: Path) -> Path:
    """Return ``path`` without an image's extension; other dots belong to the name."""
    return path.with_suffix("") if path.suffix.lower() in EXTENSIONS else path


def find_image(path: Path) -> Path | None:
    """Return the image file ``path``, which may lack its extension; None where there is none."""
    named = path.suffix.lower() in EXTENSIONS
    choices = [path] if named else [path.with_name(path.name + extension) for extension in EXTENSIONS]
    # os.path.isfile, unlike Path's, answers False to names that no file system takes.
    return next((choice for choice in choices if os.path.isfile(choice)), None)


def number(
    meta: dict, frame: dict, key: str, default: float | None, limits: tuple[float, float], unit: str, where: str
) -> Any:
    """Return the number ``key`` of the frame, else of the file, else ``default``. Raises: UserError outside of ``limits``."""
    value = frame.get(key, meta.get(key))
    if value is None:
        return default
    try:
        found = _float(value)
    except TypeError:
        found = float("nan")
    if not limits[0] < found < limits[1]:
        raise UserError(
            f'{where}: "{key}" is {str(value)[:40]!r}: give a number of {unit} between {limits[0]:g} and {limits[1]:g}'
        )
    return found


def matrix(value: Any, where: str, remedy: str) -> np.ndarray:
    """Return rows of numbers as an array. Raises: UserError for anything else."""
    try:
        return np.array([[_float(x) for x in row] for row in value], np.float64)
    except (TypeError, ValueError) as error:
        raise UserError(f"{where}: a row is not a list of numbers: {remedy}") from error


def _float(value) -> float:
    """``value`` as a float, infinity when it is too large for one; TypeError when it isn't a number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError
    try:
        return float(value)
    except OverflowError:
        return float("inf")


def _pose(frame: dict, where: str) -> np.ndarray:
    """[4, 4] rigid camera-to-world matrix in `Camera`'s convention."""
    remedy = '"transform_matrix" must be a rigid 4x4 camera-to-world matrix'
    if "transform_matrix" not in frame:
        raise UserError(f'{where}: "transform_matrix" is missing')
    pose = matrix(frame["transform_matrix"], where, remedy)
    if pose.shape != (4, 4):
        raise UserError(f"{where}: the matrix has shape {pose.shape}: {remedy}")
    return rigid(pose, where, remedy) @ _GL_TO_CV


def _distortion(meta: dict, frame: dict, where: str) -> Distortion:
    model = frame.get("camera_model", meta.get("camera_model", "PINHOLE"))
    if model not in PERSPECTIVE or frame.get("is_fisheye", meta.get("is_fisheye", False)):
        raise UserError(
            f'{where}: its "camera_model" {str(model)[:40]!r} is no perspective lens with Brown\'s distortion '
            f"({', '.join(PERSPECTIVE)}): undistort the photographs first"
        )
    get = lambda key: number(meta, frame, key, 0.0, _COEFFICIENT_LIMITS, "distortion", where)
    return Distortion(tuple(map(get, ("k1", "k2", "k3", "k4"))), tangential=(get("p1"), get("p2")))


def _camera(meta: dict, frame: dict, where: str, to_world: np.ndarray, photograph: tuple[int, int]):
    """The pinhole of a frame whose image is ``photograph`` (width, height), which may be a resize of ``w`` x ``h``."""
    get = lambda key, default, limits, unit="pixels": number(meta, frame, key, default, limits, unit, where)
    size = get("w", photograph[0], SIZE_LIMITS), get("h", photograph[1], SIZE_LIMITS)
    fx = get("fl_x", None, FOCAL_LIMITS)
    if fx is None:
        fov = get("camera_angle_x", None, (1e-4, 3.1), "radians")
        if fov is None:
            raise UserError(f'{where}: neither "camera_angle_x" nor "fl_x" is given: add one of them to the file')
        fx = 0.5 * size[0] / np.tan(0.5 * fov)
    fy = get("fl_y", fx, FOCAL_LIMITS)
    principal = (get("cx", size[0] / 2, _POINT_LIMITS), get("cy", size[1] / 2, _POINT_LIMITS))
    return pinhole(to_world, (fx, fy), principal, size, photograph, where)

"""The layout of NeRF Synthetic and Shiny Blender: ``transforms_{train,test}.json`` beside folders of images.

A frame's ``transform_matrix`` is camera to world in the OpenGL convention (x right, y up, looking along -z). Intrinsics
come from ``camera_angle_x`` (horizontal field of view, radians) or ``fl_x``, ``fl_y``, ``cx``, ``cy`` in pixels of a
``w`` x ``h`` image; each may stand in the file or in a frame. ``transforms_val.json`` is not read. A sparse point cloud
(`points.FILES`) may stand beside them, in the same world frame.
"""

import json
import os
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from ..camera import Camera
from ..color import srgb_decode
from ..errors import UserError
from . import Dataset, View
from .points import sparse_points

TRAIN, TEST = "transforms_train.json", "transforms_test.json"
EXTENSIONS = (".png", ".exr", ".jpg", ".jpeg")  # in order of preference where file_path names none
MAX_PIXELS = 1 << 26  # 8192 x 8192; a header that promises more is damaged or hostile
_GL_TO_CV = np.diag([1.0, -1.0, -1.0, 1.0])


def load(root: Path) -> Dataset:
    """Load a capture; without ``transforms_test.json`` nothing is held out.

    Frames without an image file and views with an empty mask are left out, each kind with one warning per split.
    Raises: UserError for anything in the folder that cannot be used, naming the file and the frame.
    """
    root = Path(root)
    if not root.is_dir():
        raise UserError(f"data folder '{root}' does not exist: give a capture's folder with --data")
    points, colors = sparse_points(root) or (None, None)
    test = _load_split(root / TEST, normals=True) if (root / TEST).is_file() else []
    return Dataset(train=_load_split(root / TRAIN, normals=False), test=test, points=points, point_colors=colors, root=root)


# ---- The JSON file ----

def _load_split(file: Path, normals: bool) -> list[View]:
    """All usable views of one transforms file."""
    meta = _read_json(file)
    jobs, missing, names = [], [], {}
    for index, frame in enumerate(meta["frames"]):
        where = f"{file}: frame {index}"
        if not isinstance(frame, dict):
            raise UserError(f"{where} is not an object: write {{\"file_path\": ..., \"transform_matrix\": ...}}")
        stem, path = _image_path(file.parent, frame, where)
        if path is None:
            missing.append(stem)
            continue
        if (first := names.setdefault(Path(stem).name, index)) != index:
            raise UserError(f"{where} has the same file name as frame {first} ({path.name}): names must be unique")
        jobs.append((where, frame, stem, path, _pose(frame, where)))
    if not jobs:
        raise UserError(f"{file}: none of its {len(missing)} frames has an image file (first: {missing[0]}): "
                        f"check file_path and that the images were unpacked")
    if missing:
        warnings.warn(f"{file}: {len(missing)} of {len(missing) + len(jobs)} frames have no image file and are skipped "
                      f"(first: {missing[0]})", stacklevel=3)
    with ThreadPoolExecutor() as pool:
        views = list(pool.map(lambda job: _load_view(meta, *job, normals), jobs))
    kept = [view for view in views if view.pixels[..., 3].any()]
    if not kept:
        raise UserError(f"{file}: the alpha channel of every image is zero: export with a mask, or as RGB")
    if len(kept) < len(views):
        first = next(view.path for view in views if not view.pixels[..., 3].any())
        warnings.warn(f"{file}: {len(views) - len(kept)} views with an empty mask are left out (first: {first})",
                      stacklevel=3)
    return kept


def _read_json(file: Path) -> dict:
    """The parsed file, of which only the shape of the outermost level is checked."""
    try:
        meta = json.loads(file.read_bytes().decode("utf-8-sig"))
    except OSError as error:
        raise UserError(f"{file} cannot be read ({error.strerror}): the Blender layout needs it") from error
    except json.JSONDecodeError as error:
        raise UserError(f"{file}: malformed JSON at line {error.lineno}, column {error.colno} ({error.msg}): "
                        f"fix it or export again") from error
    except (ValueError, RecursionError) as error:  # not UTF-8, an integer of thousands of digits, absurd nesting
        reason = str(error).splitlines()[0]
        raise UserError(f"{file}: not a JSON text file ({reason}): export it again") from error
    if not isinstance(meta, dict):
        raise UserError(f"{file}: the outermost value must be an object with \"frames\"")
    if not isinstance(meta.get("frames"), list):
        raise UserError(f"{file}: \"frames\" is missing or not a list")
    if not meta["frames"]:
        raise UserError(f"{file}: \"frames\" is empty: at least one frame is needed")
    return meta


def _image_path(root: Path, frame: dict, where: str) -> tuple[str, Path | None]:
    """The frame's file_path without its extension, and the image file, None where there is none."""
    name = frame.get("file_path")
    if not isinstance(name, str) or not name.strip("./"):
        raise UserError(f"{where}: \"file_path\" is missing or not a file name")
    stem, extension = os.path.splitext(name)
    choices = (extension,) if extension.lower() in EXTENSIONS else EXTENSIONS
    stem = stem if extension.lower() in EXTENSIONS else name
    # os.path.isfile, unlike Path's, answers False to names that no file system takes.
    return stem, next((root / (stem + e) for e in choices if os.path.isfile(root / (stem + e))), None)


def _pose(frame: dict, where: str) -> np.ndarray:
    """[4, 4] rigid camera-to-world matrix in `Camera`'s convention."""
    remedy = "\"transform_matrix\" must be a rigid 4x4 camera-to-world matrix"
    try:
        matrix = np.array([[_number(x) for x in row] for row in frame["transform_matrix"]], np.float64)
    except KeyError as error:
        raise UserError(f"{where}: \"transform_matrix\" is missing") from error
    except (TypeError, ValueError) as error:
        raise UserError(f"{where}: a row is not a list of numbers: {remedy}") from error
    if matrix.shape != (4, 4):
        raise UserError(f"{where}: the matrix has shape {matrix.shape}: {remedy}")
    if not np.isfinite(matrix).all():
        raise UserError(f"{where}: the matrix holds NaN or infinity: {remedy}")
    rotation = matrix[:3, :3]
    if (np.abs(rotation).max() > 2 or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3
            or np.linalg.det(rotation) < 0 or np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6
            or np.abs(matrix[:3, 3]).max() > 1e6):
        raise UserError(f"{where}: the matrix scales, shears, mirrors or lies absurdly far away: {remedy}")
    u, _, v = np.linalg.svd(rotation)  # the nearest rotation: files hold rounded numbers
    matrix[:3, :3] = u @ v
    return matrix @ _GL_TO_CV


def _number(value) -> float:
    """``value`` as a float, infinity when it is too large for one; TypeError when it isn't a number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError
    try:
        return float(value)
    except OverflowError:
        return float("inf")


def _camera(meta: dict, frame: dict, to_world: np.ndarray, size: tuple[int, int], where: str) -> Camera:
    """The pinhole of a frame whose image is ``size`` (width, height), which may be a resize of ``w`` x ``h``."""
    def get(key, default, lower, upper, unit):
        value = frame.get(key, meta.get(key))
        if value is None:
            return default
        try:
            number = _number(value)
        except TypeError:
            number = float("nan")
        if not lower < number < upper:
            raise UserError(f"{where}: \"{key}\" is {str(value)[:40]!r}: give a number of {unit} "
                            f"between {lower:g} and {upper:g}")
        return number

    width, height = get("w", size[0], 0, 1e6, "pixels"), get("h", size[1], 0, 1e6, "pixels")
    fx = get("fl_x", None, 0, 1e8, "pixels")
    if fx is None:
        fov = get("camera_angle_x", None, 1e-4, 3.1, "radians")
        if fov is None:
            raise UserError(f"{where}: neither \"camera_angle_x\" nor \"fl_x\" is given: add one of them to the file")
        fx = 0.5 * width / np.tan(0.5 * fov)
    fy = get("fl_y", fx, 0, 1e8, "pixels")
    principal = (get("cx", width / 2, -1e6, 1e6, "pixels"), get("cy", height / 2, -1e6, 1e6, "pixels"))
    return Camera(to_world, (float(fx), float(fy)), principal, (width, height)).resized(*size)


# ---- Images ----

def _load_view(meta, where, frame, stem, path, to_world, normals) -> View:
    """Read one frame's image, and its normals where ``normals`` asks for them."""
    pixels, masked = read_image(path, where)
    height, width = pixels.shape[:2]
    camera = _camera(meta, frame, to_world, (width, height), where)
    normal = _read_normal(path.parent / Path(stem).name, pixels, where) if normals else None
    return View(Path(stem).name, camera, pixels, masked, normal, path)


def read_image(path: Path, where: str) -> tuple[np.ndarray, bool]:
    """A photograph as `View.pixels`, and whether it has a mask (an alpha channel that is not opaque everywhere).

    16-bit PNGs keep their high bytes. EXR files are linear with premultiplied alpha, as the format has it; ``where``
    begins the message. Raises: UserError when the file is damaged, empty, too large, or holds NaN or infinity.
    """
    try:
        pixels, alpha = _read_exr(path) if path.suffix.lower() == ".exr" else _read_ldr(path)
    except Exception as error:  # decoders raise anything from OSError to SyntaxError on damaged files
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise UserError(f"{where}: {path} cannot be read as an image ({reason}): replace the file") from error
    if not alpha:
        pixels[..., 3] = 255 if pixels.dtype == np.uint8 else 1
    opaque = pixels[..., 3].min() >= (255 if pixels.dtype == np.uint8 else 1)
    return pixels, alpha and not bool(opaque)


def _read_ldr(path: Path) -> tuple[np.ndarray, bool]:
    """[H, W, 4] uint8 of a PNG or JPEG, and whether it has alpha."""
    from PIL import Image, UnidentifiedImageError

    try:
        image = Image.open(path, formats=("PNG", "JPEG"))
    except UnidentifiedImageError as error:
        raise ValueError("not a PNG or JPEG file") from error
    with image:
        _check_size(*image.size)
        if image.mode.startswith("I"):  # 16-bit grey
            image = Image.fromarray((np.asarray(image) >> 8).astype(np.uint8))
        alpha = "A" in image.mode or "transparency" in image.info
        return np.array(image.convert("RGBA")), alpha


def _read_exr(path: Path) -> tuple[np.ndarray, bool]:
    """[H, W, 4] float32 of an OpenEXR file with straight alpha, and whether it has alpha."""
    import OpenEXR

    with OpenEXR.File(str(path), header_only=True) as file:
        lower, upper = file.header()["dataWindow"]
        _check_size(int(upper[0]) - int(lower[0]) + 1, int(upper[1]) - int(lower[1]) + 1)
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
    if "Y" in channels:
        channels = {**dict.fromkeys("RGB", channels["Y"]), **channels}
    if not {"R", "G", "B"} <= channels.keys():
        raise ValueError(f"channels {', '.join(sorted(channels))}, but R, G and B are needed")
    alpha = channels.get("A")
    pixels = np.stack([channels[c] for c in "RGB"] + [np.ones_like(channels["R"]) if alpha is None else alpha], -1)
    pixels = np.maximum(pixels.astype(np.float32), 0)
    if not np.isfinite(pixels).all():
        raise ValueError("NaN or infinite pixels")
    a = pixels[..., 3:] = np.minimum(pixels[..., 3:], 1)
    pixels[..., :3] = np.where(a > 1e-4, pixels[..., :3] / np.maximum(a, 1e-4), 0)
    return pixels, alpha is not None


def _check_size(width: int, height: int):
    if width < 1 or height < 1:
        raise ValueError("its size is zero")
    if width * height > MAX_PIXELS:
        raise ValueError(f"{width} x {height} pixels are too many")


def _read_normal(stem: Path, pixels: np.ndarray, where: str) -> np.ndarray | None:
    """[H, W, 3] world-space unit normals that belong to the photograph ``stem``; 0 where unknown. None without a file.

    ``_normal.png`` (Shiny Blender) holds n/2 + 1/2 and is known where neither its own alpha is zero nor it is black,
    which no unit normal is. ``_normal_0001.png`` (NeRF Synthetic) holds n itself, cut to [0, 1]
    and put through the sRGB curve (measured on lego: planes of its visual hull agree to 1 degree): it is known only
    where no negative component was lost, that is where its length is still one.
    """
    shiny, clamped = (stem.parent / (stem.name + end) for end in ("_normal.png", "_normal_0001.png"))
    path = shiny if shiny.is_file() else clamped
    if not path.is_file():
        return None
    image = read_image(path, where)[0]
    if image.shape != pixels.shape:
        raise UserError(f"{where}: {path} is {image.shape[1]} x {image.shape[0]}, its photograph "
                        f"{pixels.shape[1]} x {pixels.shape[0]}: normals need the same size")
    black = ~image[..., :3].any(-1, keepdims=True)
    normal = image[..., :3].astype(np.float32) / np.float32(255)
    normal = 2 * normal - 1 if path == shiny else srgb_decode(normal)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    known = (length > 0.1) & ~black & (image[..., 3:] > 0) if path == shiny else (np.abs(length - 1) < 0.02)
    return np.where(known & (pixels[..., 3:] > 0), normal / np.maximum(length, 0.1), 0).astype(np.float32)

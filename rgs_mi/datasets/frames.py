"""From the frames that a layout names to views: what all layouts share."""

import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import BoundedSemaphore

import numpy as np

from ..core.camera import Camera
from ..core.errors import UserError
from .distortion import Distortion, cropped_to_valid, undistorted
from .images import check_proportions, image_size, limited, read_image, read_normal, with_mask
from .points import FARTHEST
from .types import View

HOLD_OUT = 8  # as LLFF, Mip-NeRF 360 and 3DGS have it
FOCAL_LIMITS = (1e-3, 1e8)  # pixels
SIZE_LIMITS = (0, 1e6)  # pixels; the principal point lies between -1e6 and 1e6
_AT_ONCE = BoundedSemaphore(3)  # photographs that are held at their full size, however many threads there are


@dataclass(frozen=True)
class Frame:
    """One photograph as a layout names it.

    Attributes
      where:      begins error messages: the file that names it, and its place there
      name:       `View.name`
      path:       the image file, or what was looked for where it is ``missing``
      camera:     callback that returns the image's `Camera` from its (width, height), or raises a UserError; None where the
                  image is ``missing``
      distortion: of the lens, which is taken out of the photograph (`distortion.undistorted`)
      mask:       gives the coverage [h, w] of a photograph without alpha of its own, in [0, 1] and of any size; or None
      normal:     the file of its normals (`images.read_normal`), or None
    """

    where: str
    name: str
    path: Path
    camera: Callable[[tuple[int, int]], Camera] | None
    distortion: Distortion = Distortion()
    mask: Callable[[], np.ndarray] | None = None
    normal: Path | None = None
    missing: bool = False


def load_views(source: Path, frames: list[Frame], longest: int) -> list[View]:
    """Load the usable views of ``frames``, which ``source`` names, scaled where they have more than ``longest`` pixels along a
    side. Frames without an image file and views with an empty mask are left out, each kind with one warning.

    Raises: UserError for a bad image, mask or camera, for two frames of one name, and where no view is left.
    """
    missing, names = [frame for frame in frames if frame.missing], {}
    found = [frame for frame in frames if not frame.missing]
    if not found:
        raise UserError(
            f"{source}: none of its {len(frames)} frames has an image file (first: {str(missing[0].path)!r}): "
            f"check the names and that the images were unpacked"
        )
    for frame in found:
        if (first := names.setdefault(frame.name, frame)) is not frame:
            raise UserError(
                f"{frame.where} has the same file name as {first.where} ({frame.path.name}): names must be unique"
            )
    if missing:
        warnings.warn(
            f"{source}: {len(missing)} of {len(frames)} frames have no image file and are skipped "
            f"(first: {str(missing[0].path)!r})",
            stacklevel=4,
        )
    with ThreadPoolExecutor() as pool:
        views = list(pool.map(partial(_load_view, longest=longest), found))
    kept = [view for view in views if view.pixels[..., 3].any()]
    if not kept:
        raise UserError(f"{source}: the alpha channel of every image is zero: export with a mask, or as RGB")
    if len(kept) < len(views):
        first = next(view.path for view in views if not view.pixels[..., 3].any())
        warnings.warn(
            f"{source}: {len(views) - len(kept)} views with an empty mask are left out (first: {first})", stacklevel=4
        )
    return kept


def load_split(source: Path, frames: list[Frame], held_out: set[str], longest: int) -> dict[str, list[View]]:
    """Load views (`load_views`) as the lists ``train`` and ``test`` of `Dataset`; ``held_out`` are the names of test views.

    Raises: UserError where no view is left to train with.
    """
    views = load_views(source, frames, longest)
    train = [view for view in views if view.name not in held_out]
    if not train:
        raise UserError(f"{source}: all {len(views)} usable views are held out as test views: add photographs")
    return {"train": train, "test": [view for view in views if view.name in held_out]}


def every_eighth(names: list[str]) -> set[str]:
    """Return the names held out where a layout has no split of its own: 0, 8, 16 … of ``names`` in their order."""
    return set(names[::HOLD_OUT]) if len(names) > 1 else set()


def rigid(matrix: np.ndarray, where: str, remedy: str) -> np.ndarray:
    """Return ``matrix`` [4, 4], a pose whose numbers were rounded, with its rotation made exact.

    Raises: UserError where it is not finite, scales, shears, mirrors, or lies beyond `FARTHEST`.
    """
    if not np.isfinite(matrix).all():
        raise UserError(f"{where}: the matrix holds NaN or infinity: {remedy}")
    rotation = matrix[:3, :3]
    if (
        np.abs(rotation).max() > 2
        or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3
        or np.linalg.det(rotation) < 0
        or np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6
        or np.abs(matrix[:3, 3]).max() > FARTHEST
    ):
        raise UserError(f"{where}: the matrix scales, shears, mirrors or lies absurdly far away: {remedy}")
    u, _, v = np.linalg.svd(rotation)  # the nearest rotation
    matrix = matrix.copy()
    matrix[:3, :3] = u @ v
    return matrix


def pinhole(
    to_world: np.ndarray,
    focal: tuple[float, float],
    principal: tuple[float, float],
    size: tuple[int, int],
    photograph: tuple[int, int],
    where: str,
) -> Camera:
    """Return the camera of a ``photograph`` (width, height) that may be a resize of the ``size`` it was calibrated for;
    ``to_world``, ``focal`` and ``principal`` are those of `Camera`, and ``where`` begins error messages.

    Raises: UserError for numbers out of range and other proportions.
    """
    for what, numbers, (lower, upper) in (
        ("focal length", focal, FOCAL_LIMITS),
        ("image size", size, SIZE_LIMITS),
        ("principal point", principal, (-SIZE_LIMITS[1], SIZE_LIMITS[1])),
    ):
        if not all(lower < number < upper for number in numbers):  # False for NaN
            raise UserError(
                f"{where}: the {what} {' x '.join(f'{n:g}' for n in numbers)} is out of range: "
                f"give pixels between {lower:g} and {upper:g}"
            )
    check_proportions(size, photograph, f"{where}: its camera")
    floats = lambda pair: (float(pair[0]), float(pair[1]))
    return Camera(to_world, floats(focal), floats(principal), (size[0], size[1])).resized(*photograph)


def _load_view(frame: Frame, longest: int) -> View:
    assert frame.camera is not None, "its image is there"
    size = image_size(frame.path, frame.where)
    scaled = limited(size, longest)
    with _AT_ONCE:
        pixels, masked = read_image(frame.path, frame.where, scaled)
        if frame.mask and not masked:
            pixels, masked = with_mask(pixels, frame.mask(), frame.where)
        normal = read_normal(frame.normal, size, pixels, frame.where) if frame.normal and not frame.distortion else None
    camera = frame.camera(size).resized(*scaled)
    if frame.distortion:
        pixels = undistorted(pixels, camera, frame.distortion, frame.name)
        if not masked:
            pixels, camera = cropped_to_valid(pixels, camera)
    return View(frame.name, camera, pixels, masked, normal, frame.path, size if scaled != size else None)

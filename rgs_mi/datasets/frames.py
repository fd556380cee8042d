"""From the frames that a layout names to views: what all layouts share."""

import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Condition

import numpy as np

from ..core.camera import Camera
from ..core.errors import UserError
from ..core.memory import available, words
from .distortion import Distortion, cropped_to_valid, undistorted
from .exif import orientation
from .images import check_proportions, image_size, is_linear, limited, read_image, read_normal, with_mask
from .points import FARTHEST
from .types import View

HOLD_OUT = 8  # as LLFF, Mip-NeRF 360 and 3DGS have it
FOCAL_LIMITS = (1e-3, 1e8)  # pixels
SIZE_LIMITS = (0, 1e6)  # pixels; the principal point lies between -1e6 and 1e6
_DECODED = 1 << 30  # bytes that photographs may take at their full size while they are read, of several at the same time
_WORK = 12  # bytes a pixel that reading one takes at its full size: as the file has it, as RGBA, and between; of EXR 4 times that
_HELD = {False: 4, True: 16}  # bytes a pixel of what is kept: 8 bits, or float
_CACHE = 8  # bytes a pixel that a fit keeps beside it, in half precision
MOST_KEPT = 1 << 30  # bytes that it keeps so; images of more photographs are made anew for each step


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
    budget, sizes = _planned(source, found, longest)
    with ThreadPoolExecutor() as pool:
        views = list(pool.map(partial(_load_view, longest=longest, budget=budget), found, sizes))
    if turned := [view.path for view in views if orientation(view.path) != 1]:
        warnings.warn(
            f"{source}: EXIF of {len(turned)} photographs (first: {turned[0].name}) says that they lie on their side; they are "
            "taken as they are stored, as COLMAP and nerfstudio do",
            stacklevel=4,
        )
    kept = [view for view in views if view.pixels[..., 3].any()]
    if not kept:
        raise UserError(f"{source}: the alpha channel of every image is zero: export with a mask, or as RGB")
    if len(kept) < len(views):
        first = next(view.path for view in views if not view.pixels[..., 3].any())
        warnings.warn(
            f"{source}: {len(views) - len(kept)} views with an empty mask are left out (first: {first})", stacklevel=4
        )
    return kept


def load_split(source: Path, frames: list[Frame], held_out: set[str], longest: int) -> tuple[list[View], list[View]]:
    """Load views (`load_views`) as the lists ``train`` and ``test`` of `Dataset`; ``held_out`` are the names of test views.

    Raises: UserError where no view is left to train with.
    """
    views = load_views(source, frames, longest)
    train = [view for view in views if view.name not in held_out]
    if not train:
        raise UserError(f"{source}: all {len(views)} usable views are held out as test views: add photographs")
    return train, [view for view in views if view.name in held_out]


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


# ---- Memory ----


class _Budget:
    """So many bytes, of which threads take and give back; who wants more than all gets all."""

    def __init__(self, total: int) -> None:
        self._total = self._left = total
        self._changed = Condition()

    @contextmanager
    def taken(self, amount: int) -> Iterator[None]:
        amount = min(amount, self._total)
        with self._changed:
            self._changed.wait_for(lambda: self._left >= amount)
            self._left -= amount
        try:
            yield
        finally:
            with self._changed:
                self._left += amount
                self._changed.notify_all()


def _planned(source, frames, longest) -> tuple[_Budget, list[tuple[int, int]]]:
    """What reading ``frames`` may take at the same time, and the size of each, from their headers: nothing is decoded yet.

    Raises: UserError where this process can't have the memory for them; warns where a fit to them can't.
    """
    with ThreadPoolExecutor() as pool:
        sizes = list(pool.map(lambda frame: image_size(frame.path, frame.where), frames))
    linear = [is_linear(frame.path) for frame in frames]
    areas = [int(np.prod(limited(size, longest))) for size in sizes]
    kept = sum(_HELD[kind] * area for kind, area in zip(linear, areas))
    work = max(_work_of(size, kind) for size, kind in zip(sizes, linear))
    free = available()
    if free is None:
        return _Budget(_DECODED), sizes
    side = min(longest, max(map(max, sizes)))
    what = f"{source}: its {len(frames)} photographs take {words(kept)} of memory at {side} pixels"
    fitting = side * min(1.0, (max(0.8 * free - work, 0) / kept) ** 0.5)
    remedy = f"give a smaller resolution: --set resolution={max(int(fitting) // 100 * 100, 16)}"
    if kept + work > free:
        raise UserError(f"{what}, and {words(work)} while the largest is read, where {words(free)} are free: {remedy}")
    if (fitted := kept + min(_CACHE * sum(areas), MOST_KEPT)) > free:
        warnings.warn(f"{what}, a fit to them up to {words(fitted)}, and {words(free)} are free: {remedy}", stacklevel=5)
    return _Budget(min(_DECODED, max((free - kept) // 2, 1))), sizes


def _work_of(size, linear) -> int:
    return _WORK * (4 if linear else 1) * size[0] * size[1]


def _load_view(frame: Frame, size: tuple[int, int], longest: int, budget: _Budget) -> View:
    assert frame.camera is not None, "its image is there"
    scaled = limited(size, longest)
    with budget.taken(_work_of(size, is_linear(frame.path))):
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

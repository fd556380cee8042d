"""Depth maps from files: what any estimator wrote, one map per photograph, matched by name.

``.npz`` (a single array, or the one named ``depth``), ``.npy``, ``.exr`` and 16-bit grey ``.png`` (0 where unknown). NaN and
infinity are unknown in all of them.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..core.errors import UserError
from ..core.inputs import opened
from ..datasets.images import MAX_PIXELS, check_size, exr_channels, resize
from ..datasets.types import DepthPrior, View
from .maps import masked

_ASPECT = 0.05  # how far proportions may be off: estimators round sizes to multiples of 14 or 32


def load(views: Sequence[View], folder: str | Path, inverse: bool = False, suffix: str = "") -> list[DepthPrior]:
    """Read the maps in ``folder`` that belong to ``views``, in their order.

    Args:
      views: the map of a view is the file called its name and ``suffix``, whatever the extension
      inverse: whether the files hold inverse depths (disparities)

    Maps of another size are resized (`maps.resize`), since estimators have sizes of their own; other proportions are an
    error, since such a map shows another part of the scene. Pixels outside the photograph's mask are unknown.
    Raises: UserError for a missing folder or map, two maps of one view, and files that hold no depth map.
    """
    folder, found = Path(folder).expanduser(), {}
    if not folder.is_dir():
        raise UserError(f"depth folder '{folder}' does not exist: give the folder that holds a depth map a photograph")
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in _READERS:
            found.setdefault(path.stem, []).append(path)
    priors = []
    for view in views:
        stem = view.name + suffix
        paths = found.get(stem, [])
        if len(paths) != 1:
            problem = f"{' and '.join(p.name for p in paths)} are" if paths else f"no {stem}{{{','.join(_READERS)}}} is"
            remedy = "leave one of them" if paths else "export it, or leave the photograph out"
            raise UserError(f"{folder}: {problem} there as the depth map of {view.path or view.name}: {remedy}")
        values, (height, width) = _read(paths[0]), view.pixels.shape[:2]
        if abs(values.shape[0] * width / (values.shape[1] * height) - 1) > _ASPECT:
            raise UserError(
                f"{paths[0]} is {values.shape[1]} x {values.shape[0]}, its photograph {width} x {height}: "
                "a depth map must show the whole photograph and no more"
            )
        priors.append(DepthPrior(masked(resize(values, height, width), view), inverse))
    return priors


def _read(path: Path) -> np.ndarray:
    """[h, w] numbers of one file."""
    try:
        values = _READERS[path.suffix.lower()](path)
        if values.ndim > 2:
            values = values.squeeze()
        if values.ndim != 2 or not values.size:
            raise ValueError(f"its shape is {' x '.join(map(str, values.shape)) or 'a single number'}, not height x width")
        if values.dtype.kind not in "fiu":
            raise ValueError(f"it holds {values.dtype}, not numbers")
        return values
    except Exception as error:  # decoders raise anything from OSError to SyntaxError on damaged files
        reason = getattr(error, "strerror", None) or " ".join(str(error).split()) or type(error).__name__
        raise UserError(f"{path} cannot be read as a depth map ({reason}): export it again") from error


def _read_npz(path):
    with opened(path) as stream, np.load(stream, allow_pickle=False) as arrays:
        if "depth" not in arrays and len(arrays) != 1:
            raise ValueError(f"none of its arrays ({', '.join(arrays) or 'it has none'}) is called 'depth'")
        if max(info.file_size for info in arrays.zip.infolist()) > 16 * MAX_PIXELS:
            raise ValueError("its arrays are too large")
        return arrays["depth" if "depth" in arrays else arrays.files[0]]


def _read_npy(path):
    with opened(path) as stream:  # np.load would take any format
        return np.lib.format.read_array(stream, allow_pickle=False)


def _read_exr(path):
    """The channel called depth, Depth.Z (of any layer), Z or Y, upper or lower case; else the first that is not alpha."""

    def rank(name):
        name = name.lower()
        layer = name.endswith((".depth", ".depth.z"))
        return [name == "depth", name == "depth.z", layer, name == "z", name == "y", name != "a"].index(True)

    first = lambda names: [min(sorted(n for n in names if n.lower() != "a") or names, key=rank)]
    (values,) = exr_channels(path, first, np.nan).values()
    return values


def _read_png(path):
    from PIL import Image

    with opened(path) as stream, Image.open(stream, formats=("PNG",)) as image:
        check_size(*image.size)
        if not image.mode.startswith("I"):
            raise ValueError(f"its mode is {image.mode}, and 16-bit grey is needed: 8 bits are too few for depth")
        values = np.asarray(image).astype(np.float32)
    return np.where(values > 0, values, np.float32(np.nan))


_READERS = {".npz": _read_npz, ".npy": _read_npy, ".exr": _read_exr, ".png": _read_png}

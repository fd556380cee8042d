"""Pictures of several fits side by side: ground truth, then each fit, images and normals."""

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill

import numpy as np
from PIL import Image

from ..core.sheet import Sheet
from ..datasets.types import View
from ..evaluation.evaluate import ground_truth
from ..evaluation.metrics import normal_colors
from ..evaluation.pictures import crop
from .figures import text

_PANEL, _GAP, _MARGIN = 260, 8, 24  # pixels
_CHARACTERS = 22  # as wide as a panel


def write(path: str | Path, views: Sequence[View], columns: Sequence[tuple[str, dict, Path]], background: float) -> None:
    """Write a picture of a scene: for each of ``views`` a row of images and one of normals. Columns are the ground truth,
    then ``columns``, [(label, what metrics.json holds, the run's folder)]; ``background`` is the display-space grey level
    that was fitted with. Raises: UserError where the file can't be written."""
    labels = ["truth", *(f"{fill(label, _CHARACTERS)}\n{_caption(figures)}" for label, figures, _ in columns)]
    rows = [row for view in views for row in _rows(view, [folder / "test" for _, _, folder in columns], background)]
    Sheet(rows, _PANEL, _GAP, _MARGIN, labels).write(path)


def _caption(figures):
    return " · ".join(filter(None, (text(name, figures[name], unit=True) for name in ("psnr", "normal_mae_deg"))))


def _rows(view, folders, background):
    """Images and normals of a view: two lists of [H, W, 3] display values, cropped to the object, the ground truth's first
    (None: unknown)."""
    normals = [None]
    if view.normal is not None:
        known = np.linalg.norm(view.normal, axis=-1, keepdims=True) > 0.5
        normals = [normal_colors(view.normal * known, known[..., 0])]
    normals += [_normals(folder / f"{view.name}_gbuffer.exr") for folder in folders]
    images = [np.asarray(Image.open(folder / f"{view.name}.png"))[..., :3] / 255 for folder in folders]
    for row in ([ground_truth(view, background), *images], normals):
        cropped = crop({k: image for k, image in enumerate(row) if image is not None}, view)
        yield [cropped.get(k) for k in range(len(row))]


def _normals(path):
    """[H, W, 3] the normals of a G-buffer (premultiplied there) as colours over white."""
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
    return normal_colors(np.stack([channels[f"sh_normal.{axis}"] for axis in "XYZ"], -1), channels["alpha.Y"])

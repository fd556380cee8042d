"""What people look at: pictures of each test view, panels that take it apart, and one sheet that tells the whole fit."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from ..core.color import srgb_encode, to_8bit, tone_map
from ..core.files import write_exr, write_png
from ..core.sheet import Sheet
from ..datasets.types import View
from . import metrics
from .evaluate import Rendering, ground_truth

ERROR_GAIN = 4  # of the absolute error in comparisons
ERROR_RANGE, NORMAL_RANGE = 0.2, 20  # what the ramp of errors ends at: display values, degrees
#: Colours of errors, from none to the largest, evenly spaced; from light to dark.
RAMP = np.array([[255, 255, 255], [250, 214, 122], [235, 130, 56], [184, 51, 69], [84, 18, 74]]) / 255
_PANEL, _GAP, _MARGIN, _TEXT = 280, 12, 32, 24  # pixels of the contact sheet
_ON_SHEET = (
    "photograph",
    "rendering",
    "normals",
    "true normals",
    "roughness",
    "metallic",
    "base color",
    "diffuse",
    "specular",
)

K = TypeVar("K")


def write_view(folder: Path, view: View, rendering: Rendering, background: float, gbuffer: bool) -> None:
    """Write ``NAME.png`` (the rendering), ``NAME_compare.png`` (photograph, rendering, `ERROR_GAIN` times the error), and
    where asked ``NAME_gbuffer.exr`` (linear maps premultiplied by coverage; normals in world space). ``background`` is a
    display-space grey level.

    Raises: UserError where a file can't be written.
    """
    expected = ground_truth(view, background)
    error = np.abs(rendering.image - expected) * ERROR_GAIN
    write_png(folder / f"{view.name}.png", rendering.image)
    write_png(folder / f"{view.name}_compare.png", np.concatenate([expected, rendering.image, error], 1))
    if gbuffer:
        maps = rendering.maps | {"alpha": rendering.alpha}
        names = [
            f"{name}.{c}"
            for name, m in maps.items()
            for c in ("Y" if m.shape[-1] == 1 else "XYZ" if name == "sh_normal" else "RGB")
        ]
        write_exr(folder / f"{view.name}_gbuffer.exr", np.concatenate(list(maps.values()), -1), names)


# ---- Panels ----


def panels(view: View, rendering: Rendering, background: float) -> dict[str, np.ndarray]:
    """Take a view apart: return name -> [H, W, 3] uint8 over white, all cropped to the object.

    There are ``photograph``, ``rendering``; ``error`` (mean absolute difference of display values, from 0 to `ERROR_RANGE`);
    ``normals`` and, where the view has them, ``true normals`` (world space) and ``normal error`` (angle, from 0 to
    `NORMAL_RANGE`); ``depth`` (along the axis, near is light); ``roughness``, ``metallic``, ``base color``; ``diffuse`` and
    ``specular`` radiance, clipped.
    """
    alpha, maps, expected = rendering.alpha, rendering.maps, ground_truth(view, background)
    over_white = lambda premultiplied: premultiplied + (1 - alpha)
    mean = lambda name: maps[name] / np.maximum(alpha, 1e-6)
    light = lambda name: over_white(srgb_encode(np.clip(mean(name), 0, 1)) * alpha)
    images = {
        "photograph": expected,
        "rendering": rendering.image,
        "error": ramp(np.abs(rendering.image - expected).mean(-1) / ERROR_RANGE),
        "normals": metrics.normal_colors(maps["sh_normal"], alpha[..., 0]),
    }
    if view.normal is not None:
        known = np.linalg.norm(view.normal, axis=-1, keepdims=True) > 0.5
        images["true normals"] = metrics.normal_colors(view.normal * known, known[..., 0])
        angles = metrics.normal_angles_deg(maps["sh_normal"], view.normal)
        images["normal error"] = np.where(known, ramp(angles / NORMAL_RANGE), 1)
    images |= {
        "depth": over_white(alpha * _nearness(mean("depth"), alpha > 0.5)).repeat(3, -1),
        "roughness": over_white(maps["roughness"]).repeat(3, -1),
        "metallic": over_white(maps["metallic"]).repeat(3, -1),
        "base color": light("base_color"),
        "diffuse": light("diffuse"),
        "specular": light("specular"),
    }
    return crop({name: to_8bit(image) for name, image in images.items()}, view)


def ramp(values: np.ndarray) -> np.ndarray:
    """Take values in [0, 1], of any shape, to colours of `RAMP` [..., 3]; what is beyond has the last one."""
    return np.stack([np.interp(values, np.linspace(0, 1, len(RAMP)), channel) for channel in RAMP.T], -1)


def _nearness(depth, covered):
    """0.95 for the nearest that is ``covered``, 0.05 for the farthest."""
    if not covered.any():
        return np.ones_like(depth)
    near, far = np.percentile(depth[covered], (1, 99))
    return 0.05 + 0.9 * np.clip((far - depth) / max(far - near, 1e-9), 0, 1)


def crop(panels: dict[K, np.ndarray], view: View) -> dict[K, np.ndarray]:
    """Crop images [H, W, 3] of a ``view`` to the square around the object where it has a mask; else return them as they
    are."""
    if not view.masked:
        return panels
    y, x = np.nonzero(view.pixels[..., 3])
    height, width = view.pixels.shape[:2]
    side = min(height, width, round(1.06 * max(np.ptp(x), np.ptp(y))) + 2)
    left, top = (int(np.clip((v.min() + v.max() - side) // 2, 0, n - side)) for v, n in ((x, width), (y, height)))
    return {name: image[top : top + side, left : left + side] for name, image in panels.items()}


# ---- The contact sheet ----


def contact_sheet(
    path: str | Path, rows: Sequence[Mapping[str, np.ndarray]], environment: np.ndarray, title: str, lines: Sequence[str]
) -> None:
    """Write one picture of the fit: a row for each view's `panels` of ``rows``; below them the ``environment``
    [rows, columns, 3], linear radiance, and beside it ``lines`` of text. Raises: UserError where it can't be written."""
    names = [name for name in _ON_SHEET if any(name in row for row in rows)]
    line = 2 * _TEXT
    map_height = (len(names) * (_PANEL + _GAP) - _GAP) * 3 // 10
    panels = [[row.get(name) for name in names] for row in rows]
    sheet = Sheet(panels, _PANEL, _GAP, _MARGIN, names, title, _TEXT, below=line + map_height + _MARGIN)
    top = sheet.height - map_height - _MARGIN
    sheet.text(_MARGIN, top - line, "environment", _TEXT)
    sheet.image(tone_map(environment), _MARGIN, top, 2 * map_height, map_height)
    sheet.text(2 * map_height + 3 * _MARGIN, top, "\n".join(lines), 1.5 * _TEXT)
    sheet.write(path)

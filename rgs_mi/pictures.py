"""What people look at: pictures of each test view, and one sheet that tells the whole fit."""

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from .checkpoint import atomic_file
from .color import srgb_encode
from .evaluate import Rendering, photograph
from .export import write_exr

ERROR_GAIN = 4  # of the absolute error in comparisons
_PANEL, _GAP, _MARGIN, _TEXT = 280, 12, 32, 24  # pixels of the contact sheet
_INK = (60, 60, 60)


def write_png(path, image: np.ndarray):
    """Write [H, W, 3 or 4] display values in [0, 1] as an 8-bit PNG, whole or not at all."""
    with atomic_file(path) as stream:
        Image.fromarray(to_8bit(image)).save(stream, "PNG")


def to_8bit(image) -> np.ndarray:
    """Display values in [0, 1] to uint8, rounded."""
    return np.uint8(np.clip(np.nan_to_num(image), 0, 1) * 255 + 0.5)


def write_view(folder, view, rendering: Rendering, background, gbuffer: bool):
    """``NAME.png`` (the rendering), ``NAME_compare.png`` (photograph, rendering, `ERROR_GAIN` times the error), and
    where asked ``NAME_gbuffer.exr`` (linear maps premultiplied by coverage; normals in world space)."""
    truth = photograph(view, background)
    error = np.abs(rendering.image - truth) * ERROR_GAIN
    write_png(folder / f"{view.name}.png", rendering.image)
    write_png(folder / f"{view.name}_compare.png", np.concatenate([truth, rendering.image, error], 1))
    if gbuffer:
        maps = rendering.maps | {"alpha": rendering.alpha}
        names = [f"{name}.{c}" for name, m in maps.items() for c in
                 ("Y" if m.shape[-1] == 1 else "XYZ" if name == "normal" else "RGB")]
        write_exr(folder / f"{view.name}_gbuffer.exr", np.concatenate(list(maps.values()), -1), names)


# ---- The contact sheet ----

def contact_sheet(path, rows, environment: np.ndarray, background, title: str, lines):
    """One picture of the fit: a row for each (view, `Rendering`) of ``rows``, cropped to the object; below them the
    ``environment`` [rows, columns, 3] and beside it ``lines`` of text."""
    rows = [crop(_panels(view, rendering, background), view) for view, rendering in rows]
    names = list(dict.fromkeys(name for row in rows for name in row))
    step, line = _PANEL + _GAP, round(1.6 * _TEXT)
    heights = [round(_PANEL * image.shape[0] / image.shape[1]) for image in (row["photograph"] for row in rows)]
    width = 2 * _MARGIN + len(names) * step - _GAP
    map_height = (width - 2 * _MARGIN) * 3 // 10
    top = _MARGIN + 4 * line
    below = top + sum(heights) + len(rows) * _GAP + _MARGIN
    sheet = Image.new("RGB", (width, below + line + map_height + _MARGIN), "white")
    draw = ImageDraw.Draw(sheet)
    small, large = ImageFont.load_default(_TEXT), ImageFont.load_default(1.5 * _TEXT)

    draw.text((_MARGIN, _MARGIN), title, _INK, large)
    for k, name in enumerate(names):
        draw.text((_MARGIN + k * step + _PANEL / 2, top - line / 2), name, _INK, small, anchor="mm")
    y = top
    for row, height in zip(rows, heights):
        for k, name in enumerate(names):
            if name in row:
                _paste(sheet, row[name], (_MARGIN + k * step, y), (_PANEL, height))
        y += height + _GAP
    draw.text((_MARGIN, below + line / 2), "environment", _INK, small, anchor="lm")
    _paste(sheet, tone_map(environment), (_MARGIN, below + line), (2 * map_height, map_height))
    for k, text in enumerate(lines):
        draw.text((2 * map_height + 3 * _MARGIN, below + line + 1.5 * k * line), text, _INK, large)
    with atomic_file(path) as stream:
        sheet.save(stream, "PNG")


def crop(panels, view):
    """The square around the object where the view has a mask, else the whole."""
    if not view.masked:
        return panels
    y, x = np.nonzero(view.pixels[..., 3])
    height, width = view.pixels.shape[:2]
    side = min(height, width, round(1.06 * max(np.ptp(x), np.ptp(y))) + 2)
    left, top = (int(np.clip((v.min() + v.max() - side) // 2, 0, n - side)) for v, n in ((x, width), (y, height)))
    return {name: image[top:top + side, left:left + side] for name, image in panels.items()}


def tone_map(radiance: np.ndarray) -> np.ndarray:
    """Linear radiance to display values: Reinhard's curve, white at the 99.5th percentile, then sRGB."""
    white = max(float(np.percentile(radiance, 99.5)), 1.0)
    x = np.maximum(radiance, 0)
    return srgb_encode(np.clip(x * (1 + x / white**2) / (1 + x), 0, 1))


def _panels(view, rendering, background):
    """name -> display values [H, W, 3] over white, in the order of the sheet's columns."""
    alpha, maps = rendering.alpha, rendering.maps
    over_white = lambda premultiplied: premultiplied + (1 - alpha)
    mean = lambda name: maps[name] / np.maximum(alpha, 1e-6)
    light = lambda name: over_white(srgb_encode(np.clip(mean(name), 0, 1)) * alpha)
    panels = {"photograph": photograph(view, background), "rendering": rendering.image,
              "normals": over_white((maps["normal"] + alpha) / 2)}
    if view.normal is not None:
        known = np.linalg.norm(view.normal, axis=-1, keepdims=True) > 0.5
        panels["true normals"] = np.where(known, view.normal / 2 + 0.5, 1)
    return panels | {"roughness": over_white(maps["roughness"]).repeat(3, -1),
                     "metallic": over_white(maps["metallic"]).repeat(3, -1), "base color": light("base_color"),
                     "diffuse": light("diffuse"), "specular": light("specular")}


def _paste(sheet, image, corner, size):
    sheet.paste(Image.fromarray(to_8bit(image)).resize(size, Image.LANCZOS), corner)

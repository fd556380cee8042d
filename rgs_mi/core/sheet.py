"""Contact sheets: pictures in rows and columns on white with words above them, drawn by Matplotlib to the pixel."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .files import atomic_file

INK = "#3c3c3c"
_DPI = 128  # of Matplotlib's inches, a power of two, so that pixels stay whole; lengths here are pixels
_LINE = 1.5  # a line's height, in sizes of the text
_OF_FONT = 1.16  # the same, of Matplotlib's font by itself


class Sheet:
    """A sheet with ``rows`` of pictures [H, W, 3], display values or uint8 (None: nothing), each ``width`` pixels wide and
    those of a row equally high, ``gap`` pixels apart and ``margin`` from the edges. ``columns`` are the words above each, of
    one or more lines of ``text_size`` pixels; ``title`` is larger, above all; ``below`` are pixels that are left free under
    the rows."""

    def __init__(
        self,
        rows: Sequence[Sequence[np.ndarray | None]],
        width: int,
        gap: int,
        margin: int,
        columns: Sequence[str] = (),
        title: str = "",
        text_size: int = 20,
        below: int = 0,
    ) -> None:
        from matplotlib.figure import Figure

        shapes = [next(image.shape for image in row if image is not None) for row in rows]
        heights = [max(round(width * shape[0] / shape[1]), 1) for shape in shapes]
        line = round(_LINE * text_size)
        lines = max((words.count("\n") + 1 for words in columns), default=0)
        top = margin + 2 * line * bool(title) + line * lines
        self.width = 2 * margin + max(map(len, rows)) * (width + gap) - gap
        self.height = top + sum(heights) + (len(rows) - 1) * gap + margin + below
        self.figure = Figure((self.width / _DPI, self.height / _DPI), dpi=_DPI, facecolor="white")
        if title:
            self.text(margin, margin, title, 1.5 * text_size)
        for k, words in enumerate(columns):
            self.text(margin + k * (width + gap) + width / 2, top - gap, words, text_size, ha="center", va="bottom")
        for row, height in zip(rows, heights):
            for k, image in enumerate(row):
                if image is not None:
                    self.image(image, margin + k * (width + gap), top, width, height)
            top += height + gap

    def image(self, image: np.ndarray, left: float, top: float, width: float, height: float) -> None:
        """Draw ``image`` into a rectangle of pixels, counted from the sheet's upper left corner."""
        bottom = self.height - top - height
        axes = self.figure.add_axes(
            (left / self.width, bottom / self.height, width / self.width, height / self.height), frameon=False
        )
        axes.set_axis_off()
        axes.imshow(image, aspect="auto", interpolation="lanczos", interpolation_stage="rgba")

    def text(self, left: float, top: float, words: str, size: float, **options: Any) -> None:
        """Write ``words`` of ``size`` pixels below and to the right of a pixel, unless ``options`` of
        `matplotlib.text.Text` say otherwise."""
        options = {"va": "top", "linespacing": _LINE / _OF_FONT, "parse_math": False} | options
        self.figure.text(left / self.width, 1 - top / self.height, words, size=size * 72 / _DPI, color=INK, **options)

    def write(self, path: str | Path) -> None:
        """Write the sheet as a PNG. Raises: UserError where it can't be written."""
        with atomic_file(path) as stream:
            self.figure.savefig(stream, format="png", metadata={"Software": None})

"""Frames as a video that plays everywhere, H.264 in an MP4, and as a contact sheet."""

import itertools
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from ..core.errors import UserError
from ..core.files import atomic_file
from ..core.sheet import Sheet

VIDEO, SHEET = "video.mp4", "sheet.png"
_SECONDS, _RATES = 6, (4, 30)  # about how long a video is, as far as these bounds of its frames a second let it
_CELLS, _COLUMNS, _WIDTH, _GAP = 12, 4, 320, 8  # frames on a sheet, in a row; pixels
_QUALITY = ("-crf", "17", "-preset", "slow", "-movflags", "+faststart")
# What players take for granted: without these, colours are converted one way and read another
_COLORS = (
    "-vf",
    "scale=out_color_matrix=bt709:out_range=tv,setparams=colorspace=bt709:color_primaries=bt709:color_trc=bt709:range=tv",
)


def check() -> None:
    """Check that the encoder is installed. Raises: UserError where it is not."""
    try:
        import imageio_ffmpeg  # noqa: F401
    except ImportError as error:
        raise UserError("a video needs an encoder: pip install imageio-ffmpeg") from error


def write(folder: str | Path, files: Sequence[str | Path]) -> list[Path]:
    """Write ``FOLDER/video.mp4`` and ``sheet.png`` of the PNGs ``files``, which have one size, and return their paths. What
    is transparent is white.

    The video takes about six seconds where that means 4 to 30 frames in each. Pixels are yuv420p, which needs even sizes:
    odd ones grow by a white row or column.
    Raises: UserError where the encoder is not installed, or fails, and where a file can't be written.
    """
    check()
    rate = int(np.clip(round(len(files) / _SECONDS), *_RATES))
    paths = [Path(folder) / VIDEO, Path(folder) / SHEET]
    _encode(paths[0], (_even(over_white(file)) for file in files), rate)
    chosen = sorted({int(k) for k in np.linspace(0, len(files) - 1, _CELLS).round()})
    sheet([over_white(files[k]) for k in chosen]).write(paths[1])
    return paths


def over_white(file: str | Path) -> np.ndarray:
    """Read a PNG with straight alpha over white, blended in display space: [H, W, 3] uint8."""
    with Image.open(file) as image:
        pixels = np.asarray(image.convert("RGBA"), np.float32)
    alpha = pixels[..., 3:] / 255
    return (pixels[..., :3] * alpha + 255 * (1 - alpha) + 0.5).astype(np.uint8)


def sheet(frames: Sequence[np.ndarray]) -> Sheet:
    """Return a contact sheet of ``frames``, [H, W, 3] uint8 each, row by row."""
    return Sheet([frames[k : k + _COLUMNS] for k in range(0, len(frames), _COLUMNS)], _WIDTH, _GAP, margin=_GAP)


def _even(frame):
    """A frame of even width and height."""
    height, width = frame.shape[:2]
    return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), constant_values=255)


def _encode(path, frames, rate):
    """Frames, [H, W, 3] uint8 of one even size, as a video."""
    import imageio_ffmpeg

    with tempfile.TemporaryDirectory() as folder:
        file, first = Path(folder) / VIDEO, next(frames)
        writer = imageio_ffmpeg.write_frames(
            str(file),
            first.shape[1::-1],
            fps=rate,
            codec="libx264",
            quality=None,  # pyright: ignore[reportArgumentType]  # the rate factor below stands for it
            macro_block_size=1,
            output_params=[*_COLORS, *_QUALITY],
        )
        try:
            writer.send(None)
            for frame in itertools.chain([first], frames):
                writer.send(np.ascontiguousarray(frame))
            writer.close()
        except (OSError, RuntimeError) as error:
            reason = (str(error).strip().splitlines() or ["no reason given"])[-1]
            raise UserError(f"{path}: can't be encoded ({reason}): free some space, or reinstall imageio-ffmpeg") from error
        with atomic_file(path) as stream, open(file, "rb") as encoded:
            shutil.copyfileobj(encoded, stream)

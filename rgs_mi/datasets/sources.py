"""What a capture begins with, a folder of photographs or a video, as files that every layout's reader takes: upright PNGs and
JPEGs of bounded size, whose names are letters, digits, dots and dashes.
"""

import logging
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from ..core.errors import UserError
from .exif import ORIENTATION, exposure_value, kept
from .images import check_size, limited

PHOTOGRAPHS = (".jpg", ".jpeg", ".png")
_OTHERS = {".heic": "HEIC", ".heif": "HEIC", ".dng": "raw", ".cr2": "raw", ".nef": "raw", ".arw": "raw", ".tif": "TIFF"}
_QUALITY = 95  # of JPEG
_SHARPNESS_SIDE = 800  # pixels: blur of phones is seen, noise of sensors is not


@dataclass(frozen=True)
class Source:
    """One photograph of a capture.

    Attributes
      name:      of its file in the capture, which is upright
      origin:    what it was made of, in words: a file's name, or the time in a video
      sharpness: variance of the Laplacian of its grey levels (0 to 255) at `_SHARPNESS_SIDE` pixels: only to be compared
                 with that of photographs of the same things
      exposure:  exposure value at ISO 100, in stops, as its EXIF tells; None where that says nothing
      alpha:     whether it has an alpha channel that is not opaque everywhere
    """

    name: str
    origin: str
    sharpness: float
    exposure: float | None = None
    alpha: bool = False


def photographs(folder: Path, target: Path, longest: int, done: Callable[[float], None]) -> list[Source]:
    """Copy the photographs in ``folder`` (not in folders below it) to ``target`` by name; those of more than ``longest`` pixels
    along a side are scaled, those that EXIF says lie on their side are turned. ``done`` is told the fraction that is done.

    Focal length and exposure stay in the EXIF of what is encoded again; places and times do not.
    Raises: UserError for a folder without photographs, for two of one name, and for files that can't be read.
    """
    shown = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    paths = [path for path in shown if path.suffix.lower() in PHOTOGRAPHS and path.is_file()]
    if not paths:
        kinds = sorted({_OTHERS[s] for path in shown if (s := path.suffix.lower()) in _OTHERS})
        raise UserError(
            f"{folder} holds no photographs (JPEG or PNG): "
            + (
                f"convert its {' and '.join(kinds)} files to JPEG"
                if kinds
                else "give the folder that they are in, or a video"
            )
        )
    names: dict[str, Path] = {}
    for path in paths:
        stem = re.sub(r"[^\w.-]+", "_", path.stem)
        if (first := names.setdefault(stem, path)) is not path:
            raise UserError(f"{path} and {first.name} would have the same name in the capture: rename one of them")
    sources = []
    for stem, path in names.items():
        sources.append(_photograph(path, target, stem, longest))
        done(len(sources) / len(paths))
    return sources


def _photograph(path: Path, target: Path, stem: str, longest: int) -> Source:
    from PIL import Image, ImageOps

    try:
        with Image.open(path, formats=("PNG", "JPEG", "MPO")) as image:
            check_size(*image.size)
            exif = image.getexif()
            turned = exif.get(ORIENTATION, 1) not in (0, 1)
            size = limited(image.size, longest)
            verbatim = not turned and size == image.size and image.format != "MPO"
            image.draft(image.mode, size)
            opened = ImageOps.exif_transpose(image) if turned else image
            size = limited(opened.size, longest) if turned else size
            if opened.mode.startswith("I"):  # 16-bit grey
                opened = Image.fromarray((np.asarray(opened) >> 8).astype(np.uint8))
            alpha = "A" in opened.mode or "transparency" in opened.info
            pixels = opened.convert("RGBA" if alpha else "RGB").resize(size, Image.Resampling.HAMMING)
    except UserError:
        raise
    except Exception as error:  # decoders raise anything from OSError to SyntaxError on damaged files
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise UserError(f"{path} cannot be read as a photograph ({reason}): remove it, or replace it") from error
    if min(size) < 16:
        raise UserError(f"{path} is {size[0]} x {size[1]} pixels, too small for a photograph: remove it")
    name = stem + (".png" if path.suffix.lower() == ".png" else ".jpg")
    if verbatim:
        (target / name).write_bytes(path.read_bytes())
    elif name.endswith(".png"):
        pixels.save(target / name)
    else:
        pixels.save(target / name, quality=_QUALITY, subsampling=0, exif=kept(exif))
    masked = alpha and np.asarray(pixels)[..., 3].min() < 255
    return Source(name, path.name, sharpness(np.asarray(pixels.convert("L"))), exposure_value(exif), bool(masked))


def sharpness(grey: np.ndarray) -> float:
    """Return `Source.sharpness` of grey levels [H, W] in 0 to 255."""
    from PIL import Image

    size = limited(grey.shape[::-1], _SHARPNESS_SIDE)
    small = Image.fromarray(np.ascontiguousarray(grey, np.uint8)).resize(size, Image.Resampling.BOX)
    return float(ndimage.laplace(np.asarray(small, np.float32)).var())


# ---- Videos ----


def frames(video: Path, target: Path, count: int, longest: int, done: Callable[[float], None]) -> list[Source]:
    """Write the sharpest frame of each of ``count`` equal stretches of a ``video`` to ``target``, JPEGs of at most ``longest``
    pixels along a side. ``done`` is told the fraction that is done.

    Raises: UserError where the decoder is not installed, and for a video that it can't decode.
    """
    from PIL import Image

    total, rate, decoded = _decoder(video, longest)
    count = min(count, total)
    best: dict[int, tuple[float, int, np.ndarray]] = {}
    sources = []

    def write(k):
        value, index, frame = best.pop(k)
        name = f"frame_{len(sources) + 1:04d}.jpg"
        Image.fromarray(frame).save(target / name, quality=_QUALITY, subsampling=0)
        sources.append(Source(name, f"frame {index} at {index / rate:.2f} s", value))

    for index, frame in enumerate(decoded):
        k = min(index * count // total, count - 1)
        value = sharpness(np.asarray(Image.fromarray(frame).convert("L")))
        if k not in best or value > best[k][0]:
            for earlier in [other for other in best if other != k]:
                write(earlier)
            best[k] = value, index, frame
        done((index + 1) / total)
    for k in list(best):
        write(k)
    if not sources:
        raise UserError(f"{video}: no frame of it could be decoded: export it as MP4 (H.264), or give photographs")
    return sources


def _decoder(video: Path, longest: int) -> tuple[int, float, Iterator[np.ndarray]]:
    """(number of frames, frames a second, the frames [H, W, 3] uint8, upright and scaled)."""
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise UserError("a video needs a decoder: pip install 'rgs-mi[video]'") from error
    logging.getLogger("imageio_ffmpeg").setLevel(logging.ERROR)  # it warns of frames that are scaled, as is asked for
    scale = f"scale='if(gt(iw,ih),min(iw,{longest}),-2)':'if(gt(iw,ih),-2,min(ih,{longest}))'"
    try:
        total, _ = imageio_ffmpeg.count_frames_and_secs(str(video))
        reader = imageio_ffmpeg.read_frames(
            str(video), pix_fmt="rgb24", output_params=["-vf", scale, "-fps_mode", "passthrough"]
        )
        meta = next(reader)
        width, height = meta["size"]
        rate = float(meta["fps"]) or 30.0
    except (OSError, RuntimeError, KeyError, ValueError, StopIteration) as error:
        raise UserError(f"{video} cannot be decoded as a video: export it as MP4 (H.264), or give photographs") from error
    if not total:
        raise UserError(f"{video} holds no frames: export it as MP4 (H.264), or give photographs")

    def decoded():
        try:
            for frame in reader:
                yield np.frombuffer(frame, np.uint8).reshape(height, width, 3)
        except (OSError, RuntimeError):
            return  # what came before the damage is used
        finally:
            reader.close()

    return total, rate, decoded()

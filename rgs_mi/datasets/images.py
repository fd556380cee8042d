"""Image files as arrays: photographs, masks and normal maps; PNG and JPEG (8 and 16 bit), OpenEXR."""

from collections.abc import Callable, Iterable
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
from scipy import ndimage

from ..core.color import srgb_decode
from ..core.errors import UserError
from ..core.inputs import check_file, opened

EXTENSIONS = (".png", ".exr", ".jpg", ".jpeg")  # in order of preference where a file is named without one
MAX_PIXELS = 1 << 26  # 8192 x 8192; a header that promises more is damaged or hostile
_ASPECT = 0.05  # how far proportions may be off: small images round their sizes


def read_image(path: Path, where: str, size: tuple[int, int] | None = None) -> tuple[np.ndarray, bool]:
    """Read a photograph as `View.pixels`, and whether it has a mask (an alpha channel that is not opaque everywhere); scaled
    to ``size`` (width, height) where that is given and another.

    The means of scaling are weighted with alpha, and of display values where the file has those. 16-bit PNGs keep their high
    bytes. EXR files are linear with premultiplied alpha, as the format has it; where their alpha is 0 the rest does not count.
    ``where`` begins the message.
    Raises: UserError when the file is damaged, empty, too large, or holds NaN or infinity.
    """
    pixels, alpha = _decoded(_read_exr if is_linear(path) else _read_ldr, path, where, size)
    if not alpha:
        pixels[..., 3] = 255 if pixels.dtype == np.uint8 else 1
    opaque = pixels[..., 3].min() >= (255 if pixels.dtype == np.uint8 else 1)
    return pixels, alpha and not bool(opaque)


def image_size(path: Path, where: str) -> tuple[int, int]:
    """Return the (width, height) that an image's header tells. Raises: UserError as `read_image` does."""
    return _decoded(_size_of_exr if is_linear(path) else _size_of_ldr, path, where)


def limited(size: tuple[int, int], longest: int) -> tuple[int, int]:
    """Return ``size`` (width, height) with the longer side ``longest`` where it is more, in the same proportions."""
    scale = min(1.0, longest / max(size))
    return max(round(scale * size[0]), 1), max(round(scale * size[1]), 1)


def read_grey(path: Path, where: str) -> np.ndarray:
    """Read an image's alpha channel where that is not opaque everywhere, else its grey level, as the file encodes it (no sRGB
    curve), of 16 bits where there are 16: [H, W] float32 in [0, 1]. Raises: UserError as `read_image` does."""
    grey = _decoded(_read_grey, path, where)
    return grey.astype(np.float32) / np.float32(255 if grey.dtype == np.uint8 else 65535)


def with_mask(pixels: np.ndarray, coverage: np.ndarray, where: str) -> tuple[np.ndarray, bool]:
    """Put a photograph without alpha [H, W, 4] under a mask ``coverage`` [h, w] (values in [0, 1], resized where its size is
    another); return it, and whether anything is masked. Raises: UserError where the mask's proportions are other than the
    photograph's."""
    from PIL import Image

    height, width = pixels.shape[:2]
    check_proportions(coverage.shape[::-1], (width, height), f"{where}: its mask")
    if coverage.shape != (height, width):
        coverage = np.asarray(Image.fromarray(coverage).resize((width, height), Image.Resampling.BOX))
    pixels[..., 3] = np.rint(255 * coverage) if pixels.dtype == np.uint8 else coverage
    return pixels, bool((coverage < 1).any())


def check_proportions(size: tuple[float, float], photograph: tuple[int, int], what: str) -> None:
    """Check that ``what``, of ``size`` (width, height), can be a ``photograph`` of another resolution. Raises: UserError."""
    if abs(size[0] * photograph[1] / (size[1] * photograph[0]) - 1) > _ASPECT:
        raise UserError(
            f"{what} is {size[0]:g} x {size[1]:g}, the photograph {photograph[0]} x {photograph[1]}: both must "
            "have the same proportions, neither cropped nor turned"
        )


def is_linear(path: Path) -> bool:
    """Return whether an image is an OpenEXR file, by its name."""
    return path.suffix.lower() == ".exr"


def _decoded(read, path, where, *options):
    try:
        return read(path, *options)
    except Exception as error:  # decoders raise anything from OSError to SyntaxError on damaged files
        reason = (getattr(error, "strerror", None) or str(error) or type(error).__name__).splitlines()[0]
        raise UserError(f"{where}: {path} cannot be read as an image ({reason}): replace the file") from error


@contextmanager
def _opened(path):
    """A PNG or JPEG of tolerable size, not decoded yet."""
    from PIL import Image, UnidentifiedImageError

    with opened(path) as stream:
        try:
            image = Image.open(stream, formats=("PNG", "JPEG"))
        except UnidentifiedImageError as error:
            raise ValueError("not a PNG or JPEG file") from error
        with image:
            check_size(*image.size)
            yield image


def _size_of_ldr(path: Path) -> tuple[int, int]:
    with _opened(path) as image:
        return image.size


def _read_ldr(path: Path, size: tuple[int, int] | None) -> tuple[np.ndarray, bool]:
    """[H, W, 4] uint8 of a PNG or JPEG, scaled to ``size`` (width, height), and whether it has alpha."""
    from PIL import Image

    with _opened(path) as image:
        if size:
            image.draft(image.mode, size)  # a JPEG is decoded at a half, a quarter or an eighth where that is enough
        if image.mode.startswith("I"):  # 16-bit grey
            image = Image.fromarray((np.asarray(image) >> 8).astype(np.uint8))
        alpha = "A" in image.mode or "transparency" in image.info
        image = image.convert("RGBA" if alpha else "RGB")
        if size and size != image.size:
            image = image.resize(size, Image.Resampling.HAMMING)
        return np.array(image.convert("RGBA")), alpha


def _read_grey(path: Path) -> np.ndarray:
    """[H, W] uint8 or uint16 of a PNG or JPEG."""
    with _opened(path) as image:
        if image.mode.startswith("I"):
            return np.asarray(image).astype(np.uint16)
        if "A" in image.mode or "transparency" in image.info:
            alpha = np.asarray(image.convert("RGBA"))[..., 3]
            if alpha.min() < 255:
                return alpha
        return np.asarray(image.convert("L"))


def exr_channels(path: Path, chosen: Callable[[list[str]], Iterable[str]], fill: float) -> dict[str, np.ndarray]:
    """Return those channels of an OpenEXR file that are ``chosen`` of their names, {name: [H, W] float32}, and read no others.
    They are of the file's display window, which is the image: ``fill`` where its data window has nothing.

    Raises: OSError, ValueError and whatever else the library raises on damaged files.
    """
    import Imath
    import OpenEXR

    names, data, display = _exr_header(path)
    taken = list(dict.fromkeys(chosen(names)))
    with closing(OpenEXR.InputFile(str(path))) as file:
        planes = file.channels(taken, Imath.PixelType(Imath.PixelType.FLOAT))
    width, height = _extent(data)
    placed = {}
    for name, plane in zip(taken, planes):
        plane = np.frombuffer(plane, np.float32).reshape(height, width)
        placed[name] = plane if (data == display).all() else _placed(plane, data[0] - display[0], _extent(display), fill)
    return placed


def _placed(plane, corner, size, fill):
    """An image of ``size`` (width, height) that has a ``plane`` at its ``corner`` (x, y), as far as it lies inside."""
    (x, y), (height, width) = corner, plane.shape
    image = np.full(size[::-1], fill, np.float32)
    left, top, right, bottom = max(x, 0), max(y, 0), min(x + width, size[0]), min(y + height, size[1])
    if left < right and top < bottom:
        image[top:bottom, left:right] = plane[top - y : bottom - y, left - x : right - x]
    return image


def _exr_header(path):
    """(names of the channels, data window, display window) of an OpenEXR file; a window is [[x, y], [x, y]], with its last pixel.
    Raises: ValueError for windows of intolerable size."""
    import OpenEXR

    check_file(path)
    with OpenEXR.File(str(path), header_only=True) as file:
        header = file.header()
        data, display = (np.array([*header[name]], np.int64) for name in ("dataWindow", "displayWindow"))
        names = [channel.name for channel in header["channels"]]
    for window in (data, display):
        check_size(*_extent(window))
    return names, data, display


def _extent(window) -> tuple[int, int]:
    """(width, height) of a window."""
    width, height = (window[1] - window[0] + 1).tolist()
    return width, height


def _size_of_exr(path: Path) -> tuple[int, int]:
    return _extent(_exr_header(path)[2])


def _read_exr(path: Path, size: tuple[int, int] | None) -> tuple[np.ndarray, bool]:
    """[H, W, 4] float32 of an OpenEXR file with straight alpha, scaled to ``size`` (width, height), and whether it has
    alpha."""
    from PIL import Image

    def chosen(names):
        colors = ["R", "G", "B"] if {"R", "G", "B"} <= {*names} else ["Y"]
        if colors == ["Y"] and "Y" not in names:
            raise ValueError(f"channels {', '.join(sorted(names))[:80]}, but R, G and B are needed")
        return [*colors, "A"] if "A" in names else colors

    channels = exr_channels(path, chosen, 0.0)
    alpha, gray = channels.get("A"), channels.get("Y")
    colors = [channels["RGB"[k]] if gray is None else gray for k in range(3)]
    pixels = np.stack([*colors, np.ones_like(colors[0]) if alpha is None else alpha], -1)
    if alpha is not None:
        pixels[alpha == 0] = 0  # renderers leave NaN where nothing is
    pixels = np.maximum(pixels, 0)
    if not np.isfinite(pixels).all():
        raise ValueError("NaN or infinite pixels")
    if size and size != pixels.shape[1::-1]:  # its colours are premultiplied yet
        planes = [
            Image.fromarray(plane).resize(size, Image.Resampling.HAMMING) for plane in np.moveaxis(pixels, 2, 0).copy()
        ]
        pixels = np.stack([np.asarray(plane) for plane in planes], -1)
    a = pixels[..., 3:] = np.minimum(pixels[..., 3:], 1)
    pixels[..., :3] = np.where(a > 1e-4, pixels[..., :3] / np.maximum(a, 1e-4), 0)
    return pixels, alpha is not None


def check_size(width: int, height: int) -> None:
    """Check that an image can have this size in pixels. Raises: ValueError."""
    if width < 1 or height < 1:
        raise ValueError("its size is zero")
    if width * height > MAX_PIXELS:
        raise ValueError(f"{width} x {height} pixels are too many")


def read_normal(path: Path, size: tuple[int, int], pixels: np.ndarray, where: str) -> np.ndarray:
    """Read the world-space unit normals [H, W, 3] float32 that belong to a photograph whose file is of ``size`` (width,
    height) and which is ``pixels`` [H, W, 4]; 0 where unknown. Those of a photograph that was scaled are sampled
    (`resize`).

    ``_normal.png`` (Shiny Blender) holds n/2 + 1/2 and is known where neither its own alpha is zero nor it is black,
    which no unit normal is. ``_normal_0001.png`` (NeRF Synthetic) holds n itself, cut to [0, 1]
    and put through the sRGB curve (measured on lego: planes of its visual hull agree to 1 degree): it is known only
    where no negative component was lost, that is where its length is still one.
    """
    clamped = path.stem.endswith("_0001")
    image = read_image(path, where)[0]
    if image.shape[1::-1] != size:
        raise UserError(
            f"{where}: {path} is {image.shape[1]} x {image.shape[0]}, its photograph {size[0]} x {size[1]}: normals need the "
            "same size"
        )
    black = ~image[..., :3].any(-1, keepdims=True)
    normal = image[..., :3].astype(np.float32) / np.float32(255)
    normal = srgb_decode(normal) if clamped else 2 * normal - 1
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    known = (np.abs(length - 1) < 0.02) if clamped else (length > 0.1) & ~black & (image[..., 3:] > 0)
    normal = np.where(known, normal / np.maximum(length, 0.1), np.float32(np.nan))
    if image.shape[:2] != pixels.shape[:2]:
        normal = np.stack([resize(normal[..., k], *pixels.shape[:2]) for k in range(3)], -1)
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 0.1)
    return np.where(np.isfinite(normal) & (pixels[..., 3:] > 0), normal, 0).astype(np.float32)


def resize(values: np.ndarray, height: int, width: int) -> np.ndarray:
    """Put a map [h, w] on another pixel grid over the same image plane: [height, width] float32.

    Bilinear between those of the four neighbours that are known, unknown (NaN) where the nearest one is. A smaller grid
    takes samples, not means, which would mix the object with what lies behind it.
    """
    if values.shape == (height, width):
        return values.astype(np.float32)
    known = np.isfinite(values)
    # Pixel centres are at half integers on both grids.
    rows, columns = (np.clip((np.arange(n) + 0.5) * (m / n) - 0.5, 0, m - 1) for n, m in zip((height, width), values.shape))
    grid = np.meshgrid(rows, columns, indexing="ij")
    sample = lambda x: ndimage.map_coordinates(x.astype(np.float32), grid, order=1, mode="nearest")
    weight, total = sample(known), sample(np.where(known, values, 0))
    nearest = known[np.ix_(np.rint(rows).astype(int), np.rint(columns).astype(int))]
    return np.where(nearest, total / np.maximum(weight, 0.1), np.float32(np.nan)).astype(np.float32)

"""Masks of a capture that is being made: from a folder, or from any program that makes one of a photograph."""

import shlex
import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core.errors import UserError
from .images import check_proportions, image_size, read_grey, read_image
from .sources import Source
from .transforms import find_image

_SECONDS = 600  # a photograph, until a program counts as one that hangs


@dataclass(frozen=True)
class Silhouette:
    """How much of a photograph a mask takes, ``coverage`` in [0, 1], and whether it is ``cut_off`` by the photograph's
    border."""

    coverage: float
    cut_off: bool


def from_folder(folder: Path, sources: Sequence[Source], images: Path, target: Path) -> None:
    """Write the masks of photographs ``sources``, which lie in ``images``, to ``target``, PNGs by name and at the photographs'
    size. A mask in ``folder`` has the name of its photograph as it was given, of any type: grey, white where the object
    is, or with an alpha channel.

    Raises: UserError where one is missing or can't be read, or has other proportions than its photograph.
    """
    if not folder.is_dir():
        raise UserError(f"the folder of masks '{folder}' does not exist: give it with --masks")
    found = {source: _find(folder, source) for source in sources}
    if missing := [source for source, path in found.items() if path is None]:
        raise UserError(
            f"{folder}: {len(missing)} of {len(sources)} photographs have no mask (first: {missing[0].origin}): add "
            f"{Path(missing[0].name).stem}.png and so on, or leave these photographs out"
        )
    target.mkdir()
    for source, path in found.items():
        assert path is not None
        _write(path, images / source.name, target)


def _find(folder: Path, source: Source) -> Path | None:
    origin = Path(source.origin)
    names = (origin.stem, f"{origin.name}.png", Path(source.name).stem)
    return next((path for name in names if (path := find_image(folder / name))), None)


def check_command(command: str) -> list[str]:
    """Return the words of a ``command`` in which {image} and {mask} stand for files. Raises: UserError where it lacks them,
    or its program is not there."""
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise UserError(f"--mask-command {command!r} has an open quotation ({error}): close it") from error
    if not all(any(place in word for word in words) for place in ("{image}", "{mask}")):
        raise UserError(f"--mask-command {command!r}: write {{image}} for the photograph and {{mask}} for the PNG to write")
    if shutil.which(words[0]) is None:
        raise UserError(f"--mask-command: there is no program '{words[0]}': install it, or give its path")
    return words


def from_command(
    words: Sequence[str], sources: Sequence[Source], images: Path, target: Path, done: Callable[[float], None]
) -> None:
    """Write the masks that a program makes of photographs, as `from_folder`; ``words`` are those of `check_command`. No shell
    sees them. ``done`` is told the fraction that is done.

    Raises: UserError where the program fails or leaves no mask, and for a mask of other proportions than its photograph.
    """
    target.mkdir()
    for count, source in enumerate(sources, 1):
        image, mask = (images / source.name).absolute(), (target / f"{Path(source.name).stem}.png").absolute()
        call = [word.replace("{image}", str(image)).replace("{mask}", str(mask)) for word in words]
        try:
            ended = subprocess.run(
                call, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=_SECONDS
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise UserError(
                f"--mask-command: '{words[0]}' can't be run on {source.origin} ({error}): try it by hand"
            ) from error
        if ended.returncode or not mask.is_file():
            said = (ended.stdout.decode(errors="replace").strip().splitlines() or ["it said nothing"])[-1][:200]
            what = f"ended with {ended.returncode}" if ended.returncode else "wrote no mask"
            raise UserError(f"--mask-command: '{words[0]}' {what} for {source.origin} ({said}): try it by hand")
        _write(mask, image, target)
        done(count / len(sources))


def _write(path: Path, image: Path, target: Path) -> None:
    from PIL import Image

    where = f"mask of {image.name}"
    size, coverage = image_size(image, where), read_grey(path, where)
    check_proportions(coverage.shape[::-1], size, f"{path}: it")
    grey = Image.fromarray(np.rint(255 * coverage).astype(np.uint8))
    grey.resize(size, Image.Resampling.BOX).save(target / f"{image.stem}.png")


def silhouette(image: Path, mask: Path) -> Silhouette | None:
    """Return what is known of the mask of the photograph ``image``: its own alpha channel, else the file ``mask``; None where
    it has neither. Raises: UserError where a file can't be read."""
    pixels, masked = read_image(image, str(image))
    if masked:
        inside = pixels[..., 3] > 127
    elif mask.is_file():
        inside = read_grey(mask, str(mask)) > 0.5
    else:
        return None
    border = np.concatenate([inside[0], inside[-1], inside[:, 0], inside[:, -1]])
    return Silhouette(float(inside.mean()), bool(border.mean() > 0.01))

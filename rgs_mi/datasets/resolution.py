"""Which of several resolutions of a capture is used: ``images``, or a smaller copy ``images_2``, ``images_4`` … beside it.

The largest whose longer side is `LONGEST` pixels at most, the limit of 3DGS and of nerfstudio, or what is asked for
instead; the smallest there is where none is so small, which is then scaled when it is read (`images.read_image`). That
gives what publications use: images_4 for Ref-NeRF Real and for the outdoor scenes of Mip-NeRF 360, images_2 for its indoor
scenes.
"""

import re
from pathlib import Path

LONGEST = 1600


def chosen(folder: Path, side: float, longest: int = LONGEST) -> Path:
    """Return ``folder`` or the smaller copy beside it, for photographs whose longer side is ``side`` pixels in ``folder``
    and should be ``longest`` at most."""
    choices = {1: folder} if folder.is_dir() else {}
    for copy in folder.parent.glob(f"{folder.name}_*") if side > longest or not choices else ():
        match = re.fullmatch(r"_([1-9]\d{0,2})", copy.name[len(folder.name) :])
        if match and copy.is_dir():
            choices[int(match[1])] = copy
    fitting = [factor for factor in choices if side / factor <= longest]
    return choices[min(fitting) if fitting else max(choices)] if choices else folder

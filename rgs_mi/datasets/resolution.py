"""Which of several resolutions of a capture is used: ``images``, or a smaller copy ``images_2``, ``images_4`` … beside it.

The largest whose longer side is `LONGEST` pixels at most, the limit of 3DGS and of nerfstudio; the smallest there is
where none is so small. That gives what publications use: images_4 for Ref-NeRF Real and for the outdoor scenes of
Mip-NeRF 360, images_2 for its indoor scenes.
"""

import re
from pathlib import Path

LONGEST = 1600


def chosen(folder: Path, longest: float) -> Path:
    """Return ``folder`` or the smaller copy beside it, for photographs whose longer side is ``longest`` pixels in
    ``folder``."""
    choices = {1: folder} if folder.is_dir() else {}
    for copy in folder.parent.glob(f"{folder.name}_*") if longest > LONGEST or not choices else ():
        match = re.fullmatch(r"_([1-9]\d{0,2})", copy.name[len(folder.name) :])
        if match and copy.is_dir():
            choices[int(match[1])] = copy
    fitting = [factor for factor in choices if longest / factor <= LONGEST]
    return choices[min(fitting) if fitting else max(choices)] if choices else folder

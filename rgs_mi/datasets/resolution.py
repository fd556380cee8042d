"""Which of several resolutions of a capture is used: ``images``, or a smaller copy ``images_2``, ``images_4`` … beside it.

The largest whose longer side is `LONGEST` pixels at most, the limit of 3DGS and of nerfstudio, or what is asked for
instead; the smallest there is where none is so small, which is then scaled when it is read (`images.read_image`). That
gives what publications use: images_4 for Ref-NeRF Real and for the outdoor scenes of Mip-NeRF 360, images_2 for its indoor
scenes.
"""

import os
import re
from pathlib import Path

LONGEST = 1600


def chosen(folder: Path, side: float, longest: int = LONGEST) -> Path:
    """Return ``folder`` or the smaller copy beside it, for photographs whose longer side is ``side`` pixels in ``folder``
    and should be ``longest`` at most."""
    # unlike Path's, os.path's answers False to names that no file system takes
    choices = {1: folder} if os.path.isdir(folder) else {}
    if (side > longest or not choices) and os.path.isdir(folder.parent):
        for name in os.listdir(folder.parent):
            match = re.fullmatch(re.escape(folder.name) + r"_([1-9]\d{0,2})", name)
            if match and os.path.isdir(folder.parent / name):
                choices[int(match[1])] = folder.parent / name
    fitting = [factor for factor in choices if side / factor <= longest]
    return choices[min(fitting) if fitting else max(choices)] if choices else folder

"""Splats as the PLY of 3DGS, which most viewers read."""

from pathlib import Path

from ..surfels.ply import core_columns, write_columns
from .splats import Splats

NAME = "splats.ply"


def write(folder: str | Path, splats: Splats) -> list[Path]:
    """Write ``splats`` as `NAME` into ``folder``, in the world that they are in, and return the path, in a list. A comment
    tells PlayCanvas and SuperSplat to draw disks in place of ellipsoids, and another where their origin is, if it is
    elsewhere: the file's floats could not be far from theirs.

    Raises: UserError where the disk is full or the folder can't be written.
    """
    fields = {name: getattr(splats, name) for name in ("centers", "rotations", "scales")}
    columns = core_columns(
        {**fields, "opacities": splats.opacities[:, None], "sh": splats.harmonics.reshape(len(splats), -1)}
    )
    placed = [f"origin {' '.join(f'{x:.9g}' for x in splats.origin)}"] if any(splats.origin) else []
    path = Path(folder) / NAME
    write_columns(path, columns, ["SplatRenderMode: 2dgs", *placed])
    return [path]

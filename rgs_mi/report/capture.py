"""The page of a capture that was made from photographs: where cameras stand, how well they fit, and what to do better."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from ..core.camera import Camera
from ..core.files import atomic_file
from ..datasets.masks import Silhouette
from ..datasets.sources import Source
from ..datasets.structure_from_motion import Structure
from . import html, plots
from .advice import advice, blurred, largest_gap

PAGE = "capture.html"
_STORED, _WIDTH = 192, 96  # pixels of a thumbnail's width, in the file and on the page
_GAP = 45  # degrees of azimuth from which the plot shows a gap
_CLOUD = 3000  # points in a plot


def write(
    folder: Path,
    title: str,
    structure: Structure,
    cameras: Mapping[str, Camera],
    points: np.ndarray,
    sources: Sequence[Source],
    silhouettes: Mapping[str, Silhouette],
) -> list[str]:
    """Write ``FOLDER/capture.html``, and return the advice that it gives (`advice.advice`).

    Args:
      structure: what was found of the photographs, of which the files are in the folder's ``images``
      cameras, points: those of the capture's world: name -> camera, and [N, 3]
      sources, silhouettes: see `advice.advice`

    Raises: UserError where the disk is full or the folder can't be written.
    """
    lines = advice(cameras, sources, structure.errors, silhouettes)
    errors = np.array([structure.errors[name] for name in cameras])
    odd = (errors > 1.8 * np.nanmedian(errors)).tolist()
    start, width, _, _ = largest_gap(cameras)
    gap = (start, width) if width > _GAP else None
    dull = {source.name for source in blurred(sources)}
    page = html.render(
        "capture.html",
        title=title,
        placed=len(cameras),
        count=len(sources),
        masked=len(silhouettes),
        advice=lines,
        error=float(np.nanmedian(errors)),
        points=len(points),
        places=_places(cameras, points, gap),
        gap=gap,
        plots=[
            plots.bars(errors.tolist(), odd, "photograph", "mean reprojection error, pixels"),
            plots.bars(
                [structure.observations[name] for name in cameras],
                [structure.observations[name] < 100 for name in cameras],
                "photograph",
                "points that it shows",
            ),
        ],
        lenses=_lenses(structure),
        left_out=[
            {"picture": _thumbnail(folder / "images" / s.name), "source": s, "reason": structure.left_out[s.name]}
            for s in sources
            if s.name in structure.left_out
        ],
        photographs=[
            {
                "number": k,
                "picture": _thumbnail(folder / "images" / source.name),
                "source": source,
                "error": structure.errors[source.name],
                "observations": structure.observations[source.name],
                "blurred": source.name in dull,
            }
            for k, source in enumerate((s for s in sources if s.name in cameras), 1)
        ],
    )
    with atomic_file(folder / PAGE) as stream:
        stream.write(page)
    return lines


def _places(cameras, points, gap) -> list[str]:
    origins = np.stack([camera.origin for camera in cameras.values()])
    axes = np.stack([camera.to_world[:3, 2] for camera in cameras.values()])
    return plots.cameras(origins, axes, points[:: -(-len(points) // _CLOUD)], gap)


def _lenses(structure) -> list[dict]:
    """What the page says of each lens."""
    lenses = {}
    for image in structure.images:
        lenses.setdefault(image.lens, []).append(image.name)
    return [
        {
            "count": len(names),
            "size": lens.size,
            "focal": lens.focal,
            "principal": lens.principal,
            "fov": float(np.degrees(2 * np.arctan(max(lens.size) / (2 * max(lens.focal))))),
            "radial": lens.distortion.radial,
            "tangential": lens.distortion.tangential,
        }
        for lens, names in lenses.items()
    ]


def _thumbnail(path) -> html.Picture:
    with Image.open(path) as image:
        image.draft("RGB", (_STORED, _STORED))
        pixels = image.convert("RGB")
        pixels.thumbnail((_STORED, _STORED))
    return html.jpeg(np.asarray(pixels), path.name, _STORED, round(_WIDTH * pixels.width / max(pixels.size)))

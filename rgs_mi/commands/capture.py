"""A capture from photographs or a video: cameras, lens, points and masks in nerfstudio's layout, which fits read. What the
verb ``capture`` calls.

Everything is made in a folder beside the capture's, which appears whole or not at all.
"""

import os
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..core.alignment import Similarity
from ..core.camera import Camera
from ..core.errors import UserError
from ..core.files import make_folder, write_json
from ..core.ply_format import write_vertices
from ..core.progress import Progress
from ..datasets import masks as mask_files
from ..datasets import sources
from ..datasets.images import image_size
from ..datasets.nerfstudio import FILE
from ..datasets.resolution import LONGEST
from ..datasets.structure_from_motion import Structure, check, structure_from_motion
from ..datasets.world_frame import world_frame
from ..report import capture as page

POINTS = "points.ply"
_CV_TO_GL = np.diag([1.0, -1.0, -1.0, 1.0])


def capture(
    source: str | Path,
    out: str | Path,
    *,
    masks: str | Path | None = None,
    mask_command: str | None = None,
    frames: int = 80,
    longest: int = LONGEST,
    quiet: bool = False,
) -> Path:
    """Make a capture of ``source``, a folder of photographs or a video, in the folder ``out``, which is returned.

    The world has z up, the point that the cameras look at is the origin, and half of the cameras are within four units of it
    (`world_frame`). Photographs that have no place among the others are left out; the page ``capture.html`` says which and
    why.

    Args:
      masks:        a folder of masks, of the photographs' names (`masks.from_folder`)
      mask_command: a program that makes a mask, in which {image} and {mask} stand for files (`masks.from_command`)
      frames:       how many frames of a video are used: the sharpest of so many equal stretches
      longest:      photographs are scaled to this longer side, in pixels, if theirs is longer

    Raises: UserError for bad input, a package that is missing, a folder that is not empty, photographs that tell no cameras,
    and where a file can't be written.
    """
    source, out = Path(source), Path(out)
    words = _checked(source, out, masks, mask_command, frames)
    make_folder(out.absolute().parent)
    work = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.absolute().parent))
    try:
        made = work / "capture"
        (made / "images").mkdir(parents=True)
        with _Phases(quiet) as phases:
            placed, lost, lines = _make(source, made, work, f"Capture {out.name}", masks, words, frames, longest, phases)
        if out.exists():
            out.rmdir()
        made.rename(out)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    if not quiet:
        print(f"{out}: {placed} photographs placed, {lost} left out; {out / page.PAGE} shows them")
        for line in lines:
            print(f"- {line}")
        print(f"next: rgs-mi optimize object --data {out}")
    return out


def _checked(source, out, masks, mask_command, frames) -> list[str]:
    """The words of the command that makes masks. Raises: UserError for what is known to be bad before any work."""
    if not os.path.exists(source):
        raise UserError(f"'{source}' does not exist: give a folder of photographs, or a video")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UserError(f"{out} is there and not empty: choose another --out, or delete it")
    if masks and mask_command:
        raise UserError("--masks and --mask-command both say where masks come from: give one of them")
    if masks and not Path(masks).is_dir():
        raise UserError(f"the folder of masks '{masks}' does not exist: give it with --masks")
    if frames < 3:
        raise UserError(f"--frames {frames}: give 3 at the very least, better 80")
    check()
    return mask_files.check_command(mask_command) if mask_command else []


def _make(source, made, work, title, masks, words, frames, longest, phases) -> tuple[int, int, list[str]]:
    """Fill the folder ``made``; return how many photographs have a place, how many have none, and what to do better."""
    images, mask_folder = made / "images", made / "masks"
    if source.is_dir():
        taken = sources.photographs(source, images, longest, lambda done: phases("photographs", done))
    else:
        taken = sources.frames(source, images, frames, longest, lambda done: phases("video", done))
    if masks:
        mask_files.from_folder(Path(masks), taken, images, mask_folder)
    sizes = {s.name: image_size(images / s.name, s.origin) for s in taken}
    (work / "colmap").mkdir()
    structure = structure_from_motion(images, sizes, work / "colmap", phases)
    cameras, points = _in_world(structure)
    placed = [s for s in taken if s.name in cameras]
    if words:
        mask_files.from_command(words, placed, images, mask_folder, lambda done: phases("masks", done))
    paths = {s.name: mask_folder / f"{Path(s.name).stem}.png" for s in taken}
    silhouettes = {s.name: found for s in placed if (found := mask_files.silhouette(images / s.name, paths[s.name]))}
    write_json(made / FILE, _transforms(structure, cameras, {name for name, path in paths.items() if path.is_file()}))
    _write_points(made / POINTS, points, structure.colors)
    lines = page.write(made, title, structure, cameras, points, taken, silhouettes)
    for name in structure.left_out:
        (images / name).unlink()
        paths[name].unlink(missing_ok=True)
    return len(cameras), len(structure.left_out), lines


def _in_world(structure: Structure) -> tuple[dict[str, Camera], np.ndarray]:
    """Name -> camera, and the points, of the capture's world."""
    cameras = structure.cameras
    frame: Similarity = world_frame(cameras)
    moved = [replace(camera, to_world=frame.pose(camera.to_world)) for camera in cameras]
    return dict(zip((image.name for image in structure.images), moved)), frame.points(structure.points)


# ---- Files ----


def _transforms(structure: Structure, cameras: dict[str, Camera], masked: set[str]) -> dict:
    """What transforms.json holds; intrinsics stand at a frame where there are several lenses."""
    lenses = {image.name: _intrinsics(image.lens) for image in structure.images}
    one = all(lens == lenses[structure.images[0].name] for lens in lenses.values())
    frames = [
        {
            "file_path": f"images/{name}",
            **({"mask_path": f"masks/{Path(name).stem}.png"} if name in masked else {}),
            "transform_matrix": (camera.to_world @ _CV_TO_GL).tolist(),
            **({} if one else lenses[name]),
        }
        for name, camera in cameras.items()
    ]
    shared = lenses[structure.images[0].name] if one else {}
    return {"camera_model": "OPENCV", **shared, "ply_file_path": POINTS, "frames": frames}


def _intrinsics(lens) -> dict:
    (w, h), (fx, fy), (cx, cy) = lens.size, lens.focal, lens.principal
    (k1, k2), (p1, p2) = lens.distortion.radial, lens.distortion.tangential
    return {"w": w, "h": h, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "k1": k1, "k2": k2, "p1": p1, "p2": p2}


def _write_points(path: Path, points: np.ndarray, colors: np.ndarray) -> None:
    rows = np.zeros(len(points), [(axis, "f4") for axis in "xyz"] + [(c, "u1") for c in ("red", "green", "blue")])
    for column, name in zip([*points.T, *colors.T], rows.dtype.names or ()):
        rows[name] = column
    write_vertices(path, rows)


class _Phases:
    """One line of progress a phase: called with what is going on and which fraction of it is done."""

    def __init__(self, quiet: bool) -> None:
        self.quiet, self.label, self.progress = quiet, None, None

    def __enter__(self) -> "_Phases":
        return self

    def __call__(self, label: str, fraction: float) -> None:
        if label != self.label:
            self.__exit__()
            self.label, self.progress = label, Progress(quiet=self.quiet, label=label).__enter__()
        assert self.progress is not None
        self.progress.update(fraction)

    def __exit__(self, *_: object) -> None:
        if self.progress is not None:
            self.progress.__exit__()
            self.progress = None

"""What a fit made of the cameras: cameras.json, and how far they moved."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.camera import Camera
from ..core.errors import UserError
from ..core.files import write_json
from ..core.inputs import JSON, read_file
from ..core.lens import Lens
from ..datasets.types import Dataset, View
from ..evaluation.registration import Registered, Registration

if TYPE_CHECKING:
    from ..fit.cameras import Cameras

FILE = "cameras.json"


def registration(learned: "Cameras | None", views: Sequence[View]) -> Registration | None:
    """Return how the evaluation ``views`` of a fit find their place; None where nothing was ``learned`` of cameras."""
    if learned is None:
        return None
    return Registration(
        "poses" in learned.rows, "exposure" in learned.rows, {view.name: learned.calibrated(view.camera) for view in views}
    )


# ---- cameras.json ----


def write(
    folder: Path, learned: "Cameras", dataset: Dataset, views: Sequence[View], found: Mapping[str, Registered]
) -> Path:
    """Write ``FOLDER/cameras.json`` and return its path: for each training view, and each of the evaluation ``views`` as it was
    ``found``, pose and intrinsics as learned, the pose that was ``given``, and the gain of its photograph.

    Raises: UserError where the disk is full or the folder can't be written.
    """
    train = {view.name: _row(view.camera, learned.camera(k), learned.gain(k)) for k, view in enumerate(dataset.train)}
    evaluated = {v.name: _row(v.camera, found[v.name].camera, found[v.name].gain) for v in views}
    kinds = {"poses": "poses" in learned.rows, "exposure": "exposure" in learned.rows}
    write_json(folder / FILE, {"learned": kinds, "train": train, "evaluated": evaluated})
    return folder / FILE


def _row(given: Camera, camera: Camera, gain: np.ndarray | None) -> dict[str, Any]:
    lens = camera.lens or Lens()
    return {
        "given": given.to_world.tolist(),
        "to_world": camera.to_world.tolist(),
        "focal": camera.focal,
        "principal": camera.principal,
        "size": [int(n) for n in camera.size],
        "distortion": dict(zip(("k1", "k2", "p1", "p2"), lens.coefficients)) | {"reach": lens.reach},
        "gain": np.ones(3).tolist() if gain is None else gain.tolist(),
    }


def read(folder: Path, views: Sequence[View]) -> Registration | None:
    """Return how the evaluation ``views`` of the run in ``folder`` found their place, and where; None where it learned nothing
    of cameras.

    Raises: UserError where cameras.json is damaged, or says nothing of a view.
    """
    saved = _read(folder, "evaluated", views)
    if saved is None:
        return None
    poses, exposure, rows = saved
    starts = {name: given for name, (given, _) in rows.items()}
    return Registration(poses, exposure, starts, {name: found for name, (_, found) in rows.items()})


def read_training(folder: Path, views: Sequence[View]) -> dict[str, Registered] | None:
    """Return how the run in ``folder`` sees its training ``views``, by their names; None where it learned nothing of cameras.

    Raises: UserError as `read` does.
    """
    saved = _read(folder, "train", views)
    return None if saved is None else {name: found for name, (_, found) in saved[-1].items()}


def _read(folder, kind, views):
    """(whether poses were learned, exposures, {name: (camera as given, as found)}) of ``views``, 'train' or 'evaluated' ones."""
    path = folder / FILE
    if not path.is_file():
        return None
    try:
        saved = json.loads(read_file(path, JSON))
        poses, exposure = (bool(saved["learned"][name]) for name in ("poses", "exposure"))
        rows = {}
        for view in views:
            row = saved[kind][view.name]
            lens = Lens(**dict(zip(row["distortion"], _numbers([*row["distortion"].values()]))))
            (fx, fy), (cx, cy) = map(_numbers, (row["focal"], row["principal"]))
            width, height = map(int, row["size"])
            of = lambda key: Camera(np.reshape(_numbers(row[key]), (4, 4)), (fx, fy), (cx, cy), (width, height), lens)
            gain = np.reshape(_numbers(row["gain"]), 3) if exposure else None
            rows[view.name] = of("given"), Registered(of("to_world"), gain)
        return poses, exposure, rows
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise UserError(f"{path}: damaged, or not of these photographs ({error}): fit again") from error


def _numbers(value) -> list[float]:
    """What JSON has as a list, or a list of lists, of finite numbers. Raises: ValueError, TypeError."""
    numbers = np.array(value, float).ravel()
    if not np.isfinite(numbers).all():
        raise ValueError("a number is not finite")
    return numbers.tolist()


# ---- Figures ----


def summary(learned: "Cameras") -> dict[str, Any]:
    """Return how far training cameras are from the given ones, as metrics.json has it: median and greatest angle in degrees,
    way in units of the distance to what they look at, and shift of that in pixels; for each camera the change of focal
    lengths, the shift of the principal point (pixels) and distortion; the range of exposures in stops."""
    figures: dict[str, Any] = {}
    pairs = [(given, learned.camera(k)) for k, given in enumerate(learned.given)]
    if "poses" in learned.rows:
        trace = np.array([np.trace(a.rotation @ b.rotation.T) for a, b in pairs])
        ways = [np.linalg.norm(a.origin - b.origin) / np.linalg.norm(a.origin - learned.pivot) for a, b in pairs]
        shifts = [np.linalg.norm(b.project(learned.pivot[None])[0] - a.project(learned.pivot[None])[0]) for a, b in pairs]
        figures |= {
            "rotation_deg": _spread(np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))),
            "distance": _spread(ways),
            "pixels": _spread(shifts),
            "intrinsics": [
                _intrinsics(a, b) for a, b in {(a.focal, a.principal, a.size): (a, b) for a, b in pairs}.values()
            ],
        }
    if "exposure" in learned.rows:
        stops = np.log2([learned.gain(k) for k in range(len(pairs))])
        figures["exposure_ev"] = {"min": float(stops.min()), "max": float(stops.max())}
    return figures


def _spread(values) -> dict[str, float]:
    return {"median": float(np.median(values)), "max": float(np.max(values))}


def _intrinsics(given: Camera, camera: Camera) -> dict[str, Any]:
    assert camera.lens is not None, "cameras that are learned have one"
    return {
        "focal_change": [float(b / a - 1) for a, b in zip(given.focal, camera.focal)],
        "principal_shift": [float(b - a) for a, b in zip(given.principal, camera.principal)],
        "distortion": dict(zip(("k1", "k2", "p1", "p2"), camera.lens.coefficients)),
    }


def rows(figures: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return `summary` in words for the report: (what, value) in the order of a table."""
    pair = lambda name, form, unit="": "{} median, {} at most".format(
        *(f"{figures[name][k]:{form}}{unit}" for k in ("median", "max"))
    )
    table = []
    if "rotation_deg" in figures:
        table += [
            ("turned by", pair("rotation_deg", ".3f", "°")),
            ("moved by, in units of the distance", pair("distance", ".5f")),
            ("shift of what they look at, pixels", pair("pixels", ".2f")),
        ]
        for k, camera in enumerate(figures["intrinsics"]):
            of = f" of camera {k + 1}" if len(figures["intrinsics"]) > 1 else ""
            table += [
                (f"focal lengths{of}", ", ".join(f"{100 * v:+.3f} %" for v in camera["focal_change"])),
                (f"principal point{of}, pixels", ", ".join(f"{v:+.2f}" for v in camera["principal_shift"])),
                (f"distortion{of}", ", ".join(f"{name} {v:+.5f}" for name, v in camera["distortion"].items())),
            ]
    if "exposure_ev" in figures:
        table.append(("exposure, stops", "{min:+.2f} to {max:+.2f}".format(**figures["exposure_ev"])))
    return table

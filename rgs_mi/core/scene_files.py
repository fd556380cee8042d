"""Mitsuba scene files in, scenes out; what is wrong with a file in one line."""

import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path

import mitsuba as mi
import numpy as np

from .errors import UserError
from .film import Film
from .inputs import is_file

_PACKAGE = Path(__file__).parents[1]


def bundled(kind: str) -> dict[str, Path]:
    """name -> file of the scenes that come with the package. ``kind``: 'scenes', those to fit, or 'targets', those that
    photographs are path-traced from."""
    beside = _PACKAGE / "scenes"  # of an installed wheel; a clone has it beside the package
    folder = beside if beside.is_dir() else _PACKAGE.parent / "scenes"
    return {path.stem: path for path in sorted((folder / "targets" if kind == "targets" else folder).glob("*.xml"))}


def find_scene(name: str, kind: str) -> Path:
    """What an argument names: a path, or else one of those `bundled` with the package.

    Raises: UserError for a bare name that is neither.
    """
    path, known = Path(name), bundled(kind)
    if os.path.exists(path) or path.suffix or len(path.parts) > 1:
        return path
    if name not in known:
        raise UserError(f"no file or folder '{name}' here, and no scene of that name: choose one of {', '.join(known)}")
    return known[name]


def load_scene(path: str | Path, variables: Mapping[str, object]) -> "mi.Scene":
    """Load a scene file; ``variables`` override the scene's ``<default>``s. A variant must be active.

    Raises: UserError, in one line, for whatever is wrong with the scene.
    """
    if not is_file(path):
        raise UserError(f"no scene at {path}: check the path")
    _check_no_code(Path(path))
    try:
        # In parallel, surfels that wait for Dr.Jit may take over the reading of an EXR, whose own tasks wait for a thread that
        # waits for Python, to make another of our plugins: for ever.
        scene = mi.load_file(str(path), parallel=False, **{name: str(value) for name, value in variables.items()})
        _check_light(scene.environment())
        return scene
    except UserError:
        raise
    except Exception as error:  # Mitsuba wraps what a plugin raises, its traceback included
        text = str(error)
        if "UserError: " in text:
            text = text.rpartition("UserError: ")[2]
        text = " ".join(re.sub(r"\[\w+\.(cpp|h):\d+\] ", "", text).split())
        raise UserError(f"cannot load {path}: {text}") from error


def _check_light(emitter: "mi.Emitter | None") -> None:
    """What Mitsuba does not look at. Raises: ValueError for an ``emitter`` whose map has numbers that are not finite."""
    if emitter is not None and emitter.class_name() == "EnvironmentMapEmitter":
        if not np.isfinite(mi.traverse(emitter)["data"].numpy()).all():
            raise ValueError("its environment map holds NaN or infinity: export it again")


def _check_no_code(path):
    """Mitsuba takes the plugin of an unknown type from ``plugins/TYPE.so`` beside the scene, on the paths that this names, or in
    the current folder, and runs it. Raises: UserError where there is such code, which scenes of others might have brought."""
    try:
        named = [e.get("value") or "" for e in ET.parse(path).getroot().iter("path")]
    except (ET.ParseError, OSError):
        named = []  # Mitsuba says what is wrong
    for folder in dict.fromkeys([path.parent, Path(), *(path.parent / name for name in named)]):
        for found in (folder / "plugins").glob("*"):
            if found.suffix in (".so", ".dylib", ".dll") and os.path.isfile(found):
                raise UserError(
                    f"{found} is native code, which Mitsuba would run for {path}: move it, if you trust the scene"
                )


def film_of(scene: "mi.Scene") -> Film:
    """Return the film of the scene's first sensor, of as many samples per pixel as it asks for."""
    return Film.of(scene.sensors()[0].film().rfilter(), spp_of(scene))


def spp_of(scene: "mi.Scene") -> int:
    """Return the samples per pixel that the scene's first sensor asks for."""
    return scene.sensors()[0].sampler().sample_count()

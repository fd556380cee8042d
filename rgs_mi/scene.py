"""What there is to fit: a Mitsuba scene whose surfels name photographs, and the YAML beside it that says how."""

import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi

from .camera import Camera
from .config import load_config
from .errors import UserError
from .settings import Settings
from .shading.environment import Environment
from .truth import render_dataset
from .views import Dataset, load_dataset

RENDERED = Path("data")  # photographs of path-traced scenes are kept here, below the current folder
_ENVIRONMENTS = ("envmap", "procedural_envmap", "constant")


def load_scene(path, variables: dict):
    """``mi.load_file``. Raises: UserError, in one line, for whatever is wrong with the scene."""
    if not Path(path).is_file():
        raise UserError(f"no scene at {path}: check the path")
    try:
        return mi.load_file(str(path), **variables)
    except UserError:
        raise
    except Exception as error:  # Mitsuba wraps what a plugin raises, its traceback included
        text = str(error)
        if "UserError: " in text:
            text = text.rpartition("UserError: ")[2]
        text = " ".join(re.sub(r"\[\w+\.(cpp|h):\d+\] ", "", text).split())
        raise UserError(f"{path}: {text}") from error


def surfels_of(scene, path):
    """The scene's one `surfels` shape. Raises: UserError where there is none, or more."""
    found = [shape for shape in scene.shapes() if hasattr(shape, "photographs")]
    if len(found) != 1:
        raise UserError(f"{path}: has {len(found)} shapes of type 'surfels': a scene to fit has exactly one")
    return found[0]


def _parse(path):
    """The root element. Raises: UserError for what Mitsuba's parser forgives, as '--' in a comment."""
    try:
        return ET.parse(path).getroot()
    except ET.ParseError as error:
        raise UserError(f"{path}: malformed XML ({error}): fix it") from error


@dataclass(frozen=True)
class FitScene:
    """A scene to fit: the XML ``path`` and its ``root`` element, the ``variables`` it was loaded with, where its
    ``photographs`` are (a folder, or a scene to render them from), and the ``environment`` to start from."""

    path: Path
    root: ET.Element
    variables: dict
    photographs: Path
    environment: Environment

    @classmethod
    def load(cls, path, data=None, variables=None) -> "FitScene":
        """``data``: the scene's variable of that name, relative to the current folder (`None`: as the scene has it,
        relative to the scene).

        Raises: UserError for a scene that does not load, without photographs, or with a sensor that surfels can't take.
        """
        path, variables = Path(path), dict(variables or {})
        if data is not None:
            variables["data"] = str(Path(data).absolute())
        scene = load_scene(path, variables)
        photographs = surfels_of(scene, path).photographs
        if not photographs:
            raise UserError(f"{path}: no photographs are named: give a capture's folder with --data")
        for sensor in scene.sensors():
            Camera.from_sensor(sensor)
        if scene.environment() is None:
            raise UserError(f"{path}: has no 'envmap' or 'constant' emitter: it says where the fit of the light starts")
        root = _parse(path)
        if cls.surfels_element(root) is None or cls.emitter_element(root) is None:
            raise UserError(f"{path}: surfels and environment must stand in this file, not in one it includes")
        return cls(path, root, variables, Path(photographs), Environment.from_emitter(scene.environment()))

    @staticmethod
    def surfels_element(root):
        """The element of the surfels in the XML, or None."""
        return root.find("shape[@type='surfels']")

    @staticmethod
    def emitter_element(root):
        """The element of the environment in the XML, or None."""
        return next((e for e in root.findall("emitter") if e.get("type") in _ENVIRONMENTS), None)

    @property
    def name(self) -> str:
        """What a run is called: after the scene, or after the photographs where the scene fits any."""
        given = self.photographs
        if "data" not in self.variables:
            return self.path.stem
        return given.stem if given.suffix == ".xml" else given.name

    def settings(self, config=None, overrides=()) -> Settings:
        """Defaults, then the YAML beside the scene, ``config`` (a preset or file), and ``overrides`` ('a.b=value')."""
        beside = self.path.with_suffix(".yaml")
        sources = [beside.absolute()] if beside.is_file() else []
        return load_config(Settings, [*sources, *([config] if config else [])], overrides)

    def dataset(self, quiet=False) -> Dataset:
        """The photographs; those of a scene are path-traced on first use, which takes minutes."""
        folder = self.photographs
        if folder.suffix == ".xml":
            folder = render_dataset(folder, RENDERED / folder.stem, quiet=quiet)
        return load_dataset(folder)

"""What there is to fit: a Mitsuba scene whose surfels name photographs, and the YAML beside it that says how."""

import os
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..core.camera import Camera
from ..core.errors import UserError
from ..core.runtime import cache_folder
from ..core.scene_files import load_scene
from ..datasets import is_photographed, load_dataset
from ..datasets.path_traced import render_dataset
from ..datasets.resolution import LONGEST
from ..datasets.types import Dataset
from ..plugins import deferred_of, surfels_of
from ..settings.config import load_config
from ..settings.settings import Settings
from ..shading.environment import Environment
from ..shading.lighting import Shading

PHOTOGRAPHS = "photographs"  # the preset of what is photographed, not path-traced
_ENVIRONMENTS = ("envmap", "procedural_envmap", "constant")


def _parse(path):
    """The root element. Raises: UserError for what Mitsuba's parser forgives, as '--' in a comment."""
    try:
        return ET.parse(path).getroot()
    except ET.ParseError as error:
        raise UserError(f"{path}: malformed XML ({error}): fix it") from error


@dataclass(frozen=True)
class FitScene:
    """A scene to fit: the XML ``path`` and its ``root`` element, the ``variables`` it was loaded with, where its
    ``photographs`` are (a folder, or a scene to render them from), the ``environment`` to start from, and how it is
    shaded."""

    path: Path
    root: ET.Element
    variables: dict
    photographs: Path
    environment: Environment
    shading: Shading

    @classmethod
    def load(
        cls, path: str | Path, data: str | Path | None = None, variables: Mapping[str, object] | None = None
    ) -> "FitScene":
        """Load the scene file ``path``; ``data`` is its variable of that name, relative to the current folder (None: as the
        scene has it, relative to the scene).

        Raises: UserError for a scene that does not load, without photographs, or with a sensor that surfels can't take.
        """
        path, variables = Path(path), dict(variables or {})
        if data is not None:
            variables["data"] = str(Path(data).absolute())
        scene = load_scene(path, variables)
        surfels, integrator = surfels_of(scene, path), deferred_of(scene, path)
        if not surfels.photographs:
            raise UserError(f"{path}: no photographs are named: give a capture's folder with --data")
        for sensor in scene.sensors():
            Camera.from_sensor(sensor)
        if scene.environment() is None:
            raise UserError(f"{path}: has no 'envmap' or 'constant' emitter: it says where the fit of the light starts")
        root = _parse(path)
        if None in (cls.integrator_element(root), cls.surfels_element(root), cls.emitter_element(root)):
            raise UserError(f"{path}: integrator, surfels and environment must stand in this file, not in one it includes")
        return cls(
            path,
            root,
            variables,
            Path(surfels.photographs),
            Environment.from_emitter(scene.environment()),
            integrator.shading(surfels.eta),
        )

    @staticmethod
    def integrator_element(root: ET.Element) -> ET.Element | None:
        """Return the element of the integrator in the XML, or None."""
        return root.find("integrator[@type='rgs_deferred']")

    @staticmethod
    def surfels_element(root: ET.Element) -> ET.Element | None:
        """Return the element of the surfels in the XML, or None."""
        return root.find("shape[@type='surfels']")

    @staticmethod
    def emitter_element(root: ET.Element) -> ET.Element | None:
        """Return the element of the environment in the XML, or None."""
        return next((e for e in root.findall("emitter") if e.get("type") in _ENVIRONMENTS), None)

    @property
    def name(self) -> str:
        """What a run is called: after the scene, or after the photographs where the scene fits any."""
        given = self.photographs
        if "data" not in self.variables:
            return self.path.stem
        given = Path(os.path.normpath(given))  # 'captures/car/..' is called 'captures'
        return (given.stem if given.suffix == ".xml" else given.name) or self.path.stem

    def settings(self, config: str | Path | None = None, overrides: Sequence[str] = ()) -> Settings:
        """Return the settings: defaults, over them those of the preset `PHOTOGRAPHS` where it is photographs that are
        fitted, the YAML beside the scene, ``config`` (a preset or file), and ``overrides`` ('a.b=value'). Raises: UserError as
        `load_config` does."""
        beside = self.path.with_suffix(".yaml")
        sources = [PHOTOGRAPHS] if is_photographed(self.photographs) else []
        sources += [beside.absolute()] if beside.is_file() else []
        settings = load_config(Settings, [*sources, *([config] if config else [])], overrides)
        if settings.minutes is None and settings.iterations is None:
            raise UserError("settings: minutes and iterations are both null: give one of them, which bounds the fit")
        return settings

    def dataset(self, longest: int = LONGEST, quiet: bool = False) -> Dataset:
        """Return the photographs, scaled where they have more than ``longest`` pixels along a side; those of a scene are
        path-traced on first use, which takes minutes.

        Raises: UserError for photographs that can't be read.
        """
        folder = self.photographs
        if folder.suffix == ".xml":
            folder = render_dataset(folder, cache_folder(folder.stem), quiet=quiet)
        return load_dataset(folder, longest, quiet)

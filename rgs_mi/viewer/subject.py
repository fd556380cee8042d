"""What there is to see: surfels, how they are shaded, and under which light; edited and relit as a `Look` says."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import as_tensor
from ..core.camera import Camera, focus_point
from ..core.turntable import Turntable
from ..datasets.types import View
from ..export.relight import MATERIAL, about_vertical, edited
from ..plugins import is_deferred
from ..shading.environment import Environment, FilteredEnvironment
from ..shading.lighting import Lighting, Shading, lighting_of
from ..shading.shader import Shader
from ..surfels.proxies import Proxies
from ..surfels.surfels import Surfels
from .lights import Lights
from .look import OWN, Look

_KEPT = 6  # lightings: more windows that differ take turns


@dataclass
class Lit:
    """Surfels as a `Look` has them, the ``lighting`` that shades them (None: their own radiance alone), and the environment
    behind them (None: there is none)."""

    surfels: Surfels
    lighting: Lighting | None
    environment: FilteredEnvironment | None


@dataclass
class Subject:
    """A scene of surfels.

    surfels, shading, shader, lights   what `lighting_of` needs; without ``lights`` nothing is specular
    cameras   of the scene, in which it is first seen; there is one at least
    views     photographs of it, which may be none
    still     ``(scene, integrator)`` by which pictures at rest are rendered instead, a sample at a time: of a scene whose own
              integrator is another than 'rgs_deferred'
    """

    surfels: Surfels
    shading: Shading
    shader: Shader | None
    lights: Lights | None
    cameras: list[Camera]
    views: list[View] = field(default_factory=list)
    still: Any = None
    proxies: Proxies | None = None  # what reflected rays meet; made where it is needed
    irradiance_visibility: "mi.Color3f | None" = None  # under a light before
    changing: bool = False  # whether it is a fit in progress, which is never `settled`

    def __post_init__(self) -> None:
        self._arrays: dict[str, np.ndarray] = {}
        self._lit: dict[tuple, Lit] = {}
        self._bounds = np.percentile(dr.detach(self.surfels.centers).numpy(), (1, 99), axis=0)

    def forget(self) -> None:
        """Forget what was derived from surfels and lights that were replaced."""
        self._arrays, self._lit = {}, {}

    @classmethod
    def of(cls, scene: "mi.Scene", envmaps: Iterable[str | Path] = ()) -> "Subject":
        """Take what there is to see from a loaded ``scene``, with images ``envmaps`` to offer as lights.

        Raises: UserError where there are no surfels, or a file can't be read.
        """
        from ..plugins.surfels import surfels_in  # of the variant that is active now

        surfels, eta = surfels_in(scene)
        emitter, integrator = scene.environment(), scene.integrator()
        if deferred := is_deferred(integrator):
            shading, shader = integrator.shading(eta), integrator.shader
        else:
            lit = emitter is not None and getattr(integrator, "diffuse", "radiance") == "lit"
            diffuse, box = "lit" if lit else "radiance", getattr(integrator, "box", None)
            shading, shader = Shading("split_sum" if emitter else "none", diffuse, eta=eta, box=box), None
        lights = None
        if emitter and shading.specular != "none":
            own = replace(Environment.from_emitter(emitter), room=getattr(integrator, "room", None))
            lights = Lights(own, envmaps)
            lights.prepare(OWN)
        cameras = [Camera.from_sensor(sensor) for sensor in scene.sensors()] or [_in_front(surfels)]
        return cls(surfels, shading, shader, lights, cameras, still=None if deferred else (scene, integrator))

    def compare_with(self, views: Iterable[View]) -> None:
        """Take photographs of it, in whose place it is first seen."""
        self.views = list(views)
        self.cameras = [view.camera for view in self.views] or self.cameras

    # ---- Where it is ----

    @property
    def up(self) -> np.ndarray:
        """The up axis of its environment, unit vector [3] in world space; z where it has none."""
        return np.array([0, 0, 1.0]) if self.lights is None else self.lights.rotation[:, 1]

    @property
    def center(self) -> np.ndarray:
        """What the cameras look at, [3] in world space."""
        return focus_point(self.cameras)[0] if len(self.cameras) > 1 else self._bounds.mean(0)

    @property
    def radius(self) -> float:
        """About how far it reaches from its middle, world units."""
        return float(np.linalg.norm(np.ptp(self._bounds, axis=0)) / 2)

    def nearest(self, look: Look) -> View:
        """Return the photograph that ``look`` is through, or that from nearest to its camera that looks about the same way. There
        must be one."""

        def away(view):
            apart = np.linalg.norm(view.camera.origin - look.camera.origin) / max(self.radius, 1e-9)
            return apart + 1 - view.camera.to_world[:3, 2] @ look.camera.to_world[:3, 2]

        named = next((view for view in self.views if view.name == look.through), None)
        return named or min(self.views, key=away)

    # ---- How it is lit ----

    def lit(self, look: Look, settled: bool) -> Lit:
        """Return the surfels under the light of ``look``, with its materials. Where it is not ``settled`` yet, what is sampled is
        filtered instead, and what the object hides of a light is that of one before."""
        settled = settled and not self.changing
        key = look.light, look.rotate, look.brighten, look.changes(), settled and self._settles
        if key not in self._lit:
            while len(self._lit) >= _KEPT:
                self._lit.pop(next(iter(self._lit)))
            with dr.suspend_grad():
                self._lit[key] = self._make(look, settled)
        return self._lit[key]

    def turntable(self, look: Look) -> Turntable | None:
        """Return the turntable round which the light of ``look`` goes, None where it stands still."""
        return self.shading.turntable if look.light == OWN else None

    @property
    def _settles(self):
        """Whether a picture at rest has another lighting than one in motion."""
        hidden = self.shading.diffuse != "radiance" and self.shading.indirect != "none"
        return hidden or self.shading.specular == "monte_carlo"

    def _make(self, look, settled):
        surfels = self._edited(look)
        if self.lights is None:
            return Lit(surfels, None, None)
        environment = _turned(self.lights[look.light], look)
        shading = replace(self.shading, turntable=self.turntable(look))
        if shading.diffuse == "relightable" and shading.specular != "none" and look.changed:
            shading = replace(shading, diffuse="lit")
        sampled, emitter = shading.specular == "monte_carlo" and settled, None
        if shading.indirect != "none" and self.proxies is None:
            self.proxies = Proxies(self.surfels, box=shading.box)
        if sampled:
            emitter = environment.environment.emitter()
        elif shading.specular != "none":
            shading = replace(shading, specular="split_sum")
        lighting = lighting_of(
            shading,
            surfels,
            environment.environment.unfiltered() if sampled else environment,
            emitter,
            self.shader,
            proxies=self.proxies,
            irradiance_visibility=None if settled else self.irradiance_visibility,
        )
        if lighting is not None and lighting.indirect is not None and not sampled:
            self.irradiance_visibility = lighting.indirect.irradiance_visibility
        return Lit(surfels, lighting, environment)

    def _edited(self, look):
        """The surfels with the materials of ``look``, which lie in memory as what is edited does: kernels know the difference."""
        if not self._arrays:
            self._arrays = {name: dr.detach(getattr(self.surfels, name)).numpy() for name in ("centers", *MATERIAL)}
        materials = self._arrays | edited(self._arrays, look.changes())
        return replace(self.surfels, **{name: as_tensor(materials[name]) for name in MATERIAL})


def _turned(light, look):
    """A `FilteredEnvironment`, turned and brightened."""
    own, gain = light.environment, dr.opaque(mi.Float, 2.0**look.brighten)
    environment = replace(own, rotation=own.rotation @ about_vertical(look.rotate), texels=own.texels * gain)
    return replace(light, texels=light.texels * gain, environment=environment)


def _in_front(surfels):
    """A camera that sees all of the surfels, from a side."""
    centers = dr.detach(surfels.centers).numpy()
    low, high = np.percentile(centers, (1, 99), axis=0)
    middle, reach = (low + high) / 2, float(np.linalg.norm(high - low))
    return Camera.look_at(middle + 1.5 * reach * np.array([1, 0.5, 0.5]) / 1.5**0.5, middle, [0, 0, 1], 40, (400, 400))

"""What a fit does when: functions of `Settings` and of progress, the spent part of the budget in [0, 1]."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from ..settings.settings import Settings, Stage
from ..shading.lighting import Shading
from .model import ENVIRONMENT, ROOM, SHADER, SPECULAR

#: The field of `LearningRates` that each parameter of a `Model` obeys.
_RATES = {
    "centers": "centers",
    "rotations": "rotations",
    "log_scales": "scales",
    "logit_opacities": "opacities",
    "sh_dc": "sh_dc",
    "sh_rest": "sh_rest",
    "logit_base_color": "base_color",
    "logit_roughness": "roughness",
    "logit_metallic": "metallic",
    "delta_normal": "delta_normal",
    "curvature": "curvature",
    ENVIRONMENT: "environment",
    SHADER: "shader",
    ROOM: "room",
    SPECULAR: "specular",
}
_RADIANCE, _RELIT = (
    ("sh_dc", "sh_rest"),
    ("logit_base_color", "logit_metallic"),
)  # what lit surfels show nothing of, and most
_NORMALS, _HELD = ("rotations", "delta_normal", "curvature"), 0.1  # the part of their rates that they have at first
# A mirror ball, its radius r 3/8 of the picture, turns what its middle reflects by 2/r a pixel: π r/2 rows are told apart
_ROWS_A_PIXEL, _MOST_ROWS = 3 * np.pi / 16, 512


@dataclass(frozen=True)
class Schedule:
    """The plan of a fit under ``settings`` whose end result is shaded as ``final`` says, reflections included."""

    settings: Settings
    final: Shading

    @classmethod
    def of(cls, settings: Settings, shading: Shading) -> "Schedule":
        """The schedule of a fit to a scene that is shaded as ``shading`` says: ``settings`` decide on ``indirect``, and on
        whether anything is specular at all."""
        if settings.specular_start >= 1:
            return cls(settings, replace(shading, specular="none", diffuse="radiance", indirect="none"))
        return cls(settings, replace(shading, indirect=settings.indirect))

    def progress(self, steps: int, seconds: float) -> float:
        """The part of the budget that ``steps`` done in ``seconds`` have spent, in [0, 1]."""
        s = self.settings
        if s.iterations is not None:
            return min(1.0, steps / s.iterations)
        assert s.minutes is not None, "FitScene.settings refuses settings that have neither"
        return min(1.0, seconds / (60 * s.minutes))

    def stage(self, progress: float) -> Stage:
        """The level of the pyramid in use."""
        stages = self.settings.stages
        assert stages, "`plan.planned` gives them"
        return next((stage for stage in stages if progress < stage.until), stages[-1])

    def sh_order(self, progress: float) -> int:
        """The order of spherical harmonics in use: one more in each of equal parts of what follows ``sh_start``."""
        s = self.settings
        if s.sh_order == 0 or progress < s.sh_start:
            return 0
        return min(s.sh_order, 1 + int((progress - s.sh_start) / (1 - s.sh_start + 1e-9) * s.sh_order))

    def shading(self, progress: float) -> Shading:
        """How the model is shaded by then: nothing specular before ``specular_start``, unless the light makes the diffuse
        radiance, too; no light sampled before ``monte_carlo_start``; no indirect light before ``indirect_start``."""
        s, final = self.settings, self.final
        if final.diffuse != "lit" and progress < s.specular_start:
            return replace(final, specular="none", indirect="none")
        early = final.specular == "monte_carlo" and progress < s.monte_carlo_start
        specular = "split_sum" if early else final.specular
        indirect = "none" if specular == "none" or progress < s.indirect_start else final.indirect
        return replace(final, specular=specular, indirect=indirect)

    def explains(self, progress: float) -> bool:
        """Return whether base colors are held to explain the surfels' own diffuse radiance by then, so that it can be relit: once
        they reflect each other, and until photographs themselves are explained (`relights`)."""
        s = self.settings
        return s.weights.residual > 0 and s.indirect_start <= progress < s.relit[0] and self._relightable(progress)

    def relights(self, progress: float) -> bool:
        """Return whether a step sees the surfels as another light would show them: lit, their own radiance put aside."""
        s = self.settings
        return s.relit[0] <= progress < s.relit[1] and self._relightable(progress)

    def _relightable(self, progress):
        """Whether base colors are to be what another light would show, and nothing samples the light, which has noise."""
        shading = self.shading(progress)
        return shading.diffuse == "relightable" and shading.specular == "split_sum"

    def value(self, pair: tuple[float, float], progress: float) -> float:
        """Of a (first, last) ``pair``: geometrically between them, linearly from or to zero."""
        first, last = pair
        if min(first, last) <= 0:
            return first + (last - first) * progress
        return first * (last / first) ** progress

    def learning_rates(self, names: Iterable[str], progress: float, extent: float, two_sided: bool) -> dict[str, float]:
        """Adam's rate of each of the parameters ``names``; positions are in units of ``extent``, the object's radius."""
        s = self.settings
        rates = {name: self.value(getattr(s.learning_rates, _RATES[name]), progress) for name in names}
        rates["centers"] *= extent
        if progress < s.refine_start:  # a light that is a blur yet would take its shape from them: all walls come near
            rates |= {name: 0.0 for name in (ROOM, SPECULAR) if name in rates}
        # A light that has no shape yet would turn normals that the hull has right. Two-sided surfels began at random.
        if progress < s.normals_start and not two_sided:
            rates |= {name: _HELD * rates[name] for name in _NORMALS}
        held: tuple = ()
        if self.relights(progress):
            held = _RADIANCE  # Adam would go on as before
        elif s.relit[0] < s.relit[1] <= progress and self._relightable(progress):
            held = _RELIT  # the radiance makes up for what these have become
        rates |= {name: 0.0 for name in held if name in rates}
        return {name: rate * self._cooled(progress) for name, rate in rates.items()}

    def camera_rates(self, progress: float, pixel: float) -> dict[str, float]:
        """Adam's rate of each kind of `fit.cameras.Cameras.rows`; a ``pixel`` of the images in use is so many radians."""
        rates, unit = self.settings.learning_rates, {"poses": pixel}
        return {
            name: self.value(getattr(rates, name), progress) * unit.get(name, 1) * self._cooled(progress)
            for name in ("poses", "intrinsics", "exposure")
        }

    def turn_rate(self, progress: float) -> float:
        """Adam's rate of the turns of a turntable's rings, radians."""
        return self.value(self.settings.learning_rates.turns, progress) * self._cooled(progress)

    def _cooled(self, progress):
        """The part that rates have of themselves in the end. Adam's steps are as long as its rates, however little there is to
        gain: what is right trembles to the last."""
        s = self.settings
        return (1 - progress) / s.cooldown if progress > 1 - s.cooldown else 1.0

    def learns_cameras(self, progress: float) -> bool:
        """Whether cameras that are learned have begun to move."""
        return progress >= self.settings.cameras_start

    def envmap_height(self, progress: float, height: int, width: int) -> int:
        """Rows that an environment of ``height`` rows should have by then: twice as many, and twice again, up to
        `_MOST_ROWS`, while photographs ``width`` pixels wide tell more apart. One that is not learned keeps its own."""
        s = self.settings
        if progress >= s.refine_start and any(s.learning_rates.environment):
            while 2 * height <= _MOST_ROWS and np.sqrt(2) * height < _ROWS_A_PIXEL * width:
                height *= 2
        return height

    def refines(self, step: int) -> bool:
        """Whether density statistics end with this ``step``."""
        return step % self.settings.density.refine_every == 0

    def surfel_budget(self, progress: float) -> int | None:
        """How many surfels density control may leave; None where it does not run. The budget opens gradually: what is spent
        early goes where the coarse images, not the fine ones, need it."""
        d = self.settings.density
        if not d.start <= progress < d.stop:
            return None
        opened = (progress - d.start) / (d.stop - d.start)
        first, last = self.settings.initialization.surfels, d.max_surfels
        assert first and last, "`plan.planned` gives them"
        return int(first + opened * (last - first))

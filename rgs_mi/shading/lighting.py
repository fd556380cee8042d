"""How surfels are shaded, and the lighting that does it: what fits and the integrator `rgs_deferred` both build."""

from dataclasses import dataclass, replace
from typing import Literal

import drjit as dr
import mitsuba as mi

from ..core.bounding_box import BoundingBox
from ..core.camera import Camera
from ..core.turntable import Turntable
from ..surfels.proxies import Proxies
from ..surfels.surfels import SurfelColumns
from .environment import FilteredEnvironment, IncidentRadiance
from .indirect import Indirect
from .monte_carlo import SAMPLES, MonteCarlo
from .shader import Shader
from .split_sum import DEFAULT_ETA, SplitSum
from .surface import Surface

# Roughness up to which a surface with a radiance of its own reflects the other surfels wholly, and from which on not at all:
# what it receives of them is blurred then, and already in that radiance.
_NARROW, _WIDE = 0.2, 0.4


@dataclass(frozen=True)
class Shading:
    """How a scene is shaded, as the parameters of its integrator `rgs_deferred` say; ``eta`` is the surfels' index of
    refraction, ``box`` says where all this holds (None: everywhere), and ``turntable`` on which the object turns under its light
    (None: it stands still)."""

    specular: Literal["none", "split_sum", "monte_carlo"] = "split_sum"
    diffuse: Literal["radiance", "relightable", "lit"] = "radiance"
    samples: int = SAMPLES
    eta: float = DEFAULT_ETA
    box: BoundingBox | None = None
    indirect: Literal["none", "visibility", "one_bounce"] = "none"
    turntable: Turntable | None = None


@dataclass
class Lighting:
    """What surfels reflect, and how.

    estimator  estimates the BSDF's integrals, and holds the environment
    shader     f_φ (None: the identity)
    indirect   says how surfels reflect each other (None: they do not)
    lit        whether their diffuse radiance, too, is that of their base colour under the light, and not their own
    box        where all this holds (None: everywhere); beyond it they have their own diffuse radiance alone
    turntable  on which they turn under the light, so that it depends on the camera how that stands to them (None: it does not)
    turn       of the turntable's ring that the camera is in, radians, in place of its own (None: its own)
    """

    estimator: SplitSum | MonteCarlo
    shader: Shader | None = None
    indirect: Indirect | None = None
    lit: bool = False
    box: BoundingBox | None = None
    turntable: Turntable | None = None
    turn: "mi.Float | None" = None

    def seen_by(self, camera: Camera, width: int) -> "Lighting":
        """Return the lighting as it stands to the surfels when ``camera`` sees them, for a kernel of this ``width``; see
        `Turntable.to_lamps`."""
        if self.turntable is None:
            return self
        return self._turned(self.turntable.to_lamps(camera, width, self.turn))

    def _turned(self, turn):
        return replace(self, estimator=replace(self.estimator, environment=self.estimator.environment.turned(turn)))

    def turned(self, angle: "mi.Float") -> "Lighting":
        """Return the lighting as it stands to the surfels for cameras at azimuths ``angle``, radians; see `Turntable.turned`."""
        return self if self.turntable is None else self._turned(self.turntable.turned(angle))

    @property
    def near(self) -> bool:
        """Whether it depends on where a `Surface` is what it reflects, so that it needs its ``point``."""
        return self.indirect is not None or self.estimator.environment.environment.room is not None

    def specular(self, surface: Surface) -> "mi.Color3f":
        """Return f_φ(C_s), linear radiance that a `Surface` reflects towards its ``view``; see `SplitSum.specular`."""
        C_s = self.estimator.specular(surface, self._incident_radiance(surface))
        return C_s if self.shader is None else self.shader(C_s, surface.roughness, surface.cosine)

    def diffuse(self, surface: Surface, irradiance_visibility: "mi.Color3f | float" = 1) -> "mi.Color3f":
        """Return C_d of a lit `Surface`, as `specular` does C_s; ``irradiance_visibility`` is a of (9) in `indirect.py`."""
        return self.estimator.diffuse(surface, self._incident_radiance(surface), irradiance_visibility)

    def radiance(
        self,
        surfels: SurfelColumns,
        uv: "mi.Point2f",
        view: "mi.Vector3f",
        irradiance_visibility: "mi.Color3f | float" = 1,
    ) -> "mi.Color3f":
        """Return the linear radiance that each of the ``surfels`` sends along its unit ``view``, in world space, from ``uv``
        on it, in standard deviations from its center: C_d + f_φ(C_s), or in places out of the `box` its own alone."""
        own = surfels.radiance(-view)
        if self.box is None:
            return self._reflected(surfels, uv, view, own, irradiance_visibility)
        inside = dr.compress(self.box.contains(surfels.column(mi.Point3f, "centers")))
        if dr.width(inside) > 0:
            at = lambda v: v if isinstance(v, int) else dr.gather(type(v), v, inside)
            part = self._reflected(surfels.take(inside), *map(at, (uv, view, own, irradiance_visibility)))
            dr.scatter(own, part, inside)
        return own

    def _reflected(self, surfels, uv, view, own, irradiance_visibility):
        """`radiance` of surfels in the box, whose diffuse radiance is their ``own`` where they are not lit."""
        surface = self._surface(surfels, view, uv)
        diffuse = self.diffuse(surface, irradiance_visibility) if self.lit else own
        return diffuse + self.specular(surface)

    def _surface(self, surfels, view, uv=None):
        """What the ``surfels`` are where they are seen, or at their centers."""
        normal = surfels.normals(uv)
        if surfels.two_sided:
            normal = dr.mulsign(normal, dr.dot(view, normal))
        point = surfels.column(mi.Point3f, "centers") if uv is None else surfels.points(uv)
        return Surface(
            normal,
            view,
            surfels.column(mi.Float, "roughness"),
            surfels.column(mi.Float, "metallic"),
            surfels.column(mi.Color3f, "base_color"),
            point if self.near else None,
        )

    def lit_radiance(self, surfels: SurfelColumns, view: "mi.Vector3f") -> "mi.Color3f":
        """Return the diffuse radiance that each of the ``surfels`` would send along its unit ``view``, in world space, if it were
        lit: what its base color reflects of the light."""
        visibility = None if self.indirect is None else self.indirect.visibility_of(surfels)
        return self.estimator.diffuse(self._surface(surfels, view), None, 1 if visibility is None else visibility)

    def _incident_radiance(self, surface) -> IncidentRadiance | None:
        """The callback for a surface; None where it reflects the environment alone."""
        indirect = self.indirect
        if indirect is None:
            return None

        def incident_radiance(light, direction, index):
            at = lambda v: v if index is None else dr.gather(type(v), v, index)
            part = 1 if self.lit else dr.clip((_WIDE - at(surface.roughness)) / (_WIDE - _NARROW), 0, 1)
            return indirect.incident_radiance(light, at(surface.point), at(surface.normal), direction, self, part)

        return incident_radiance

    @property
    def _with_visibility(self) -> Indirect | None:
        """`indirect` where lit diffuse light has an irradiance visibility."""
        known = self.lit and self.indirect is not None and self.indirect.irradiance_visibility is not None
        return self.indirect if known else None

    def with_irradiance_visibility(self, seed: "mi.UInt32 | int" = 0) -> "Lighting":
        """Return the same lighting with the part of its own light that the object hides from itself; see
        `Indirect.with_irradiance_visibility`. It must have `indirect`."""
        assert self.indirect is not None, "nothing hides light where surfels do not reflect each other"
        return replace(self, indirect=self.indirect.with_irradiance_visibility(self, dr.opaque(mi.UInt32, seed)))

    def as_splatted(self, surfels: SurfelColumns) -> SurfelColumns:
        """Return the surfels to splat: what is lit has no radiance of its own, but its irradiance visibility in its place."""
        indirect = self._with_visibility
        return surfels if indirect is None else indirect.with_visibility_as_radiance(surfels, self.box)

    def irradiance_visibility(self, radiance: "mi.Color3f") -> "mi.Color3f | float":
        """Return the irradiance visibility where surfels `as_splatted` have this ``radiance``."""
        return 1 if self._with_visibility is None else radiance

    def for_secondary_bounce(self) -> "Lighting":
        """Return the lighting of what a reflected ray meets, which lies in the box: it reflects the environment alone."""
        return replace(self, estimator=self.estimator.for_secondary_bounce(), indirect=None, box=None)

    def learned(self) -> list:
        """Return the arrays that a fit changes: those of the estimator, the environment's texels as it has them first, and the
        weights of the shader where there is one."""
        return [*self.estimator.learned(), *([self.shader.weights] if self.shader else [])]

    def with_learned(self, arrays: list) -> "Lighting":
        """Return the same lighting with other ``arrays`` in place of `learned`."""
        shader = self.shader and Shader(arrays[-1])
        return replace(self, estimator=self.estimator.with_learned(arrays), shader=shader)


def lighting_of(
    shading: Shading,
    surfels: SurfelColumns,
    environment: FilteredEnvironment | None,
    emitter: "mi.Emitter | None" = None,
    shader: Shader | None = None,
    seed: int = 0,
    proxies: Proxies | None = None,
    irradiance_visibility: "mi.Color3f | None" = None,
    paired: bool = False,
    learned_specular: "mi.Float | None" = None,
) -> Lighting | None:
    """The `Lighting` of ``surfels`` that are shaded as ``shading`` says; None where it says that nothing is specular.

    Args:
      environment: None only where nothing is specular; filtered for ``split_sum``, unfiltered for ``monte_carlo``
      emitter: Mitsuba's, whose sampling ``monte_carlo`` uses
      shader:  f_φ; None is the identity
      seed:    of what is random: samples of ``monte_carlo``, rays of irradiance visibility
      proxies: what reflected rays meet; None builds them of ``surfels``
      irradiance_visibility: a of (9), one entry per surfel; None computes it where it is needed
      paired:  see `MonteCarlo`
      learned_specular: see `SplitSum`
    """
    if shading.specular == "none":
        return None
    assert environment is not None
    lit, sampled = shading.diffuse == "lit", shading.specular == "monte_carlo"
    estimator = SplitSum(environment, shading.eta, learned_specular=learned_specular)
    if sampled:
        random = dr.opaque(mi.UInt32, seed)
        estimator = MonteCarlo(environment, emitter, shading.eta, shading.samples, random, paired)
    indirect = None
    if shading.indirect != "none":
        proxies = Proxies(surfels, box=shading.box) if proxies is None else proxies
        indirect = Indirect(shading.indirect, proxies, surfels, irradiance_visibility)
    lighting = Lighting(estimator, shader, indirect, lit, shading.box, shading.turntable)
    # Where the light is sampled, its rays say by themselves what is hidden
    needs_visibility = lit and indirect is not None and not sampled and irradiance_visibility is None
    return lighting.with_irradiance_visibility(seed) if needs_visibility else lighting

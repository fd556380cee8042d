"""The lighting of a scene, from how it is shaded: what fits and the integrator `rgs_deferred` both build."""

import drjit as dr
import mitsuba as mi

from ..surfels.proxies import Proxies
from ..surfels.surfels import Surfels
from .deferred import Lighting, Shading
from .environment import FilteredEnvironment
from .indirect import Indirect
from .monte_carlo import MonteCarlo
from .shader import Shader
from .split_sum import SplitSum


def lighting_of(
    shading: Shading,
    surfels: Surfels,
    environment: FilteredEnvironment | None,
    emitter: "mi.Emitter | None" = None,
    shader: Shader | None = None,
    seed: int = 0,
    proxies: Proxies | None = None,
    irradiance_visibility: "mi.Color3f | None" = None,
    paired: bool = False,
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
    """
    if shading.specular == "none":
        return None
    assert environment is not None
    lit, sampled = shading.diffuse == "lit", shading.specular == "monte_carlo"
    estimator = SplitSum(environment, shading.eta)
    if sampled:
        random = dr.opaque(mi.UInt32, seed)
        estimator = MonteCarlo(environment, emitter, shading.eta, shading.samples, random, paired)
    indirect = None
    if shading.indirect != "none":
        proxies = Proxies(surfels, box=shading.box) if proxies is None else proxies
        indirect = Indirect(shading.indirect, proxies, surfels, irradiance_visibility)
    lighting = Lighting(estimator, shader, indirect, lit, shading.box)
    # Where the light is sampled, its rays say by themselves what is hidden
    needs_visibility = lit and indirect is not None and not sampled and irradiance_visibility is None
    return lighting.with_irradiance_visibility(seed) if needs_visibility else lighting

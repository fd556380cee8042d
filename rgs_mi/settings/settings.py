"""How to fit: every number of the schedule, with defaults that suit two CPU cores. YAML files and --set change them."""

from dataclasses import dataclass, field
from typing import Any, Literal

_SURFELS, _SURFELS_A_MINUTE = 50_000, 5_000


def _within(default, low, high):
    return field(default=default, metadata={"min": low, "max": high})


@dataclass(frozen=True)
class Stage:
    """One level of the coarse-to-fine pyramid, used until that fraction of the fit is done."""

    until: float = _within(1.0, 0, 1)
    downscale: int = _within(1, 1, 64)  # of the photographs
    views: int = _within(1, 1, 256)  # rendered per step; their losses are averaged (MVGS)


@dataclass(frozen=True)
class Initialization:
    """Where the fit begins."""

    surfels: int = _within(25_000, 1, 10_000_000)
    hull: bool = True  # on the visual hull, where photographs have masks; else on the data set's points, or at random
    carve: bool = True  # that hull less what photographs look through (`priors.stereo`)
    scale: float = _within(0.8, 0.01, 10)  # standard deviation over the distance to the neighbours
    opacity: float | None = _within(None, 0.001, 0.999)  # unless given: 0.1 at random points, else 0.7
    roughness: float = _within(0.3, 0, 1)
    surroundings: int = _within(5_000, 0, 1_000_000)  # more surfels far away, where photographs have no masks


@dataclass(frozen=True)
class LearningRates:
    """Adam's learning rates: the first and the last, joined geometrically. Positions are in units of the object."""

    centers: tuple[float, float] = (5e-4, 1e-5)
    rotations: tuple[float, float] = (2e-3, 2e-4)
    scales: tuple[float, float] = (1e-2, 2e-3)
    opacities: tuple[float, float] = (5e-2, 1e-2)
    sh_dc: tuple[float, float] = (1e-2, 1e-3)
    sh_rest: tuple[float, float] = (1e-3, 1e-4)
    base_color: tuple[float, float] = (1e-1, 2e-2)
    roughness: tuple[float, float] = (1e-1, 2e-2)
    metallic: tuple[float, float] = (1e-1, 2e-2)
    delta_normal: tuple[float, float] = (1e-3, 1e-4)
    curvature: tuple[float, float] = (2e-3, 2e-4)
    environment: tuple[float, float] = (6e-2, 5e-3)
    shader: tuple[float, float] = (1e-2, 1e-3)


@dataclass(frozen=True)
class Weights:
    """Weights of the losses."""

    dssim: float = _within(0.2, 0, 1)  # of D-SSIM against L1
    mask: float = _within(0.1, 0, 1e3)
    # depth-normal consistency (2DGS), first and last, joined geometrically: early on it would hold the surface back
    consistency: tuple[float, float] = _within((0.05, 0.6), 0, 1e3)
    distortion: float = _within(0.0, 0, 1e6)  # of the surfels along a ray (2DGS)
    normal: float = _within(0.1, 0, 1e3)  # smoothness of the normals of what is reflective (RGS, L_normal)
    crease: float = _within(0.1, 0, 1e3)  # difference of unit normals from pixel to pixel that it lets be; 0: none
    minimum_variation: float = _within(30.0, 0, 1e6)  # change of curvature where what is reflective is smooth
    delta_normal: float = _within(0.0, 0, 1e3)  # length of the normals' residuals (RGS, L_Δn)
    depth: float = _within(1e-3, 0, 1e3)  # correlation with the depth prior (RGS, L_depth)
    environment_tv: float = _within(
        1e-5, 0, 1e3
    )  # total variation of the environment: what nothing reflects sharply stays smooth


@dataclass(frozen=True)
class Prior:
    """Where the depth prior of the photographs comes from, and the options of its function (`priors`)."""

    name: Literal["hull", "stereo", "files", "vggt", "none"] = "none"
    options: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Density:
    """Adaptive density control (2DGS)."""

    start: float = _within(0.08, 0, 1)  # fraction of the fit
    stop: float = _within(0.6, 0, 1)
    refine_every: int = _within(100, 1, 100_000)  # steps
    grow_grad2d: float = _within(1e-4, 0, 1)  # positional gradient in NDC units; half of 2DGS's: rather many surfels
    grow_scale3d: float = _within(0.01, 0, 1)  # surfels smaller than this (in units of the object) are cloned, others split
    prune_opacity: float = _within(0.05, 0, 1)
    max_surfels: int | None = _within(None, 1, 10_000_000)  # unless given: see `Settings.max_surfels`
    guided: bool = False  # half the threshold where two views or more see something reflective (RGS, Algorithm 1)


@dataclass(frozen=True)
class Settings:
    """All of the above. Exactly one of ``minutes`` and ``iterations`` bounds the fit; `--minutes` sets the former."""

    minutes: float | None = _within(8.0, 0.01, 100_000)
    iterations: int | None = _within(None, 1, 10_000_000)
    seed: int = _within(0, 0, 2**31)
    spp: int = _within(4, 1, 64)  # samples per pixel of what a fit leaves behind, on a grid; its steps take one
    background: float = _within(1.0, 0, 1)  # display grey level behind masked objects, in training and in figures
    specular_start: float = _within(0.0, 0, 1)  # fraction of the fit from which reflections are shaded; 1: never
    # Fraction of the fit from which the normals of a start on the hull move at their rates; before, at a tenth of them
    normals_start: float = _within(0.2, 0, 1)
    cooldown: float = _within(0.05, 0, 1)  # the last fraction of the fit, in which all rates fall to zero
    # Lower and upper corner of the box around the object, in captures without masks: what reflects. Unless given, it is
    # half as far from the point that the cameras look at as the nearest of them
    box: tuple[float, float, float, float, float, float] | None = None
    reflective: float = _within(0.9, 0, 1)  # the fraction of a view's foreground, smoothest first, that is reflective
    # Fraction of the fit from which a learned environment has the rows that photographs tell apart, by doubling, up to 512
    refine_start: float = _within(0.5, 0, 1)
    shader: Literal["identity", "mlp"] = "identity"  # f_φ of C = C_d + f_φ(C_s): nothing, or a tiny network trained along
    indirect: Literal["none", "visibility", "one_bounce"] = "one_bounce"  # what reflected rays that meet surfels bring
    indirect_start: float = _within(0.1, 0, 1)  # fraction of the fit from which they are traced
    # Where the scene's integrator asks for monte_carlo: the fraction of the fit from which it takes over from split_sum, and
    # its samples a pixel
    monte_carlo_start: float = _within(0.8, 0, 1)
    monte_carlo_samples: int = _within(4, 1, 4096)
    sh_order: int = _within(2, 0, 3)
    sh_start: float = _within(0.4, 0, 1)  # fraction of the fit from which view-dependent diffuse is learned
    checkpoint_seconds: float = _within(20, 0, 1e6)
    stages: tuple[Stage, ...] = (Stage(0.2, 2, 1), Stage(1.0, 1, 1))
    initialization: Initialization = Initialization()
    learning_rates: LearningRates = LearningRates()
    weights: Weights = Weights()
    prior: Prior = Prior()
    density: Density = Density()

    @property
    def max_surfels(self) -> int:
        """How many surfels a fit may have: unless it is given, as many as it has time for."""
        return self.density.max_surfels or max(_SURFELS, int(_SURFELS_A_MINUTE * (self.minutes or 0)))

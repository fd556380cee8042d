"""How to fit: every number of the schedule, with defaults that suit two CPU cores. YAML files and --set change them.

The models say all there is to say about a setting: its type, default, range and meaning. Reading (`config`), ``--help`` and
the documentation take it from here.
"""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, ConfigDict, Field
from pydantic.dataclasses import dataclass

_MODEL = ConfigDict(extra="forbid", allow_inf_nan=False)


def _in_order(period: tuple[float, float]) -> tuple[float, float]:
    if period[0] > period[1]:
        raise ValueError(f"must not end before it begins; got [{period[0]:g}, {period[1]:g}]")
    return period


#: A learning rate at the beginning and at the end, joined geometrically.
Rates = tuple[Annotated[float, Field(ge=0, le=10)], Annotated[float, Field(ge=0, le=10)]]
#: A part of the fit.
Fraction = Annotated[float, Field(ge=0, le=1)]
#: From which to which part of the fit.
Period = Annotated[tuple[Fraction, Fraction], AfterValidator(_in_order)]
#: How far a wall of a room is, in radii of the object.
Wall = Annotated[float, Field(gt=0, le=1e6)]
#: A weight at the beginning and at the end, joined geometrically.
WeightPair = tuple[Annotated[float, Field(ge=0, le=1e3)], Annotated[float, Field(ge=0, le=1e3)]]


@dataclass(frozen=True, config=_MODEL)
class Stage:
    """One level of the coarse-to-fine pyramid."""

    until: float = Field(default=1.0, ge=0, le=1, description="The stage lasts until this fraction of the fit is done.")
    downscale: int = Field(default=1, ge=1, le=64, description="Photographs are this many times smaller.")
    views: int = Field(
        default=1, ge=1, le=256, description="So many views are rendered per step; losses are averaged (MVGS)."
    )
    spp: int = Field(default=1, ge=1, le=16, description="Samples per pixel of a step, on a grid.")


@dataclass(frozen=True, config=_MODEL)
class Initialization:
    """Where the fit begins."""

    surfels: int | None = Field(
        default=None,
        ge=1,
        le=10_000_000,
        description="The fit starts with so many surfels; unless given, half of `density.max_surfels`, or three quarters where "
        "photographs have no masks; 25,000 at least.",
    )
    hull: bool = Field(
        default=True,
        description="Surfels start on the visual hull where photographs have masks, else on the data set's points, or at random.",
    )
    compare: bool = Field(
        default=True,
        description="Photographs are compared first: surfels start where they agree on a depth, and not where they look through "
        "the hull.",
    )
    foreground: bool = Field(
        default=True,
        description="Where photographs have no masks, a short fit tells what they show of an object, above the ground; if that "
        "mirrors, so that they agree on depths deep within it, surfels start on its visual hull.",
    )
    silhouettes: bool = Field(
        default=True,
        description="Where cameras are learned, poses begin where the photographs' masks agree, if they agree much better there "
        "than as they are given.",
    )
    scale: float = Field(
        default=0.8, ge=0.01, le=10, description="Standard deviation of a surfel over the distance to its neighbours."
    )
    opacity: float | None = Field(
        default=None,
        ge=0.001,
        le=0.999,
        description="Opacity of all surfels. Unless given, it is 0.1 at random points, else 0.7.",
    )
    roughness: float = Field(default=0.3, ge=0, le=1, description="Roughness of all surfels.")
    two_sided: bool = Field(
        default=False,
        description="Surfels show from behind, too, so that those that turn away while they are fitted are not lost. Those of an "
        "object among surroundings, and those that face anywhere at first, always do.",
    )
    surroundings: int = Field(
        default=5_000, ge=0, le=1_000_000, description="So many more surfels lie far away where photographs have no masks."
    )


@dataclass(frozen=True, config=_MODEL)
class LearningRates:
    """Adam's learning rates: the first and the last, joined geometrically. Positions are in units of the object."""

    centers: Rates = Field(default=(5e-4, 1e-5), description="Of the positions.")
    rotations: Rates = Field(default=(2e-3, 2e-4), description="Of the orientations.")
    scales: Rates = Field(default=(1e-2, 2e-3), description="Of the standard deviations.")
    opacities: Rates = Field(default=(5e-2, 1e-2), description="Of the opacities.")
    sh_dc: Rates = Field(default=(1e-2, 1e-3), description="Of the diffuse radiance, its mean over directions.")
    sh_rest: Rates = Field(default=(1e-3, 1e-4), description="Of the diffuse radiance, what varies with direction.")
    base_color: Rates = Field(default=(1e-1, 2e-2), description="Of the base colours.")
    roughness: Rates = Field(default=(1e-1, 2e-2), description="Of the roughness.")
    metallic: Rates = Field(default=(1e-1, 2e-2), description="Of how metallic surfels are.")
    delta_normal: Rates = Field(default=(1e-3, 1e-4), description="Of the normals' residuals (RGS, Δn).")
    curvature: Rates = Field(default=(2e-3, 2e-4), description="Of the curvatures; 0 leaves every surfel one normal.")
    environment: Rates = Field(default=(6e-2, 5e-3), description="Of the environment's texels.")
    shader: Rates = Field(default=(1e-2, 1e-3), description="Of the network of `shader`.")
    room: Rates = Field(default=(2e-2, 1e-3), description="Of the distances of the room's walls, their logarithms.")
    specular: Rates = Field(
        default=(3e-2, 3e-3),
        description="Of what surfels that are no metal reflect, one number for all; 0, 0: as the scene says.",
    )
    poses: Rates = Field(
        default=(0.2, 0.01), description="Of the cameras' poses: pixels of the images in use that what they show moves by."
    )
    intrinsics: Rates = Field(
        default=(5e-5, 5e-6),
        description="Of focal lengths, principal points and distortion, relative to the picture's size.",
    )
    turns: Rates = Field(
        default=(5e-3, 2e-4), description="Of how far the lamps of a turntable's rings of cameras are turned, radians."
    )
    exposure: Rates = Field(default=(5e-2, 1e-3), description="Of the photographs' exposure, natural logarithms of gains.")


@dataclass(frozen=True, config=_MODEL)
class Weights:
    """Weights of the losses."""

    dssim: float = Field(default=0.2, ge=0, le=1, description="D-SSIM has this weight against L1.")
    mask: float = Field(default=0.1, ge=0, le=1e3, description="Difference of opacity and mask.")
    consistency: WeightPair = Field(
        default=(0.05, 0.6),
        description="Depth-normal consistency (2DGS), first and last, joined geometrically: early it would hold surfaces back.",
    )
    distortion: float = Field(
        default=0.0, ge=0, le=1e6, description="Distance of the surfels along a ray from each other (2DGS)."
    )
    normal: float = Field(
        default=0.1, ge=0, le=1e3, description="Smoothness of the normals of what is reflective (RGS, L_normal)."
    )
    crease: float = Field(
        default=0.1,
        ge=0,
        le=1e3,
        description="`normal` lets differences of unit normals from pixel to pixel be that are larger than this; 0 lets none be.",
    )
    minimum_variation: float = Field(
        default=30.0, ge=0, le=1e6, description="Change of curvature where what is reflective is smooth."
    )
    delta_normal: float = Field(default=0.0, ge=0, le=1e3, description="Length of the normals' residuals (RGS, L_Δn).")
    depth: float = Field(default=1e-3, ge=0, le=1e3, description="Correlation with the depth prior (RGS, L_depth).")
    environment_tv: float = Field(
        default=1e-5,
        ge=0,
        le=1e3,
        description="Total variation of the environment: what nothing reflects sharply stays smooth.",
    )
    residual: float = Field(
        default=0.2,
        ge=0,
        le=1e3,
        description="Diffuse radiance that the base color does not explain, where the integrator's `diffuse` is `relightable`.",
    )
    poses: float = Field(
        default=0.1, ge=0, le=1e6, description="Squared distance of learned poses from the given ones, in radians."
    )
    intrinsics: float = Field(
        default=0.1, ge=0, le=1e6, description="Squared distance of learned intrinsics from the given ones, relative."
    )


@dataclass(frozen=True, config=_MODEL)
class Prior:
    """Where the depth prior of the photographs comes from."""

    name: Literal["hull", "stereo", "files", "vggt", "none"] = Field(
        default="none", description="What estimates depth (`rgs_mi.priors`)."
    )
    options: dict[str, Any] = Field(default_factory=dict, description="Options of the prior's function.")


@dataclass(frozen=True, config=_MODEL)
class Density:
    """Adaptive density control (2DGS)."""

    start: float = Field(
        default=0.08, ge=0, le=1, description="Fraction of the fit from which surfels are cloned and split."
    )
    stop: float = Field(default=0.6, ge=0, le=1, description="Fraction of the fit after which they no longer are.")
    refine_every: int = Field(default=100, ge=1, le=100_000, description="Steps from one time to the next.")
    grow_by: Literal["gradient", "loss"] = Field(
        default="gradient",
        description="Which surfels of an object without surroundings grow: those of the largest positional gradients (3DGS), or "
        "those that most of the photometric loss lies on, which are split.",
    )
    grow_grad2d: float = Field(
        default=1e-4,
        ge=0,
        le=1,
        description="Positional gradient, in NDC units, above which they grow by gradient; half of 2DGS's: rather many surfels.",
    )
    grow_scale3d: float = Field(
        default=0.01,
        ge=0,
        le=1,
        description="Those smaller than this, in units of the object, are cloned then, others split.",
    )
    prune_opacity: float = Field(default=0.05, ge=0, le=1, description="Surfels of less opacity are removed.")
    prune_weight: float = Field(
        default=0,
        ge=0,
        le=1,
        description="Surfels of an object without surroundings that make less of a picture, in the mean over the views that "
        "list them, than this part of what they make in the mean are removed.",
    )
    max_surfels: int | None = Field(
        default=None,
        ge=1,
        le=10_000_000,
        description="Never more surfels than this; unless given, 50,000, or 5,000 a minute, up to 150,000; of photographs, which "
        "have relief, as many as one shows pixels of the object, if that is more, but 15,000 a minute at most; without masks "
        "40,000, up to 400,000.",
    )
    guided: bool = Field(
        default=False,
        description="The threshold is halved where two views or more see something reflective (RGS, Algorithm 1).",
    )


@dataclass(frozen=True, config=_MODEL)
class Settings:
    """All settings. ``iterations``, or else ``minutes``, bound the fit."""

    minutes: float | None = Field(
        default=8.0, ge=0.01, le=100_000, description="The fit is planned to end within this time, which `--minutes` sets."
    )
    iterations: int | None = Field(
        default=None,
        ge=1,
        le=10_000_000,
        description="The fit takes so many steps, however long that is, instead of `minutes`.",
    )
    seed: int = Field(default=0, ge=0, le=2**31, description="Seed of everything random.")
    spp: int = Field(
        default=4,
        ge=1,
        le=64,
        description="Samples per pixel of what a fit leaves behind, on a grid; its steps take one.",
    )
    resolution: int = Field(
        default=1600,
        ge=16,
        le=8192,
        description="Photographs are scaled to this longer side when read, if theirs is longer.",
    )
    background: float = Field(
        default=1.0, ge=0, le=1, description="Display grey level behind masked objects, in training and in figures."
    )
    mask_tolerance: int = Field(
        default=0,
        ge=0,
        le=100,
        description="Pixels of a photograph that its mask may be off by: that near its border, what the photograph shows lies "
        "behind the object.",
    )
    rfilter: float | None = Field(
        default=None,
        ge=0,
        le=1,
        description="Standard deviation, in pixels, of the Gaussian that has filtered the photographs, as the reconstruction "
        "filter of a film does; 0: a box of one pixel. Unless given, 0.5, as Mitsuba has it, for images that it path-traced, "
        "else 0.",
    )
    mask_rim: int | None = Field(
        default=None,
        ge=0,
        le=100,
        description="Pixels that masks are too large by, which are taken off; unless given, as many as photographs tell by "
        "where they change.",
    )
    specular_start: float = Field(
        default=0.0, ge=0, le=1, description="Fraction of the fit from which reflections are shaded; 1 means never."
    )
    normals_start: float = Field(
        default=0.2,
        ge=0,
        le=1,
        description="Fraction of the fit from which normals that start on the hull move at their rates; before, at a tenth.",
    )
    cooldown: float = Field(
        default=0.05, ge=0, le=1, description="The last fraction of the fit, in which all rates fall to zero."
    )
    box: tuple[float, float, float, float, float, float] | None = Field(
        default=None,
        description="Lower and upper corner of the box around the object, in captures without masks: what reflects. Unless "
        "given, it is that of the first points that are at most half as far from the point that the cameras look at as the "
        "nearest of them.",
    )
    reflective: float = Field(
        default=0.9, ge=0, le=1, description="The fraction of a view's foreground, smoothest first, that is reflective."
    )
    refine_start: float = Field(
        default=0.5,
        ge=0,
        le=1,
        description="Fraction of the fit from which a learned environment has the rows that photographs tell apart, by "
        "doubling, up to 512.",
    )
    shader: Literal["identity", "mlp"] = Field(
        default="identity", description="f_φ of C = C_d + f_φ(C_s): nothing, or a tiny network trained along."
    )
    indirect: Literal["none", "visibility", "one_bounce"] = Field(
        default="one_bounce", description="What reflected rays that meet surfels bring."
    )
    indirect_start: float = Field(
        default=0.1, ge=0, le=1, description="Fraction of the fit from which those rays are traced."
    )
    relit: Period = Field(
        default=(0.82, 0.9),
        description="Fractions of the fit from and until which photographs are explained by what base colours reflect, where "
        "the integrator's `diffuse` is `relightable`; afterwards base colours and metallic stay, and the radiance makes up for "
        "it. 1, 1: never.",
    )
    monte_carlo_start: float = Field(
        default=0.8,
        ge=0,
        le=1,
        description="Fraction of the fit from which `monte_carlo` takes over from `split_sum` where the integrator asks for it.",
    )
    monte_carlo_samples: int = Field(default=4, ge=1, le=4096, description="Samples a pixel of `monte_carlo`.")
    sh_order: int = Field(default=2, ge=0, le=3, description="Order of the spherical harmonics of the diffuse radiance.")
    sh_start: float = Field(
        default=0.4, ge=0, le=1, description="Fraction of the fit from which view-dependent diffuse is learned."
    )
    light: Literal["auto", "world", "turntable"] = Field(
        default="auto",
        description="Whether the light stands still to the object, or to a camera that goes round it, as on a turntable, where "
        "it is the object that turns. Unless told, poses, backgrounds and, where these leave it open, two short fits decide.",
    )
    turns: tuple[Annotated[float, Field(ge=-360, le=360)], ...] | None = Field(
        default=None,
        description="Degrees by which the lamps of each ring of cameras around a turntable, lowest first, are turned, because "
        "someone has moved the camera among them. Unless given, a short fit to the largest ring tells; then they are learned.",
    )
    room: Literal["auto"] | Wall | tuple[Wall, Wall, Wall, Wall, Wall, Wall] | None = Field(
        default=None,
        description="The light is painted on the walls of a room, at first so many radii of the object from its middle: one "
        "number, one for each wall (-x, +x, -y, +y, -z, +z of the environment's frame), or (auto) what photographs without masks "
        "show of them, else what two short fits tell, if they do. From `refine_start` on they are learned. Unless given, the "
        "light is at infinity.",
    )
    cameras: Literal["fixed", "learned"] = Field(
        default="fixed",
        description="Whether poses, focal lengths, principal points and distortion are learned.",
    )
    cameras_start: float = Field(
        default=0.1,
        ge=0,
        le=1,
        description="Fraction of the fit from which cameras are learned: at first surfels are too wrong.",
    )
    exposure: Literal["fixed", "learned"] = Field(
        default="fixed",
        description="Whether exposure and white balance of each photograph are learned.",
    )
    checkpoint_seconds: float = Field(default=20.0, ge=0, le=1e6, description="Seconds from one checkpoint to the next.")
    stages: tuple[Stage, ...] | None = Field(
        default=None,
        description="The coarse-to-fine pyramid, a mapping of `until`, `downscale` and `views` for each level; unless given, by "
        "halves, from the pixels of a square of some 220 to all of them from 20 % of the fit on. Bounded by `minutes`, a fit "
        "stays at a level where there is no time for enough steps at the next.",
    )
    initialization: Initialization = Initialization()
    learning_rates: LearningRates = LearningRates()
    weights: Weights = Weights()
    prior: Prior = Prior()
    density: Density = Density()

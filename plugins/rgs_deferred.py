"""
Deferred shading of surfels (:monosp:`rgs_deferred`)
----------------------------------------------------

Splats all shapes of type :monosp:`surfels` into a G-buffer and shades every pixel once: their diffuse radiance, plus
what a principled BSDF with the G-buffer's material reflects of the environment (Reflection-aware Gaussian splatting).

.. pluginparameters::

 * - specular
   - |string|
   - ``split_sum``: the environment filtered by roughness times the directional albedo; ``monte_carlo``: samples of BSDF
     and emitter, free of bias; ``none``: diffuse radiance only (Default: ``split_sum``)

 * - samples
   - |int|
   - Samples of ``monte_carlo``, of BSDF and emitter each, at every point of a pixel (Default: 16)

 * - diffuse
   - |string|
   - ``radiance``: the surfels' own, spherical harmonics; ``lit``: what their base colour, as a principled BSDF's, reflects
     of the environment; ``relightable``: their own, of surfels whose base colours explain it, so that
     `rgs_mi.export.relight` makes it ``lit`` where light or colours change (Default: ``radiance``)

 * - indirect
   - |string|
   - What a reflected ray that meets a surfel brings: ``none``, the environment behind it; ``visibility``, nothing;
     ``one_bounce``, the surfel's own radiance, which in turn reflects the environment alone. Where the diffuse radiance is
     ``lit``, the same holds for its light (Default: ``none``)

 * - box
   - |string|
   - Six numbers, lower and upper corner: only what lies in this box reflects light, and is met by reflected rays. What lies
     beyond, the surroundings in a capture without masks, has its diffuse radiance alone (Default: none, everything)

 * - turntable
   - |string|
   - The axis of a turntable on which the object turns under lamps that stand still: six numbers, x, y, z of its direction and
     of a point on it. The environment is as a sensor at azimuth 0 sees it, and goes about the axis with the sensor; two more
     numbers for each ring of sensors, its elevation and how much farther its lamps are turned, in degrees, say where it was not
     the object alone that turned (Default: none, the light stands still)

 * - room
   - |string|
   - A room on whose walls the environment is painted: nine numbers, x, y, z of its center in world space, from which the map is
     seen (on a turntable a point on its axis), and the distances to the walls -x, +x, -y, +y, -z, +z of the environment's
     frame, ``inf`` where there is none (Default: none, the environment is at infinity)

 * - shader
   - |string|
   - What a pixel makes of the specular radiance: the weights of a tiny network, an ``.npz`` that a fit with
     ``shader: mlp`` wrote (`rgs_mi.shading.shader`); relative to the scene's folder (Default: none, the identity)

 * - hide_emitters
   - |bool|
   - Whether pixels show nothing behind the surfels, with their coverage as alpha, rather than the environment
     (Default: |false|)

 * - aovs
   - |string|
   - Further channels, a comma-separated list of ``<name>:<type>`` pairs as Mitsuba's :monosp:`aov` has them, for example
     ``nn:sh_normal``; a type alone is named after itself (Default: none)

Types of ``aovs``, and the channels of one called ``name``. As all that a film holds they are premultiplied by the surfels'
coverage: divide by that of type ``alpha`` for means.

 * ``depth``: distance along the ray, ``name.T``
 * ``sh_normal``: shading normal, world space, not normalised, ``name.X``, ``name.Y``, ``name.Z``
 * ``albedo``: the base colour, ``name.R``, ``name.G``, ``name.B``
 * ``roughness``, ``metallic``, ``alpha`` (coverage): ``name.Y``
 * ``diffuse``, ``specular``: the two parts of the radiance, ``name.R``, ``name.G``, ``name.B``

The scene needs an ``envmap`` or ``constant`` emitter and a ``perspective`` sensor; other shapes and emitters are
ignored. ``mi.render`` differentiates, in both modes, with respect to all fields of the surfels and the radiance of the
environment, not to the sensor nor the shader's weights. ``spp``, rounded up to a square, is the number of points of a
regular grid in each pixel, which the film's reconstruction filter weighs. Nothing is random but ``monte_carlo``, whose samples
``seed`` decides.
"""

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from rgs_mi.core.camera import Camera, pixel_directions
from rgs_mi.core.errors import UserError
from rgs_mi.core.film import Film
from rgs_mi.shading import deferred, indirect
from rgs_mi.shading.environment import Environment, FilteredEnvironment
from rgs_mi.shading.lighting import Lighting, Shading, lighting_of
from rgs_mi.shading.monte_carlo import SAMPLES
from rgs_mi.shading.shader import Shader
from rgs_mi.surfels.surfels import Surfels

from .surfels import box_of, resolve, room_of, surfels_in, turntable_of

AOVS = {
    "depth": "T",
    "sh_normal": "XYZ",
    "albedo": "RGB",
    "roughness": "Y",
    "metallic": "Y",
    "alpha": "Y",
    "specular": "RGB",
    "diffuse": "RGB",
}
ESTIMATORS = ("split_sum", "monte_carlo", "none")
DIFFUSE = ("radiance", "relightable", "lit")


class DeferredIntegrator(mi.SamplingIntegrator):
    """This is the integrator that the module describes."""

    def __init__(self, props: "mi.Properties") -> None:
        super().__init__(props)  # takes hide_emitters
        if not mi.is_rgb:
            raise UserError(f"rgs_deferred: variant '{mi.variant()}' is not supported: use llvm_ad_rgb or cuda_ad_rgb")
        self.specular = _choice(props, "specular", "split_sum", ESTIMATORS)
        self.diffuse = _choice(props, "diffuse", "radiance", DIFFUSE)
        if self.diffuse == "lit" and self.specular == "none":
            raise UserError("rgs_deferred: diffuse 'lit' needs an estimator: choose another specular than 'none'")
        self.samples = props.get("samples", SAMPLES)
        if self.samples < 1:
            raise UserError(f"rgs_deferred: samples is {self.samples}: needs at least 1")
        self.indirect = _choice(props, "indirect", "none", indirect.KINDS)
        self.box, self.turntable, self.room = box_of(props), turntable_of(props), room_of(props)
        self.shader_file = resolve(props.get("shader", ""))
        self.shader = Shader.load(self.shader_file) if self.shader_file else None
        self.aovs = _aovs(props.get("aovs", ""))
        self.filtered = None

    def aov_names(self) -> list[str]:
        """Return the names of the channels behind R, G, B and alpha, in their order."""
        return [f"{name}.{channel}" for name, kind in self.aovs.items() for channel in AOVS[kind]]

    def render(
        self,
        scene: "mi.Scene",
        sensor: "mi.Sensor | int" = 0,
        seed: "mi.UInt32 | int" = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> "mi.TensorXf":
        """Return the image [height, width, channels] that ``sensor`` sees, linear radiance, and put it on its film; ``spp``
        0 means as many samples per pixel as its sampler has.

        Raises: UserError for a film of another type than 'hdrfilm', and for a scene that can't be shaded.
        """
        chosen: mi.Sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        film = chosen.film()
        if mi.has_flag(film.flags(), mi.FilmFlags.Special):
            raise UserError(f"rgs_deferred: film '{film.id()}' is a {film.class_name()}: use an 'hdrfilm'")
        film.prepare(self.aov_names())
        spp = spp or chosen.sampler().sample_count()
        has_alpha = mi.has_flag(film.flags(), mi.FilmFlags.Alpha)
        channels = self._channels(scene, Camera.from_sensor(chosen), Film.of(film.rfilter(), spp), has_alpha, seed)
        film.put_block(mi.ImageBlock(channels, film.crop_offset()))
        image = film.develop() if develop else mi.TensorXf()
        if evaluate:
            dr.eval(image)
        return image

    # Without these two, mi.render() differentiates through a fallback that unrolls all loops.

    def render_forward(
        self,
        scene: "mi.Scene",
        params: Any,
        sensor: "mi.Sensor | int" = 0,
        seed: "mi.UInt32 | int" = 0,
        spp: int = 0,
    ) -> "mi.TensorXf":
        """Return the derivative of the image along the gradients that are set on the scene's parameters."""
        image = self.render(scene, sensor, seed, spp, evaluate=False)
        dr.forward_to(image)
        return dr.grad(image)

    def render_backward(
        self,
        scene: "mi.Scene",
        params: Any,
        grad_in: "mi.TensorXf",
        sensor: "mi.Sensor | int" = 0,
        seed: "mi.UInt32 | int" = 0,
        spp: int = 0,
    ) -> None:
        """Accumulate the gradients of the scene's parameters, of which ``grad_in`` is that of the image."""
        image = self.render(scene, sensor, seed, spp, evaluate=False)
        dr.backward_from(image * grad_in)

    def to_string(self) -> str:
        return f"DeferredIntegrator[specular = {self.specular}, aovs = {', '.join(self.aovs)}]"

    # ---- One image ----

    def _channels(self, scene, camera, film, has_alpha, seed):
        """[height, width, channels] in the layout of the film's block: R, G, B, (alpha,) weight, AOVs."""
        size, camera = camera.size, film.samples(camera)
        surfels, eta = surfels_in(scene)
        environment = self.environment(scene)
        image = deferred.render(surfels, camera, self.lighting(scene, surfels, eta, environment, seed))
        maps = image.gbuffer.all
        rays = pixel_directions(camera, dr.arange(mi.UInt32, camera.size[0] * camera.size[1]))
        color, alpha = image.color, maps.alpha
        if not self.hide_emitters and environment is not None:
            color, alpha = color + (1 - alpha) * deferred.behind(camera, environment, self.turntable), mi.Float(1)
        values = [*color, *([alpha] if has_alpha else []), mi.Float(1)]
        for kind in self.aovs.values():
            values += _aov(kind, image, maps, camera, rays)
        return _tensor(film.develop(values, size), size)

    def shading(self, eta: float) -> Shading:
        """Return how this integrator shades surfels of the index of refraction ``eta``."""
        return Shading(self.specular, self.diffuse, self.samples, eta, self.box, self.indirect, self.turntable)

    def lighting(
        self,
        scene: "mi.Scene",
        surfels: Surfels,
        eta: float,
        environment: FilteredEnvironment | None,
        seed: "mi.UInt32 | int",
    ) -> Lighting | None:
        """Return by what `deferred.shade` shades ``surfels`` in the ``scene``, whose `environment` this is; None
        stands for nothing."""
        return lighting_of(self.shading(eta), surfels, environment, scene.environment(), self.shader, seed)

    def environment(self, scene: "mi.Scene") -> FilteredEnvironment | None:
        """Return the scene's environment, filtered as the estimator needs it, which is kept until texels change.

        Raises: UserError where the scene has none and something is specular.
        """
        emitter = scene.environment()
        if emitter is None:
            if self.specular == "none":
                return None
            raise UserError("rgs_deferred: the scene has no environment: add an 'envmap' or 'constant' emitter")
        environment = replace(Environment.from_emitter(emitter), room=self.room)
        if self.specular != "split_sum":
            return environment.unfiltered()
        if dr.grad_enabled(environment.texels):
            return environment.filtered()
        if self.filtered is None or not _equal(self.filtered.environment.texels, environment.texels):
            self.filtered = environment.filtered()
        return replace(self.filtered, environment=environment)


def _choice(props, name, default, choices) -> Any:
    value = props.get(name, default)
    if value not in choices:
        raise UserError(f"rgs_deferred: unknown {name} '{value}': choose one of {', '.join(choices)}")
    return value


def _aovs(text) -> dict[str, str]:
    """{name: type} of the property ``aovs``. Raises: UserError for an unknown type and for a name that is there twice."""
    pairs = [entry.strip().rpartition(":") for entry in text.split(",") if entry.strip()]
    aovs = {}
    for name, _, kind in pairs:
        name = name or kind
        if kind not in AOVS:
            raise UserError(f"rgs_deferred: unknown aov '{kind}': choose from {', '.join(AOVS)}")
        if name in aovs:
            raise UserError(f"rgs_deferred: two aovs are called '{name}': name one of them, as in 'other:{kind}'")
        aovs[name] = kind
    return aovs


def _aov(kind, image, maps, camera, rays):
    """Channels of one AOV, premultiplied, a list of ``mi.Float`` with one entry per sample."""
    if kind == "depth":
        forward = mi.Vector3f(*[dr.opaque(mi.Float, float(v)) for v in camera.rotation[2]])
        return [maps.depth / dr.dot(rays, forward)]
    value = {
        "sh_normal": maps.normal,
        "albedo": maps.base_color,
        "roughness": maps.roughness,
        "metallic": maps.metallic,
        "alpha": maps.alpha,
        "specular": image.specular,
        "diffuse": image.diffuse,
    }[kind]
    return [value] if isinstance(value, mi.Float) else [*value]


def _tensor(values, size):
    """[height, width, channels] of ``values``, which have one entry per pixel of ``size`` (width, height)."""
    width, height = size
    flat = dr.empty(mi.Float, width * height * len(values))
    row = dr.arange(mi.UInt32, width * height) * len(values)
    for k, value in enumerate(values):
        dr.scatter(flat, value, row + k)
    return mi.TensorXf(flat, (height, width, len(values)))


def _equal(a, b):
    return a.shape == b.shape and dr.all(a.array == b.array)


mi.register_integrator("rgs_deferred", DeferredIntegrator)

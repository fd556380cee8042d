"""Images and videos of a fitted scene from its own views, along them or from a turntable, through ``mi.load_file`` and
``mi.render``."""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import mitsuba as mi
import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, RotationSpline

from ..core.camera import Camera, focus_point
from ..core.color import srgb_encode
from ..core.errors import UserError
from ..core.files import write_exr, write_png
from ..core.progress import Progress
from ..core.scene_files import load_scene, spp_of
from ..plugins import is_deferred, surfels_of
from ..shading.environment import Environment
from . import video
from .mitsuba_scene import SCENE
from .relight import edit, relight

_PASS = 16  # samples per pixel at a time
_MOST = 10_000  # frames
AOVS = ("albedo", "roughness", "metallic", "sh_normal", "depth", "diffuse", "specular", "alpha")


def render_scene(
    path: str | Path,
    *,
    variables: Mapping[str, object] | None = None,
    view: str | None = None,
    turntable: int | None = None,
    along: int | None = None,
    filmed: bool = False,
    size: int | None = None,
    spp: int | None = None,
    out: str | Path | None = None,
    aovs: bool = False,
    envmap: str | Path | None = None,
    rotate: float = 0.0,
    changes: Sequence[str] = (),
    quiet: bool = False,
) -> list[Path]:
    """Render a scene of surfels into PNGs with straight alpha, and return their paths.

    Args:
      path:      a run's folder, or a scene file
      variables: of the scene, to override its defaults
      view:      a sensor, by its id or index (default: the first)
      turntable: instead of a view, that many frames of a camera that circles the object about the environment's
                 up axis, at the sensors' mean distance and elevation
      along:     instead of a view, that many frames of a camera that moves from sensor to sensor in their order, which for
                 a run is that of its test views (0: the sensors themselves)
      filmed:    whether to write the frames as a video and a contact sheet, too (`video.write`)
      size:      width in pixels (default: the sensor's); the height follows
      spp:       samples per pixel; a square number for 'rgs_deferred' (default: what the first sensor says)
      out:       a folder, or a PNG for a single view (default: ``renders``, ``turntable`` or ``path`` beside the scene)
      aovs:      whether to write ``NAME.exr`` as well: radiance, alpha and the G-buffer, float32
      envmap, rotate: another environment map, and the degrees by which light is turned (`relight`)
      changes:   materials to set (`relight.edit`)

    Raises: UserError for bad input and where a file can't be written.
    """
    moves = turntable is not None or along is not None
    for option, count, least in (("--turntable", turntable, 1), ("--path", along, 0)):
        if count is not None and not least <= count <= _MOST:
            raise UserError(f"{option} {count}: needs {least} to {_MOST} frames")
    if filmed:
        if not moves:
            raise UserError("--video: one view makes no video: add --turntable N or --path")
        video.check()
    path = Path(path)
    path = path / SCENE if path.is_dir() else path
    scene = load_scene(path, variables or {})
    if not scene.sensors():
        raise UserError(f"{path}: has no sensors: nothing says where to look from")
    if envmap is not None or rotate:
        relight(scene, path, envmap, rotate)
        if getattr(scene.integrator(), "diffuse", "lit") != "lit":
            print(
                f"{path}: its diffuse radiance stays as photographed, only reflections change: "
                "fit with -D diffuse=lit to relight all of it",
                file=sys.stderr,
            )
    if changes:
        edit(scene, path, changes)
    cameras = (
        _circle(scene, path, turntable) if turntable else _along(scene, path, along) if moves else _view(scene, path, view)
    )
    out = Path(out) if out else path.parent / ("turntable" if turntable else "path" if moves else "renders")
    integrator = with_aovs(scene, path) if aovs else scene.integrator()
    spp = spp or spp_of(scene)
    written = []
    with Progress(None, quiet or len(cameras) == 1 and spp <= _PASS, "rendering") as progress:
        for k, (name, camera) in enumerate(cameras.items()):
            step = lambda part: progress.update((k + part) / len(cameras))
            if size:
                camera = camera.resized(size, max(1, round(size * camera.size[1] / camera.size[0])))
            file = out if out.suffix == ".png" and not moves else out / f"{name}.png"
            image = _render(scene, mi.load_dict(sensor_dict(camera)), integrator, spp, step)
            write_png(file, straight(image))
            if aovs:
                write_exr(file.with_suffix(".exr"), image, ["R", "G", "B", "A", *integrator.aov_names()])
            written.append(file)
    return written + (video.write(out, written) if filmed else [])


def _render(scene, sensor, integrator, spp, progress):
    """[H, W, channels] in passes of `_PASS` samples, which bound memory; ``progress`` is told the part that is done. The
    samples of `rgs_deferred` are a grid, and stay together."""
    passes = [spp] if is_deferred(integrator) else [_PASS] * (spp // _PASS) + [spp % _PASS] * (spp % _PASS > 0)
    image = 0.0
    for k, samples in enumerate(passes):
        image += samples / spp * np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=samples, seed=k))
        progress((k + 1) / len(passes))
    return np.asarray(image)


def straight(image: np.ndarray) -> np.ndarray:
    """Take a rendering, linear and premultiplied [H, W, 4 or more], to display values with straight alpha [H, W, 4]."""
    alpha = np.clip(image[..., 3:4], 0, 1)
    return np.concatenate([srgb_encode(np.clip(image[..., :3] / np.maximum(alpha, 1e-6), 0, 1)), alpha], -1)


def sensor_dict(camera: Camera) -> dict:
    """Return a sensor for ``mi.load_dict`` whose film has alpha."""
    sensor = camera.to_sensor_dict()
    sensor["film"]["pixel_format"] = "rgba"
    return sensor


def _view(scene, path, view):
    """{name: camera} of one sensor."""
    ids = [sensor.id() for sensor in scene.sensors()]
    index = 0 if view is None else ids.index(view) if view in ids else int(view) if view.isdigit() else -1
    if not 0 <= index < len(ids):
        shown = ", ".join(ids[:5]) + (", …" if len(ids) > 5 else "")
        raise UserError(f"{path}: has no view '{view}': give a name ({shown}) or a number below {len(ids)}")
    return {ids[index]: Camera.from_sensor(scene.sensors()[index])}


def _circle(scene, path, frames):
    """{'000': camera, …} around the surfels."""
    cameras = [Camera.from_sensor(sensor) for sensor in scene.sensors()]
    centers = np.array(mi.traverse(surfels_of(scene, path))["centers"])
    center = np.percentile(centers, (1, 99), axis=0).mean(0)
    up = Environment.from_emitter(scene.environment()).rotation[:, 1] if scene.environment() else np.array([0, 0, 1.0])
    away = np.array([c.origin for c in cameras]) - center
    distance = np.linalg.norm(away, axis=1)
    elevation = np.arcsin(np.clip(away @ up / distance, -1, 1)).mean()
    first = cameras[0]
    side = np.cross(up, np.eye(3)[np.argmin(abs(up))])
    side /= np.linalg.norm(side)
    fov = np.degrees(2 * np.arctan(0.5 * first.size[0] / first.focal[0]))
    circle = {}
    for k in range(frames):
        angle = 2 * np.pi * k / frames
        horizontal = np.cos(angle) * side + np.sin(angle) * np.cross(up, side)
        direction = np.cos(elevation) * horizontal + np.sin(elevation) * up
        circle[f"{k:03}"] = Camera.look_at(center + distance.mean() * direction, center, up, fov, first.size)
    return circle


def _along(scene, path, frames):
    """{sensor's id: camera} of all sensors, or {'000': camera, …} on a smooth path through them, about the point that they
    look at; of one size."""
    cameras = [Camera.from_sensor(sensor) for sensor in scene.sensors()]
    size = cameras[0].size
    cameras = [camera.resized(*size) for camera in cameras]
    if not frames:
        return dict(zip([sensor.id() for sensor in scene.sensors()], cameras))
    if len(cameras) < 2:
        raise UserError(f"{path}: has one sensor, which is no path: use --turntable")
    center, _ = focus_point(cameras)
    knots, times = np.arange(len(cameras)), np.linspace(0, len(cameras) - 1, frames)
    through = lambda values: PchipInterpolator(knots, values)(times)
    rotations = RotationSpline(knots, Rotation.from_matrix([c.to_world[:3, :3] for c in cameras]))(times).as_matrix()
    seen = through([c.rotation @ (center - c.origin) for c in cameras])  # the center in camera space
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations, center - np.einsum("kij,kj->ki", rotations, seen)
    focal, principal = (through([getattr(c, name) for c in cameras]) for name in ("focal", "principal"))
    return {f"{k:03}": Camera(poses[k], tuple(focal[k]), tuple(principal[k]), size) for k in range(frames)}


def with_aovs(scene: "mi.Scene", path: str | Path) -> "mi.Integrator":
    """Return the integrator of the ``scene`` in the file ``path`` with all its AOVs. Raises: UserError for one of another
    type."""
    own = scene.integrator()
    if not is_deferred(own):
        raise UserError(f"{path}: maps come from the integrator 'rgs_deferred' only: leave out --aovs")
    given = {name: str(value) for name in ("box", "turntable", "room") if (value := getattr(own, name))}
    kept = ("specular", "diffuse", "samples", "indirect", "hide_emitters")
    return mi.load_dict(
        {"type": "rgs_deferred", "shader": own.shader_file, "aovs": ",".join(AOVS)}
        | given
        | {name: getattr(own, name) for name in kept}
    )

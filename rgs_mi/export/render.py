"""Images and videos of a fitted scene from its own views, along them or from a turntable, through ``mi.load_file`` and
``mi.render``."""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation, RotationSpline

from ..core.camera import Camera, focus_point
from ..core.color import TONES, exposed
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
_WIDEST = 16_384  # pixels along a side
AOVS = ("albedo", "roughness", "metallic", "sh_normal", "depth", "diffuse", "specular", "alpha")


def render_scene(
    path: str | Path,
    *,
    variables: Mapping[str, object] | None = None,
    view: str | None = None,
    poses: Sequence[str] = (),
    turntable: int | None = None,
    along: int | None = None,
    as_video: bool = False,
    size: int | tuple[int, int] | None = None,
    spp: int | None = None,
    out: str | Path | None = None,
    aovs: bool = False,
    envmap: str | Path | None = None,
    rotate: float = 0.0,
    brighten: float = 0.0,
    changes: Sequence[str] = (),
    background: bool | None = None,
    exposure: float = 0.0,
    tone: str = "clip",
    quiet: bool = False,
) -> list[Path]:
    """Render a scene of surfels into PNGs with straight alpha, and return their paths.

    Args:
      path:      a run's folder, or a scene file
      variables: of the scene, to override its defaults
      view:      a sensor, by its id or index (default: the first)
      poses:     instead of a view, cameras as `posed` reads them; with ``along`` the path goes through them
      turntable: instead of a view, that many frames of a camera that circles the object about the environment's
                 up axis, at the sensors' mean distance and elevation
      along:     instead of a view, that many frames of a camera that moves from sensor to sensor in their order, which for
                 a run is that of its test views (0: the sensors themselves)
      as_video:  whether to write the frames as a video and a contact sheet, too (`video.write`)
      size:      width in pixels, of which the height follows, or both (default: the sensor's)
      spp:       samples per pixel; a square number for 'rgs_deferred' (default: what the first sensor says)
      out:       a folder, or a PNG for a single view (default: ``renders``, ``turntable`` or ``path`` beside the scene)
      aovs:      whether to write ``NAME.exr`` as well: radiance, alpha and the G-buffer, float32
      envmap, rotate, brighten: another environment map, the degrees by which light is turned, and the stops by which it is
                 brighter (`relight`)
      changes:   materials to set or scale (`relight.edit`)
      background: whether pixels show the environment behind the object (default: as the scene says)
      exposure, tone: of the PNGs, `core.color.exposed`

    Raises: UserError for bad input and where a file can't be written.
    """
    moves = turntable is not None or along is not None
    for option, count, least in (("--turntable", turntable, 1), ("--path", along, 0)):
        if count is not None and not least <= count <= _MOST:
            raise UserError(f"{option} {count}: needs {least} to {_MOST} frames")
    for option, numbers, most in (
        ("--size", size if isinstance(size, tuple) else (size,), _WIDEST),
        ("--spp", (spp,), 1 << 20),
    ):
        if any(n is not None and not 1 <= n <= most for n in numbers):
            raise UserError(f"{option} {'x'.join(map(str, numbers))}: needs 1 to {most}")
    if as_video:
        if not moves:
            raise UserError("--video: one view makes no video: add --turntable N or --path")
        video.check()
    path = Path(path)
    path = path / SCENE if path.is_dir() else path
    scene = load_scene(path, variables or {})
    if not scene.sensors():
        raise UserError(f"{path}: has no sensors: nothing says where to look from")
    if tone not in TONES:
        raise UserError(f"--tone {tone}: choose one of {', '.join(TONES)}")
    if background is not None and is_deferred(scene.integrator()):
        scene.integrator().hide_emitters = not background
    if envmap is not None or rotate or brighten:
        relight(scene, path, envmap, rotate, brighten)
        if getattr(scene.integrator(), "diffuse", "lit") != "lit":
            print(
                f"{path}: its diffuse radiance stays as photographed, only reflections change: "
                "fit without -D diffuse=radiance to relight all of it",
                file=sys.stderr,
            )
    if changes:
        edit(scene, path, changes)
    cameras = _cameras(scene, path, view, poses, turntable, along, size)
    out = Path(out) if out else path.parent / ("turntable" if turntable else "path" if moves else "renders")
    integrator = with_aovs(scene, path) if aovs else scene.integrator()
    spp = spp or spp_of(scene)
    written = []
    with Progress(None, quiet or len(cameras) == 1 and spp <= _PASS, "rendering") as progress:
        for k, (name, camera) in enumerate(cameras.items()):
            step = lambda part: progress.update((k + part) / len(cameras))
            camera = camera.resized(*_size(size, camera.size))
            file = out if out.suffix == ".png" and not moves else out / f"{name}.png"
            image = _render(scene, mi.load_dict(sensor_dict(camera, scene)), integrator, spp, step)
            write_png(file, straight(image, exposure, tone))
            if aovs:
                write_exr(file.with_suffix(".exr"), image, ["R", "G", "B", "A", *integrator.aov_names()])
            written.append(file)
    return written + (video.write(out, written) if as_video else [])


def _render(scene, sensor, integrator, spp, progress):
    """[H, W, channels] in passes of `_PASS` samples, which bound memory; ``progress`` is told the part that is done. The
    samples of `rgs_deferred` are a grid, and stay together."""
    passes = [spp] if is_deferred(integrator) else [_PASS] * (spp // _PASS) + [spp % _PASS] * (spp % _PASS > 0)
    image = 0.0
    for k, samples in enumerate(passes):
        image += samples / spp * np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=samples, seed=k))
        progress((k + 1) / len(passes))
    return np.asarray(image)


def straight(image: np.ndarray, stops: float = 0.0, tone: str = "clip") -> np.ndarray:
    """Take a rendering, linear and premultiplied [H, W, 4 or more], to display values with straight alpha [H, W, 4], `exposed`
    by ``stops`` and ``tone``."""
    alpha = np.clip(image[..., 3:4], 0, 1)
    return np.concatenate([exposed(image[..., :3] / np.maximum(alpha, 1e-6), stops, tone), alpha], -1)


def sensor_dict(camera: Camera, scene: "mi.Scene | None" = None) -> dict:
    """Return a sensor for ``mi.load_dict`` whose film has alpha, and is filtered as that of the first sensor of ``scene``; by
    a box where there is none."""
    sensor = camera.to_sensor_dict()
    if scene is not None and scene.sensors():
        sensor["film"]["rfilter"] = scene.sensors()[0].film().rfilter()
    sensor["film"]["pixel_format"] = "rgba"
    return sensor


def _size(size, own):
    """Width and height of a picture, of what was asked for and a camera's ``own``."""
    if not size:
        return own
    return size if isinstance(size, tuple) else (size, max(1, round(size * own[1] / own[0])))


def posed(text: str, size: tuple[int, int]) -> Camera:
    """Return the camera of ``size`` (width, height) that ten numbers with commas stand for: its position, a point that it looks
    at, an up direction, x, y, z each, world space, and its horizontal field of view in degrees. `pose` is the inverse.

    Raises: UserError where they stand for none.
    """
    try:
        numbers = np.array([float(v) for v in text.split(",")])
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) == 10 and np.isfinite(numbers).all() and 0 < numbers[9] < 180:
        origin, target, up = numbers[:9].reshape(3, 3)
        if np.linalg.norm(np.cross(target - origin, up)) > 1e-9:
            return Camera.look_at(origin, target, up, numbers[9], size)
    raise UserError(
        f"--camera {text}: needs ten numbers X,Y,Z,X,Y,Z,X,Y,Z,DEG: where it is, what it looks at, up, and its field of view"
    )


def pose(camera: Camera, distance: float = 1.0) -> str:
    """Return the ten numbers of which `posed` makes a ``camera`` of square pixels, whose principal point is its center; it
    looks at the point at that ``distance``."""
    x, y, z = camera.to_world[:3, :3].T
    fov = np.degrees(2 * np.arctan(0.5 * camera.size[0] / camera.focal[0]))
    return ",".join(f"{v:.9g}" for v in (*camera.origin, *(camera.origin + distance * z), *-y, fov))


def _cameras(scene, path, view, poses, turntable, along, size):
    """{name: camera} of the pictures that were asked for."""
    if poses and (view is not None or turntable):
        raise UserError("--camera: has a place of its own: leave out --view and --turntable")
    given = [posed(text, _size(size, Camera.from_sensor(scene.sensors()[0]).size)) for text in poses]
    named = {f"camera_{k}": camera for k, camera in enumerate(given)}
    if turntable:
        return _circle(scene, path, turntable)
    return (named or _view(scene, path, view)) if along is None else _along(scene, path, along, named)


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


def _along(scene, path, frames, given=None):
    """{name: camera} of the cameras ``given`` (default: all sensors), or {'000': camera, …} on a smooth path through them."""
    cameras = given or {sensor.id(): Camera.from_sensor(sensor) for sensor in scene.sensors()}
    size = next(iter(cameras.values())).size
    cameras = {name: camera.resized(*size) for name, camera in cameras.items()}
    if not frames:
        return cameras
    if len(cameras) < 2:
        raise UserError(f"{path}: has one sensor, which is no path: use --turntable")
    return {f"{k:03}": camera for k, camera in enumerate(smooth_path([*cameras.values()], frames))}


def smooth_path(cameras: Sequence[Camera], frames: int) -> list[Camera]:
    """Return ``frames`` cameras on a smooth path through two ``cameras`` or more, of one size, about the point that they look
    at."""
    from scipy.interpolate import PchipInterpolator  # for which a window need not wait

    size = cameras[0].size
    center, _ = focus_point(cameras)
    knots, times = np.arange(len(cameras)), np.linspace(0, len(cameras) - 1, frames)
    through = lambda values: PchipInterpolator(knots, values)(times)
    rotations = RotationSpline(knots, Rotation.from_matrix([c.to_world[:3, :3] for c in cameras]))(times).as_matrix()
    seen = through([c.rotation @ (center - c.origin) for c in cameras])  # the center in camera space
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations, center - np.einsum("kij,kj->ki", rotations, seen)
    focal, principal = (through([getattr(c, name) for c in cameras]) for name in ("focal", "principal"))
    return [Camera(poses[k], tuple(focal[k]), tuple(principal[k]), size) for k in range(frames)]


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

"""A loaded scene of surfels under another light, or of another material."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..core.arrays import as_tensor
from ..core.errors import UserError
from ..core.inputs import is_file
from ..plugins import is_deferred, surfels_of
from ..targets import environments

#: Materials of surfels that can be set: name -> channels.
MATERIAL = {"roughness": 1, "metallic": 1, "base_color": 3}


def relight(
    scene: "mi.Scene", path: str | Path, envmap: str | Path | None = None, rotate: float = 0.0, brighten: float = 0.0
) -> None:
    """Put another ``envmap`` (an image, latitude-longitude, or the name of an environment of the suite; None: as it is) into
    the ``scene`` that was loaded from ``path``, in the place and orientation of its own, turned by ``rotate`` degrees about
    its up axis, and brighter by ``brighten`` stops. Another map stands still, where its own goes round with the camera, as on
    a turntable, and is at infinity. Diffuse radiance that is ``relightable`` becomes ``lit``.

    Raises: UserError for a scene without an environment map, and an image that can't be read.
    """
    emitter = scene.environment()
    if emitter is None or emitter.class_name() != "EnvironmentMapEmitter":
        raise UserError(f"{path}: has no 'envmap' to put another light in place of")
    params = mi.traverse(emitter)
    if envmap is not None:
        params["data"] = mi.traverse(load_envmap(envmap))["data"]
        params["scale"] = 1.0
        if is_deferred(integrator := scene.integrator()):
            integrator.turntable = integrator.room = None
    if brighten:
        params["scale"] = params["scale"] * 2.0**brighten
    if envmap is not None or rotate or brighten:
        light_diffuse(scene)
    to_world = np.array(params["to_world"].matrix).reshape(4, 4)
    to_world[:3, :3] = to_world[:3, :3] @ about_vertical(rotate)
    params["to_world"] = mi.Transform4f(mi.ScalarTransform4f(to_world))
    params.update()


def light_diffuse(scene: "mi.Scene") -> None:
    """Have base colors, where they are known, make the diffuse radiance of the ``scene``'s surfels from now on."""
    integrator = scene.integrator()
    if is_deferred(integrator) and integrator.diffuse == "relightable" and integrator.specular != "none":
        integrator.diffuse = "lit"


def about_vertical(degrees: float) -> np.ndarray:
    """Return the rotation [3, 3] by so many degrees about the up axis of an envmap, which is y, in its own frame."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def load_envmap(envmap: str | Path) -> "mi.Emitter":
    """Return the envmap emitter of an image, latitude-longitude, or of an environment of the suite, by its name.

    Raises: UserError for an image that can't be read.
    """
    if str(envmap) in environments.ENVIRONMENTS:
        return mi.load_dict({"type": "procedural_envmap", "name": str(envmap)})
    if not is_file(envmap):
        raise UserError(
            f"no environment map at {envmap}: check the path, or name one of the suite's: "
            f"{', '.join(sorted(environments.ENVIRONMENTS))}"
        )
    try:
        bitmap = mi.Bitmap(str(envmap))
    except RuntimeError as error:
        raise UserError(f"{envmap}: can't be read ({str(error).splitlines()[-1]}): needs an EXR or HDR image") from error
    if not np.isfinite(np.array(bitmap)).all():
        raise UserError(f"{envmap}: holds NaN or infinite radiance: clean it, or take another")
    return mi.load_dict({"type": "envmap", "bitmap": bitmap})


def edit(scene: "mi.Scene", path: str | Path, changes: Sequence[str]) -> None:
    """Set or scale materials of the surfels of the ``scene`` that was loaded from ``path``, by `edited`. Diffuse radiance that is
    ``relightable`` becomes ``lit``."""
    params = mi.traverse(surfels_of(scene, path))
    arrays = {name: params[name].numpy() for name in ("centers", *MATERIAL)}
    for name, values in edited(arrays, changes).items():
        params[name] = as_tensor(values)
    params.update()
    light_diffuse(scene)


def edited(arrays: Mapping[str, np.ndarray], changes: Iterable[str]) -> dict[str, np.ndarray]:
    """Return those of the arrays [N, channels], by the names of `Surfels`, that ``changes`` give other values, one after
    another: strings 'roughness=0.1', 'base_color=0.8,0.1,0.1', of `MATERIAL`; 'roughness*=0.5' scales what is there, and
    'roughness*=0.5@X,Y,Z,R' does so within the radius R of a world-space point alone.

    Raises: UserError for another name, and numbers that are no material.
    """
    result = {}
    for change in changes:
        name, scaled, values, ball = _parsed(change)
        before = result.get(name, arrays[name])
        after = np.clip(before * values, 0, 1) if scaled else np.broadcast_to(values, before.shape)
        if ball is not None:
            within = np.linalg.norm(arrays["centers"] - ball[:3], axis=1, keepdims=True) <= ball[3]
            after = np.where(within, after, before)
        result[name] = after.astype(np.float32)
    return result


def _parsed(change):
    """(name, whether it scales, values [1 or channels], ball [4] or None) of a change. Raises: UserError for what is none."""
    assigned, at, where = change.partition("@")
    left, _, text = assigned.partition("=")
    name, scaled = left.removesuffix("*"), left.endswith("*")
    if name not in MATERIAL:
        raise UserError(f"--set {change}: unknown material '{name}': choose from {', '.join(MATERIAL)}")
    try:
        values = np.array([float(v) for v in text.split(",")], np.float32)
        ball = np.array([float(v) for v in where.split(",")]) if at else None
    except ValueError as error:
        form = f"{name}=NUMBER" + ",NUMBER,NUMBER" * (MATERIAL[name] == 3)
        raise UserError(f"--set {change}: expected {form}, perhaps with * before = and @X,Y,Z,RADIUS at the end") from error
    most = np.inf if scaled else 1
    if len(values) not in (1, MATERIAL[name]) or not all(0 <= v <= most and np.isfinite(v) for v in values):
        raise UserError(f"--set {change}: needs {MATERIAL[name]} number(s) from 0" + " to 1" * (not scaled))
    if ball is not None and not (len(ball) == 4 and np.isfinite(ball).all() and ball[3] > 0):
        raise UserError(f"--set {change}: '{where}' is no ball: needs X,Y,Z,RADIUS")
    return name, scaled, values, ball

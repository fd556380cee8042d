"""A loaded scene of surfels under another light, or of another material."""

from collections.abc import Sequence
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import as_tensor
from ..core.errors import UserError
from ..plugins import is_deferred, surfels_of
from ..targets import environments

#: Materials of surfels that can be set: name -> channels.
MATERIAL = {"roughness": 1, "metallic": 1, "base_color": 3}


def relight(scene: "mi.Scene", path: str | Path, envmap: str | Path | None = None, rotate: float = 0.0) -> None:
    """Put another ``envmap`` (an image, latitude-longitude, or the name of an environment of the suite; None: as it is) into
    the ``scene`` that was loaded from ``path``, in the place and orientation of its own, turned by ``rotate`` degrees about
    its up axis. Another map stands still, where its own goes round with the camera, as on a turntable, and is at infinity.

    Raises: UserError for a scene without an environment map, and an image that can't be read.
    """
    emitter = scene.environment()
    if emitter is None or emitter.class_name() != "EnvironmentMapEmitter":
        raise UserError(f"{path}: has no 'envmap' to put another light in place of")
    params = mi.traverse(emitter)
    if envmap is not None:
        params["data"] = mi.traverse(_load(envmap))["data"]
        params["scale"] = 1.0
        if is_deferred(integrator := scene.integrator()):
            integrator.turntable = integrator.room = None
    turned = mi.ScalarTransform4f().rotate([0, 1, 0], rotate)  # an envmap's up axis is y
    params["to_world"] = mi.Transform4f(mi.ScalarTransform4f(np.array(params["to_world"].matrix).reshape(4, 4)) @ turned)
    params.update()


def _load(envmap):
    """An envmap emitter of an image, or of the suite."""
    if str(envmap) in environments.ENVIRONMENTS:
        return mi.load_dict({"type": "procedural_envmap", "name": str(envmap)})
    if not Path(envmap).is_file():
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
    """Set materials of all surfels of the ``scene`` that was loaded from ``path``: ``changes`` are strings 'roughness=0.1',
    'base_color=0.8,0.1,0.1', of `MATERIAL`.

    Raises: UserError for another name, and numbers that are no material.
    """
    params = mi.traverse(surfels_of(scene, path))
    for change in changes:
        name, _, text = change.partition("=")
        if name not in MATERIAL:
            raise UserError(f"--set {change}: unknown material '{name}': choose from {', '.join(MATERIAL)}")
        try:
            values = [float(v) for v in text.split(",")]
        except ValueError as error:
            raise UserError(f"--set {change}: expected {name}=NUMBER" + ",NUMBER,NUMBER" * (MATERIAL[name] == 3)) from error
        if len(values) not in (1, MATERIAL[name]) or not all(0 <= v <= 1 for v in values):
            raise UserError(f"--set {change}: needs {MATERIAL[name]} number(s) from 0 to 1")
        count = dr.width(params[name].array) // MATERIAL[name]
        params[name] = as_tensor(np.broadcast_to(np.array(values, np.float32), (count, MATERIAL[name])))
    params.update()

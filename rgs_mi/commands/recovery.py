"""How true a fit's light and materials are: against the path-traced scene that its photographs are of, and under other
lights. What `rgs-mi recovery` calls.

    OUT/recovery.json       the figures below
    OUT/relit_NAME.png      a few views under each light: ground truth, fit, three times their difference

    environment_log_rmse    of log radiance, up to a factor a channel, along the directions that test views reflect, where
                            nothing of the object lies in between, and as blurred as their roughness sees it
    roughness_mae, metallic_mae, base_color_mae    means over the pixels that the object fills; the base colour up to a
                            factor a channel, which light can take over
    base_color_factor, base_color_mae_unaligned    those factors, and the mean without them
    relit                   name -> mean psnr and ssim of the fit under that light, as it is
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import as_float
from ..core.files import write_json, write_png
from ..core.runtime import cache_folder
from ..core.scene_files import load_scene, spp_of
from ..datasets import load_dataset
from ..datasets.path_traced import render_dataset
from ..datasets.types import View
from ..evaluation import metrics
from ..evaluation.evaluate import ground_truth
from ..export.mitsuba_scene import SCENE
from ..export.relight import relight
from ..export.render import sensor_dict, straight, with_aovs
from ..plugins import surfels_of
from ..report.results import preview_views
from ..shading.environment import Environment

RECOVERY = "recovery.json"
_VIEWS = 12  # of the ground truth under each light
_WHITE = 1.0
_ABOVE = 1e-3  # of the diagonal of the object's box


def recovery(
    run: str | Path,
    ground_truth_scene: str | Path,
    lights: Sequence[str] = (),
    *,
    variables: Mapping[str, object] | None = None,
    size: int = 400,
    out: str | Path | None = None,
    quiet: bool = False,
) -> dict:
    """Compare the fit in the folder ``run`` with the scene file that its photographs are of, also under other ``lights``,
    environments of the suite; write the module's files and return what recovery.json holds.

    Args:
      variables: of that scene file, as its photographs have them
      size: pixels along a side of the path-traced views, which are kept in the `cache_folder`
      out:  folder (None: ``recovery`` in ``run``)

    Raises: UserError for scenes that do not load, and where a file can't be written.
    """
    run, true_path = Path(run), Path(ground_truth_scene)
    out = Path(out) if out else run / "recovery"
    path = run / SCENE
    variables = dict(variables or {})
    scene, true_scene = load_scene(path, {}), load_scene(true_path, variables)
    surfels_of(scene, path)
    own = _views(true_path, variables, size, quiet)
    figures: dict = _materials(scene, path, own)
    relit_scores = {}
    figures["environment_log_rmse"] = _environment(scene, true_scene, own)
    for light in lights:
        views = _views(true_path, variables | {"environment": light}, size, quiet)
        relit = load_scene(path, {})
        relight(relit, path, light)
        relit_scores[light] = _compare(relit, views, out / f"relit_{light}.png")
    figures["relit"] = relit_scores
    write_json(out / RECOVERY, figures)
    return figures


def _views(path, variables, size, quiet):
    """Path-traced views of the scene file ``path`` with its light, or another."""
    name = "-".join([path.stem, "truth", *map(str, variables.values())])
    folder = cache_folder(re.sub(r"[^\w-]+", "_", name))
    render_dataset(path, folder, train=1, test=_VIEWS, size=size, variables=variables, quiet=quiet)
    return load_dataset(folder).test


def _render(scene, view, integrator=None):
    sensor = mi.load_dict(sensor_dict(view.camera, scene))
    return np.array(mi.render(scene, sensor=sensor, integrator=integrator or scene.integrator(), spp=spp_of(scene)))


def _compare(scene, views, picture):
    """Mean scores of ``scene`` against the photographs of ``views``, some of which the file ``picture`` shows."""
    scores, rows = [], []
    for view in views:
        color = straight(_render(scene, view))
        image = color[..., :3] * color[..., 3:] + _WHITE * (1 - color[..., 3:])
        expected = ground_truth(view, _WHITE)
        scores.append((metrics.psnr(image, expected), metrics.ssim(image, expected)))
        if view in preview_views(views):
            rows.append(np.concatenate([expected, image, np.clip(3 * abs(expected - image), 0, 1)], 1))
    write_png(picture, np.concatenate(rows))
    return dict(zip(("psnr", "ssim"), np.mean(scores, 0).tolist()))


def true_maps(view: View) -> dict[str, np.ndarray]:
    """Return the maps that `render_dataset` wrote beside a view, name -> [H, W, channels]: Normal (world space), Albedo,
    Roughness, Metallic, Alpha, Depth (along the viewing axis, world units)."""
    bitmap = mi.Bitmap(str(view.path.with_name(view.path.stem + "_aov.exr")))
    channels = {field.name: np.array(bitmap)[..., k] for k, field in enumerate(bitmap.struct_())}
    names = dict.fromkeys(name.split(".")[0] for name in channels)
    order = lambda name: [c for c in ("R", "G", "B", "X", "Y", "Z") if f"{name}.{c}" in channels]
    return {
        name: np.stack([channels[f"{name}.{c}"] for c in order(name)], -1) if order(name) else channels[name][..., None]
        for name in names
    }


def _materials(scene, path, views):
    """Mean absolute errors of what the G-buffer says."""
    integrator, errors, pairs = with_aovs(scene, path), {"roughness": [], "metallic": []}, []
    for view in views:
        image = _render(scene, view, integrator)
        names = ["R", "G", "B", "A", *integrator.aov_names()]
        get = lambda *wanted: image[..., [names.index(name) for name in wanted]] / np.maximum(image[..., 3:4], 1e-6)
        maps = true_maps(view)
        inside = (maps["Alpha"][..., 0] > 0.99) & (image[..., 3] > 0.5)
        for name in errors:
            errors[name].append(abs(get(f"{name}.Y") - maps[name.capitalize()])[inside].mean())
        pairs.append((get("albedo.R", "albedo.G", "albedo.B")[inside], maps["Albedo"][inside]))
    ours, true = (np.concatenate(p) for p in zip(*pairs))
    factor = (ours * true).sum(0) / np.maximum((ours * ours).sum(0), 1e-9)
    return {f"{name}_mae": float(np.mean(e)) for name, e in errors.items()} | {
        "base_color_mae": float(abs(ours * factor - true).mean()),
        "base_color_factor": factor.tolist(),
        "base_color_mae_unaligned": float(abs(ours - true).mean()),
    }


def _environment(scene, true_scene, views):
    """Root mean squared error of log radiance, up to a factor a channel."""
    ours, true = (Environment.from_emitter(s.environment()).filtered() for s in (scene, true_scene))
    differences = []
    for view in views:
        maps = true_maps(view)
        inside = maps["Alpha"][..., 0] > 0.99
        rays, normal = view.camera.rays()[inside], maps["Normal"][inside]
        point = view.camera.origin + rays * maps["Depth"][inside]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        reflected = rays - 2 * (rays * normal).sum(1, keepdims=True) * normal
        clear = ~hidden(true_scene, point, normal, reflected)
        direction, roughness = _vectors(reflected[clear]), as_float(maps["Roughness"][inside, 0][clear])
        with dr.suspend_grad():
            log = lambda environment: np.log(np.maximum(environment.eval(direction, roughness).numpy(), 1e-4))
            differences.append(log(ours) - log(true))
    difference = np.concatenate(differences, 1)
    return float(np.sqrt(((difference - difference.mean(1, keepdims=True)) ** 2).mean()))


def _vectors(v):
    return mi.Vector3f(*map(as_float, v.T))


def hidden(scene: "mi.Scene", point: np.ndarray, normal: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return [N] whether something of the ``scene`` is in the way from ``point`` along ``direction`` (all [N, 3], world
    space). Points are means over pixels, some beneath the surface, so rays start a little above it."""
    above = point + normal * (_ABOVE * float(dr.norm(scene.bbox().extents())))
    return scene.ray_test(mi.Ray3f(mi.Point3f(_vectors(above)), _vectors(direction))).numpy()

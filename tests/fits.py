"""A model and photographs of random surfels, which several tests fit."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rgs_mi.core.camera import Camera
from rgs_mi.datasets.types import Dataset, View
from rgs_mi.fit import losses
from rgs_mi.fit.model import SURFEL_PARAMETERS, Model
from rgs_mi.settings.settings import Density, Initialization, Settings, Stage
from rgs_mi.shading import deferred
from rgs_mi.shading.lighting import Lighting
from rgs_mi.shading.split_sum import SplitSum
from rgs_mi.surfels.surfels import SH_0, Surfels, sh_order

from scenes import orbit_camera, sphere_surfels, tangent_surfels

SETTINGS = Settings(
    minutes=None,
    iterations=40,
    stages=(Stage(1.0, 1, 1),),
    initialization=Initialization(surfels=300),
    density=Density(start=1.0),
)


def model(seed=0):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(300, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return Model.start(
        x, x, np.full((300, 3), 0.3), np.full(300, 0.15), np.full((16, 32, 3), 0.5), np.eye(3), 1, specular=0.5
    )


def model_of(surfels: Surfels) -> Model:
    """The model that has these ``surfels``."""
    s, order = surfels.numpy(), sh_order(surfels.channels("sh"))
    n, logit = len(surfels), lambda p: np.log(p / (1 - p))
    learned = Model.start(
        s["centers"], s["centers"], np.full((n, 3), 0.5), np.full(n, 0.1), np.full((8, 16, 3), 0.5), np.eye(3), order
    )
    given = {
        "rotations": s["rotations"],
        "log_scales": np.log(s["scales"]),
        "logit_opacities": logit(s["opacities"]),
        "sh_dc": s["sh"][:, :3],
        "sh_rest": s["sh"][:, 3:],
        "logit_base_color": logit(s["base_color"]),
        "logit_roughness": logit(s["roughness"]),
        "logit_metallic": logit(s["metallic"]),
        "delta_normal": s["delta_normal"],
        "curvature": s["curvature"],
    }
    assert {*given, "centers"} == set(SURFEL_PARAMETERS)
    for name, value in given.items():
        learned.set(name, value)
    learned.two_sided = surfels.two_sided
    return learned


def photographed() -> tuple[Surfels, Lighting]:
    """What `random_photographs` show."""
    truth = sphere_surfels(300, seed=2, scale=0.9, opacity_shift=4)
    truth = Surfels.from_numpy(truth.numpy(), two_sided=False)
    return truth, Lighting(SplitSum(model().environment().filtered()))


def random_photographs(distance=9.0) -> Dataset:
    """Six photographs of random surfels, of odd size."""
    truth, lighting = photographed()
    views = []
    for k in range(6):
        camera = orbit_camera(k, size=(83, 75), distance=distance)
        image = deferred.render(truth, camera, lighting)
        alpha = image.gbuffer.all.alpha.numpy().reshape(75, 83, 1)
        shown = losses.display(image.color, image.gbuffer.all.alpha, 0.0).numpy().T.reshape(75, 83, 3)
        straight = shown / np.maximum(alpha, 1e-3)
        pixels = np.clip(np.concatenate([straight, alpha], 2) * 255 + 0.5, 0, 255).astype(np.uint8)
        views.append(View(f"r_{k}", camera, pixels, True, None, Path(f"r_{k}.png")))
    return Dataset(views, [])


def mirror_ball(n: int = 600) -> Surfels:
    """``n`` surfels of a ball of radius 1 that is nearly a mirror, without light of its own."""
    surfels = tangent_surfels(n, curvature=(1, 0, 1)).numpy()
    surfels |= {
        "metallic": np.full((n, 1), 0.95),
        "roughness": np.full((n, 1), 0.15),
        "opacities": np.full((n, 1), 0.98),
    }
    surfels |= {"base_color": np.full((n, 3), 0.9), "sh": np.full((n, 3), -0.5 / SH_0)}
    return Surfels.from_numpy(surfels, two_sided=False)


def photographs(surfels: Surfels, lighting: Lighting, cameras: Sequence[Camera], masked: bool = True) -> list[View]:
    """Photographs of ``surfels`` over black."""
    views = []
    for k, camera in enumerate(cameras):
        image = deferred.render(surfels, camera, lighting)
        alpha, (width, height) = image.gbuffer.all.alpha, camera.size
        shown = losses.display(image.color, alpha, 0.0).numpy().T / np.maximum(alpha.numpy()[:, None], 0.05)
        rgba = np.concatenate([shown, alpha.numpy()[:, None]], 1).reshape(height, width, 4)
        views.append(View(f"{k}", camera, np.uint8(255 * np.clip(rgba, 0, 1) + 0.5), masked, None, Path(f"{k}.png")))
    return views

"""Small scenes that several tests share."""

from dataclasses import replace

import numpy as np

from rgs_mi.core.camera import Camera
from rgs_mi.shading import deferred
from rgs_mi.shading.lighting import lighting_of
from rgs_mi.surfels.surfels import CHANNELS, Surfels, rotation_from_normal


def sphere_surfels(n, seed=0, scale=0.6, opacity_shift=1.0, order=1):
    """``n`` random surfels on the unit sphere, of all materials."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    normal = x + 0.1 * rng.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    logistic = lambda v: 1 / (1 + np.exp(-v))
    return Surfels.from_numpy(
        {
            "centers": x,
            "rotations": rotation_from_normal(normal, rng.uniform(0, 6, n)),
            "scales": np.exp(rng.normal(size=(n, 2)) * 0.3) * np.sqrt(4 * np.pi / n) * scale,
            "opacities": logistic(rng.normal(size=(n, 1)) + opacity_shift),
            "sh": rng.normal(size=(n, 3 * (order + 1) ** 2)) * 0.1,
            "base_color": rng.uniform(0.2, 0.9, (n, 3)),
            "roughness": rng.uniform(0.1, 0.9, (n, 1)),
            "metallic": rng.uniform(0.1, 0.9, (n, 1)),
            "delta_normal": rng.normal(size=(n, 3)) * 0.05,
            "curvature": 0.3 * rng.normal(size=(n, 3)),
        }
    )


def tangent_surfels(n, curvature=(0, 0, 0)):
    """``n`` random surfels, all alike, that touch the unit sphere; ``curvature`` in units of the sphere's."""
    scale = 0.6 * np.sqrt(4 * np.pi / n)
    base = sphere_surfels(n).numpy()
    return Surfels.from_numpy(
        base
        | {
            "rotations": rotation_from_normal(base["centers"]),
            "delta_normal": np.zeros((n, 3)),
            "curvature": np.tile(scale * np.array(curvature), (n, 1)),
            "scales": np.full((n, 2), scale),
            "opacities": np.full((n, 1), 0.8),
        },
        two_sided=False,
    )


def orbit_camera(angle=0.3, size=(48, 40), distance=4.0, fov=38.0):
    """A camera on a circle about the z axis that looks at the origin."""
    return Camera.look_at([distance * np.cos(angle), distance * np.sin(angle), 0.8], [0, 0, 0], [0, 0, 1], fov, size)


VARIED_CAMERAS = {
    "plain": orbit_camera(),
    "odd size": orbit_camera(2.0, (37, 53)),
    "inside reach": orbit_camera(1.0, (64, 64), distance=1.6),
    "principal point": replace(orbit_camera(0.7), principal=(11.0, 31.0)),
    "anisotropic pixels": replace(orbit_camera(0.2), focal=(90.0, 50.0)),
}


def layered_surfels(camera, seed):
    """Surfels one behind the other, turned to the camera, wider than a pixel: no small step changes their order or hands
    them to the low-pass, which are jumps and kinks that finite differences see and derivatives do not."""
    surfels, rng, n = sphere_surfels(12, seed=seed), np.random.default_rng(seed), 12
    right, down, forward = camera.rotation
    across = rng.uniform(-0.7, 0.7, (n, 2))
    centers = across[:, :1] * right + across[:, 1:] * down + np.linspace(-1.2, 1.2, n)[:, None] * forward
    normals = 0.1 * rng.normal(size=(n, 3)) - forward
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Surfels.from_numpy(
        surfels.numpy()
        | {
            "centers": centers,
            "rotations": rotation_from_normal(normals, rng.uniform(0, 6, n)),
            "scales": rng.uniform(0.15, 0.3, (n, 2)),
        }
    )


def shape(surfels):
    """The dict of the plugin `surfels` that has the fields of ``surfels``."""
    return {"type": "surfels"} | {name: getattr(surfels, name) for name in CHANNELS}


def colors(surfels, camera, shading, light):
    """[3, W · H] of what ``camera`` sees of ``surfels``, shaded as ``shading`` says under the `Environment` ``light``."""
    emitter = light.emitter() if shading.specular == "monte_carlo" else None
    seen = light.unfiltered() if emitter else light.filtered()
    return deferred.render(surfels, camera, lighting_of(shading, surfels, seen, emitter)).color.numpy()

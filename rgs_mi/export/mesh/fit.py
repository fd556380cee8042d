"""Base colour and metallic of a lit mesh fitted to photographs, as surfels are shaded: without noise.

What cameras see of surfels differs from view to view, and its mean is blurred. So the mesh itself is looked at: each step takes
some thousand pixels of one photograph, which the mesh fills, the means of the maps over four rays each, and shades these as
`deferred.py` does a G-buffer; Adam follows the gradient of the squared error of display values. Normals and roughness stay as
they were seen: they gain nothing.
"""

from collections.abc import Sequence
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.arrays import as_float
from ...core.camera import opaque, pixel_directions
from ...core.color import srgb
from ...core.interrupt import GracefulInterrupt
from ...core.progress import Progress
from ...shading.lighting import Lighting
from ...shading.surface import Surface
from .photographs import SATURATED, Photograph
from .surface import UVMesh, as_mitsuba
from .textures import Texels, Textures

_STEPS, _PIXELS = 300, 2**14
_RATE, _LAST = 8e-3, 0.1  # learning rate at first, and its part at the end
_SIDE = 2  # rays along a pixel's side
_CHANNELS = 4  # base colour, metallic


def fitted(
    textures: Textures,
    mesh: UVMesh,
    texels: Texels,
    visibility: np.ndarray,
    photographs: Sequence[Photograph],
    lighting: Lighting,
    quiet: bool = False,
) -> Textures:
    """Return the ``textures`` of a ``mesh`` with base color and metallic such that it looks like the ``photographs`` under the
    ``lighting``, in which it is lit; ``visibility`` [H, W, 3] is the texture of its irradiance visibility. Ctrl-C keeps what was
    reached."""
    scene = mi.load_dict({"type": "scene", "mesh": as_mitsuba(mesh)})
    lighting = replace(lighting, shader=None)  # which no other program has
    learned = np.concatenate([texels.at(image) for image in (textures.base_color, textures.metallic)], 1)
    known = [texels.at(image) for image in (textures.normal, textures.roughness, visibility)]
    known = np.concatenate([*known, np.zeros((len(learned), 1))], 1)
    maps = _Maps(mi.UInt32(texels.near.astype(np.uint32)), mesh.size, as_float(known))
    optimizer = mi.ad.Adam(lr=_RATE)
    optimizer["texels"] = as_float(learned)
    rng, order = np.random.default_rng(0), []
    with Progress(None, quiet, "fitting textures") as progress, GracefulInterrupt() as interrupt:
        for step in range(_STEPS):
            if interrupt.signal is not None:
                break
            order = order or rng.permutation(len(photographs)).tolist()
            optimizer.set_learning_rate(_RATE * _LAST ** (step / _STEPS))
            _step(scene, maps, optimizer, photographs[order.pop()], lighting, rng)
            progress.update((step + 1) / _STEPS)
    found = optimizer["texels"].numpy().reshape(-1, _CHANNELS)
    return replace(textures, base_color=texels.image(found[:, :3]), metallic=texels.image(found[:, 3:]))


def _step(scene, maps, optimizer, photograph, lighting, rng):
    """One step of Adam for some pixels of a ``photograph``."""
    inside = np.flatnonzero(photograph.object)
    if not len(inside):
        return
    some = inside[rng.integers(len(inside), size=_PIXELS)]
    pixel = mi.UInt32(some.astype(np.uint32))
    with dr.suspend_grad():
        corners, point, filled = _seen(scene, maps, photograph.camera, pixel)
        dr.eval(corners, point, filled)
        seen = replace(photograph, pixels=photograph.pixels.reshape(-1, 4)[some])
        y = mi.Color3f(*(as_float(channel) for channel in seen.radiance.T))
        gain = mi.Color3f(*(dr.opaque(mi.Float, float(g)) for g in photograph.exposure))
    base_color, metallic, normal, roughness, radiance = maps.means(corners, optimizer["texels"])
    lighting = lighting.seen_by(photograph.camera, _PIXELS)
    surface = Surface(
        dr.normalize(normal), -pixel_directions(photograph.camera, pixel), roughness, metallic, base_color, point
    )
    x = lighting.specular(surface) + lighting.diffuse(surface, lighting.irradiance_visibility(radiance))
    error = srgb(gain * x) - srgb(y)
    error = dr.select(filled & ~((y >= SATURATED) & (error > 0)), error, 0)
    dr.backward(dr.sum(dr.squared_norm(error)) / dr.opaque(mi.Float, _PIXELS))
    optimizer.step()
    optimizer["texels"] = dr.clip(optimizer["texels"], 0, 1)


def _seen(scene, maps, camera, pixel):
    """What the rays of each ``pixel`` meet: the `_Maps.corners` of each ray, the mean position, and whether all meet the mesh."""
    fine, _ = camera.subdivided(_SIDE**2)
    width = dr.opaque(mi.UInt32, camera.size[0])
    column, row = pixel % width * _SIDE, pixel // width * _SIDE
    corners, point, filled = [], mi.Point3f(0), mi.Bool(True)
    for k in range(_SIDE**2):
        direction = pixel_directions(fine, (row + k // _SIDE) * width * _SIDE + column + k % _SIDE)
        hit = scene.ray_intersect(mi.Ray3f(opaque(camera).origin, direction))
        corners += maps.corners(hit.uv)
        point += hit.p / _SIDE**2
        filled &= hit.is_valid()
    return corners, point, filled


class _Maps:
    """Textures that are known at texels: which of these each of the H × W texels is ``like``, their ``size`` (columns, rows), and
    the ``known`` numbers of each, eight: normal, roughness, irradiance visibility and a zero."""

    def __init__(self, like, size, known):
        self.like, self.size, self.known = like, [dr.opaque(mi.UInt32, n) for n in size], known

    def corners(self, uv):
        """[(texel, weight)] of the four about ``uv``, between which textures are linear."""
        x, y = (c * n - 0.5 for c, n in zip(uv, self.size))
        found = []
        for i, j in ((0, 0), (1, 0), (0, 1), (1, 1)):
            column, row = mi.Int32(dr.floor(x)) + i, mi.Int32(dr.floor(y)) + j
            weight = (1 - dr.abs(x - column)) * (1 - dr.abs(y - row))
            column, row = (dr.clip(c, 0, mi.Int32(n) - 1) for c, n in zip((column, row), self.size))
            found.append((dr.gather(mi.UInt32, self.like, mi.UInt32(row) * self.size[0] + mi.UInt32(column)), weight))
        return found

    def means(self, corners, learned):
        """(base color, metallic, normal, roughness, visibility), means over the rays of a pixel; differentiable in what is
        ``learned``, four numbers of each texel."""
        total = [mi.Vector4f(0) for _ in range(3)]
        for texel, weight in corners:
            packets = (
                dr.gather(mi.Vector4f, learned, texel),
                *(dr.gather(mi.Vector4f, self.known, texel * 2 + k) for k in (0, 1)),
            )
            total = [t + weight / _SIDE**2 * p for t, p in zip(total, packets)]
        own, shape, light = total
        return mi.Color3f(own.xyz), own.w, mi.Vector3f(shape.xyz), shape.w, mi.Color3f(light.xyz)

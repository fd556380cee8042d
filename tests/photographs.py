"""Photographs of a textured corner of a room, a floor and two walls, whose cameras are known: rendered by NumPy."""

import numpy as np
from PIL import Image
from scipy import ndimage

from rgs_mi.core.camera import Camera

from captures import distort

SIZE, FOCAL = (400, 300), 380.0
LENS = {"k1": -0.08, "k2": 0.02}
_TEXELS, _REACH = 700, 6.0  # along a side of a wall; units


def textures():
    """[3, T, T]: noise of several scales, as carpets and wallpapers are none."""
    rng = np.random.default_rng(5)
    noise = sum(ndimage.gaussian_filter(rng.normal(size=(3, _TEXELS, _TEXELS)), (0, s, s)) * s for s in (1.2, 2.5, 5, 10))
    return np.clip(0.5 + 0.28 * noise / noise.std(), 0.02, 0.98)


def ring(count, target=(1.2, 1.2, 0.6), span=75):
    """Cameras on an arc before the corner, up and down by turns, z up."""
    angles = np.radians(45 + np.linspace(-span / 2, span / 2, count))
    heights = np.where(np.arange(count) % 2, 1.0, 2.4)
    places = [np.array([5 * np.cos(a), 5 * np.sin(a), h]) for a, h in zip(angles, heights)]
    fov = 2 * np.degrees(np.arctan(SIZE[0] / (2 * FOCAL)))
    return [Camera.look_at(place, target, (0, 0, 1), fov, SIZE) for place in places]


def turning(count):
    """Cameras that stand still and look around."""
    fov = 2 * np.degrees(np.arctan(SIZE[0] / (2 * FOCAL)))
    targets = [(1.5 * np.cos(a), 1.5 * np.sin(a), 0.7) for a in np.radians(np.linspace(0, 90, count))]
    return [Camera.look_at((3.5, 3.5, 1.6), target, (0, 0, 1), fov, SIZE) for target in targets]


def photograph(camera, planes, **lens):
    """[H, W, 3] uint8, the corner of textured ``planes`` (`textures`) through a lens with distortion (`captures.distort`)."""
    x, y = camera.image_plane()
    seen = np.stack([x.ravel(), y.ravel()], -1)
    straight = seen.copy()
    for _ in range(12):  # the inverse of the distortion
        straight += seen - distort(straight, **lens)
    rays = np.c_[straight, np.ones(len(straight))] @ camera.rotation
    depth, color = np.full(len(rays), np.inf), np.full(len(rays), 0.5)
    for axis, texture in enumerate(planes):
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -camera.origin[axis] / rays[:, axis]
        points = camera.origin + t[:, None] * rays
        a, b = (points[:, k] * _TEXELS / _REACH for k in range(3) if k != axis)
        hit = (t > 0) & (t < depth) & (np.minimum(a, b) >= 0) & (np.maximum(a, b) < _TEXELS - 1)
        depth[hit] = t[hit]
        color[hit] = ndimage.map_coordinates(texture, [a[hit], b[hit]], order=1)
    grey = color.reshape(SIZE[::-1])
    return np.rint(255 * np.stack([grey, grey**1.2, grey**0.8], -1)).astype(np.uint8)


def write(folder, cameras, **lens):
    """Photographs p00.jpg, … in ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    planes = textures()
    for k, camera in enumerate(cameras):
        Image.fromarray(photograph(camera, planes, **lens)).save(folder / f"p{k:02d}.jpg", quality=95, subsampling=0)
    return folder

"""Masks that are drawn too large: by how much photographs tell, and what is left of them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from rgs_mi.core.camera import Camera
from rgs_mi.datasets.rims import _width, rim, without_rim
from rgs_mi.datasets.types import View

SIZE = (90, 70)


def photographs(larger=0, behind=128, texture=60, count=6):
    """Ellipses of a texture, masks ``larger`` by so many pixels, before a grey or before noise (``behind`` None)."""
    y, x = np.mgrid[: SIZE[1], : SIZE[0]] + 0.5
    views = []
    for k in range(count):
        rng = np.random.default_rng(k)
        shape = ((x - 44 - k) / (22 + 2 * k)) ** 2 + ((y - 36) / 20) ** 2 < 1
        inside = 190 + texture * ndimage.gaussian_filter(rng.normal(size=(*shape.shape, 3)), (3, 3, 0)) * 6
        outside = rng.uniform(0, 255, (*shape.shape, 3)) if behind is None else np.full((*shape.shape, 3), float(behind))
        image = np.where(ndimage.binary_erosion(shape)[..., None], inside, np.where(shape[..., None], inside, outside))
        mask = ndimage.distance_transform_edt(~shape) <= larger
        pixels = np.concatenate([np.clip(image, 0, 255), 255 * mask[..., None]], -1).astype(np.uint8)
        camera = Camera.look_at((3, 0, 0), (0, 0, 0), (0, 0, 1), 40, SIZE)
        views.append(View(str(k), camera, pixels, True, None, None))
    return views


@pytest.mark.parametrize("larger, found", [(0, 0), (1, 0), (2, 2), (3, 3), (5, 5)])
def test_how_wide_it_is(larger, found):
    assert rim(photographs(larger)) == found
    hdr = [replace(v, pixels=v.pixels.astype(np.float32) / 255) for v in photographs(larger)]
    assert rim(hdr) == found


def test_the_border_of_what_is_round_is_no_rim():
    """The helmet of `tests/room.py` has such borders, as exact as they can be: photographs change most half a pixel within."""
    profile = np.float32([11, 12, 11, 11, 12, 13, 19, 63, 95, 70, 81, 79, 66, 57, 50, 45])
    assert _width(profile) == 0
    assert _width(np.roll(profile, 2)) == 3


def test_what_does_not_tell():
    assert rim(photographs(3, behind=None)) == 0  # as much goes on behind the object as at its edge
    views = photographs(3)
    assert rim([]) == rim([replace(v, masked=False) for v in views]) == 0
    filled = [replace(v, pixels=np.full_like(v.pixels, alpha)) for v in views for alpha in (0, 255)]
    assert rim(filled) == 0
    tiny = [replace(v, camera=v.camera.cropped(20, 30, 5, 4), pixels=v.pixels[30:34, 20:25]) for v in views]
    assert rim(tiny) == 0


def test_without_it():
    views = photographs(3)
    true = [v.alpha > 0.5 for v in photographs(0)]
    for view, shape in zip(views, true):
        left = without_rim(view, 3)
        assert abs(left.alpha.sum() - shape.sum()) < 0.02 * shape.sum() < 0.2 * shape.sum() < view.alpha.sum() - shape.sum()
        assert np.abs(left.alpha - shape).sum() < 0.03 * shape.sum()
        assert left.pixels is not view.pixels and (left.pixels[..., :3] == view.pixels[..., :3]).all()
        assert without_rim(view, 0) is view and without_rim(replace(view, masked=False), 3).alpha.sum() == view.alpha.sum()
        assert without_rim(view, 60) is view  # nothing would be left


def test_the_frame_is_no_border():
    view = photographs(2)[5]
    cut = replace(view, camera=view.camera.cropped(40, 0, 50, 70), pixels=view.pixels[:, 40:])
    assert (without_rim(cut, 2).alpha == without_rim(view, 2).alpha[:, 40:]).all()

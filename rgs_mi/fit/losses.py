"""Image losses and geometric regularizers, all on Dr.Jit arrays with one entry per pixel (row-major); a loss has width 1."""

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import as_float
from ..core.camera import Camera, pixel_rays
from ..core.color import srgb
from ..shading.deferred import COVERED
from ..splat.gbuffer import GBuffer, Maps
from ..surfels.surfels import columns_of

SATURATED = 0.995  # display value from which a photograph only says "at least this bright"
_WINDOW, _SIGMA, _STRIP = 11, 1.5, 8  # SSIM's Gaussian window, and how many pixels of a column are blurred together
_C1, _C2 = 0.01**2, 0.03**2
_SLOPE = 4.0  # change of log radiance per radian up to which it counts by its square
_APART, _BEND = 0.015, 0.015  # of `minimum_variation`: part of the image's width; radians
_FLAT = 1e-6  # standard deviation of a depth map, in units of its depth, up to which it is constant


def completed(color: "mi.Color3f", alpha: "mi.Float", left: float) -> "tuple[mi.Color3f, mi.Float]":
    """Return premultiplied ``color`` and ``alpha`` as if pixels that end once their transmittance falls to ``left`` had gone
    on: what is left shows more of the same. Else the background would shine through what hides it, where a finished
    rendering has none of it."""
    whole = dr.rcp(dr.maximum(alpha, 1 - left))
    return color * whole, alpha * whole


def display(color: "mi.Color3f", alpha: "mi.Float", background: "float | mi.Color3f") -> "mi.Color3f":
    """Composite premultiplied linear ``color`` over ``background``, of display values, in display space, as data
    sets with straight alpha are: srgb(color / alpha) alpha + background (1 − alpha)."""
    covered = alpha > COVERED
    safe = dr.select(covered, alpha, 1)
    return dr.select(covered, srgb(color / safe) * alpha, 0) + background * (1 - alpha)


class _Evaluated(dr.CustomOp):
    """The custom operation of `evaluated_adjoint`."""

    def eval(self, color):
        return color

    def forward(self):
        self.set_grad_out(self.grad_in("color"))

    def backward(self):
        adjoint = self.grad_out()
        dr.eval(adjoint)
        self.set_grad_in("color", adjoint)

    def name(self):
        return "rgs_mi.fit.losses.Evaluated"


def evaluated_adjoint(color: "mi.Color3f") -> "mi.Color3f":
    """Return ``color``, whose adjoint is evaluated, once for its channels together: what gathers from it, or sums it up, would
    make a kernel for each, with all that lies behind."""
    return dr.custom(_Evaluated, color)


class _Blur(dr.CustomOp):
    """SSIM's Gaussian window over a list of images, zero beyond their edges: symmetric, so it is its own adjoint."""

    def eval(self, channels, size):
        self.size = size
        return self._apply(channels)

    def forward(self):
        self.set_grad_out(self._apply(self.grad_in("channels")))

    def backward(self):
        self.set_grad_in("channels", self._apply(self.grad_out()))

    def _apply(self, channels):
        (width, height), count = self.size, len(channels)
        dr.eval(channels)
        index = dr.arange(mi.UInt32, width * height)
        planes = dr.empty(mi.Float, count * width * height)
        for k, channel in enumerate(channels):
            dr.scatter(planes, channel, index + k * (width * height))
        planes, transposed = _blurred_columns(planes, count, (width, height), width)
        planes, stride = _blurred_columns(planes, count, (height, width), transposed)
        at = index // width * stride + index % width
        return [dr.gather(mi.Float, planes, at + k * (height * stride)) for k in range(count)]

    def name(self):
        return "rgs_mi.fit.losses.Blur"


def _blurred_columns(planes, count, size, stride):
    """(``count`` images, one after the other, blurred along their columns and transposed; the floats of a row of these). The
    images come with ``size`` (width, height) and rows of ``stride`` floats. A lane blurs `_STRIP` pixels of a column, of
    which neighbours share nearly all that they read."""
    (width, height), reach = size, _WINDOW // 2
    weights = np.exp(-0.5 * (np.arange(_WINDOW) - reach) ** 2 / _SIGMA**2)
    _, *weights = (weights / weights.sum())[reach - 1 :].tolist()
    strips = -(-height // _STRIP)
    lane = dr.arange(mi.UInt32, count * width * strips)
    x, strip, image = lane % width, lane // width % strips, lane // (width * strips)
    column, first = mi.Int32(image * (height * stride) + x), mi.Int32(strip * _STRIP) - reach
    rows = [first + k for k in range(_STRIP + 2 * reach)]
    read = [dr.gather(mi.Float, planes, mi.UInt32(column + y * stride), (y >= 0) & (y < height)) for y in rows]
    blurred = []
    for k in range(reach, reach + _STRIP):
        value = weights[0] * read[k]
        for offset, weight in enumerate(weights[1:], 1):
            value = dr.fma(weight, read[k - offset] + read[k + offset], value)
        blurred.append(value)
    out = dr.empty(mi.Float, count * width * strips * _STRIP)
    dr.scatter(out, mi.ArrayXf(*blurred), (image * width + x) * strips + strip)
    dr.eval(out)
    return out, strips * _STRIP


def ssim(image: "mi.Color3f", target: "mi.Color3f", size: tuple[int, int]) -> "mi.Float":
    """Return the structural similarity of two images of ``size`` (width, height) at each pixel, the mean of its channels, with
    an 11 × 11 Gaussian window of σ 1.5 (Wang et al. 2004); differentiable in the first."""
    with dr.suspend_grad():
        mu_y = mi.Color3f(*dr.custom(_Blur, list(target), size))
    blurred = dr.custom(_Blur, [*image, *(image * image + target * target), *(image * target)], size)
    mu_x, squares, xy = (mi.Color3f(*blurred[3 * k : 3 * k + 3]) for k in range(3))
    means, product = mu_x * mu_x + mu_y * mu_y, mu_x * mu_y  # of variances only the sum is asked for
    value = ((2 * product + _C1) * (2 * (xy - product) + _C2)) / ((means + _C1) * (squares - means + _C2))
    return dr.mean(value)


def photometric(image: "mi.Color3f", target: "mi.Color3f", size: tuple[int, int], dssim: float) -> "mi.Float":
    """Return (1 − λ) L1 + λ (1 − SSIM)/2 with λ = ``dssim`` (3DGS) at each pixel, of display values.

    Where the photograph is saturated a brighter rendering is no error, and a too bright rendering elsewhere still feels its
    gradient.
    """
    image = dr.select(target >= SATURATED, dr.minimum(image, target), image)
    l1 = dr.mean(dr.abs(image - target))
    return (1 - dssim) * l1 + dssim * (1 - ssim(image, target, size)) / 2


def mask(alpha: "mi.Float", target: "mi.Float") -> "mi.Float":
    """Return the mean absolute difference of coverage ``alpha`` and mask ``target``."""
    return dr.mean(dr.abs(alpha - target))


class _Shifted(dr.CustomOp):
    """A list of images as others see them, once for each of ``offsets``, one after the other: each pixel what so many pixels
    further has, zero beyond the ends. Its adjoint is a gather, too, where that of a plain gather would add atomically."""

    def eval(self, channels, offsets):
        self.offsets = offsets
        return self._apply(channels)

    def forward(self):
        self.set_grad_out(self._apply(self.grad_in("channels")))

    def backward(self):
        adjoint = list(self.grad_out())
        dr.eval(adjoint)
        count = len(adjoint) // len(self.offsets)
        parts = [self._shift(adjoint[k * count : (k + 1) * count], -offset) for k, offset in enumerate(self.offsets)]
        self.set_grad_in("channels", [sum(values, mi.Float(0)) for values in zip(*parts)])

    def _apply(self, channels):
        dr.eval(channels)
        return [value for offset in self.offsets for value in self._shift(channels, offset)]

    @staticmethod
    def _shift(channels, offset):
        count = dr.width(channels)
        at = dr.arange(mi.Int32, count) + offset
        inside = (at >= 0) & (at < count)
        return [dr.gather(mi.Float, c, mi.UInt32(at), inside) for c in channels]

    def name(self):
        return "rgs_mi.fit.losses.Shifted"


def _beside(image, offsets):
    """What the pixels so many further on (row-major) have of an ``image`` (a list of channels), for each of ``offsets``."""
    kind, values = type(image), dr.custom(_Shifted, list(image), offsets)
    return [kind(*values[k : k + len(image)]) for k in range(0, len(values), len(image))]


def _interior(gbuffer):
    """Which pixels are covered together with their four neighbours."""
    (width, height), alpha = gbuffer.size, dr.detach(gbuffer.all.alpha)
    with dr.suspend_grad():
        dr.eval(alpha)  # a gather from a packet that is not evaluated yet crashes (Dr.Jit 1.5.0)
        index = dr.arange(mi.UInt32, width * height)
        x, y = index % width, index // width
        inner = (x > 0) & (y > 0) & (x + 1 < width) & (y + 1 < height)
        for neighbour in (index, index - 1, index + 1, index - width, index + width):
            inner &= dr.gather(mi.Float, alpha, neighbour, inner) > 0.5
        dr.eval(inner)
        return inner


def depth_normal_consistency(gbuffer: GBuffer, camera: Camera) -> "mi.Float":
    """Return the depth-normal consistency (2DGS): the mean of 1 − n·n_D over the image, with n the rendered normal and n_D
    that of the surface which the rendered (expected) depth describes, by central differences."""
    (width, height), m, inner = gbuffer.size, gbuffer.all, _interior(gbuffer)
    rays = pixel_rays(camera, dr.arange(mi.UInt32, width * height))
    point = rays * (m.depth / dr.select(m.alpha > 0.5, m.alpha, 1))  # relative to the camera, world space
    left, right, above, below = _beside(point, (-1, 1, -width, width))
    unit = lambda v: dr.normalize(dr.select(inner, v, mi.Vector3f(0, 0, 1)))
    n, n_depth = unit(m.normal), unit(dr.cross(below - above, right - left))
    return dr.sum(dr.select(inner, 1 - dr.dot(n, n_depth), 0)) / (width * height)


def distortion(maps: Maps, extent: float) -> "mi.Float":
    """Return 2DGS's depth distortion, the mean over the image of Σ_ij w_i w_j (t_i − t_j)² = 2 (Σw Σwt² − (Σwt)²), in units
    of the squared radius ``extent`` of the object: it draws surfels along a ray together. ``maps`` are those of all
    pixels."""
    return dr.mean(2 * (maps.alpha * maps.square - dr.square(maps.depth))) / dr.opaque(mi.Float, float(extent) ** 2)


def normal_smoothness(gbuffer: GBuffer, reflective: np.ndarray, crease: float = 0.0) -> "mi.Float":
    """Return RGS's L_normal: the mean squared forward difference of N from pixel to pixel, where both are ``reflective``
    (β̂, [H, W] bool). With ``crease``, d² counts as d² / (1 + d²/crease²): noise of a few degrees is smoothed, an edge of
    the object is let be."""
    inner, here = _interior(gbuffer), gbuffer.all.normal
    total, pairs = mi.Float(0), mi.Float(0)
    right, below = _beside(here, (1, gbuffer.size[0]))
    for axis, beside in ((1, right), (0, below)):
        counted = inner & (as_float(reflective & np.roll(reflective, -1, axis)) > 0)  # what is rolled in is not interior
        d2 = dr.squared_norm(beside - here)
        total += dr.sum(dr.select(counted, d2 / (1 + d2 / crease**2) if crease > 0 else d2, 0))
        pairs += mi.Float(dr.count(counted))
    return 2 * total / dr.maximum(pairs, 1)


def minimum_variation(gbuffer: GBuffer, reflective: np.ndarray, corner: tuple[int, int] = (0, 0)) -> "mi.Float":
    """Return how fast the curvature of smooth surfaces changes (minimum-variation surfaces, Moreton and Séquin 1992). Where
    a flat mirror shows each part of the environment to few photographs, they agree with any wobble of it; held-out views
    don't.

        mean of F d² / (1 + d²/ε²),   d = ‖N(p + s) − 2 N(p) + N(p − s)‖,   F = lerp(0.04, 1, metallic(p))

    over pixels p and steps s, to the right and down, of `_APART` image widths, with unit normals N. What changes by more
    than ε = `_BEND`, an edge or the end of one, is let be. F, which has no gradient, is what is reflected at normal
    incidence (metals as if white): it keeps the balance with the photographs, which say the less about normals the less is
    reflected. All three pixels are ``reflective`` (β̂, [H, W] bool). Of every 2 × 2 pixels only the one at ``corner`` (row,
    column) is a p.
    """
    width = gbuffer.size[0]
    apart = max(1, round(_APART * width))
    total, count = mi.Float(0), 0
    for axis, stride in ((1, apart), (0, apart * width)):
        triple = reflective & np.roll(reflective, apart, axis) & np.roll(reflective, -apart, axis)
        np.moveaxis(triple, axis, 0)[:apart] = np.moveaxis(triple, axis, 0)[-apart:] = False  # rolled in from the other side
        chosen = np.zeros_like(triple)
        chosen[corner[0] :: 2, corner[1] :: 2] = triple[corner[0] :: 2, corner[1] :: 2]
        index, step = dr.compress(as_float(chosen) > 0), dr.opaque(mi.UInt32, stride)
        if dr.width(index) == 0:
            continue
        here, ahead, behind = (gbuffer.maps(i) for i in (index, index + step, index - step))
        n = lambda maps: dr.normalize(maps.normal)
        d2 = dr.squared_norm(n(ahead) - 2 * n(here) + n(behind))
        reflectance = dr.lerp(0.04, 1, dr.detach(here.metallic))
        total += dr.sum(reflectance * d2 / (1 + d2 / _BEND**2))
        count += dr.width(index)
    return total / dr.opaque(mi.Float, max(count, 1))


def delta_normal(gbuffer: GBuffer) -> "mi.Float":
    """Return RGS's L_Δn: the mean of ‖ΔN‖ over the image, of which ``gbuffer`` has all maps."""
    length2 = dr.squared_norm(gbuffer.all.delta_normal)
    nonzero = length2 > 0
    return dr.sum(dr.select(nonzero, dr.sqrt(dr.select(nonzero, length2, 1)), 0)) / (gbuffer.size[0] * gbuffer.size[1])


def residual(radiance: "mi.Color3f", lit: "mi.Color3f", shown: "mi.Float") -> "mi.Float":
    """Return the mean absolute difference of the diffuse ``radiance`` of surfels and of what their base color reflects, ``lit``,
    both linear, one entry a surfel, which counts by the area that is ``shown`` of it:

        Σ a |C_d − C_d^lit| / Σ a                                                                   (21)

    Photographs leave open what of a radiance is light and what is material: (21) takes for light what the base color can
    reflect."""
    d = dr.abs(radiance - lit)
    return dr.sum(shown * (d.x + d.y + d.z)) / (3 * dr.maximum(dr.sum(shown), 1e-12))


def pearson_depth(depth: "mi.Float", prior: "mi.Float", valid: "mi.Bool", inverse: bool = False) -> "mi.Float":
    """Return RGS's L_depth: 1 − r, with r Pearson's correlation of the rendered z-depth and a prior's over the ``valid``
    pixels.

    ``valid`` says where ``depth`` and ``prior`` are both known; pixels where one is not finite never count. Where
    ``inverse``, the prior holds inverse depths, which are compared with 1/z (z > 0 where valid). The loss is differentiable
    in ``depth``. r knows neither scale nor shift of the prior; where one of the two
    maps is constant, or fewer than two pixels are valid, it isn't defined, and the loss and its gradient are 0.
    """
    with dr.suspend_grad():
        valid = valid & dr.isfinite(prior) & dr.isfinite(depth)
        if inverse:
            valid &= depth > 0
        count = mi.Float(dr.maximum(dr.count(valid), 1))
    x = dr.rcp(dr.select(valid, depth, 1)) if inverse else depth
    x, spread_x = _centered(x, valid, count)
    y, spread_y = _centered(prior, valid, count)
    defined = (spread_x > 0) & (spread_y > 0)
    r = dr.sum(x * y) / dr.select(defined, spread_x * spread_y, 1)
    return dr.select(defined, 1 - r, 0)


def environment_total_variation(log_radiance: "mi.TensorXf") -> "mi.Float":
    """Return the total variation of an environment, 1/4π ∫ |∇ log L| dω per radian, summed over channels: each derivative d,
    along rows and columns, counts as √(d² + `_SLOPE`²) − `_SLOPE`: gentle slopes by their square, edges by their height.

    ``log_radiance`` is [rows, columns, 3], with rows from pole to pole as in `Environment`.
    """
    rows, columns, _ = log_radiance.shape
    polar, azimuthal = np.pi / (rows - 1), 2 * np.pi / columns  # angles from texel to texel
    index = dr.arange(mi.UInt32, rows * columns)
    row, column = index // columns, index % columns
    length = lambda d: dr.sum(dr.sqrt(dr.square(d) + _SLOPE**2) - _SLOPE)
    sine = dr.sin(mi.Float(row) * polar)
    ring = (row > 0) & (row + 1 < rows)  # the poles are points
    here = mi.Color3f(*columns_of([log_radiance.array], [3]))
    beside, around, below = _beside(here, (1, 1 - columns, columns))
    right = dr.select(column + 1 < columns, beside, around)
    along = dr.select(ring, right - here, 0) / dr.select(ring, azimuthal * sine, 1)
    middle = dr.sin((mi.Float(row) + 0.5) * polar)
    down = (below - here) / polar
    total = dr.select(ring, length(along) * sine, 0) + dr.select(row + 1 < rows, length(down) * middle, 0)
    return dr.sum(total) * (polar * azimuthal / (4 * np.pi))


def _centered(x, valid, count):
    """The ``valid`` entries of ``x`` less their mean (0 in the others), and the root of the sum of their squares; that is 0
    where the map is constant but for rounding."""
    with dr.suspend_grad():
        base = dr.min(dr.select(valid, x, dr.inf))  # first, so that a sum of many alike numbers loses nothing
    x = dr.select(valid, x - base, 0)
    x = dr.select(valid, x - dr.sum(x) / count, 0)
    square = dr.sum(x * x)
    varies = square > count * dr.square(_FLAT * base)
    return x, dr.select(varies, dr.sqrt(dr.select(varies, square, 1)), 0)

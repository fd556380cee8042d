"""Front-to-back compositing of surfels in one walk over the tile intersections, and its replayed adjoint (docs/method.md §2).

Per pixel, over its block's surfels front to back, with T_1 = 1:

    α_i = o_i exp(−½ min(u² + v², low_pass |δ|²)),   w_i = T_i α_i,   T_{i+1} = T_i − w_i,
    image = Σ_i w_i (features_i, t_i, 1), and where asked t_i²                                     (2)

The normal among the features is n_i + u ∂n_i/∂u + v ∂n_i/∂v, with the derivatives of `Surfels.normal_derivatives`;
where the low-pass decides, it is the center's, as the depth is.

The adjoint walks the same lists again, front to back, and stores nothing per step. With g_i the inner product of the
pixel's adjoint with surfel i's vector in (2), and rest_i = Σ_{j>i} w_j g_j,

    ∂L/∂w-part: w_i · adjoint      ∂L/∂α_i = T_i g_i − rest_i / (1 − α_i)                          (3)

and the chain from α, t, u and v down to the ten numbers of a projected Gaussian is written out in `Hit.vjp`. The tangent
(forward mode) walks it a third way: Ṫ_{i+1} = Ṫ_i − ẇ_i.
"""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .hit import PACKET, FetchAll, Hit, adding, fetch, pack, padded
from .intersect import TileIntersections
from .project import GEOMETRY, Projected
from .tiles import Cutoffs, block_pixels

_NORMAL = 3  # the first of its three features
_DERIVATIVES = 6  # floats


@dataclass(frozen=True)
class Layout:
    """How ``features`` channels lie in a projected Gaussian's row (ten geometric numbers, the features, the derivatives of the
    normal, if that is among them, padded) and in a pixel (features, depth, alpha, with ``squares`` also depth², padded), and
    the constants of the walk. ``normals`` says whether the fourth to sixth feature are the normal."""

    size: tuple[int, int]
    features: int
    cutoffs: Cutoffs = Cutoffs()
    squares: bool = False
    normals: bool = True

    @property
    def gaussian(self) -> int:
        """Floats in a projected Gaussian's row."""
        return padded(self.columns)

    @property
    def columns(self) -> int:
        """Floats in a projected Gaussian's row, without padding."""
        return len(GEOMETRY) + self.features + _DERIVATIVES * self.normals

    @property
    def pixel(self) -> int:
        """Floats in a pixel."""
        return padded(self.values)

    @property
    def values(self) -> int:
        """Floats in a pixel, without padding."""
        return self.features + 2 + self.squares


def _normal_derivatives(gaussian, layout):
    """(∂n/∂u, ∂n/∂v) of a projected Gaussian, a list each; empty ones without normals."""
    if not layout.normals:
        return [], []
    end = len(GEOMETRY) + layout.features
    return gaussian[end : end + 3], gaussian[end + 3 : end + _DERIVATIVES]


def _turned(gaussian, layout, offset):
    """What the normal of a projected Gaussian changes by, ``offset`` (u, v) from its center."""
    return [offset[0] * a + offset[1] * b for a, b in zip(*_normal_derivatives(gaussian, layout))]


def _features(gaussian, layout, offset):
    """The features of a projected Gaussian where a pixel meets it, ``offset`` (u, v) from its center."""
    values = gaussian[len(GEOMETRY) : len(GEOMETRY) + layout.features]
    for k, turn in enumerate(_turned(gaussian, layout, offset), _NORMAL):
        values[k] = values[k] + turn
    return values


def _walk(isects, layout, state, body):
    """Run ``body(surfel, pixels, T, state) -> (T, state)`` over every block's list; T and state are lists with an entry per
    pixel of a block. Returns the final state."""
    _, pixels = block_pixels(layout.size)
    centers = [(mi.Float(x) + 0.5, mi.Float(y) + 0.5) for x, y in pixels]
    end = isects.first + isects.count

    def alive(i, T, state):
        greatest = T[0]
        for t in T[1:]:
            greatest = dr.maximum(greatest, t)
        return (i < end) & (greatest > layout.cutoffs.transmittance_min)

    def step(i, T, state):
        T, state = body(dr.gather(mi.UInt32, isects.ids, i), centers, T, state)
        return i + 1, T, state

    T = [mi.Float(1) for _ in pixels]
    return dr.while_loop((mi.UInt32(isects.first), T, state(len(pixels))), alive, step, label="splat")[2]


def _image_rows(layout):
    """(row-major index of the pixel, inside the image?) for each pixel of a block."""
    width, height = layout.size
    _, pixels = block_pixels(layout.size)
    return [(y * width + x, (x < width) & (y < height)) for x, y in pixels]


def _gather_image(image, layout):
    return [fetch(image, row, layout.pixel, inside) for row, inside in _image_rows(layout)]


def _scatter_image(values, layout):
    """Block order to row-major pixels: ``mi.Float`` of width H · W · layout.pixel."""
    width, height = layout.size
    dr.eval(values)  # otherwise every scatter below would walk the lists again
    image = dr.empty(mi.Float, width * height * layout.pixel)
    for (row, inside), value in zip(_image_rows(layout), values):
        value = value + [mi.Float(0)] * (layout.pixel - len(value))
        for q in range(layout.pixel // PACKET):
            dr.scatter(image, mi.Vector4f(*value[PACKET * q : PACKET * (q + 1)]), row * (layout.pixel // PACKET) + q, inside)
    return image


class Composite(dr.CustomOp):
    """The custom operation from projected Gaussians, the columns of their rows, to the image of (2), with its adjoint (3) and
    its tangent."""

    def eval(self, columns: "list[mi.Float]", isects: TileIntersections, layout: Layout) -> "mi.Float":
        self.gaussian, self.isects, self.layout = pack([dr.detach(column) for column in columns]), isects, layout
        self.surfels, n = dr.width(columns), layout.features

        def body(surfel, centers, T, out):
            r = fetch(self.gaussian, surfel, layout.gaussian)
            for k, (x, y) in enumerate(centers):
                hit = Hit(r, x, y, layout.cutoffs)
                w = T[k] * hit.alpha
                features = _features(r, layout, hit.offset)
                alpha, squares = out[k][n + 1] + w, [dr.fma(w, hit.t * hit.t, o) for o in out[k][n + 2 :]]
                out[k] = [dr.fma(w, value, o) for o, value in zip(out[k], [*features, hit.t])] + [alpha, *squares]
                T[k] = T[k] - w
            return T, out

        out = _walk(isects, layout, lambda pixels: [[mi.Float(0)] * layout.values for _ in range(pixels)], body)
        self.image = _scatter_image(out, layout)
        dr.eval(self.image)
        return self.image

    def backward(self) -> None:
        layout, n = self.layout, self.layout.features
        adjoint = _gather_image(self.grad_out(), layout)
        image = _gather_image(self.image, layout)
        rest = [sum((a * o for a, o in zip(adj, out)), mi.Float(0)) for adj, out in zip(adjoint, image)]
        dr.eval(adjoint, rest)
        gradient = dr.zeros(mi.Float, dr.width(self.gaussian))
        mode = adding(dr.width(gradient))
        stride = layout.gaussian // PACKET

        def body(surfel, centers, T, rest):
            r = fetch(self.gaussian, surfel, layout.gaussian)
            total = [mi.Float(0)] * layout.gaussian
            for k, (x, y) in enumerate(centers):
                hit = Hit(r, x, y, layout.cutoffs)
                w = T[k] * hit.alpha
                g, d_normal = adjoint[k][n + 1], [w * a for a in adjoint[k][_NORMAL : _NORMAL + 3 * layout.normals]]
                for a, value in zip(adjoint[k], [*_features(r, layout, hit.offset), hit.t]):
                    g = dr.fma(a, value, g)
                d_t = adjoint[k][n]
                if layout.squares:
                    g = dr.fma(adjoint[k][n + 2], hit.t * hit.t, g)
                    d_t = dr.fma(2 * hit.t, adjoint[k][n + 2], d_t)
                rest[k] = rest[k] - w * g
                d_alpha = T[k] * g - rest[k] * dr.rcp(1 - hit.alpha)
                d_offset = [sum((a * d for a, d in zip(v, d_normal)), mi.Float(0)) for v in _normal_derivatives(r, layout)]
                local = hit.vjp(r, d_alpha, w * d_t, d_offset)
                local += [w * a for a in adjoint[k][:n]] + [d * a for d in hit.offset for a in d_normal]
                total = [t + l for t, l in zip(total, local)] + total[len(local) :]
                T[k] = T[k] - w
            for q in range(stride):
                dr.scatter_reduce(
                    dr.ReduceOp.Add,
                    gradient,
                    mi.Vector4f(*total[PACKET * q : PACKET * (q + 1)]),
                    surfel * stride + q,
                    mode=mode,
                )
            return T, rest

        dr.eval(_walk(self.isects, layout, lambda pixels: rest, body))
        rows = fetch(gradient, dr.arange(mi.UInt32, self.surfels), layout.gaussian)
        self.set_grad_in("columns", rows[: layout.columns])

    def forward(self) -> None:
        layout, n = self.layout, self.layout.features
        tangent = pack(self.grad_in("columns"))

        def body(surfel, centers, T, state):
            r, r_ = (fetch(b, surfel, layout.gaussian) for b in (self.gaussian, tangent))
            for k, (x, y) in enumerate(centers):
                hit = Hit(r, x, y, layout.cutoffs)
                alpha_, t_, offset_ = hit.jvp(r, r_)
                T_, out_ = state[k]
                values, values_ = (_features(b, layout, hit.offset) for b in (r, r_))
                for c, turn_ in enumerate(_turned(r, layout, offset_), _NORMAL):
                    values_[c] = values_[c] + turn_
                w, w_ = T[k] * hit.alpha, T_ * hit.alpha + T[k] * alpha_
                squares = [o + (w_ * hit.t + 2 * w * t_) * hit.t for o in out_[n + 2 :]]
                out_ = [o + w_ * f + w * f_ for o, f, f_ in zip(out_, [*values, hit.t], [*values_, t_])]
                out_ += [state[k][1][n + 1] + w_, *squares]
                state[k], T[k] = (T_ - w_, out_), T[k] - w
            return T, state

        start = lambda pixels: [(mi.Float(0), [mi.Float(0)] * layout.values) for _ in range(pixels)]
        state = _walk(self.isects, layout, start, body)
        self.set_grad_out(_scatter_image([out_ for _, out_ in state], layout))

    def name(self) -> str:
        return "rgs_mi.splat.Composite"


def composite(projected: Projected, features: "list[mi.Float]", isects: TileIntersections, layout: Layout) -> "mi.Float":
    """Return the image of (2), of width H · W · layout.pixel, row-major, each pixel (features, depth, alpha, perhaps depth²,
    padding). ``features`` have width N; the normal's three come after the first three, if ``layout`` says that they do.
    Differentiable in the projected Gaussians, in both modes."""
    derivatives = [value for derivative in projected.normal_derivatives for value in derivative] if layout.normals else []
    return dr.custom(Composite, projected.geometry + features + derivatives, isects, layout)


class Planes(FetchAll):
    """The custom operation of `planes`."""

    def name(self) -> str:
        return "rgs_mi.splat.Planes"


def planes(image: "mi.Float", stride: int) -> "list[mi.Float]":
    """Return the ``stride`` floats of all pixels of an ``image`` that has so many a pixel; differentiable."""
    return dr.custom(Planes, image, stride)


def median_depth(projected: Projected, isects: TileIntersections, size: tuple[int, int]) -> "tuple[mi.Float, mi.Float]":
    """Return the depth at which half of each pixel's light is left, of width W · H, row-major: that of the first surfel behind
    which the transmittance T of (2) is at most ½ (2DGS); 0 where there is none. And the pixel's coverage, 1 less the last T. Not
    differentiated."""
    layout, stride = Layout(size, 0), padded(len(GEOMETRY))

    def body(surfel, centers, T, state):
        r = fetch(gaussian, surfel, stride)
        for k, (x, y) in enumerate(centers):
            hit = Hit(r, x, y, layout.cutoffs)
            behind = T[k] * (1 - hit.alpha)
            state[k] = (dr.select((T[k] > 0.5) & (behind <= 0.5), hit.t, state[k][0]), 1 - behind)
            T[k] = behind
        return T, state

    with dr.suspend_grad():
        gaussian = pack(projected.geometry)
        state = _walk(isects, layout, lambda pixels: [(mi.Float(0), mi.Float(0))] * pixels, body)
        dr.eval(state)  # otherwise every scatter below would walk the lists again
        depth, coverage = (dr.empty(mi.Float, size[0] * size[1]) for _ in range(2))
        for (row, inside), values in zip(_image_rows(layout), state):
            for image, value in zip((depth, coverage), values):
                dr.scatter(image, value, row, inside)
    return depth, coverage

"""Front-to-back compositing of surfels in one walk over the lists, and its replayed adjoint.

Per pixel, over its lane's surfels front to back, with T_1 = 1:

    α_i = o_i exp(−½ min(u² + v², LOW_PASS |δ|²)),   w_i = T_i α_i,   T_{i+1} = T_i − w_i,
    image = Σ_i w_i (features_i, t_i, 1), and where asked t_i²                                     (2)

The normal among the features is n_i + u ∂n_i/∂u + v ∂n_i/∂v, what `Surfels.slopes` makes of it; where the low-pass decides,
it is the centre's, as the depth is.

The adjoint walks the same lists again, front to back, and stores nothing per step. With g_i the inner product of the
pixel's adjoint with surfel i's vector in (2), and rest_i = Σ_{j>i} w_j g_j,

    ∂L/∂w-part: w_i · adjoint      ∂L/∂α_i = T_i g_i − rest_i / (1 − α_i)                          (3)

and the chain from α, t, u and v down to the ten numbers of a record is written out in `Hit.pull_back`. The tangent
(forward mode) walks it a third way: Ṫ_{i+1} = Ṫ_i − ẇ_i.
"""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .hit import PACKET, Hit, adding, fetch, pack, padded
from .project import GEOMETRY
from .tiles import Cutoffs, lane_pixels

_NORMAL = 3  # the first of its three features
_SLOPES = 6  # floats


@dataclass(frozen=True)
class Layout:
    """How ``features`` channels lie in a record (ten geometric numbers, the features, the normal's slopes, padded) and in a
    pixel (features, depth, alpha, with ``squares`` also depth², padded), and the constants of the walk."""

    size: tuple[int, int]
    features: int
    cutoffs: Cutoffs = Cutoffs()
    squares: bool = False

    @property
    def record(self):
        return padded(len(GEOMETRY) + self.features + _SLOPES)

    @property
    def pixel(self):
        return padded(self.values)

    @property
    def values(self):
        """Numbers in a pixel, without padding."""
        return self.features + 2 + self.squares


def _slopes(record, layout):
    """(∂n/∂u, ∂n/∂v) of a record, a list each."""
    end = len(GEOMETRY) + layout.features
    return record[end : end + 3], record[end + 3 : end + _SLOPES]


def _turned(record, layout, offset):
    """What the normal of a record changes by, ``offset`` (u, v) from its centre."""
    return [offset[0] * a + offset[1] * b for a, b in zip(*_slopes(record, layout))]


def _features(record, layout, offset):
    """The features of a record where a pixel meets it, ``offset`` (u, v) from its centre."""
    values = record[len(GEOMETRY) : len(GEOMETRY) + layout.features]
    for k, turn in enumerate(_turned(record, layout, offset), _NORMAL):
        values[k] = values[k] + turn
    return values


def _walk(lists, layout, state, body):
    """Run ``body(surfel, pixels, T, state) -> (T, state)`` over every lane's list; T and state are lists, one a pixel of a
    lane. Returns the final state."""
    _, pixels = lane_pixels(layout.size)
    centres = [(mi.Float(x) + 0.5, mi.Float(y) + 0.5) for x, y in pixels]
    end = lists.first + lists.count

    def alive(i, T, state):
        greatest = T[0]
        for t in T[1:]:
            greatest = dr.maximum(greatest, t)
        return (i < end) & (greatest > layout.cutoffs.transmittance_min)

    def step(i, T, state):
        T, state = body(dr.gather(mi.UInt32, lists.ids, i), centres, T, state)
        return i + 1, T, state

    T = [mi.Float(1) for _ in pixels]
    return dr.while_loop((mi.UInt32(lists.first), T, state(len(pixels))), alive, step, label="splat")[2]


def _image_rows(layout):
    """(row-major pixel number, inside the image?) for each pixel of a lane."""
    width, height = layout.size
    _, pixels = lane_pixels(layout.size)
    return [(y * width + x, (x < width) & (y < height)) for x, y in pixels]


def _gather_image(image, layout):
    return [fetch(image, row, layout.pixel, inside) for row, inside in _image_rows(layout)]


def _scatter_image(values, layout):
    """Lane order to row-major pixels: ``mi.Float`` of width H · W · layout.pixel."""
    width, height = layout.size
    dr.eval(values)  # otherwise every scatter below would walk the lists again
    image = dr.empty(mi.Float, width * height * layout.pixel)
    for (row, inside), value in zip(_image_rows(layout), values):
        value = value + [mi.Float(0)] * (layout.pixel - len(value))
        for q in range(layout.pixel // PACKET):
            dr.scatter(image, mi.Vector4f(*value[PACKET * q : PACKET * (q + 1)]), row * (layout.pixel // PACKET) + q, inside)
    return image


class Composite(dr.CustomOp):
    """Records to image (2), with adjoint (3) and tangent."""

    def eval(self, record, lists, layout):
        self.record, self.lists, self.layout = dr.detach(record), lists, layout
        n = layout.features

        def body(surfel, centres, T, out):
            r = fetch(self.record, surfel, layout.record)
            for k, (x, y) in enumerate(centres):
                hit = Hit(r, x, y, layout.cutoffs)
                w = T[k] * hit.alpha
                features = _features(r, layout, hit.offset)
                alpha, squares = out[k][n + 1] + w, [dr.fma(w, hit.t * hit.t, o) for o in out[k][n + 2 :]]
                out[k] = [dr.fma(w, value, o) for o, value in zip(out[k], [*features, hit.t])] + [alpha, *squares]
                T[k] = T[k] - w
            return T, out

        out = _walk(lists, layout, lambda pixels: [[mi.Float(0)] * layout.values for _ in range(pixels)], body)
        self.image = _scatter_image(out, layout)
        dr.eval(self.image)
        return self.image

    def backward(self):
        layout, n = self.layout, self.layout.features
        adjoint = _gather_image(self.grad_out(), layout)
        image = _gather_image(self.image, layout)
        rest = [sum((a * o for a, o in zip(adj, out)), mi.Float(0)) for adj, out in zip(adjoint, image)]
        dr.eval(adjoint, rest)
        gradient = dr.zeros(mi.Float, dr.width(self.record))
        mode = adding(dr.width(gradient))
        stride = layout.record // PACKET

        def body(surfel, centres, T, rest):
            r = fetch(self.record, surfel, layout.record)
            total = [mi.Float(0)] * layout.record
            for k, (x, y) in enumerate(centres):
                hit = Hit(r, x, y, layout.cutoffs)
                w = T[k] * hit.alpha
                g, d_normal = adjoint[k][n + 1], [w * a for a in adjoint[k][_NORMAL : _NORMAL + 3]]
                for a, value in zip(adjoint[k], [*_features(r, layout, hit.offset), hit.t]):
                    g = dr.fma(a, value, g)
                d_t = adjoint[k][n]
                if layout.squares:
                    g = dr.fma(adjoint[k][n + 2], hit.t * hit.t, g)
                    d_t = dr.fma(2 * hit.t, adjoint[k][n + 2], d_t)
                rest[k] = rest[k] - w * g
                d_alpha = T[k] * g - rest[k] * dr.rcp(1 - hit.alpha)
                d_offset = [sum((a * d for a, d in zip(slope, d_normal)), mi.Float(0)) for slope in _slopes(r, layout)]
                local = hit.pull_back(r, d_alpha, w * d_t, d_offset)
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

        dr.eval(_walk(self.lists, layout, lambda pixels: rest, body))
        self.set_grad_in("record", gradient)

    def forward(self):
        layout, n = self.layout, self.layout.features
        tangent = self.grad_in("record")

        def body(surfel, centres, T, state):
            r, r_ = (fetch(b, surfel, layout.record) for b in (self.record, tangent))
            for k, (x, y) in enumerate(centres):
                hit = Hit(r, x, y, layout.cutoffs)
                alpha_, t_, offset_ = hit.push_forward(r, r_)
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
        state = _walk(self.lists, layout, start, body)
        self.set_grad_out(_scatter_image([out_ for _, out_ in state], layout))

    def name(self):
        return "rgs_mi.splat.Composite"


def composite(projected, features, lists, layout):
    """The image of (2): ``mi.Float`` of width H · W · layout.pixel, row-major, each pixel (features, depth, alpha, perhaps
    depth², padding). ``features``: a list of ``mi.Float`` of width N, the normal's three after the first three.
    Differentiable in the records, in both modes."""
    slopes = [value for slope in projected.slopes for value in slope]
    return dr.custom(Composite, pack(projected.geometry + features + slopes), lists, layout)

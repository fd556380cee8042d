"""Front-to-back compositing of surfels in one list walk, and its replayed adjoint.

Per pixel, over its tile's surfels front to back, with T_1 = 1:

    α_i = o_i exp(−½ min(u² + v², LOW_PASS |δ|²)),   w_i = T_i α_i,   T_{i+1} = T_i − w_i,
    image = Σ_i w_i (features_i, t_i, 1)                                                           (2)

Lists are sorted by depth at the tile's centre, which on a smooth surface, where surfels lie almost on one another, is not
their order elsewhere: reflections would jump from tile to tile, and with the view. So each lane sorts on the way, in a queue
of ``window`` surfels, by the depth at which its own 2 × 2 pixels meet them (StopThePop, Radl et al. 2024).

The adjoint walks the same list again, front to back, and stores nothing per step. With g_i the inner product of the
pixel's adjoint with surfel i's vector in (2), and rest_i = Σ_{j>i} w_j g_j,

    ∂L/∂w-part: w_i · adjoint      ∂L/∂α_i = T_i g_i − rest_i / (1 − α_i)                          (3)

and the chain from α, t down to the ten numbers of a record is written out in `_pull_back`. The tangent (forward mode)
walks it a third way: Ṫ_{i+1} = Ṫ_i − ẇ_i.
"""

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .project import GEOMETRY
from .tiles import LOW_PASS, PIXELS, Cutoffs, lane_pixels

PACKET = 4  # floats per gather and scatter
HORIZON = 1e-5  # least h of (1): beyond it a ray runs along the surfel's plane, or meets it behind the camera
_HALF_DIAGONAL = 0.5 * math.hypot(PIXELS[0] - 1, PIXELS[1] - 1)  # from a lane's middle to its pixels' centres


@dataclass(frozen=True)
class Layout:
    """How ``features`` channels lie in a record (ten geometric numbers, then the features, padded) and in a pixel
    (features, depth, alpha, padded), and the constants of the walk."""

    size: tuple[int, int]
    features: int
    cutoffs: Cutoffs = Cutoffs()

    @property
    def record(self):
        return -(-(len(GEOMETRY) + self.features) // PACKET) * PACKET

    @property
    def geometry(self):
        """Floats to fetch for the geometric part of a record."""
        return -(-len(GEOMETRY) // PACKET) * PACKET

    @property
    def pixel(self):
        return -(-(self.features + 2) // PACKET) * PACKET


def pack(projected, features, layout):
    """Records, ``mi.Float`` of width N · layout.record: geometry and ``features`` (a list of ``mi.Float``) side by side."""
    columns = projected.geometry + features
    columns += [mi.Float(0)] * (layout.record - len(columns))
    n = dr.width(columns)
    out = dr.zeros(mi.Float, n * layout.record)
    row = dr.arange(mi.UInt32, n) * (layout.record // PACKET)
    for q in range(layout.record // PACKET):
        dr.scatter(out, mi.Vector4f(*columns[PACKET * q: PACKET * (q + 1)]), row + q)
    return out


def _fetch(buffer, row, stride, active=True, count=None):
    """The first ``count`` (None: all) of the ``stride`` floats of row ``row``, as a list; zeros where not ``active``."""
    floats = []
    for q in range((count or stride) // PACKET):
        floats += list(dr.gather(mi.Vector4f, buffer, row * (stride // PACKET) + q, active))
    return floats


class _Hit:
    """One pixel against one record: equation (1) of `project.py` and the weight of (2)."""

    def __init__(self, record, x, y, cutoffs):
        X, Y, A_x, A_y, B_x, B_y, N_x, N_y, z, opacity = record[:len(GEOMETRY)]
        self.dx, self.dy = x - X, y - Y
        h = 1 + N_x * self.dx + N_y * self.dy
        in_front = h > HORIZON
        self.inv_h = dr.rcp(dr.select(in_front, h, 1))
        self.u = (A_x * self.dx + A_y * self.dy) * self.inv_h
        self.v = (B_x * self.dx + B_y * self.dy) * self.inv_h
        on_plane = dr.select(in_front, self.u * self.u + self.v * self.v, dr.largest(mi.Float))
        on_screen = LOW_PASS * (self.dx * self.dx + self.dy * self.dy)
        self.on_plane = on_plane <= on_screen  # else the low-pass decides, and the depth is the centre's
        self.gauss = dr.exp(-0.5 * dr.minimum(on_plane, on_screen))
        alpha = opacity * self.gauss
        self.kept = alpha > cutoffs.alpha_min
        self.clamped = alpha > cutoffs.alpha_max
        self.alpha = dr.select(self.kept, dr.minimum(alpha, cutoffs.alpha_max), 0)
        self.t = dr.select(self.on_plane, z * self.inv_h, z)

    def sort_key(self, record, cutoffs):
        """t, if this hit is in the middle of a lane's pixels, and −∞ where none of them can see the surfel."""
        _, _, A_x, A_y, B_x, B_y, N_x, N_y, _, opacity = record[:len(GEOMETRY)]
        tilt = _HALF_DIAGONAL * dr.sqrt(N_x * N_x + N_y * N_y)
        turn = _HALF_DIAGONAL * dr.sqrt(A_x * A_x + A_y * A_y + B_x * B_x + B_y * B_y)
        # From the middle to a pixel, h changes by at most tilt, and (u, v) by (turn + |(u, v)| tilt) / h there
        distance = dr.sqrt(self.u * self.u + self.v * self.v)
        least_h = dr.rcp(self.inv_h) - tilt
        on_plane = dr.select(least_h > HORIZON, distance - (turn + distance * tilt) / least_h, 0)
        on_screen = math.sqrt(LOW_PASS) * (dr.sqrt(self.dx * self.dx + self.dy * self.dy) - _HALF_DIAGONAL)
        nearest = dr.maximum(dr.minimum(on_plane, on_screen), 0)
        return dr.select(opacity * dr.exp(-0.5 * nearest * nearest) > cutoffs.alpha_min, self.t, -dr.inf)

    def pull_back(self, record, d_alpha, d_t):
        """Gradient of the ten geometric numbers, from that of α and t."""
        _, _, A_x, A_y, B_x, B_y, N_x, N_y, _, _ = record[:len(GEOMETRY)]
        d_alpha = dr.select(self.kept & ~self.clamped, d_alpha, 0)
        d_rho = -0.5 * self.alpha * d_alpha
        plane = lambda value: dr.select(self.on_plane, value, 0)
        d_u, d_v = plane(2 * self.u * d_rho * self.inv_h), plane(2 * self.v * d_rho * self.inv_h)  # both over h
        d_h = -(d_u * self.u + d_v * self.v) - plane(d_t * self.t * self.inv_h)
        d_screen = dr.select(self.on_plane, 0, 2 * LOW_PASS * d_rho)
        d_dx = d_u * A_x + d_v * B_x + d_h * N_x + d_screen * self.dx
        d_dy = d_u * A_y + d_v * B_y + d_h * N_y + d_screen * self.dy
        return [-d_dx, -d_dy, d_u * self.dx, d_u * self.dy, d_v * self.dx, d_v * self.dy, d_h * self.dx, d_h * self.dy,
                dr.select(self.on_plane, d_t * self.inv_h, d_t), d_alpha * self.gauss]

    def push_forward(self, record, tangent):
        """(α̇, ṫ) from the tangent of the record."""
        _, _, A_x, A_y, B_x, B_y, N_x, N_y, z, _ = record[:len(GEOMETRY)]
        X_, Y_, A_x_, A_y_, B_x_, B_y_, N_x_, N_y_, z_, opacity_ = tangent[:len(GEOMETRY)]
        h_ = N_x_ * self.dx + N_y_ * self.dy - N_x * X_ - N_y * Y_
        u_ = (A_x_ * self.dx + A_y_ * self.dy - A_x * X_ - A_y * Y_ - self.u * h_) * self.inv_h
        v_ = (B_x_ * self.dx + B_y_ * self.dy - B_x * X_ - B_y * Y_ - self.v * h_) * self.inv_h
        rho_ = dr.select(self.on_plane, 2 * (self.u * u_ + self.v * v_), -2 * LOW_PASS * (self.dx * X_ + self.dy * Y_))
        alpha_ = dr.select(self.kept & ~self.clamped, opacity_ * self.gauss - 0.5 * self.alpha * rho_, 0)
        return alpha_, dr.select(self.on_plane, (z_ - self.t * h_) * self.inv_h, z_)


def _walk(records, lists, layout, state, body):
    """Run ``body(surfel, valid, pixels, T, state) -> (T, state)`` over every tile's list, each lane in its own order; T and
    state are lists, one a pixel of a lane. Returns the final state."""
    tile, pixels = lane_pixels(layout.size)
    window = layout.cutoffs.window
    first = dr.gather(mi.UInt32, lists.first, tile)
    count = dr.gather(mi.UInt32, lists.count, tile)
    end, stop = first + count, first + dr.select(count > 0, count + window, 0)
    centres = [(mi.Float(x) + 0.5, mi.Float(y) + 0.5) for x, y in pixels]
    middle = [mi.Float(corner) + 0.5 * n for corner, n in zip(pixels[0], PIXELS)]

    def alive(i, depths, surfels, T, state):
        greatest = T[0]
        for t in T[1:]:
            greatest = dr.maximum(greatest, t)
        return (i < stop) & (greatest > layout.cutoffs.transmittance_min)

    def step(i, depths, surfels, T, state):
        listed = i < end
        surfel = dr.gather(mi.UInt32, lists.ids, i, listed)
        record = _fetch(records, surfel, layout.record, listed, layout.geometry)
        # One surfel enters the queue, the nearest leaves it; after the list's end "farther than all" pushes the rest out.
        depth = dr.select(listed, _Hit(record, *middle, layout.cutoffs).sort_key(record, layout.cutoffs), dr.inf)
        for k in reversed(range(window)):
            nearer = depth < depths[k]
            depth, depths[k] = dr.minimum(depth, depths[k]), dr.maximum(depth, depths[k])
            surfel, surfels[k] = dr.select(nearer, surfel, surfels[k]), dr.select(nearer, surfels[k], surfel)
        T, state = body(surfel, depth > -dr.inf, centres, T, state)
        return i + 1, depths, surfels, T, state

    start = (first, [mi.Float(-dr.inf)] * window, [mi.UInt32(0)] * window, [mi.Float(1) for _ in pixels], state(len(pixels)))
    return dr.while_loop(start, alive, step, label="splat")[4]


def _image_rows(layout):
    """(row-major pixel number, inside the image?) for each pixel of a lane."""
    width, height = layout.size
    _, pixels = lane_pixels(layout.size)
    return [(y * width + x, (x < width) & (y < height)) for x, y in pixels]


def _gather_image(image, layout):
    return [_fetch(image, row, layout.pixel, inside) for row, inside in _image_rows(layout)]


def _scatter_image(values, layout):
    """Lane order to row-major pixels: ``mi.Float`` of width H · W · layout.pixel."""
    width, height = layout.size
    dr.eval(values)  # otherwise every scatter below would walk the lists again
    image = dr.empty(mi.Float, width * height * layout.pixel)
    for (row, inside), value in zip(_image_rows(layout), values):
        value = value + [mi.Float(0)] * (layout.pixel - len(value))
        for q in range(layout.pixel // PACKET):
            dr.scatter(image, mi.Vector4f(*value[PACKET * q: PACKET * (q + 1)]), row * (layout.pixel // PACKET) + q, inside)
    return image


class Composite(dr.CustomOp):
    """Records to image (2), with adjoint (3) and tangent."""

    def eval(self, record, lists, layout):
        self.record, self.lists, self.layout = dr.detach(record), lists, layout
        n = layout.features

        def body(surfel, valid, centres, T, out):
            r = _fetch(self.record, surfel, layout.record, valid)
            features = r[len(GEOMETRY): len(GEOMETRY) + n]
            for k, (x, y) in enumerate(centres):
                hit = _Hit(r, x, y, layout.cutoffs)
                w = T[k] * hit.alpha
                out[k] = [dr.fma(w, value, o) for o, value in zip(out[k], [*features, hit.t])] + [out[k][n + 1] + w]
                T[k] = T[k] - w
            return T, out

        out = _walk(self.record, lists, layout, lambda pixels: [[mi.Float(0)] * (n + 2) for _ in range(pixels)], body)
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
        stride = layout.record // PACKET

        def body(surfel, valid, centres, T, rest):
            r = _fetch(self.record, surfel, layout.record, valid)
            features = r[len(GEOMETRY): len(GEOMETRY) + n]
            total = [mi.Float(0)] * layout.record
            for k, (x, y) in enumerate(centres):
                hit = _Hit(r, x, y, layout.cutoffs)
                w = T[k] * hit.alpha
                g = adjoint[k][n + 1]
                for a, value in zip(adjoint[k], [*features, hit.t]):
                    g = dr.fma(a, value, g)
                rest[k] = rest[k] - w * g
                d_alpha = T[k] * g - rest[k] * dr.rcp(1 - hit.alpha)
                local = hit.pull_back(r, d_alpha, w * adjoint[k][n]) + [w * a for a in adjoint[k][:n]]
                total = [t + l for t, l in zip(total, local)] + total[len(local):]
                T[k] = T[k] - w
            for q in range(stride):
                dr.scatter_reduce(dr.ReduceOp.Add, gradient, mi.Vector4f(*total[PACKET * q: PACKET * (q + 1)]),
                                  surfel * stride + q, valid, mode=dr.ReduceMode.Expand)
            return T, rest

        dr.eval(_walk(self.record, self.lists, layout, lambda pixels: rest, body))
        self.set_grad_in("record", gradient)

    def forward(self):
        layout, n = self.layout, self.layout.features
        tangent = self.grad_in("record")

        def body(surfel, valid, centres, T, state):
            r, r_ = (_fetch(b, surfel, layout.record, valid) for b in (self.record, tangent))
            values, values_ = (b[len(GEOMETRY): len(GEOMETRY) + n] for b in (r, r_))
            for k, (x, y) in enumerate(centres):
                hit = _Hit(r, x, y, layout.cutoffs)
                alpha_, t_ = hit.push_forward(r, r_)
                T_, out_ = state[k]
                w, w_ = T[k] * hit.alpha, T_ * hit.alpha + T[k] * alpha_
                out_ = [o + w_ * f + w * f_ for o, f, f_ in zip(out_, [*values, hit.t], [*values_, t_])] + [out_[n + 1] + w_]
                state[k], T[k] = (T_ - w_, out_), T[k] - w
            return T, state

        start = lambda pixels: [(mi.Float(0), [mi.Float(0)] * (n + 2)) for _ in range(pixels)]
        state = _walk(self.record, self.lists, layout, start, body)
        self.set_grad_out(_scatter_image([out_ for _, out_ in state], layout))

    def name(self):
        return "rgs_mi.splat.Composite"


def composite(projected, features, lists, layout):
    """The image of (2): ``mi.Float`` of width H · W · layout.pixel, row-major, each pixel (features, depth, alpha, padding).
    Differentiable in the records, in both modes."""
    return dr.custom(Composite, pack(projected, features, layout), lists, layout)

"""A pixel meets a surfel: the weight and depth of its hit, their derivatives, and what surfels are sorted by."""

import itertools
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from .project import GEOMETRY
from .tiles import BLOCK, Cutoffs

PACKET = 4  # floats per gather and scatter
HORIZON = 1e-5  # least h of (1): beyond it a ray runs along the surfel's plane, or meets it behind the camera
_LEAST_ROWS = 1024
_MOST_COPIED = 2**26  # floats, in all threads together
_SLACK = 1e-3  # of squared distances from surfels, for rounding


def padded(count: int) -> int:
    """Return the floats of a row that holds ``count``: the next multiple of `PACKET`."""
    return -(-count // PACKET) * PACKET


def adding(floats: int) -> "dr.ReduceMode":
    """Return the fastest mode to add into so many ``floats`` from lanes that meet different ones at a time: a copy for each
    thread, twice as fast as atomics, while these fit into memory."""
    return dr.ReduceMode.Expand if floats * dr.thread_count() <= _MOST_COPIED else dr.ReduceMode.Local


def pack(columns: "list[mi.Float]") -> "mi.Float":
    """Interleave ``columns`` of width N into rows of `padded` floats, with room up to a power of two of rows: the kernel that
    adds gradients into them (``ReduceMode.Expand``) has their number compiled in."""
    stride = padded(len(columns))
    columns = columns + [mi.Float(0)] * (stride - len(columns))
    n = dr.width(columns)
    out = dr.empty(mi.Float, max(_LEAST_ROWS, 1 << (n - 1).bit_length()) * stride)
    row = dr.arange(mi.UInt32, n) * (stride // PACKET)
    for q in range(stride // PACKET):
        dr.scatter(out, mi.Vector4f(*columns[PACKET * q : PACKET * (q + 1)]), row + q)
    return out


def fetch(buffer: "mi.Float", row: "mi.UInt32", stride: int, active: "mi.Bool | bool" = True) -> "list[mi.Float]":
    """Return the ``stride`` floats of each ``row`` of what `pack` made; zeros where not ``active``."""
    floats = []
    for q in range(stride // PACKET):
        floats += list(dr.gather(mi.Vector4f, buffer, row * (stride // PACKET) + q, active))
    return floats


def reach(geometry: "Sequence[mi.Float]", cutoffs: Cutoffs) -> "mi.Float":
    """Return the squared distance, in standard deviations, within which surfels of this ``geometry`` have an α above the cut-off,
    or a little more."""
    return 2 * dr.log(geometry[-1] / cutoffs.alpha_min) + _SLACK


class FetchAll(dr.CustomOp):
    """The custom operation from a buffer to the floats of all of its rows, so many a row. Each is read once, so that the adjoint
    writes where that of a plain gather would add atomically."""

    def eval(self, buffer: "mi.Float", stride: int) -> "list[mi.Float]":
        self.stride, self.count = stride, dr.width(buffer) // stride
        return self._fetch(buffer)

    def _fetch(self, buffer):
        return fetch(buffer, dr.arange(mi.UInt32, self.count), self.stride)

    def forward(self) -> None:
        self.set_grad_out(self._fetch(self.grad_in("buffer")))

    def backward(self) -> None:
        adjoint = list(self.grad_out())
        dr.eval(adjoint)  # otherwise every scatter below would compute them again
        buffer, packets = dr.empty(mi.Float, self.count * self.stride), self.stride // PACKET
        row = dr.arange(mi.UInt32, self.count) * packets
        for q in range(packets):
            dr.scatter(buffer, mi.Vector4f(*adjoint[PACKET * q : PACKET * (q + 1)]), row + q)
        self.set_grad_in("buffer", buffer)


class Hit:
    """One pixel, at (x, y), against one projected Gaussian, a row of `pack`: equation (1) of `project.py` and the weight of
    (2) of `composite.py`.

    ``alpha``: α of (2); ``t``: depth (camera-space z); ``offset``: (u, v) of the hit in standard deviations, 0 where the
    low-pass decides.
    """

    def __init__(self, gaussian: "Sequence[mi.Float]", x: "mi.Float", y: "mi.Float", cutoffs: Cutoffs) -> None:
        X, Y, A_x, A_y, B_x, B_y, N_x, N_y, z, opacity = gaussian[: len(GEOMETRY)]
        self.dx, self.dy, self.low_pass = x - X, y - Y, cutoffs.low_pass
        h = 1 + N_x * self.dx + N_y * self.dy
        in_front = h > HORIZON
        self.inv_h = dr.rcp(dr.select(in_front, h, 1))
        self.u = (A_x * self.dx + A_y * self.dy) * self.inv_h
        self.v = (B_x * self.dx + B_y * self.dy) * self.inv_h
        on_plane = dr.select(in_front, self.u * self.u + self.v * self.v, dr.largest(mi.Float))
        on_screen = cutoffs.low_pass * (self.dx * self.dx + self.dy * self.dy)
        self.on_plane = on_plane <= on_screen  # else the low-pass decides, and the depth is the center's
        self.offset = [dr.select(self.on_plane, value, 0) for value in (self.u, self.v)]  # where normals are taken
        self.gauss = dr.exp(-0.5 * dr.minimum(on_plane, on_screen))
        alpha = opacity * self.gauss
        self.kept = alpha > cutoffs.alpha_min
        self.clamped = alpha > cutoffs.alpha_max
        self.alpha = dr.select(self.kept, dr.minimum(alpha, cutoffs.alpha_max), 0)
        self.t = dr.select(self.on_plane, z * self.inv_h, z)

    def in_block(
        self, gaussian: "Sequence[mi.Float]", reach: "mi.Float", cutoffs: Cutoffs
    ) -> "tuple[mi.Float, mi.Bool, list[mi.Float]]":
        """Return what this hit, in the middle of a block's pixels, says of these: the depth t; whether any of them can see the
        surfel, being within its `reach`; and at least how much of the light behind it hides from each of them. u and v are
        taken times h to spare the divisions, and exp(−ρ/2) is at least (1 − ρ/8)⁴."""
        _, _, A_x, A_y, B_x, B_y, N_x, N_y, _, opacity = gaussian[: len(GEOMETRY)]
        most, seen, alphas = dr.minimum(opacity, cutoffs.alpha_max), mi.Bool(False), []
        eighth = self.inv_h * self.inv_h / 8
        for x, y in itertools.product(*((k - 0.5 * (n - 1) for k in range(n)) for n in BLOCK)):
            dx, dy = self.dx + x, self.dy + y
            h, u, v = (offset + a * dx + b * dy for offset, a, b in ((1, N_x, N_y), (0, A_x, A_y), (0, B_x, B_y)))
            rho = u * u + v * v
            near = (h > HORIZON) & (rho < reach * h * h)
            seen |= near | (cutoffs.low_pass * (dx * dx + dy * dy) < reach)
            alphas.append(dr.select(near, most * dr.square(dr.square(dr.maximum(1 - eighth * rho, 0))), 0))
        return self.t, seen, alphas

    def vjp(
        self, gaussian: "Sequence[mi.Float]", d_alpha: "mi.Float", d_t: "mi.Float", d_offset: "Sequence[mi.Float]"
    ) -> "list[mi.Float]":
        """Return the gradient of the ten geometric numbers, from that of α, t and the offset (vector-Jacobian product)."""
        _, _, A_x, A_y, B_x, B_y, N_x, N_y, _, _ = gaussian[: len(GEOMETRY)]
        d_alpha = dr.select(self.kept & ~self.clamped, d_alpha, 0)
        d_rho = -0.5 * self.alpha * d_alpha
        plane = lambda value: dr.select(self.on_plane, value, 0)
        d_u, d_v = (
            plane((2 * value * d_rho + d_value) * self.inv_h)  # both over h
            for value, d_value in zip((self.u, self.v), d_offset)
        )
        d_h = -(d_u * self.u + d_v * self.v) - plane(d_t * self.t * self.inv_h)
        d_screen = dr.select(self.on_plane, 0, 2 * self.low_pass * d_rho)
        d_dx = d_u * A_x + d_v * B_x + d_h * N_x + d_screen * self.dx
        d_dy = d_u * A_y + d_v * B_y + d_h * N_y + d_screen * self.dy
        return [
            -d_dx,
            -d_dy,
            d_u * self.dx,
            d_u * self.dy,
            d_v * self.dx,
            d_v * self.dy,
            d_h * self.dx,
            d_h * self.dy,
            dr.select(self.on_plane, d_t * self.inv_h, d_t),
            d_alpha * self.gauss,
        ]

    def jvp(
        self, gaussian: "Sequence[mi.Float]", tangent: "Sequence[mi.Float]"
    ) -> "tuple[mi.Float, mi.Float, list[mi.Float]]":
        """Return the tangents of α, t and the offset, from that of the projected Gaussian (Jacobian-vector product)."""
        _, _, A_x, A_y, B_x, B_y, N_x, N_y, z, _ = gaussian[: len(GEOMETRY)]
        X_, Y_, A_x_, A_y_, B_x_, B_y_, N_x_, N_y_, z_, opacity_ = tangent[: len(GEOMETRY)]
        h_ = N_x_ * self.dx + N_y_ * self.dy - N_x * X_ - N_y * Y_
        u_ = (A_x_ * self.dx + A_y_ * self.dy - A_x * X_ - A_y * Y_ - self.u * h_) * self.inv_h
        v_ = (B_x_ * self.dx + B_y_ * self.dy - B_x * X_ - B_y * Y_ - self.v * h_) * self.inv_h
        rho_ = dr.select(self.on_plane, 2 * (self.u * u_ + self.v * v_), -2 * self.low_pass * (self.dx * X_ + self.dy * Y_))
        alpha_ = dr.select(self.kept & ~self.clamped, opacity_ * self.gauss - 0.5 * self.alpha * rho_, 0)
        on_plane = lambda value, otherwise=0: dr.select(self.on_plane, value, otherwise)
        return alpha_, on_plane((z_ - self.t * h_) * self.inv_h, z_), [on_plane(u_), on_plane(v_)]

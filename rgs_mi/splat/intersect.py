"""Tile intersections: which surfels each block of 2 × 2 pixels sees, front to back.

First by tile: bounds, then a radix sort by tile and by depth at the tile's centre. On a smooth surface, where surfels lie
almost on one another, that is not their order elsewhere in the tile: reflections would jump from tile to tile, and with the
view. So every block takes from its tile's list the surfels that its own 2 × 2 pixels can see, until these hide what is
behind, and brings them into the order in which these pixels meet them, through a queue of ``resort_window`` surfels
(StopThePop, Radl et al. 2024).

The bounds are exact. A surfel's weight exceeds the cut-off where u² + v² ≤ r² with r² = 2 ln(opacity / cut-off), which by
(1) of `project.py` is an ellipse on the screen, or inside the disk of the low-pass. Each row of tiles is intersected with
both, so no tile is listed that the surfel cannot reach, whatever its shape, tilt or opacity.
"""

import functools
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .hit import Hit, fetch, pack, padded, reach
from .project import Projected
from .tiles import BLOCK, TILE, Cutoffs, block_pixels, tile_grid

FAR = 1e6  # pixels: beyond every image
SORT_RADIUS = 3.0  # standard deviations
_OCTAVE, _INFINITY = 1 << 23, 0x7F800000  # in bits of floats
_HIDDEN = 0.1  # of the least transmittance: where a list ends, for what its block's own order brings forward


@dataclass
class TileIntersections:
    """Which surfels each block (or tile) sees: ``ids`` are indices of surfels, front to back, ``first`` and ``count`` each
    block's range of these, between which there may be gaps; ``seen`` says of each surfel whether any tile lists it."""

    ids: "mi.UInt32"
    first: "mi.UInt32"
    count: "mi.UInt32"
    seen: "mi.Bool"


@dataclass
class _Unsorted:
    """What each block sees, not in its order yet. ``keys`` are the depths at which its middle meets surfels, and in the ``low``
    bits below that these surfels' places in the list of its tile, which begins at ``tile_first``; ``first`` and ``count`` are
    each block's range of keys."""

    keys: "mi.UInt32"
    low: int
    tile_first: "mi.UInt32"
    first: "mi.UInt32"
    count: "mi.UInt32"


@dataclass(frozen=True)
class _Depths:
    """Positive floats, from one with the bits ``least`` to one with the bits ``most``, as numbers of fewer bits: floats are in
    the order of their bits, which are steps of some part of themselves."""

    least: int
    most: int

    @classmethod
    def of(cls, depth: "mi.Float") -> "_Depths":
        """Return those from the least ``depth`` to the greatest."""
        bits = _bits(depth)
        return cls(*(int(reduced(bits)[0]) for reduced in (dr.min, dr.max)))

    def wider(self) -> "_Depths":
        """Return the same, and an octave more to either side."""
        return _Depths(max(self.least - _OCTAVE, 0), min(self.most + _OCTAVE, _INFINITY))

    def steps(self, depth: "mi.Float", bits: int) -> "mi.UInt32":
        """Return ``depth`` as a number of so many ``bits``; what lies beyond the ends is there."""
        drop = max((self.most - self.least).bit_length() - bits, 0)
        least, most, drop = (dr.opaque(mi.UInt32, number) for number in (self.least, self.most, drop))
        return (dr.clip(_bits(depth), least, most) - least) >> drop


def _bits(depth):
    """Those of depths, of 0 where one is not a number or negative."""
    return dr.reinterpret_array(mi.UInt32, dr.fmax(depth, 0))


@dataclass
class _Outline:
    """Where a surfel's weight can exceed the cut-off: an ellipse about (ex, ey) with inverse shape matrix (i00, i01; ., i11)
    and level k, half extents (hx, hy), and a disk of radius r about (x, y). Pixels."""

    ex: "mi.Float"
    ey: "mi.Float"
    hx: "mi.Float"
    hy: "mi.Float"
    i00: "mi.Float"
    i01: "mi.Float"
    i11: "mi.Float"
    k: "mi.Float"
    x: "mi.Float"
    y: "mi.Float"
    r: "mi.Float"

    def columns(self):
        return [getattr(self, name) for name in self.__dataclass_fields__]

    def span(self, low, high):
        """Least and greatest x that the outline reaches with y in [low, high]."""
        slope = self.i01 / self.i11
        half = dr.sqrt(dr.maximum(self.i00 - self.i01 * slope, 0))
        y_max = self.i01 * dr.sqrt(self.k / self.i00)  # the rightmost point lies that far below the centre
        right, left = (dr.clip(dr.clip(self.ey + s, low, high) - self.ey, -self.hy, self.hy) for s in (y_max, -y_max))
        chord = lambda y: half * dr.sqrt(dr.maximum(self.k - y * y / self.i11, 0))
        x_max, x_min = self.ex + slope * right + chord(right), self.ex + slope * left - chord(left)
        y_disk = dr.clip(self.y, low, high) - self.y
        in_disk = dr.abs(y_disk) < self.r
        chord_disk = dr.sqrt(dr.maximum(self.r * self.r - y_disk * y_disk, 0))
        return (
            dr.select(in_disk, dr.minimum(x_min, self.x - chord_disk), x_min),
            dr.select(in_disk, dr.maximum(x_max, self.x + chord_disk), x_max),
        )


def _outline(geometry, cutoffs):
    """The outline of every surfel, and whether it has one. A plane that reaches behind the camera inside its r has no
    ellipse but an unbounded conic: such a surfel (rare: the camera is almost inside it) is listed everywhere."""
    x, y, A_x, A_y, B_x, B_y, N_x, N_y, _, opacity = geometry
    r2 = 2 * dr.log(dr.maximum(opacity / cutoffs.alpha_min, 1))
    # (A·δ)² + (B·δ)² = r² (1 + N·δ)², written as (δ−e)ᵀ Q (δ−e) = k
    q00, q11 = A_x * A_x + B_x * B_x - r2 * N_x * N_x, A_y * A_y + B_y * B_y - r2 * N_y * N_y
    q01 = A_x * A_y + B_x * B_y - r2 * N_x * N_y
    det = q00 * q11 - q01 * q01
    i00, i01, i11 = q11 / det, -q01 / det, q00 / det
    e_x, e_y = r2 * (i00 * N_x + i01 * N_y), r2 * (i01 * N_x + i11 * N_y)
    k = r2 * (1 + N_x * e_x + N_y * e_y)
    bounded = (det > 0) & (q00 > 0) & dr.isfinite(k)
    ellipse = lambda value, everywhere: dr.select(bounded, value, everywhere)
    e_x, e_y, i01 = (ellipse(v, 0) for v in (e_x, e_y, i01))
    i00, i11, k = ellipse(i00, 1), ellipse(i11, 1), ellipse(k, FAR * FAR)
    return _Outline(
        x + e_x, y + e_y, dr.sqrt(k * i00), dr.sqrt(k * i11), i00, i01, i11, k, x, y, dr.sqrt(r2 / cutoffs.low_pass)
    ), r2 > 0


def _depth_at_tile(geometry, column, row):
    """Depth of surfels where the ray through a tile's centre meets them, or, at most SORT_RADIUS standard deviations from
    their own centres, comes closest to it.

    Sorting by the centres' depths instead would favour, on a smooth surface, the surfels that lie nearer to the camera than
    the pixel does: their normals face it more, and reflections move by about a standard deviation.
    """
    x, y, A_x, A_y, B_x, B_y, N_x, N_y, z, _ = geometry
    dx = (mi.Float(column) + 0.5) * TILE[0] - x
    dy = (mi.Float(row) + 0.5) * TILE[1] - y
    # (u, v) of equation (1) without its 1/h, which is near 1 where it matters
    distance = dr.sqrt(dr.square(A_x * dx + A_y * dy) + dr.square(B_x * dx + B_y * dy))
    shrink = dr.minimum(1, SORT_RADIUS / dr.maximum(distance, 1e-6))
    return z / dr.clip(1 + shrink * (N_x * dx + N_y * dy), 0.5, 2)


def isect_tiles(projected: Projected, size: tuple[int, int], cutoffs: Cutoffs) -> TileIntersections:
    """Return the surfels that every block of an image of ``size`` (width, height) pixels sees, in the order in which it meets
    them; blocks are in the order of `block_pixels`. Not differentiated."""
    with dr.suspend_grad():
        tiles, depths = _tile_intersections(projected, size, cutoffs)
        return _sorted(_seen_by_blocks(projected, size, tiles, depths, cutoffs), tiles, cutoffs)


def in_view(projected: Projected, size: tuple[int, int], cutoffs: Cutoffs) -> "mi.Bool":
    """Return which surfels an image of ``size`` (width, height) pixels shows, or one that is larger by a tile on each side, as
    far as no surfel hides another. Not differentiated."""
    with dr.suspend_grad():
        outline, drawn = _outline(projected.geometry, cutoffs)
        for n, margin, e, h, center in zip(
            size, TILE, (outline.ex, outline.ey), (outline.hx, outline.hy), (outline.x, outline.y)
        ):
            drawn &= dr.maximum(e + h, center + outline.r) > -margin
            drawn &= dr.minimum(e - h, center - outline.r) < n + margin
        return drawn & projected.visible


def _seen_by_blocks(projected, size, tiles, depths, cutoffs):
    """`_Unsorted` lists of blocks, in the order of their tiles, in which surfels have such `_Depths`. They end where nothing
    behind can be seen any more, or a little later."""
    tile, pixels = block_pixels(size)
    first, count = (dr.gather(mi.UInt32, values, tile) for values in (tiles.first, tiles.count))
    end, blocks = first + count, dr.width(tile) // dr.width(tiles.first)
    start = first * blocks + count * (dr.arange(mi.UInt32, dr.width(tile)) % blocks)  # room for the whole tile's list
    x, y = (mi.Float(corner) + 0.5 * n for corner, n in zip(pixels[0], BLOCK))
    gaussians = pack([*projected.geometry, reach(projected.geometry, cutoffs)])
    keys, low = dr.empty(mi.UInt32, dr.width(tiles.ids) * blocks), max(int(dr.max(tiles.count)[0]) - 1, 1).bit_length()
    near, shift = depths.wider(), dr.opaque(mi.UInt32, low)
    dr.eval(gaussians, first, end, start, x, y)

    def step(i, at, T):
        surfel = dr.gather(mi.UInt32, tiles.ids, i)
        *gaussian, farthest, _ = fetch(gaussians, surfel, padded(len(projected.geometry) + 1))
        depth, seen, alphas = Hit(gaussian, x, y, cutoffs).in_block(gaussian, farthest, cutoffs)
        dr.scatter(keys, (near.steps(depth, 32 - low) << shift) | (i - first), at, seen)
        return i + 1, at + dr.select(seen, mi.UInt32(1), 0), [t - t * alpha for t, alpha in zip(T, alphas)]

    def alive(i, at, T):
        return (i < end) & (functools.reduce(dr.maximum, T) > _HIDDEN * cutoffs.transmittance_min)

    past = dr.while_loop((first, start, [mi.Float(1) for _ in pixels]), alive, step, label="list")[1]
    count = past - start
    dr.eval(keys, count)
    return _Unsorted(keys, low, first, start, count)


def _sorted(lists, tiles, cutoffs) -> TileIntersections:
    """The ``lists`` of blocks of ``tiles`` in the order of their depths, but for surfels that are farther than a queue from
    their place."""
    first = dr.prefix_reduce(dr.ReduceOp.Add, lists.count, exclusive=True)
    total = int(first[-1] + lists.count[-1])
    if total == 0:
        return TileIntersections(dr.zeros(mi.UInt32, 1), first, lists.count, tiles.seen)
    ids, length = dr.empty(mi.UInt32, total), cutoffs.resort_window
    stop = dr.select(lists.count > 0, lists.count + length, 0)
    places = dr.opaque(mi.UInt32, (1 << lists.low) - 1)

    def step(i, queue):
        # One surfel enters the queue, the nearest leaves it; "farther than all" drives the rest out in the end.
        listed = i < lists.count
        key = dr.select(listed, dr.gather(mi.UInt32, lists.keys, lists.first + i, listed), 0xFFFFFFFF)
        for k in reversed(range(length)):
            key, queue[k] = dr.minimum(key, queue[k]), dr.maximum(key, queue[k])
        leaves = i >= length
        surfel = dr.gather(mi.UInt32, tiles.ids, lists.tile_first + (key & places), leaves)
        dr.scatter(ids, surfel, first + i - length, leaves)
        return i + 1, queue

    state = mi.UInt32(0), [mi.UInt32(0)] * length
    dr.eval(dr.while_loop(state, lambda i, queue: i < stop, step, label="sort"))
    dr.eval(ids)
    return TileIntersections(ids, first, lists.count, tiles.seen)


def _sort_key(tile, depth, tiles, depths):
    """One number of 32 bits to sort by: the ``tile``, of so many ``tiles``, then the ``depth``, one of these `_Depths`, as finely
    as there are bits left: to 1e-4 and less, as a rule, which the blocks' own order mends."""
    room = 32 - max(tiles - 1, 1).bit_length()
    return (tile << room) | depths.steps(depth, room)


def _tile_intersections(projected, size, cutoffs) -> tuple[TileIntersections, _Depths]:
    """The surfels of every tile, sorted by `_depth_at_tile`, and what `_Depths` these are. Call it where gradients are
    suspended."""
    columns, rows = tile_grid(size)
    outline, drawn = _outline(projected.geometry, cutoffs)
    drawn &= projected.visible
    # A pixel belongs to the surfel when its centre does: tile row r holds the centres TILE[1] r + 1/2 …
    index = lambda v, n, t: mi.Int32(dr.clip(dr.floor((v - 0.5) / t), -1, n))
    top = dr.maximum(index(dr.minimum(outline.ey - outline.hy, outline.y - outline.r), rows, TILE[1]), 0)
    bottom = dr.minimum(index(dr.maximum(outline.ey + outline.hy, outline.y + outline.r), rows, TILE[1]) + 1, rows)
    drawn &= top < bottom
    bottom = dr.select(drawn, bottom, top)

    dr.eval(outline.columns(), top, bottom)

    def span(row):
        """First and one-past-last tile column of a tile row."""
        low = mi.Float(row * TILE[1]) + 0.5
        x_min, x_max = outline.span(low, low + (TILE[1] - 1))
        first = mi.UInt32(dr.clip(dr.ceil((x_min - (TILE[0] - 0.5)) / TILE[0]), 0, columns))
        last = mi.UInt32(dr.clip(dr.floor((x_max - 0.5) / TILE[0]) + 1, 0, columns))
        return first, dr.maximum(last, first)

    def count(row, n):
        first, last = span(row)
        return row + 1, n + (last - first)

    _, entries = dr.while_loop((mi.Int32(top), mi.UInt32(0)), lambda row, n: row < bottom, count)
    offset = dr.prefix_reduce(dr.ReduceOp.Add, entries, exclusive=True)
    total = int(offset[-1] + entries[-1]) if len(entries) else 0
    n_tiles = columns * rows
    seen = entries > 0
    if total == 0:
        none = dr.zeros(mi.UInt32, n_tiles)
        return TileIntersections(dr.zeros(mi.UInt32, 1), none, none, seen), _Depths(0, 0)
    tile, surfel, depth = dr.empty(mi.UInt32, total), dr.empty(mi.UInt32, total), dr.empty(mi.Float, total)
    surfels = dr.arange(mi.UInt32, dr.width(entries))

    def emit(row, at):
        first, last = span(row)

        def put(column, at):
            dr.scatter(tile, mi.UInt32(row) * columns + column, at)
            dr.scatter(surfel, surfels, at)
            dr.scatter(depth, _depth_at_tile(projected.geometry, column, row), at)
            return column + 1, at + 1

        _, at = dr.while_loop((first, at), lambda column, at: column < last, put)
        return row + 1, at

    dr.eval(dr.while_loop((mi.Int32(top), mi.UInt32(offset)), lambda row, at: row < bottom, emit))
    length = dr.zeros(mi.UInt32, n_tiles)
    dr.scatter_reduce(dr.ReduceOp.Add, length, mi.UInt32(1), tile)
    first = dr.prefix_reduce(dr.ReduceOp.Add, length, exclusive=True)
    depths = _Depths.of(depth)
    ids = dr.gather(mi.UInt32, surfel, dr.argsort(_sort_key(tile, depth, n_tiles, depths)))
    dr.eval(ids, first, length, seen)
    return TileIntersections(ids, first, length, seen), depths

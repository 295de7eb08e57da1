"""Which blocks of 4 x 4 pixels, and which tiles, a large splat can touch, sixteen at a time.

The rays of a square of pixels are a mean and its changes to the right and down, up to a small part that
they miss. So each product of a row with them lies in an interval, and a splat is left out where its
greatest Mahalanobis distance that is drawn lies below what the intervals allow.
"""

# Numba's decorators and vector types are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

import numpy as np

from alpasim_plugin.core.kernels import kernel
from alpasim_plugin.gaussians.constants import TILE
from alpasim_plugin.gaussians.raster import simd as v
from alpasim_plugin.gaussians.raster.lens_rays import (
    BLOCK_ROWS,
    LENS_TIME,
    LENS_TURN,
    MOTION,
    MOTION_BOUND_D,
    MOTION_BOUND_O,
)
from alpasim_plugin.gaussians.raster.lens_records import (
    CUT_SIGMA,
    DISTANCE,
    INVERSE_O2,
    NODE,
    PASSED,
    ROW_A,
    ROW_B,
    ROW_C,
    ROW_S,
)
from alpasim_plugin.gaussians.raster.project_kernels import cross, dot, load3, row

_f = np.float32
CLOSE = 0.95  # of (t / o)^2: the camera lies within the drawn ellipsoid, or nearly
# Of sixteen squares: mean, change to the right and down of rays, what they miss, and their times.
MISSED, SQUARE_TIME, SQUARES = 144, 160, 176
ROUNDING = _f(1e-3)  # of standard deviations


@kernel
def turned(d, turn, time):
    """Return vectors turned by ``time turn``, to second order."""
    first = cross(turn, d)
    second = cross(turn, first)
    half = _f(0.5) * time * time
    return (
        v.fma(half, second[0], v.fma(time, first[0], d[0])),
        v.fma(half, second[1], v.fma(time, first[1], d[1])),
        v.fma(half, second[2], v.fma(time, first[2], d[2])),
    )


@kernel
def time_of(lens, x, y):
    """Return when pixels are exposed, in shutters from the middle."""
    time = v.fma(x, lens[LENS_TIME], v.fma(y, lens[LENS_TIME + 1], lens[LENS_TIME + 2]))
    return v.minimum(v.maximum(time, -0.5), 0.5)


@kernel
def half_time(lens, side):
    """Return by how much a pixel of a square is exposed before or after its middle, at most;
    ``side`` is that from its first pixel to its last.
    """
    return _f(0.5) * side * _f(abs(lens[LENS_TIME]) + abs(lens[LENS_TIME + 1]))


@kernel
def roll_squares(table, place, x, y, side, lens, out, offset):
    """Write how rays vary over sixteen squares of a rolling shutter, and their times; ``x, y`` are
    the centres of their first pixels.
    """
    turn = row(lens, LENS_TURN)
    mean, right, down = load3(table, place), load3(table, place + 48), load3(table, place + 96)
    zero = x * _f(0.0)
    for k in range(9):
        v.store(out, offset + k * 16, zero)
    quarter = _f(0.25)
    half = _f(0.5) * side
    for corner in range(4):
        to_right = _f(2 * (corner & 1) - 1)
        to_down = _f((corner & 2) - 1)
        d = (
            v.fma(right[0], to_right, v.fma(down[0], to_down, mean[0])),
            v.fma(right[1], to_right, v.fma(down[1], to_down, mean[1])),
            v.fma(right[2], to_right, v.fma(down[2], to_down, mean[2])),
        )
        time = time_of(lens, x + (to_right + _f(1.0)) * half, y + (to_down + _f(1.0)) * half)
        d = turned(d, turn, time)
        for k in range(3):
            first = offset + k * 16
            v.store(out, first, v.fma(quarter, d[k], v.load(out, first)))
            v.store(out, first + 48, v.fma(quarter * to_right, d[k], v.load(out, first + 48)))
            v.store(out, first + 96, v.fma(quarter * to_down, d[k], v.load(out, first + 96)))
    # What a product of the time's and the ray's change adds.
    later = _f(2.0) * half_time(lens, side)
    by_turn = later * _f(np.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2))
    change = v.sqrt(dot(right, right)) + v.sqrt(dot(down, down))
    v.store(out, offset + MISSED, v.load(table, place + 144) + by_turn * (change + by_turn))
    v.store(out, offset + SQUARE_TIME, time_of(lens, x + half, y + half))


@kernel
def _vary(records, place, table, offset):
    """Return the mean of a row's products with the rays of each square, and its changes to the
    right and down.
    """
    a = row(records, place)
    return (
        dot(a, load3(table, offset)),
        dot(a, load3(table, offset + 48)),
        dot(a, load3(table, offset + 96)),
    )


@kernel
def _length2(records, first, end):
    total = _f(0.0)
    for k in range(first, end):
        total += records[k] * records[k]
    return total


@kernel
def touched(records, place, table, offset, motion, later):
    """Return the bit mask of sixteen squares that a large splat can touch.

    Args:
        records, place: Of the splat.
        table, offset: Of the squares: see `lens_rays.TileRays`, of a rolling shutter `roll_squares`.
        motion: See `lens_raster_kernels.composite_lens_tiles`.
        later: See `half_time`.
    """
    a = _vary(records, place + ROW_A, table, offset)
    b = _vary(records, place + ROW_B, table, offset)
    c = _vary(records, place + ROW_C, table, offset)
    size = np.sqrt(
        _length2(records, place + ROW_A, place + ROW_A + 6)
        + _length2(records, place + ROW_C, place + ROW_C + 3)
    )
    missed = v.load(table, offset + MISSED)
    if motion is not None and records[place + NODE] >= 0:
        missed = missed + motion[np.int64(records[place + NODE]) * MOTION + MOTION_BOUND_D]
    extra = size * missed + ROUNDING
    off_axis = v.sqrt(v.fma(a[0], a[0], b[0] * b[0]))
    change = _hypot(_change(a), _change(b)) + extra
    most = off_axis + change
    change_c = _change(c) + extra
    t2 = records[place + CUT_SIGMA] * records[place + CUT_SIGMA]
    inverse_o2 = records[place + INVERSE_O2]
    is_around = inverse_o2 * t2 >= _f(CLOSE)
    if motion is not None:
        time = v.load(table, offset + SQUARE_TIME)
        off_axis, change = _while_exposed(records, place, a, b, c, time, later, extra)
        if records[place + NODE] >= 0:
            bound = motion[np.int64(records[place + NODE]) * MOTION + MOTION_BOUND_O]
            off = size * bound / records[place + DISTANCE]
            change = change + off * (v.absolute(c[0]) + change_c + most)
        is_around |= records[place + PASSED] > 0
    ahead = c[0] + change_c
    if is_around:
        # What is drawn where the peak lies behind is no nearer than the line of the ray.
        ahead = v.absolute(c[0]) + change_c
    least = v.maximum(off_axis - change, _f(0.0))
    below = v.fma(most * most, inverse_o2, ahead * ahead)
    return v.bits((least * least <= _f(1.0001) * t2 * below) & (ahead > _f(0.0)))


@kernel
def _change(a):
    """Return by how much a product changes from the middle of a square on."""
    return v.absolute(a[1]) + v.absolute(a[2])


@kernel
def _hypot(x, y):
    return v.sqrt(v.fma(x, x, y * y))


@kernel
def _while_exposed(records, place, a, b, c, time, later, extra):
    """Return how far rays of a rolling shutter pass by, and by how much that changes; see
    `lens_project_kernels` for the numerator.
    """
    s1, s2, s3 = row(records, place + ROW_S)
    by_x = (
        v.fma(s2, c[0], v.negative(s3 * b[0])),
        v.fma(s2, c[1], v.negative(s3 * b[1])),
        v.fma(s2, c[2], v.negative(s3 * b[2])),
    )
    by_y = (
        v.fma(s1, c[0], v.negative(s3 * a[0])),
        v.fma(s1, c[1], v.negative(s3 * a[1])),
        v.fma(s1, c[2], v.negative(s3 * a[2])),
    )
    off_axis = _hypot(v.fma(time, by_x[0], b[0]), v.fma(time, by_y[0], a[0]))
    change_x = v.absolute(v.fma(time, by_x[1], b[1])) + v.absolute(v.fma(time, by_x[2], b[2]))
    change_x = change_x + later * (v.absolute(by_x[0]) + _change(by_x))
    change_y = v.absolute(v.fma(time, by_y[1], a[1])) + v.absolute(v.fma(time, by_y[2], a[2]))
    change_y = change_y + later * (v.absolute(by_y[0]) + _change(by_y))
    sway = _f(1.0) + _f(0.5) * (abs(s1) + abs(s2) + abs(s3))
    return off_axis, _hypot(change_x, change_y) + extra * sway


@kernel
def split_wide(cursor, wide, records, size, table, lens, motion, boxes, owners, spans, tiles_x):
    """Write for each row of tiles that a wide splat touches from which tile to which it does so, as
    a box of its own, and empty the splat's box; called by each thread.

    Args:
        cursor: int64 ``(2,)``: the next wide splat, and the number of boxes written.
        wide: int64, numbers of records.
        records, size: All records, and the numbers of each.
        table: Of tiles: `lens_rays.TileRays.tiles`, of a rolling shutter `roll_tiles`.
        lens, motion: See `lens_raster_kernels.composite_lens_tiles`.
        boxes: int16 ``(N, 4)``, in which splats are looked for.
        owners: int64 output, the record of each box.
        spans: int16 output ``(N, 4)``.
        tiles_x: Tiles in a row of tiles.
    """
    rows = SQUARES if motion is not None else BLOCK_ROWS * 16
    groups = (tiles_x + 15) // 16
    later = half_time(lens, _f(TILE - 1))
    while True:
        number = v.fetch_add(cursor, 0, 1)
        if number >= wide.shape[0]:
            return
        splat = wide[number]
        left, right, top, bottom = boxes[splat]
        for tile_y in range(top, bottom):
            first = right
            end = left
            for group in range(left // 16, (right + 15) // 16):
                offset = (tile_y * groups + group) * rows
                bits = touched(records, splat * size, table, offset, motion, later)
                if bits != 0:
                    first = min(first, group * 16 + v.lowest_bit(bits))
                    last = group * 16
                    while bits != 0:
                        last = group * 16 + v.lowest_bit(bits)
                        bits &= bits - 1
                    end = last + 1
            first = max(first, left)
            end = min(end, right)
            if first < end:
                place = v.fetch_add(cursor, 1, 1)
                owners[place] = splat
                spans[place, 0] = first
                spans[place, 1] = end
                spans[place, 2] = tile_y
                spans[place, 3] = tile_y + 1
        boxes[splat, 1] = boxes[splat, 0]
        boxes[splat, 3] = boxes[splat, 2]


@kernel
def roll_tiles(table, tiles_x, tiles_y, lens, out):
    """Write `roll_squares` of all tiles, sixteen of a row together."""
    groups = (tiles_x + 15) // 16
    for tile_y in range(tiles_y):
        y = v.splat(_f(tile_y * TILE + 0.5))
        for group in range(groups):
            number = tile_y * groups + group
            x = v.lane_pattern(_f(TILE), _f(4 * TILE)) + _f(group * 16 * TILE + 0.5)
            offset = number * SQUARES
            roll_squares(table, number * BLOCK_ROWS * 16, x, y, _f(TILE - 1), lens, out, offset)

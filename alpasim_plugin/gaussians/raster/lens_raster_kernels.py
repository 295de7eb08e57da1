"""Composite the splats of each tile along the rays of a lens, sixteen pixels at a time: the scheme of
`raster_kernels` with the records of `lens_project_kernels`.

Of a rolling shutter each pixel looks from where the camera is at its time. A record is that of the
shutter's middle; a ray is turned and shifted to there: by the camera's motion once per pixel, for
Gaussians of a moving road user by its own once more.
"""

# Numba's decorators and vector types are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

import numpy as np

from alpasim_plugin.core.kernels import kernel
from alpasim_plugin.gaussians.constants import (
    ALPHA_MAX,
    EXPONENT_SCALE,
    TILE,
    TRANSMITTANCE_STOP,
    B,
    G,
    R,
)
from alpasim_plugin.gaussians.raster import simd as v
from alpasim_plugin.gaussians.raster.lens_rays import (
    BLOCK_ROWS,
    LENS_SHIFT,
    LENS_TURN,
    MOTION,
    MOTION_CENTRE,
    MOTION_SPEED,
    MOTION_TURN,
)
from alpasim_plugin.gaussians.raster.lens_records import (
    DEPTH,
    DISTANCE,
    INVERSE_O2,
    LONG,
    NODE,
    PASSED,
    PEAK,
    ROW_A,
    ROW_B,
    ROW_C,
    ROW_S,
    SHORT,
)
from alpasim_plugin.gaussians.raster.lens_touch_kernels import (
    SQUARES,
    half_time,
    roll_squares,
    time_of,
    touched,
    turned,
)
from alpasim_plugin.gaussians.raster.project_kernels import dot, load3, row
from alpasim_plugin.gaussians.raster.raster_kernels import (
    CHUNK,
    CUT,
    KEPT,
    KEPT_LAST,
    KEPT_T,
    STATE,
    STATE_B,
    STATE_D,
    STATE_G,
    STATE_R,
    STATE_T,
    block_centres,
    falloff,
    touched_blocks,
    whitened,
)

_f = np.float32
Q2_SCALE = _f(EXPONENT_SCALE**2)
INVERSE_SCALE = _f(1 / EXPONENT_SCALE**2)
TINY = _f(1e-30)
# Per block of a rolling shutter's tile: direction and time of sixteen pixels.
ROLLED_D, ROLLED_TIME, ROLLED = 0, 48, 64


@kernel
def _store3(array, offset, a):
    v.store(array, offset, a[0])
    v.store(array, offset + 16, a[1])
    v.store(array, offset + 32, a[2])


@kernel
def _roll_pixels(rays, place, x, y, lens, rolled, block):
    """Write direction and time of a block's pixels."""
    time = time_of(lens, x, y)
    d = turned(load3(rays, place), row(lens, LENS_TURN), time)
    base = block * ROLLED
    _store3(rolled, base + ROLLED_D, d)
    v.store(rolled, base + ROLLED_TIME, time)


@kernel
def _as_if_still(motion, node, d, o, time):
    """Return the ray that meets a moving road user at the shutter's middle as a ray does at its
    time: direction and start.
    """
    turn = row(motion, node + MOTION_TURN)
    speed = row(motion, node + MOTION_SPEED)
    centre = row(motion, node + MOTION_CENTRE)
    back = v.negative(time)
    from_centre = (
        v.fma(back, speed[0], o[0] - centre[0]),
        v.fma(back, speed[1], o[1] - centre[1]),
        v.fma(back, speed[2], o[2] - centre[2]),
    )
    start = turned(from_centre, turn, back)
    start = start[0] + centre[0], start[1] + centre[1], start[2] + centre[2]
    return turned(d, turn, back), start


@kernel
def _from_start(inverse_o2, s, a, b, c):
    """Return for rays whose starts are moved by ``s``, of a Gaussian near by, how far ahead of it the
    peak lies, in no unit, and q^2 there.
    """
    middle = _f(1.0) / np.sqrt(inverse_o2)
    z = v.fnma(s[2], middle, middle)
    ahead = v.fnma(s[0], a, v.fnma(s[1], b, z * (c * middle)))
    return ahead, v.fma(s[0], s[0], v.fma(s[1], s[1], z * z))


@kernel
def _moved_q2(near, place, d, s):
    """Return q^2 on rays whose starts are moved by ``s``, see `lens_project_kernels`; its parts a, b, c
    as well, and what is below the fraction but for c^2.
    """
    a = dot(row(near, place + ROW_A), d)
    b = dot(row(near, place + ROW_B), d)
    c = dot(row(near, place + ROW_C), d)
    inverse_o2 = near[place + INVERSE_O2]
    x = v.fma(s[1], c, v.fnma(s[2], b, b))
    y = v.fma(s[0], c, v.fnma(s[2], a, a))
    z = v.fma(s[0], b, v.negative(s[1] * a))
    top = v.fma(x, x, v.fma(y, y, inverse_o2 * (z * z)))
    across = v.maximum(v.fma(a, a, b * b), TINY) * inverse_o2
    ahead = v.maximum(c, _f(0.0))
    return top / v.fma(ahead, ahead, across), (a, b, c), top, across


@kernel
def _even_q2(near, place, d, time):
    """Return q^2 on the rays of a rolling shutter of what moves evenly, and is not passed."""
    s1, s2, s3 = row(near, place + ROW_S)
    q2, _, _, _ = _moved_q2(near, place, d, (time * s1, time * s2, time * s3))
    return q2


@kernel
def _turned_q2(near, place, d, time, shift, motion):
    """Return q^2 on the rays of a rolling shutter of anything."""
    if near[place + NODE] >= 0:
        o = time * shift[0], time * shift[1], time * shift[2]
        d, o = _as_if_still(motion, np.int64(near[place + NODE]) * MOTION, d, o, time)
        inverse_n = _f(1.0) / near[place + DISTANCE]
        s = (
            dot(row(near, place + ROW_A), o) * inverse_n,
            dot(row(near, place + ROW_B), o) * inverse_n,
            dot(row(near, place + ROW_C), o) * inverse_n,
        )
    else:
        s1, s2, s3 = row(near, place + ROW_S)
        s = time * s1, time * s2, time * s3
    q2, (a, b, c), top, across = _moved_q2(near, place, d, s)
    if near[place + PASSED] > 0:
        ahead, start = _from_start(near[place + INVERSE_O2], s, a, b, c)
        q2 = v.select(ahead > _f(0.0), top / v.fma(c, c, across), start)
    return q2


@kernel
def _q2(near, place, d):
    """Return q^2 on rays from the camera's centre."""
    a = dot(row(near, place + ROW_A), d)
    b = dot(row(near, place + ROW_B), d)
    ahead = v.maximum(dot(row(near, place + ROW_C), d), _f(0.0))
    across = v.maximum(v.fma(a, a, b * b), TINY)
    return across / v.fma(ahead, ahead, across * near[place + INVERSE_O2])


@kernel
def _blend_block(block, x, y, rays, at_rays, rolled, lens, motion, chunk, kept, at_kept):
    """Blend the splats of a chunk that touch a block; returns whether its pixels are finished.

    ``rolled`` is None of a global shutter, ``motion`` where all that is near moves evenly: a branch
    for each splat would cost as much as the splat. ``kept`` as of `composite_lens_tiles`.
    """
    masks, near, size, state, first = chunk
    base = block * STATE
    through = v.load(state, base + STATE_T)
    red = v.load(state, base + STATE_R)
    green = v.load(state, base + STATE_G)
    blue = v.load(state, base + STATE_B)
    depth = v.load(state, base + STATE_D)
    if rolled is not None:
        d = load3(rolled, block * ROLLED + ROLLED_D)
        time = v.load(rolled, block * ROLLED + ROLLED_TIME)
        shift = row(lens, LENS_SHIFT)
    else:
        d = load3(rays, at_rays)
    finished = False
    for word in range(CHUNK // 64):
        touching = 0
        for part in range(4):
            touching |= v.bits(v.has_bit(v.load(masks, word * 64 + part * 16), block)) << (
                part * 16
            )
        while touching != 0:
            number = word * 64 + v.lowest_bit(touching)
            place = number * size
            touching &= touching - 1
            if near[place + INVERSE_O2] < 0:
                across, down = whitened(near, place, x, y)
                q2 = v.fma(across, across, down * down) * INVERSE_SCALE
            elif motion is not None:
                q2 = _turned_q2(near, place, d, time, shift, motion)
            elif rolled is not None:
                q2 = _even_q2(near, place, d, time)
            else:
                q2 = _q2(near, place, d)
            exponent = v.fnma(q2, Q2_SCALE, near[place + PEAK])
            visible = exponent >= CUT
            alpha = v.minimum(falloff(exponent), ALPHA_MAX)
            alpha = v.select(visible, alpha, 0.0)
            after = v.fnma(through, alpha, through)
            goes_on = after > TRANSMITTANCE_STOP
            weight = v.select(goes_on, through * alpha, 0.0)
            through = v.select(goes_on, after, v.negative(v.absolute(through)))
            red = v.fma(weight, near[place + R], red)
            green = v.fma(weight, near[place + G], green)
            blue = v.fma(weight, near[place + B], blue)
            depth = v.fma(weight, near[place + DEPTH], depth)
            if kept is not None:
                last = v.load(kept, at_kept + KEPT_LAST)
                last = v.select(goes_on & visible, first + number, last)
                v.store(kept, at_kept + KEPT_LAST, last)
            if v.bits(through > 0.0) == 0:
                finished = True
                touching = 0
        if finished:
            break
    v.store(state, base + STATE_T, through)
    v.store(state, base + STATE_R, red)
    v.store(state, base + STATE_G, green)
    v.store(state, base + STATE_B, blue)
    v.store(state, base + STATE_D, depth)
    if kept is not None:
        v.store(kept, at_kept + KEPT_T, v.absolute(through))
    return finished


@kernel
def _start_tile(tile, alive, state):
    """Reset the state of a tile and return the bit mask of blocks where the lens sees anything."""
    live = 0
    zero = v.splat(_f(0.0))
    for block in range(16):
        base = block * STATE
        sight = v.load(alive, (tile * 16 + block) * 16)
        v.store(state, base + STATE_T, sight)
        v.store(state, base + STATE_R, zero)
        v.store(state, base + STATE_G, zero)
        v.store(state, base + STATE_B, zero)
        v.store(state, base + STATE_D, zero)
        if v.bits(sight > 0.0) != 0:
            live |= 1 << block
    return live


@kernel
def _composite_tile(
    lists,
    start,
    end,
    records,
    rays,
    at_rays,
    blocks,
    at_blocks,
    rolled,
    lens,
    motion,
    live,
    corner,
    room,
    kept,
    at_kept,
):
    """Blend a tile's splats in order. ``corner`` is the centre of its first pixel; ``room`` is the
    state, and that for a chunk of splats: their records, and which blocks they touch. ``kept`` as of
    `composite_lens_tiles`.
    """
    state, near, masks = room
    x0, y0 = corner
    size = LONG if motion is not None else SHORT
    later = half_time(lens, _f(3.0))
    for first in range(start, end, CHUNK):
        if live == 0:
            return
        count = min(CHUNK, end - first)
        is_even = True
        for i in range(count):
            later_place = np.int64(lists[min(first + i + 16, end - 1)]) * size
            v.prefetch(records, later_place)
            if motion is not None:
                v.prefetch(records, later_place + 16)
            place = np.int64(lists[first + i]) * size
            if records[place + INVERSE_O2] < 0:
                masks[i] = touched_blocks(records, place, x0, y0)
                v.store(near, i * size, v.load(records, place))
                continue
            masks[i] = touched(records, place, blocks, at_blocks, motion, later)
            if masks[i] & live:
                v.store(near, i * size, v.load(records, place))
                if motion is not None:
                    v.store(near, i * size + 16, v.load(records, place + 16))
                    is_even &= (records[place + NODE] < 0) & (records[place + PASSED] <= 0)
        for i in range(count, CHUNK):
            masks[i] = 0
        todo = live
        while todo != 0:
            block = v.lowest_bit(todo)
            todo &= todo - 1
            place = at_rays + block * 48
            chunk = masks, near, size, state, first - start
            block_kept = at_kept + block * KEPT
            x, y = block_centres(x0, y0, block)
            if motion is None:
                finished = _blend_block(
                    block, x, y, rays, place, None, lens, None, chunk, kept, block_kept
                )
            elif is_even:
                finished = _blend_block(
                    block, x, y, rays, place, rolled, lens, None, chunk, kept, block_kept
                )
            else:
                finished = _blend_block(
                    block, x, y, rays, place, rolled, lens, motion, chunk, kept, block_kept
                )
            if finished:
                live &= ~(1 << block)


@kernel
def _write_tile(tile_x, tile_y, state, alive, at_alive, behind, colour, alpha, depth_sum):
    """Write a tile's pixels; those in which the lens sees nothing are black and opaque. Without a
    background, sums of weighted colours and depths.
    """
    height, width = alpha.shape
    for line in range(min(TILE, height - tile_y * TILE)):
        y = tile_y * TILE + line
        for column in range(min(TILE, width - tile_x * TILE)):
            x = tile_x * TILE + column
            block = (line >> 2) * 4 + (column >> 2)
            pixel = (line & 3) * 4 + (column & 3)
            if alive[at_alive + block * 16 + pixel] < 0:
                alpha[y, x] = _f(1.0)
                depth_sum[y, x] = _f(0.0)
                colour[y, x, 0] = colour[y, x, 1] = colour[y, x, 2] = _f(0.0)
                continue
            place = block * STATE + pixel
            opacity = _f(1.0) - abs(state[place + STATE_T])
            alpha[y, x] = opacity
            depth = state[place + STATE_D]
            if behind is not None:
                depth = depth / opacity if opacity > 0 else _f(0.0)
            depth_sum[y, x] = depth
            for channel in range(3):
                light = state[place + STATE_R + 16 * channel]
                if behind is not None:
                    back = behind[min(y, behind.shape[0] - 1), min(x, behind.shape[1] - 1), channel]
                    light = light + (_f(1.0) - opacity) * back
                    light = min(max(light, _f(0.0)), _f(1.0))
                colour[y, x, channel] = light


@kernel
def composite_lens_tiles(
    cursor,
    tiles_x,
    starts,
    lists,
    records,
    rays,
    alive,
    blocks,
    lens,
    motion,
    kept,
    behind,
    colour,
    alpha,
    depth,
):
    """Render tiles until none is left; called by each thread.

    Args:
        cursor, tiles_x, starts, lists: See `raster_kernels.composite_tiles`.
        records: Of `lens_project_kernels`, `LONG` numbers each of a rolling shutter, else `SHORT`.
        rays, alive, blocks: See `lens_rays.TileRays`.
        lens: float64 ``(LENS_SIZE,)``.
        motion: float32, `MOTION` numbers a moving node; None: the shutter is global.
        kept: float32 output, 16 x KEPT per tile, for `lens_gradient_kernels.lens_tile_gradients`, or
            None.
        behind: float32 ``(H, W, 3)`` or ``(1, 1, 3)``, the background; or None.
        colour: float32 output ``(H, W, 3)``, 0..1; without a background the sum of weighted colours.
        alpha: float32 output ``(H, W)``.
        depth: float32 output ``(H, W)``, mean distance of the Gaussians' means, metres; without a
            background the sum of weighted distances.
    """
    near = np.empty(CHUNK * (LONG if motion is not None else SHORT), dtype=np.float32)
    room = np.empty(16 * STATE, dtype=np.float32), near, np.empty(CHUNK, dtype=np.int32)
    rolled = np.empty(16 * ROLLED, dtype=np.float32)
    rolled_blocks = np.empty(SQUARES, dtype=np.float32)
    while True:
        tile = v.fetch_add(cursor, 0, 1)
        if tile >= starts.shape[0] - 1:
            return
        tile_x = tile % tiles_x
        tile_y = tile // tiles_x
        live = _start_tile(tile, alive, room[0])
        at_rays = tile * 16 * 48
        at_blocks = tile * BLOCK_ROWS * 16
        span = lists, starts[tile], starts[tile + 1], records, rays, at_rays
        x0 = _f(tile_x * TILE) + _f(0.5)
        y0 = _f(tile_y * TILE) + _f(0.5)
        at_kept = tile * 16 * KEPT
        if kept is not None:
            for place in range(at_kept, at_kept + 16 * KEPT, KEPT):
                v.store(kept, place + KEPT_T, v.splat(_f(1.0)))
                v.store(kept, place + KEPT_LAST, v.splat(_f(-1.0)))
        kept_tile = (x0, y0), room, kept, at_kept
        if motion is not None:
            first_x = v.lane_pattern(_f(4.0), _f(0.0)) + x0
            first_y = v.lane_pattern(_f(0.0), _f(4.0)) + y0
            roll_squares(blocks, at_blocks, first_x, first_y, _f(3.0), lens, rolled_blocks, 0)
            for block in range(16):
                x, y = block_centres(x0, y0, block)
                _roll_pixels(rays, at_rays + block * 48, x, y, lens, rolled, block)
            _composite_tile(*span, rolled_blocks, 0, rolled, lens, motion, live, *kept_tile)
        else:
            _composite_tile(*span, blocks, at_blocks, rolled, lens, motion, live, *kept_tile)
        at_alive = tile * 256
        _write_tile(tile_x, tile_y, room[0], alive, at_alive, behind, colour, alpha, depth)

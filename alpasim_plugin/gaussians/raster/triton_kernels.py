"""Triton kernels of the GPU rasteriser: project Gaussians, list them per tile, composite tiles.

`alpasim_plugin.gaussians.raster.rasterize_reference` is the reference implementation. Importing
this module needs Triton, which torch's CUDA wheels bring. With ``TRITON_INTERPRET=1`` in the
environment before the first import, the kernels run interpreted on the CPU.
"""

# Triton's decorators and tensor types are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator,misc"

from __future__ import annotations

import triton
import triton.language as tl

from alpasim_plugin.gaussians import constants, sh

# float64 per camera: fx, fy, cx, cy, slope limits low x, high x, low y, high y, the time (a, b, c) of a
# pixel while a shutter rolls, as of `camera.Rolling`, and whether it does
CAMERA = 12
RECORD = 12  # float32 per splat: u, v, L11, L12, L22, opacity, r, g, b, z, half width, half height
SPAN = 4  # int32 per block of Gaussians: node, first, number, view
BOX = 4  # int32 per splat: first and last + 1 tile column, first and last + 1 tile row
PIXEL = 6  # float32 per pixel: see `composite`

_EPS2D_PX2 = tl.constexpr(constants.EPS2D_PX2)
_ALPHA_MIN = tl.constexpr(constants.ALPHA_MIN)
_ALPHA_MAX = tl.constexpr(constants.ALPHA_MAX)
_STOP = tl.constexpr(constants.TRANSMITTANCE_STOP)
_POSE = tl.constexpr(constants.POSE_SIZE)
_ANTIALIAS = tl.constexpr(constants.POSE_ANTIALIAS)
_TURN = tl.constexpr(constants.POSE_TURN)
_CAMERA = tl.constexpr(CAMERA)
_TIME = tl.constexpr(8)
_LEAST_M = tl.constexpr(1e-3)  # depth of what is seen through a rolling shutter
_FAR_M = tl.constexpr(constants.FAR_M)
_MARGIN_PX = tl.constexpr(0.01)  # boxes grow by it: rounding never cuts a pixel that is drawn
_C0 = tl.constexpr(sh.C0)
_C1 = tl.constexpr(sh.C1)
_C20, _C21, _C22 = (tl.constexpr(value) for value in sh.C2)
_C30, _C31, _C32, _C33, _C34 = (tl.constexpr(value) for value in sh.C3)


@triton.jit
def colour(sh_ptr, offset, visible, x, y, z, CHANNEL: tl.constexpr, SIZE: tl.constexpr):
    """Return one colour channel of splats seen along unit directions, 0 where it would be less.

    ``offset`` is the first coefficient of each splat; the order is that of `sh.sh_terms`.
    """
    offset += CHANNEL
    value = 0.5 + _C0 * tl.load(sh_ptr + offset, visible, 0.0)
    if SIZE > 1:
        value -= _C1 * y * tl.load(sh_ptr + offset + 3, visible, 0.0)
        value += _C1 * z * tl.load(sh_ptr + offset + 6, visible, 0.0)
        value -= _C1 * x * tl.load(sh_ptr + offset + 9, visible, 0.0)
    if SIZE > 4:
        value += _C20 * x * y * tl.load(sh_ptr + offset + 12, visible, 0.0)
        value -= _C20 * y * z * tl.load(sh_ptr + offset + 15, visible, 0.0)
        value += _C21 * (2 * z * z - x * x - y * y) * tl.load(sh_ptr + offset + 18, visible, 0.0)
        value -= _C20 * x * z * tl.load(sh_ptr + offset + 21, visible, 0.0)
        value += _C22 * (x * x - y * y) * tl.load(sh_ptr + offset + 24, visible, 0.0)
    if SIZE > 9:
        four_zz = 4 * z * z - x * x - y * y
        value -= _C30 * y * (3 * x * x - y * y) * tl.load(sh_ptr + offset + 27, visible, 0.0)
        value += _C31 * x * y * z * tl.load(sh_ptr + offset + 30, visible, 0.0)
        value -= _C32 * y * four_zz * tl.load(sh_ptr + offset + 33, visible, 0.0)
        cubic = z * (2 * z * z - 3 * x * x - 3 * y * y)
        value += _C33 * cubic * tl.load(sh_ptr + offset + 36, visible, 0.0)
        value -= _C32 * x * four_zz * tl.load(sh_ptr + offset + 39, visible, 0.0)
        value += _C34 * z * (x * x - y * y) * tl.load(sh_ptr + offset + 42, visible, 0.0)
        value -= _C30 * x * (x * x - 3 * y * y) * tl.load(sh_ptr + offset + 45, visible, 0.0)
    return tl.maximum(value, 0.0)


@triton.jit
def tiles_between(low, high, count, TILE: tl.constexpr):
    """Return the first tile and the last + 1 that pixels ``low`` to ``high`` meet, in 0..count."""
    # Clamped as floats: a splat at 1e30 pixels has no tile number.
    first = tl.minimum(tl.maximum(tl.floor(low / TILE), 0.0), count).to(tl.int32)
    last = tl.minimum(tl.maximum(tl.floor(high / TILE), -1.0), count - 1.0).to(tl.int32) + 1
    return first, last


@triton.jit
def _at_its_time(x, y, z, motion, camera):
    """Return where points are, in camera axes, when the pixel that shows them is exposed; see
    `project_kernels`.

    A point moves by ``turn x p + shift`` in a shutter, to second order.
    """
    turn_x = tl.load(motion)
    turn_y = tl.load(motion + 1)
    turn_z = tl.load(motion + 2)
    first_x = turn_y * z - turn_z * y + tl.load(motion + 3)
    first_y = turn_z * x - turn_x * z + tl.load(motion + 4)
    first_z = turn_x * y - turn_y * x + tl.load(motion + 5)
    second_x = 0.5 * (turn_y * first_z - turn_z * first_y)
    second_y = 0.5 * (turn_z * first_x - turn_x * first_z)
    second_z = 0.5 * (turn_x * first_y - turn_y * first_x)
    at_x = x
    at_y = y
    at_z = z
    for _ in tl.static_range(3):
        inverse_z = 1.0 / tl.maximum(at_z, _LEAST_M)
        u = tl.load(camera) * at_x * inverse_z + tl.load(camera + 2)
        v = tl.load(camera + 1) * at_y * inverse_z + tl.load(camera + 3)
        time = tl.load(camera + _TIME) * u + tl.load(camera + _TIME + 1) * v
        time = tl.minimum(tl.maximum(time + tl.load(camera + _TIME + 2), -0.5), 0.5)
        at_x = x + time * (first_x + time * second_x)
        at_y = y + time * (first_y + time * second_y)
        at_z = z + time * (first_z + time * second_z)
    return at_x, at_y, tl.maximum(at_z, _LEAST_M)


@triton.jit
def project(
    spans,
    poses,
    camera,
    means,
    factors,
    opacities,
    extents,
    sh_ptr,
    records,
    depths,
    boxes,
    counts,
    near_m,
    tiles_x,
    tiles_y,
    SIZE: tl.constexpr,
    TILE: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Project a block of Gaussians of one node: its record, depth, box of tiles and their count.

    Positions are float64 up to the camera's axes, so that UTM-sized coordinates keep millimetres.
    A Gaussian that is not drawn has depth infinity and no tile. The tiles of a view stand below
    those of the view before.
    """
    block = tl.program_id(0)
    node = tl.load(spans + block * 4)
    lane = tl.arange(0, BLOCK)
    present = lane < tl.load(spans + block * 4 + 2)
    i = (tl.load(spans + block * 4 + 1) + lane).to(tl.int64)
    view = tl.load(spans + block * 4 + 3)
    camera += view * _CAMERA
    above = view * tiles_y
    pose = poses + node * _POSE
    r00 = tl.load(pose)
    r01 = tl.load(pose + 1)
    r02 = tl.load(pose + 2)
    r10 = tl.load(pose + 3)
    r11 = tl.load(pose + 4)
    r12 = tl.load(pose + 5)
    r20 = tl.load(pose + 6)
    r21 = tl.load(pose + 7)
    r22 = tl.load(pose + 8)
    dx = tl.load(means + 3 * i, present, 0.0) - tl.load(pose + 9)
    dy = tl.load(means + 3 * i + 1, present, 0.0) - tl.load(pose + 10)
    dz = tl.load(means + 3 * i + 2, present, 0.0) - tl.load(pose + 11)
    x = r00 * dx + r01 * dy + r02 * dz
    y = r10 * dx + r11 * dy + r12 * dz
    z = r20 * dx + r21 * dy + r22 * dz
    opacity = tl.load(opacities + i, present, 0.0)
    visible = present & (z >= near_m) & (z <= _FAR_M) & (opacity >= _ALPHA_MIN)
    z = tl.where(visible, z, 1.0)
    if tl.load(camera + _TIME + 3) > 0:
        x, y, z = _at_its_time(x, y, z, pose + _TURN, camera)
    fx = tl.load(camera)
    fy = tl.load(camera + 1)
    slope_x = x / z
    slope_y = y / z
    u = (fx * slope_x + tl.load(camera + 2)).to(tl.float32)
    v = (fy * slope_y + tl.load(camera + 3)).to(tl.float32)
    sx = tl.minimum(tl.maximum(slope_x, tl.load(camera + 4)), tl.load(camera + 5)).to(tl.float32)
    sy = tl.minimum(tl.maximum(slope_y, tl.load(camera + 6)), tl.load(camera + 7)).to(tl.float32)
    along_x = (fx / z).to(tl.float32)
    along_y = (fy / z).to(tl.float32)
    # Rows of J R: how the image moves with the node's axes.
    jx0 = along_x * (r00.to(tl.float32) - sx * r20.to(tl.float32))
    jx1 = along_x * (r01.to(tl.float32) - sx * r21.to(tl.float32))
    jx2 = along_x * (r02.to(tl.float32) - sx * r22.to(tl.float32))
    jy0 = along_y * (r10.to(tl.float32) - sy * r20.to(tl.float32))
    jy1 = along_y * (r11.to(tl.float32) - sy * r21.to(tl.float32))
    jy2 = along_y * (r12.to(tl.float32) - sy * r22.to(tl.float32))
    f = factors + 9 * i
    f00 = tl.load(f, visible, 0.0)
    f01 = tl.load(f + 1, visible, 0.0)
    f02 = tl.load(f + 2, visible, 0.0)
    f10 = tl.load(f + 3, visible, 0.0)
    f11 = tl.load(f + 4, visible, 0.0)
    f12 = tl.load(f + 5, visible, 0.0)
    f20 = tl.load(f + 6, visible, 0.0)
    f21 = tl.load(f + 7, visible, 0.0)
    f22 = tl.load(f + 8, visible, 0.0)
    m0 = jx0 * f00 + jx1 * f10 + jx2 * f20
    m1 = jx0 * f01 + jx1 * f11 + jx2 * f21
    m2 = jx0 * f02 + jx1 * f12 + jx2 * f22
    n0 = jy0 * f00 + jy1 * f10 + jy2 * f20
    n1 = jy0 * f01 + jy1 * f11 + jy2 * f21
    n2 = jy0 * f02 + jy1 * f12 + jy2 * f22
    mm = m0 * m0 + m1 * m1 + m2 * m2
    nn = n0 * n0 + n1 * n1 + n2 * n2
    antialias = tl.load(pose + _ANTIALIAS).to(tl.float32)
    eps = tl.where(antialias > 0, antialias, _EPS2D_PX2)
    c11 = mm + eps
    c22 = nn + eps
    c12 = m0 * n0 + m1 * n1 + m2 * n2
    # The determinant as a sum of squares (Cauchy-Binet) does not cancel for needles.
    cross0 = m1 * n2 - m2 * n1
    cross1 = m2 * n0 - m0 * n2
    cross2 = m0 * n1 - m1 * n0
    raw_det = cross0 * cross0 + cross1 * cross1 + cross2 * cross2
    det = raw_det + eps * (mm + nn) + eps * eps
    opacity *= tl.where(antialias > 0, tl.sqrt(raw_det / det), 1.0)
    l11 = tl.sqrt(c22 / det)
    l22 = 1.0 / tl.sqrt(c22)
    extent = tl.load(extents + i, present, 0.0)
    half_width = extent * tl.sqrt(c11)
    half_height = extent * tl.sqrt(c22)
    distance = tl.sqrt(dx * dx + dy * dy + dz * dz)
    distance = tl.where(visible, distance, 1.0)
    toward_x = (dx / distance).to(tl.float32)
    toward_y = (dy / distance).to(tl.float32)
    toward_z = (dz / distance).to(tl.float32)
    x0, x1 = tiles_between(u - half_width - _MARGIN_PX, u + half_width + _MARGIN_PX, tiles_x, TILE)
    y0, y1 = tiles_between(
        v - half_height - _MARGIN_PX, v + half_height + _MARGIN_PX, tiles_y, TILE
    )
    count = tl.maximum(x1 - x0, 0) * tl.maximum(y1 - y0, 0)
    count = tl.where(visible, count, 0)
    slot = block * BLOCK + lane
    tl.store(depths + slot, tl.where(visible, z.to(tl.float32), float("inf")))
    tl.store(counts + slot, count)
    tl.store(boxes + slot * 4, x0)
    tl.store(boxes + slot * 4 + 1, x1)
    tl.store(boxes + slot * 4 + 2, above + y0)
    tl.store(boxes + slot * 4 + 3, above + y1)
    on_screen = count > 0
    record = records + slot * 12
    tl.store(record, u, on_screen)
    tl.store(record + 1, v, on_screen)
    tl.store(record + 2, l11, on_screen)
    tl.store(record + 3, -(c12 / c22) * l11, on_screen)
    tl.store(record + 4, l22, on_screen)
    tl.store(record + 5, opacity, on_screen)
    sh_offset = i * (SIZE * 3)
    tl.store(
        record + 6,
        colour(sh_ptr, sh_offset, on_screen, toward_x, toward_y, toward_z, 0, SIZE),
        on_screen,
    )
    tl.store(
        record + 7,
        colour(sh_ptr, sh_offset, on_screen, toward_x, toward_y, toward_z, 1, SIZE),
        on_screen,
    )
    tl.store(
        record + 8,
        colour(sh_ptr, sh_offset, on_screen, toward_x, toward_y, toward_z, 2, SIZE),
        on_screen,
    )
    tl.store(record + 9, z.to(tl.float32), on_screen)


@triton.jit
def list_tiles(
    order, ends, boxes, counts, tiles, splats, total, capacity, tiles_x, BLOCK: tl.constexpr
):
    """Write the tiles of each splat, nearest splat first: pairs of tile and splat.

    ``ends`` is the running sum of the counts in the order of depth; pairs beyond ``capacity`` are
    left out.
    """
    rank = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    present = rank < total
    slot = tl.load(order + rank, present, 0)
    count = tl.where(present, tl.load(counts + slot, present, 0), 0)
    begin = tl.load(ends + rank, present, 0) - count
    x0 = tl.load(boxes + slot * 4, present, 0)
    columns = tl.maximum(tl.load(boxes + slot * 4 + 1, present, 0) - x0, 1)
    y0 = tl.load(boxes + slot * 4 + 2, present, 0)
    most = tl.max(count, axis=0)
    for k in range(most):
        slot_in_list = begin + k
        wanted = (k < count) & (slot_in_list < capacity)
        tile = (y0 + k // columns) * tiles_x + x0 + k % columns
        tl.store(tiles + slot_in_list, tile, wanted)
        tl.store(splats + slot_in_list, slot.to(tl.int32), wanted)


@triton.jit
def pixels_of(tile, tiles_x, TILE: tl.constexpr):
    """Return the columns and the rows of a tile's pixels."""
    column = (tile % tiles_x) * TILE + tl.arange(0, TILE)[None, :]
    row = (tile // tiles_x) * TILE + tl.arange(0, TILE)[:, None]
    return tl.broadcast(column, row)


@triton.jit
def ellipse_q2(record, px, py):
    """Return the squared distance of pixels from a splat's middle, in standard deviations."""
    dx = px - tl.load(record)
    dy = py - tl.load(record + 1)
    s = tl.load(record + 2) * dx + tl.load(record + 3) * dy
    t = tl.load(record + 4) * dy
    return s * s + t * t


@triton.jit
def layer(alpha, transmittance, open_):
    """Return where a layer of an opacity is drawn, with which weight, what is seen through it and which
    pixels are open behind it: the splat that would close a pixel is left out, and so is all behind it.
    """
    alpha = tl.minimum(alpha, _ALPHA_MAX)
    visible = (alpha >= _ALPHA_MIN) & open_
    after = transmittance * (1.0 - alpha)
    open_ = open_ & ~(visible & (after <= _STOP))
    visible = visible & open_
    weight = tl.where(visible, alpha * transmittance, 0.0)
    return visible, weight, tl.where(visible, after, transmittance), open_


@triton.jit
def composite(
    records,
    splats,
    starts,
    image,
    width,
    height,
    tiles_x,
    tiles_y,
    TILE: tl.constexpr,
    CHUNK: tl.constexpr,
):
    """Blend a tile's splats, nearest first, into colour, weighted depth and transmittance per pixel;
    the last of the six numbers is the place in the tile's list behind the last splat drawn.
    """
    tile = tl.program_id(0)
    tiles = tiles_x * tiles_y
    column, row = pixels_of(tile % tiles, tiles_x, TILE)
    image += (tile // tiles).to(tl.int64) * (height * width * 6)
    px = column.to(tl.float32) + 0.5
    py = row.to(tl.float32) + 0.5
    transmittance = tl.full((TILE, TILE), 1.0, tl.float32)
    red = tl.zeros((TILE, TILE), tl.float32)
    green = tl.zeros((TILE, TILE), tl.float32)
    blue = tl.zeros((TILE, TILE), tl.float32)
    depth = tl.zeros((TILE, TILE), tl.float32)
    last = tl.zeros((TILE, TILE), tl.int32)
    inside = (column < width) & (row < height)
    open_ = inside
    first = tl.load(starts + tile)
    begin = first
    end = tl.load(starts + tile + 1)
    while begin < end:
        stop = tl.minimum(begin + CHUNK, end)
        for k in range(begin, stop):
            record = records + tl.load(splats + k).to(tl.int64) * 12
            alpha = tl.load(record + 5) * tl.exp(-0.5 * ellipse_q2(record, px, py))
            visible, weight, transmittance, open_ = layer(alpha, transmittance, open_)
            red += weight * tl.load(record + 6)
            green += weight * tl.load(record + 7)
            blue += weight * tl.load(record + 8)
            depth += weight * tl.load(record + 9)
            last = tl.where(visible, k + 1 - first, last)
        begin = stop
        if tl.max(open_.to(tl.int32)) == 0:
            begin = end
    pixel = image + (row * width + column) * 6
    tl.store(pixel, red, inside)
    tl.store(pixel + 1, green, inside)
    tl.store(pixel + 2, blue, inside)
    tl.store(pixel + 3, depth, inside)
    tl.store(pixel + 4, transmittance, inside)
    tl.store(pixel + 5, last.to(tl.float32), inside)


@triton.jit
def composite_backward(
    records,
    splats,
    starts,
    image,
    gradients,
    places,
    pairs,
    width,
    height,
    tiles_x,
    TILE: tl.constexpr,
):
    """Walk a tile's splats from the last that was drawn to the nearest, and write the gradient that
    each receives in this tile to its row of ``pairs``: see `gradient_kernels`, whose equations and columns
    these are.

    ``gradients`` holds five numbers per pixel, of colour, weighted depth and opacity; ``places``
    the row of each entry of ``splats``.
    """
    tile = tl.program_id(0)
    column, row = pixels_of(tile, tiles_x, TILE)
    px = column.to(tl.float32) + 0.5
    py = row.to(tl.float32) + 0.5
    inside = (column < width) & (row < height)
    pixel = row * width + column
    transmittance = tl.load(image + pixel * 6 + 4, inside, 1.0)
    last = tl.load(image + pixel * 6 + 5, inside, 0.0).to(tl.int32)
    gradient = gradients + pixel * 5
    g_red = tl.load(gradient, inside, 0.0)
    g_green = tl.load(gradient + 1, inside, 0.0)
    g_blue = tl.load(gradient + 2, inside, 0.0)
    g_depth = tl.load(gradient + 3, inside, 0.0)
    g_alpha = tl.load(gradient + 4, inside, 0.0)
    behind = tl.zeros((TILE, TILE), tl.float32)
    begin = tl.load(starts + tile)
    count = tl.max(last)
    for back in range(count):
        i = count - 1 - back
        record = records + tl.load(splats + begin + i).to(tl.int64) * 12
        dx = px - tl.load(record)
        dy = py - tl.load(record + 1)
        s = tl.load(record + 2) * dx + tl.load(record + 3) * dy
        t = tl.load(record + 4) * dy
        full = tl.load(record + 5) * tl.exp(-0.5 * (s * s + t * t))
        alpha = tl.minimum(full, _ALPHA_MAX)
        visible = (alpha >= _ALPHA_MIN) & (i < last)
        if tl.max(visible.to(tl.int32)) > 0:
            inverse = 1.0 / (1.0 - alpha)
            before = transmittance * inverse
            q = g_alpha + g_depth * tl.load(record + 9)
            q += g_red * tl.load(record + 6)
            q += g_green * tl.load(record + 7)
            q += g_blue * tl.load(record + 8)
            weight = tl.where(visible, before * alpha, 0.0)
            # The clamp of alpha ends the gradient; colour and depth still receive theirs.
            h = tl.where(visible & (full <= _ALPHA_MAX), before * q - behind * inverse, 0.0) * alpha
            transmittance = tl.where(visible, before, transmittance)
            behind += weight * q
            pair = pairs + tl.load(places + begin + i) * 10
            tl.store(pair, tl.sum(weight * g_red))
            tl.store(pair + 1, tl.sum(weight * g_green))
            tl.store(pair + 2, tl.sum(weight * g_blue))
            tl.store(pair + 3, tl.sum(weight * g_depth))
            tl.store(pair + 4, tl.sum(h))
            tl.store(pair + 5, tl.sum(h * s))
            tl.store(pair + 6, tl.sum(h * t))
            tl.store(pair + 7, tl.sum(h * s * s))
            tl.store(pair + 8, tl.sum(h * s * t))
            tl.store(pair + 9, tl.sum(h * t * t))

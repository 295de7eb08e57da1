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

from alpasim_plugin.gaussians import constants
from alpasim_plugin.gaussians.raster.triton_functions import (
    ALPHA_MAX,
    ALPHA_MIN,
    EPS2D_PX2,
    added,
    combined,
    cross,
    dot,
    ellipse_q2,
    factor_rows,
    layer,
    number,
    offsets,
    pixels_of,
    scaled,
    slots_of,
    store_colours,
    store_pixels,
    store_tiles,
    vector,
    vector32,
)

# float64 per camera: fx, fy, cx, cy, slope limits low x, high x, low y, high y, the time (a, b, c) of a
# pixel while a shutter rolls, as of `camera.Rolling`, and whether it does
CAMERA = 12
RECORD = 12  # float32 per splat: u, v, L11, L12, L22, opacity, r, g, b, z, half width, half height
SPAN = 4  # int32 per block of Gaussians: node, first, number, view
BOX = 4  # int32 per splat: first and last + 1 tile column, first and last + 1 tile row
PIXEL = 6  # float32 per pixel: see `composite`

_POSE = tl.constexpr(constants.POSE_SIZE)
_ANTIALIAS = tl.constexpr(constants.POSE_ANTIALIAS)
_TURN = tl.constexpr(constants.POSE_TURN)
_CAMERA = tl.constexpr(CAMERA)
_TIME = tl.constexpr(8)
_LEAST_M = tl.constexpr(1e-3)  # depth of what is seen through a rolling shutter
_FAR_M = tl.constexpr(constants.FAR_M)
_MARGIN_PX = tl.constexpr(0.01)  # boxes grow by it: rounding never cuts a pixel that is drawn


@triton.jit
def _at_its_time(p, motion, camera):
    """Return where points are, in camera axes, when the pixel that shows them is exposed; see
    `project_kernels`.

    A point moves by ``turn x p + shift`` in a shutter, to second order.
    """
    turn = vector(motion, 0)
    first = added(cross(turn, p), vector(motion, 3))
    second = scaled(cross(turn, first), 0.5)
    x, y, z = p
    for _ in tl.static_range(3):
        inverse_z = 1.0 / tl.maximum(z, _LEAST_M)
        u = tl.load(camera) * x * inverse_z + tl.load(camera + 2)
        v = tl.load(camera + 1) * y * inverse_z + tl.load(camera + 3)
        time = tl.load(camera + _TIME) * u + tl.load(camera + _TIME + 1) * v
        time = tl.minimum(tl.maximum(time + tl.load(camera + _TIME + 2), -0.5), 0.5)
        x, y, z = added(p, scaled(added(first, scaled(second, time)), time))
    return x, y, tl.maximum(z, _LEAST_M)


@triton.jit
def _jacobian_row(scale, slope, across, ahead):
    """Return a row of J R, by which the image moves with the node's axes: ``scale (across - slope
    ahead)``.
    """
    return scaled(added(across, scaled(ahead, -slope)), scale)


@triton.jit
def _image_rows(camera, pose, slope_x, slope_y, z):
    """Return the two rows of J R, float32, with the slopes held to the camera's limits."""
    sx = tl.minimum(tl.maximum(slope_x, tl.load(camera + 4)), tl.load(camera + 5)).to(tl.float32)
    sy = tl.minimum(tl.maximum(slope_y, tl.load(camera + 6)), tl.load(camera + 7)).to(tl.float32)
    along_x = (tl.load(camera) / z).to(tl.float32)
    along_y = (tl.load(camera + 1) / z).to(tl.float32)
    ahead = vector32(pose, 6)
    return (
        _jacobian_row(along_x, sx, vector32(pose, 0), ahead),
        _jacobian_row(along_y, sy, vector32(pose, 3), ahead),
    )


@triton.jit
def _ellipse(rows, factor, antialias, extent):
    """Return the numbers L11, L12, L22 of ellipses, the share of the opacity that is left, and the half
    sizes of their boxes, pixels.
    """
    m = combined(rows[0], factor[0], factor[1], factor[2])
    n = combined(rows[1], factor[0], factor[1], factor[2])
    mm = dot(m, m)
    nn = dot(n, n)
    eps = tl.where(antialias > 0, antialias, EPS2D_PX2)
    c11 = mm + eps
    c22 = nn + eps
    c12 = dot(m, n)
    # The determinant as a sum of squares (Cauchy-Binet) does not cancel for needles.
    minors = cross(m, n)
    raw_det = dot(minors, minors)
    det = raw_det + eps * (mm + nn) + eps * eps
    l11 = tl.sqrt(c22 / det)
    kept = tl.where(antialias > 0, tl.sqrt(raw_det / det), 1.0)
    half_u = extent * tl.sqrt(c11) + _MARGIN_PX
    half_v = extent * tl.sqrt(c22) + _MARGIN_PX
    return l11, -(c12 / c22) * l11, 1.0 / tl.sqrt(c22), kept, half_u, half_v


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

    A Gaussian that is not drawn has depth infinity and no tile. The tiles of a view stand below
    those of the view before.
    """
    block = tl.program_id(0)
    pose = poses + tl.load(spans + block * 4) * _POSE
    lane = tl.arange(0, BLOCK)
    present = lane < tl.load(spans + block * 4 + 2)
    i = (tl.load(spans + block * 4 + 1) + lane).to(tl.int64)
    view = tl.load(spans + block * 4 + 3)
    camera += view * _CAMERA
    d = offsets(means, i, present, pose)
    x = dot(vector(pose, 0), d)
    y = dot(vector(pose, 3), d)
    z = dot(vector(pose, 6), d)
    opacity = tl.load(opacities + i, present, 0.0)
    visible = present & (z >= near_m) & (z <= _FAR_M) & (opacity >= ALPHA_MIN)
    z = tl.where(visible, z, 1.0)
    if tl.load(camera + _TIME + 3) > 0:
        x, y, z = _at_its_time((x, y, z), pose + _TURN, camera)
    slope_x = x / z
    slope_y = y / z
    u = (tl.load(camera) * slope_x + tl.load(camera + 2)).to(tl.float32)
    v = (tl.load(camera + 1) * slope_y + tl.load(camera + 3)).to(tl.float32)
    rows = _image_rows(camera, pose, slope_x, slope_y, z)
    factor = factor_rows(factors, i, visible)
    extent = tl.load(extents + i, present, 0.0)
    slot = slots_of(block, BLOCK)
    record = records + slot * 12
    l11, l12, l22, kept, half_u, half_v = _ellipse(rows, factor, number(pose, _ANTIALIAS), extent)
    on_screen = store_tiles(
        u - half_u,
        u + half_u,
        v - half_v,
        v + half_v,
        visible,
        depths,
        boxes,
        counts,
        slot,
        z.to(tl.float32),
        view * tiles_y,
        tiles_x,
        tiles_y,
        TILE,
    )
    tl.store(record, u, on_screen)
    tl.store(record + 1, v, on_screen)
    tl.store(record + 2, l11, on_screen)
    tl.store(record + 3, l12, on_screen)
    tl.store(record + 4, l22, on_screen)
    tl.store(record + 5, opacity * kept, on_screen)
    store_colours(sh_ptr, i, d, record, on_screen, SIZE)
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
    out = image + (row * width + column) * 6
    store_pixels(out, (red, green, blue), depth, transmittance, last, inside)


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
        alpha = tl.minimum(full, ALPHA_MAX)
        visible = (alpha >= ALPHA_MIN) & (i < last)
        if tl.max(visible.to(tl.int32)) > 0:
            inverse = 1.0 / (1.0 - alpha)
            before = transmittance * inverse
            q = g_alpha + g_depth * tl.load(record + 9)
            q += g_red * tl.load(record + 6)
            q += g_green * tl.load(record + 7)
            q += g_blue * tl.load(record + 8)
            weight = tl.where(visible, before * alpha, 0.0)
            # The clamp of alpha ends the gradient; colour and depth still receive theirs.
            h = tl.where(visible & (full <= ALPHA_MAX), before * q - behind * inverse, 0.0) * alpha
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

"""Draw strokes and shapes into an image with a depth buffer, band by band, four samples a pixel.

Pixels that cannot be covered are skipped. A band of rows is drawn by one thread in the order of the
lists, so the image does not depend on the number of threads. Steps that every pixel takes are
inlined: calls would cost a tenth of the time.
"""

# Numba's decorators are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

import numpy as np

from alpasim_plugin.core.kernels import inlined_kernel, kernel
from alpasim_plugin.fixers.semantic_map.kernels import (
    BACK,
    BIAS,
    FARTHEST,
    FRONT,
    HALF,
    I0,
    I1,
    NEAREST,
    RED,
    S_BIAS,
    X0,
    X1,
    Y0,
    Y1,
)
from alpasim_plugin.fixers.semantic_map.style import DEPTH_MAX_M
from alpasim_plugin.gaussians.raster.simd import fetch_add

BAND = 16  # rows
# Sample positions in a pixel, as offsets from its centre: the usual rotated grid of four.
SAMPLES = np.array([[-2.0, -6.0], [6.0, -2.0], [-6.0, 2.0], [2.0, 6.0]]) / 16.0
COUNT = 4
ALL = 15  # the mask of all samples
SLACK = 0.4  # a sample lies at most so far from the centre, along an axis


@kernel
def _pack(red, green, blue, fade):
    return np.uint32(
        np.uint32(red * fade + 0.5)
        | (np.uint32(green * fade + 0.5) << 8)
        | (np.uint32(blue * fade + 0.5) << 16)
    )


@kernel
def _fade(inverse):
    """Return the share of colour and width that is left at a depth of 1 / ``inverse``."""
    return max(0.0, 1.0 - 1.0 / (inverse * DEPTH_MAX_M))


@kernel
def _rows(low, high, band_row, height):
    """Return the first and one past the last row of a band that lie between two coordinates."""
    first = max(int(max(low - 1.0, 0.0)), band_row)
    last = min(int(min(high + 1.0, height - 1.0)), band_row + BAND - 1)
    return first, last + 1


@kernel
def _draw_stroke(stroke, band_row, height, width, stretch, depth, colour):
    """Draw a stroke into a band of rows: a line whose width and colour fade with depth.

    Distances from the line are taken in pixels' widths: rows are ``stretch`` of them high.
    """
    extent = stroke[HALF] / stretch
    low = min(stroke[Y0], stroke[Y1]) - extent
    high = max(stroke[Y0], stroke[Y1]) + extent
    first_row, end_row = _rows(low, high, band_row, height)
    if first_row >= end_row:
        return
    x0 = stroke[X0]
    y0 = stroke[Y0]
    i0 = stroke[I0]
    dx = stroke[X1] - x0
    dy = stroke[Y1] - y0
    di = stroke[I1] - i0
    sy = dy * stretch
    length2 = dx * dx + sy * sy
    over = 1.0 / length2 if length2 > 0.0 else 0.0
    reach = stroke[HALF] * _fade(max(i0, i0 + di))
    slack = SLACK * np.sqrt(1.0 + stretch * stretch)
    limit2 = (reach + slack) * (reach + slack)
    reach_y = reach / stretch + SLACK
    for row in range(first_row, end_row):
        yc = row + 0.5
        low, high = _part_near_row(y0, dy, yc, reach_y)
        if low > high:
            continue
        xa = x0 + low * dx
        xb = x0 + high * dx
        left = int(max(min(xa, xb) - reach - SLACK - 1.0, 0.0))
        right = int(min(max(xa, xb) + reach + SLACK + 1.0, width))
        vy = (yc - y0) * stretch
        for column in range(left, min(right + 1, width)):
            vx = column + 0.5 - x0
            distance2, t = _from_line(vx, vy, dx, sy, over)
            if distance2 > limit2:
                continue
            inverse = i0 + t * di
            fade = _fade(inverse)
            radius = stroke[HALF] * fade
            if distance2 > (radius + slack) * (radius + slack):
                continue
            mask = ALL
            if radius <= slack or distance2 > (radius - slack) * (radius - slack):
                mask = _samples_within(vx, vy, dx, sy, over, stretch, radius)
                if mask == 0:
                    continue
            if stroke[BIAS] != 0.0:
                inverse = inverse / max(1.0 - stroke[BIAS] * inverse, 1e-3)
            packed = _pack(stroke[RED], stroke[RED + 1], stroke[RED + 2], fade)
            first = ((row - band_row) * width + column) * COUNT
            for s in range(COUNT):
                if mask >> s & 1 and np.float32(inverse) > depth[first + s]:
                    depth[first + s] = inverse
                    colour[first + s] = packed


@kernel
def _part_near_row(y0, dy, yc, reach_y):
    """Return from where to where, as shares of it, a line is within ``reach_y`` of the row ``yc``;
    nowhere if the first is larger.
    """
    if dy == 0.0:
        return (0.0, 1.0) if abs(yc - y0) <= reach_y else (1.0, 0.0)
    ta = (yc - reach_y - y0) / dy
    tb = (yc + reach_y - y0) / dy
    return max(0.0, min(ta, tb)), min(1.0, max(ta, tb))


@inlined_kernel
def _from_line(vx, vy, dx, sy, over):
    """Return the squared distance of a point from a line, and where along it the nearest point is.

    Args:
        vx, vy: The point, from the line's beginning.
        dx, sy: The line.
        over: 1 over its squared length.
    """
    t = min(max((vx * dx + vy * sy) * over, 0.0), 1.0)
    ex = vx - t * dx
    ey = vy - t * sy
    return ex * ex + ey * ey, t


@inlined_kernel
def _samples_within(vx, vy, dx, sy, over, stretch, radius):
    """Return the mask of the samples of a pixel that lie within ``radius`` of a line; see
    `_from_line`.
    """
    mask = 0
    for s in range(COUNT):
        wx = vx + SAMPLES[s, 0]
        wy = vy + SAMPLES[s, 1] * stretch
        distance2, _ = _from_line(wx, wy, dx, sy, over)
        if distance2 <= radius * radius:
            mask |= 1 << s
    return mask


@kernel
def _draw_shape(shape, band_row, height, width, depth, colour):
    """Draw a triangle into a band of rows, shaded and faded with depth."""
    x = shape[0:12:4]
    y = shape[1:12:4]
    first_row, end_row = _rows(min(y[0], y[1], y[2]), max(y[0], y[1], y[2]), band_row, height)
    if first_row >= end_row:
        return
    area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])
    if area == 0.0:
        return
    turn = 1.0 / area
    # Barycentric coordinates b = a x + c y + e of the corners, each 0 on the opposite edge.
    a0 = (y[1] - y[2]) * turn
    a1 = (y[2] - y[0]) * turn
    a2 = (y[0] - y[1]) * turn
    c0 = (x[2] - x[1]) * turn
    c1 = (x[0] - x[2]) * turn
    c2 = (x[1] - x[0]) * turn
    slopes = (a0, c0, a1, c1, a2, c2)
    edges = (
        (a0, c0, x[1], y[1]),
        (a1, c1, x[2], y[2]),
        (a2, c2, x[0], y[0]),
    )
    m0 = SLACK * (abs(a0) + abs(c0))
    m1 = SLACK * (abs(a1) + abs(c1))
    m2 = SLACK * (abs(a2) + abs(c2))
    # 1/depth and shade/depth are planes over the image as well.
    ix = a0 * shape[2] + a1 * shape[6] + a2 * shape[10]
    iy = c0 * shape[2] + c1 * shape[6] + c2 * shape[10]
    sx = a0 * shape[3] + a1 * shape[7] + a2 * shape[11]
    sy = c0 * shape[3] + c1 * shape[7] + c2 * shape[11]
    for row in range(first_row, end_row):
        yc = row + 0.5
        low, high = _columns_of_row(edges, x, yc, width)
        r0 = c0 * (yc - y[1]) - a0 * x[1]
        r1 = c1 * (yc - y[2]) - a1 * x[2]
        r2 = c2 * (yc - y[0]) - a2 * x[0]
        ir = shape[2] + iy * (yc - y[0]) - ix * x[0]
        sr = shape[3] + sy * (yc - y[0]) - sx * x[0]
        for column in range(int(low), min(int(high) + 1, width)):
            xc = column + 0.5
            b0 = a0 * xc + r0
            b1 = a1 * xc + r1
            b2 = a2 * xc + r2
            if b0 < -m0 or b1 < -m1 or b2 < -m2:
                continue
            is_whole = b0 >= m0 and b1 >= m1 and b2 >= m2
            inverse = ix * xc + ir
            first = ((row - band_row) * width + column) * COUNT
            barycentric = (b0, b1, b2)
            mask = _cover(shape, barycentric, slopes, is_whole, inverse, ix, iy, first, depth)
            if mask == 0:
                continue
            packed = _shaded(shape, inverse, sx * xc + sr)
            for s in range(COUNT):
                if mask >> s & 1:
                    colour[first + s] = packed


@kernel
def _columns_of_row(edges, x, yc, width):
    """Return between which coordinates the row ``yc`` can meet a triangle: cut at each edge, a
    little outside.

    Args:
        edges: Slopes of a barycentric coordinate, and a corner where it is 0; three of them.
        x: The corners' coordinates.
        yc: Middle of the row.
        width: Of the image.
    """
    low = max(min(x[0], x[1], x[2]) - 1.0, 0.0)
    high = min(max(x[0], x[1], x[2]) + 1.0, np.float64(width))
    for a, c, xk, yk in edges:
        slack_left = c * (yc - yk) + SLACK * (abs(a) + abs(c))
        if a > 0.0:
            low = max(low, xk - slack_left / a - 1.0)
        elif a < 0.0:
            high = min(high, xk - slack_left / a + 1.0)
        elif slack_left < 0.0:
            high = -1.0
    return low, high


@inlined_kernel
def _cover(shape, barycentric, slopes, is_whole, inverse, ix, iy, first, depth):
    """Write the depths of the samples of a pixel that a triangle covers and where nothing
    nearer is drawn, and return their mask.

    Args:
        shape: The triangle.
        barycentric: Coordinates of the pixel's middle.
        slopes: Their slopes, across and down in turn.
        is_whole: The triangle covers all samples.
        inverse: 1/depth at the middle.
        ix, iy: Its slopes.
        first: Index of the first sample.
        depth: 1/depth of what the samples show, written.
    """
    b0, b1, b2 = barycentric
    a0, c0, a1, c1, a2, c2 = slopes
    mask = 0
    for s in range(COUNT):
        ox = SAMPLES[s, 0]
        oy = SAMPLES[s, 1]
        if is_whole or (
            b0 + a0 * ox + c0 * oy >= 0.0
            and b1 + a1 * ox + c1 * oy >= 0.0
            and b2 + a2 * ox + c2 * oy >= 0.0
        ):
            nearness = min(max(inverse + ix * ox + iy * oy, shape[FARTHEST]), shape[NEAREST])
            if shape[S_BIAS] != 0.0:
                nearness = nearness / max(1.0 - shape[S_BIAS] * nearness, 1e-3)
            if np.float32(nearness) > depth[first + s]:
                depth[first + s] = nearness
                mask |= 1 << s
    return mask


@kernel
def _shaded(shape, inverse, shade_over_depth):
    """Return the packed colour of a triangle at a depth of 1 / ``inverse``."""
    z = 1.0 / min(max(inverse, shape[FARTHEST]), shape[NEAREST])
    part = min(max(shade_over_depth * z, 0.0), 1.0)
    return _pack(
        shape[FRONT] + part * (shape[BACK] - shape[FRONT]),
        shape[FRONT + 1] + part * (shape[BACK + 1] - shape[FRONT + 1]),
        shape[FRONT + 2] + part * (shape[BACK + 2] - shape[FRONT + 2]),
        max(0.0, 1.0 - z / DEPTH_MAX_M),
    )


@kernel
def draw_bands(cursor, lines, box_edges, shapes, stretch, image):
    """Draw bands of rows until none is left: lines, then shapes, then the edges of boxes."""
    height = image.shape[0]
    width = image.shape[1]
    depth = np.empty(BAND * width * COUNT, dtype=np.float32)
    colour = np.empty(BAND * width * COUNT, dtype=np.uint32)
    while True:
        band_row = fetch_add(cursor, 0, 1) * BAND
        if band_row >= height:
            return
        depth[:] = np.float32(0.0)
        colour[:] = np.uint32(0)
        for i in range(lines.shape[0]):
            _draw_stroke(lines[i], band_row, height, width, stretch, depth, colour)
        for i in range(shapes.shape[0]):
            _draw_shape(shapes[i], band_row, height, width, depth, colour)
        for i in range(box_edges.shape[0]):
            _draw_stroke(box_edges[i], band_row, height, width, stretch, depth, colour)
        _resolve(band_row, colour, image)


@kernel
def _resolve(band_row, colour, image):
    """Average the samples of a band into the image."""
    height = image.shape[0]
    width = image.shape[1]
    for row in range(band_row, min(band_row + BAND, height)):
        for column in range(width):
            first = ((row - band_row) * width + column) * COUNT
            for channel in range(3):
                total = np.uint32(COUNT // 2)
                for s in range(COUNT):
                    total += (colour[first + s] >> (8 * channel)) & 255
                image[row, column, channel] = total // COUNT

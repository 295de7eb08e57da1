"""Draw strokes and shapes into an image with a depth buffer, band by band, several samples a pixel.

The rules are those of `tests/fixers/draw_reference.py`; here pixels that cannot be covered are
skipped. A band of rows is drawn by one thread in the order of the lists, so the image does not
depend on the number of threads.
"""

# Numba's decorators are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

from __future__ import annotations

import numpy as np
from numba import njit

from alpasim_plugin.fixers.semantic_map.kernels import (
    BACK,
    BIAS,
    BLUE,
    FARTHEST,
    FRONT,
    GAIN,
    GREEN,
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
from alpasim_plugin.gaussians.raster.simd import fetch_add

BAND = 16  # rows
# Sample positions in a pixel, as offsets from its centre: the usual rotated grid of four.
SAMPLES_4 = np.array([[-2.0, -6.0], [6.0, -2.0], [-6.0, 2.0], [2.0, 6.0]]) / 16.0
SAMPLES_1 = np.zeros((1, 2))


@njit(cache=True, nogil=True)
def rows_of(strokes, n_strokes, shapes, n_shapes, stretch, height, stroke_rows, shape_rows):
    """Write the first and last image row that each stroke and shape can touch."""
    for i in range(n_strokes):
        reach = strokes[i, HALF] / stretch
        low, high = (
            min(strokes[i, Y0], strokes[i, Y1]) - reach,
            max(strokes[i, Y0], strokes[i, Y1]) + reach,
        )
        stroke_rows[i, 0], stroke_rows[i, 1] = (
            int(max(low - 1.0, 0.0)),
            int(min(high + 1.0, height)),
        )
    for i in range(n_shapes):
        low, high = (
            min(shapes[i, 1], shapes[i, 5], shapes[i, 9]),
            max(shapes[i, 1], shapes[i, 5], shapes[i, 9]),
        )
        shape_rows[i, 0], shape_rows[i, 1] = int(max(low - 1.0, 0.0)), int(min(high + 1.0, height))


@njit(cache=True, nogil=True)
def _pack(red, green, blue, fade):
    return np.uint32(
        np.uint32(red * fade + 0.5)
        | (np.uint32(green * fade + 0.5) << 8)
        | (np.uint32(blue * fade + 0.5) << 16)
    )


@njit(cache=True, nogil=True)
def _write(depth, colour, at, n_samples, mask, inverse, packed):
    """Give covered samples that are nearer than what is there a new colour."""
    for s in range(n_samples):
        if mask >> s & 1 and inverse > depth[at + s]:
            depth[at + s] = inverse
            colour[at + s] = packed


@njit(cache=True, nogil=True)
def _draw_stroke(
    stroke,
    first_row,
    last_row,
    band_row,
    width,
    stretch,
    depth_max,
    samples,
    depth,
    colour,
    touched,
):
    n_samples = samples.shape[0]
    x0 = stroke[X0]
    y0 = stroke[Y0]
    i0 = stroke[I0]
    dx = stroke[X1] - x0
    dy = stroke[Y1] - y0
    di = stroke[I1] - i0
    sy = dy * stretch
    length2 = dx * dx + sy * sy
    over = 1.0 / length2 if length2 > 0.0 else 0.0
    widest = max(0.0, 1.0 - 1.0 / (max(i0, i0 + di) * depth_max)) * stroke[GAIN]
    reach = stroke[HALF] * min(widest, 1.0)
    slack = 0.0 if n_samples == 1 else 0.4
    slack_far = slack * np.sqrt(1.0 + stretch * stretch)
    limit2 = (reach + slack_far) * (reach + slack_far)
    reach_y = reach / stretch + slack
    for row in range(first_row, last_row + 1):
        yc = row + 0.5
        low, high = 0.0, 1.0
        if dy != 0.0:  # the part of the line from which this row can be reached
            ta, tb = (yc - reach_y - y0) / dy, (yc + reach_y - y0) / dy
            low, high = max(low, min(ta, tb)), min(high, max(ta, tb))
        elif abs(yc - y0) > reach_y:
            continue
        if low > high:
            continue
        xa, xb = x0 + low * dx, x0 + high * dx
        left = int(max(min(xa, xb) - reach - slack - 1.0, 0.0))
        right = int(min(max(xa, xb) + reach + slack + 1.0, width))
        vy = (yc - y0) * stretch
        begin, end = width, -1
        for column in range(left, min(right + 1, width)):
            vx = column + 0.5 - x0
            t = min(max((vx * dx + vy * sy) * over, 0.0), 1.0)
            ex, ey = vx - t * dx, vy - t * sy
            distance2 = ex * ex + ey * ey
            if distance2 > limit2:
                continue
            inverse = i0 + t * di
            fade = max(0.0, 1.0 - 1.0 / (inverse * depth_max))
            radius = stroke[HALF] * min(1.0, stroke[GAIN] * fade)
            if distance2 > (radius + slack_far) * (radius + slack_far):
                continue
            mask = (1 << n_samples) - 1
            if radius <= slack_far or distance2 > (radius - slack_far) * (radius - slack_far):
                mask = 0
                for s in range(n_samples):
                    wx, wy = vx + samples[s, 0], vy + samples[s, 1] * stretch
                    t = min(max((wx * dx + wy * sy) * over, 0.0), 1.0)
                    ex, ey = wx - t * dx, wy - t * sy
                    if ex * ex + ey * ey <= radius * radius:
                        mask |= 1 << s
                if mask == 0:
                    continue
            if stroke[BIAS] != 0.0:
                inverse = inverse / max(1.0 - stroke[BIAS] * inverse, 1e-3)
            packed = _pack(stroke[RED], stroke[GREEN], stroke[BLUE], fade)
            _write(
                depth,
                colour,
                ((row - band_row) * width + column) * n_samples,
                n_samples,
                mask,
                np.float32(inverse),
                packed,
            )
            begin, end = min(begin, column), column
        if end >= 0:
            touched[row - band_row, 0] = min(touched[row - band_row, 0], begin)
            touched[row - band_row, 1] = max(touched[row - band_row, 1], end)


@njit(cache=True, nogil=True)
def _draw_shape(
    shape, first_row, last_row, band_row, width, depth_max, samples, depth, colour, touched
):
    n_samples = samples.shape[0]
    x0 = shape[0]
    y0 = shape[1]
    x1 = shape[4]
    y1 = shape[5]
    x2 = shape[8]
    y2 = shape[9]
    area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    if area == 0.0:
        return
    turn = 1.0 / area
    # Barycentric coordinates b = a x + c y + e of the corners, each 0 on the opposite edge.
    a0, c0 = (y1 - y2) * turn, (x2 - x1) * turn
    a1, c1 = (y2 - y0) * turn, (x0 - x2) * turn
    a2, c2 = (y0 - y1) * turn, (x1 - x0) * turn
    slack = 0.0 if n_samples == 1 else 0.4
    m0 = slack * (abs(a0) + abs(c0))
    m1 = slack * (abs(a1) + abs(c1))
    m2 = slack * (abs(a2) + abs(c2))
    # 1/depth and shade/depth are planes over the image as well.
    ix, iy = (
        a0 * shape[2] + a1 * shape[6] + a2 * shape[10],
        c0 * shape[2] + c1 * shape[6] + c2 * shape[10],
    )
    sx, sy = (
        a0 * shape[3] + a1 * shape[7] + a2 * shape[11],
        c0 * shape[3] + c1 * shape[7] + c2 * shape[11],
    )
    far, near = shape[FARTHEST], shape[NEAREST]
    bias = shape[S_BIAS]
    for row in range(first_row, last_row + 1):
        yc = row + 0.5
        low, high = max(min(x0, x1, x2) - 1.0, 0.0), min(max(x0, x1, x2) + 1.0, np.float64(width))
        for k in range(3):  # cut the row at each edge, a little outside
            a = a0
            c = c0
            m = m0
            xk = x1
            yk = y1
            if k == 1:
                a = a1
                c = c1
                m = m1
                xk = x2
                yk = y2
            elif k == 2:
                a = a2
                c = c2
                m = m2
                xk = x0
                yk = y0
            rest = c * (yc - yk) + m
            if a > 0.0:
                low = max(low, xk - rest / a - 1.0)
            elif a < 0.0:
                high = min(high, xk - rest / a + 1.0)
            elif rest < 0.0:
                high = -1.0
        begin, end = width, -1
        r0 = c0 * (yc - y1) - a0 * x1
        r1 = c1 * (yc - y2) - a1 * x2
        r2 = c2 * (yc - y0) - a2 * x0
        ir, sr = shape[2] + iy * (yc - y0) - ix * x0, shape[3] + sy * (yc - y0) - sx * x0
        for column in range(int(low), min(int(high) + 1, width)):
            xc = column + 0.5
            b0 = a0 * xc + r0
            b1 = a1 * xc + r1
            b2 = a2 * xc + r2
            if b0 < -m0 or b1 < -m1 or b2 < -m2:
                continue
            whole = b0 >= m0 and b1 >= m1 and b2 >= m2
            centre = ix * xc + ir
            at = ((row - band_row) * width + column) * n_samples
            mask = 0
            for s in range(n_samples):
                ox, oy = samples[s, 0], samples[s, 1]
                if whole or (
                    b0 + a0 * ox + c0 * oy >= 0.0
                    and b1 + a1 * ox + c1 * oy >= 0.0
                    and b2 + a2 * ox + c2 * oy >= 0.0
                ):
                    here = min(max(centre + ix * ox + iy * oy, far), near)
                    if bias != 0.0:
                        here = here / max(1.0 - bias * here, 1e-3)
                    if np.float32(here) > depth[at + s]:
                        depth[at + s] = here
                        mask |= 1 << s
            if mask == 0:
                continue
            z = 1.0 / min(max(centre, far), near)
            fade = max(0.0, 1.0 - z / depth_max)
            part = min(max((sx * xc + sr) * z, 0.0), 1.0)
            red = shape[FRONT] + part * (shape[BACK] - shape[FRONT])
            green = shape[FRONT + 1] + part * (shape[BACK + 1] - shape[FRONT + 1])
            blue = shape[FRONT + 2] + part * (shape[BACK + 2] - shape[FRONT + 2])
            packed = _pack(red, green, blue, fade)
            for s in range(n_samples):
                if mask >> s & 1:
                    colour[at + s] = packed
            begin, end = min(begin, column), column
        if end >= 0:
            touched[row - band_row, 0] = min(touched[row - band_row, 0], begin)
            touched[row - band_row, 1] = max(touched[row - band_row, 1], end)


@njit(cache=True, nogil=True)
def draw_bands(
    cursor,
    strokes,
    n_first,
    n_strokes,
    stroke_rows,
    shapes,
    n_shapes,
    shape_rows,
    stretch,
    depth_max,
    samples,
    image,
):
    """Draw bands of rows until none is left: strokes before ``n_first``, all shapes, the other
    strokes.
    """
    height, width = image.shape[0], image.shape[1]
    n_samples = samples.shape[0]
    depth = np.zeros(BAND * width * n_samples, np.float32)
    colour = np.zeros(BAND * width * n_samples, np.uint32)
    touched = np.empty((BAND, 2), np.int64)
    while True:
        band_row = fetch_add(cursor, 0, 1) * BAND
        if band_row >= height:
            return
        end_row = min(band_row + BAND, height) - 1
        touched[:, 0], touched[:, 1] = width, -1
        for phase in range(2):
            for i in range(0 if phase == 0 else n_first, n_first if phase == 0 else n_strokes):
                if stroke_rows[i, 0] <= end_row and stroke_rows[i, 1] >= band_row:
                    first, last = max(stroke_rows[i, 0], band_row), min(stroke_rows[i, 1], end_row)
                    _draw_stroke(
                        strokes[i],
                        first,
                        last,
                        band_row,
                        width,
                        stretch,
                        depth_max,
                        samples,
                        depth,
                        colour,
                        touched,
                    )
            if phase == 1:
                break
            for i in range(n_shapes):
                if shape_rows[i, 0] <= end_row and shape_rows[i, 1] >= band_row:
                    first, last = max(shape_rows[i, 0], band_row), min(shape_rows[i, 1], end_row)
                    _draw_shape(
                        shapes[i],
                        first,
                        last,
                        band_row,
                        width,
                        depth_max,
                        samples,
                        depth,
                        colour,
                        touched,
                    )
        _resolve(band_row, end_row, n_samples, depth, colour, touched, image)


@njit(cache=True, nogil=True)
def _resolve(band_row, end_row, n_samples, depth, colour, touched, image):
    """Average the samples of a band into the image and leave the buffers clear."""
    width = image.shape[1]
    half = n_samples // 2
    for row in range(band_row, end_row + 1):
        image[row, :, :] = 0
        first = (row - band_row) * width * n_samples
        left, right = touched[row - band_row, 0], touched[row - band_row, 1] + 1
        for column in range(left, right):
            at = first + column * n_samples
            packed = colour[at]
            same = True
            for s in range(1, n_samples):
                same = same and colour[at + s] == packed
            red = packed & 255
            green = (packed >> 8) & 255
            blue = (packed >> 16) & 255
            if not same:
                for s in range(1, n_samples):
                    packed = colour[at + s]
                    red += packed & 255
                    green += (packed >> 8) & 255
                    blue += (packed >> 16) & 255
                red = (red + half) // n_samples
                green = (green + half) // n_samples
                blue = (blue + half) // n_samples
            image[row, column, 0], image[row, column, 1], image[row, column, 2] = red, green, blue
        if left < right:
            depth[first + left * n_samples : first + right * n_samples] = 0.0
            colour[first + left * n_samples : first + right * n_samples] = 0

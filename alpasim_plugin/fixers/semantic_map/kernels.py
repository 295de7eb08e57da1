"""Project segments and triangles to the image: clipping, adaptive subdivision, projection.

A straight line in space is straight in a pinhole's image and 1/depth is linear along it, so one
piece is exact. Under an f-theta lens both bend: pieces are halved in space until the middle lies
within `BEND_PX` of the chord and 1/depth at the middle is right to `DEPTH_ERROR`. Triangles are
halved at an edge that bends; the decision looks at that edge alone, so neighbours make the same one
and no crack opens.
"""

# Numba's decorators are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

from __future__ import annotations

import numpy as np
from numba import njit

from alpasim_plugin.fixers.semantic_map.prepare import GROUP

BEND_PX = 0.1
DEPTH_ERROR = 0.02
WIDE_RAD_COS = 0.94  # pieces seen under more than 20 degrees are always halved
MAX_HALVINGS = 10
# Entries of a view: image size, near and far plane, cone that holds the view, pixels of this image
# for one of the style.
WIDTH, HEIGHT, NEAR, FAR, COS_HALF, SIN_HALF, SCALE = range(7)
# Columns of a stroke: ends in pixels with 1/depth, half width at no fade in pixels, fade gain,
# bias, colour.
X0, Y0, I0, X1, Y1, I1, HALF, GAIN, BIAS, RED, GREEN, BLUE = range(12)
STROKE = 12
# Columns of a shape: three corners of x, y, 1/depth, shade/depth; depth range; bias; front and back
# colour.
SHAPE = 21
NEAREST = 12
FARTHEST = 13
S_BIAS = 14
FRONT = 15
BACK = 18


@njit(cache=True, nogil=True)
def project(camera, table, x, y, z):
    """Return the pixel (u, v) of a camera-frame point; a pinhole needs z > 0."""
    if camera[0] == 0.0:
        return camera[1] * x / z + camera[2] * y / z + camera[5], camera[4] * y / z + camera[6]
    across = np.sqrt(x * x + y * y)
    theta = np.arctan2(across, z)
    at = theta * camera[7]
    i = min(int(at), table.shape[0] - 2)
    radius = table[i] + (at - i) * (
        table[i + 1] - table[i]
    )  # goes on in a straight line beyond the table
    scale = radius / across if across > 0.0 else 0.0
    a, b = x * scale, y * scale
    return camera[1] * a + camera[2] * b + camera[5], camera[3] * a + camera[4] * b + camera[6]


@njit(cache=True, nogil=True)
def _bends(camera, table, ax, ay, az, au, av, bx, by, bz, bu, bv):
    """Tell whether a piece must be halved, and return the pixel of its middle."""
    mx = 0.5 * (ax + bx)
    my = 0.5 * (ay + by)
    mz = 0.5 * (az + bz)
    mu, mv = project(camera, table, mx, my, mz)
    du, dv = bu - au, bv - av
    length2 = du * du + dv * dv
    if length2 < 1e-12:
        return (mu - au) * (mu - au) + (mv - av) * (mv - av) > BEND_PX * BEND_PX, mu, mv
    off = (mu - au) * dv - (mv - av) * du
    if off * off > BEND_PX * BEND_PX * length2:
        return True, mu, mv
    dot = ax * bx + ay * by + az * bz
    if dot < WIDE_RAD_COS * np.sqrt((ax * ax + ay * ay + az * az) * (bx * bx + by * by + bz * bz)):
        return True, mu, mv
    if length2 < 4.0:
        return False, mu, mv
    t = ((mu - au) * du + (mv - av) * dv) / length2
    return abs(((1.0 - t) / az + t / bz) * mz - 1.0) > DEPTH_ERROR, mu, mv


@njit(cache=True, nogil=True)
def _add_stroke(out, count, au, av, az, bu, bv, bz, half, style, view):
    """Append a stroke unless it misses the image; beyond the capacity of ``out`` only count."""
    width, height = view[WIDTH], view[HEIGHT]
    if (
        max(au, bu) < -half
        or max(av, bv) < -half
        or min(au, bu) > width + half
        or min(av, bv) > height + half
    ):
        return count
    if count < out.shape[0]:
        row = out[count]
        row[X0], row[Y0], row[I0] = au, av, 1.0 / az
        row[X1], row[Y1], row[I1] = bu, bv, 1.0 / bz
        row[HALF], row[GAIN], row[BIAS] = half, style[1], style[2]
        row[RED], row[GREEN], row[BLUE] = style[3], style[4], style[5]
    return count + 1


@njit(cache=True, nogil=True)
def _in_view(x, y, z, r, view):
    """Tell whether a sphere can reach the view: the depths between near and far, and the cone
    around the axis.
    """
    if z + r <= view[NEAR] or z - r >= view[FAR]:
        return False
    return (
        view[COS_HALF] <= 0.0 or np.sqrt(x * x + y * y) * view[COS_HALF] - z * view[SIN_HALF] <= r
    )


@njit(cache=True, nogil=True)
def _to_camera(pose, p):
    """Map a point of the scene into the camera's axes; ``pose`` is the upper ``(3, 4)`` of a
    transform.
    """
    return (
        pose[0, 0] * p[0] + pose[0, 1] * p[1] + pose[0, 2] * p[2] + pose[0, 3],
        pose[1, 0] * p[0] + pose[1, 1] * p[1] + pose[1, 2] * p[2] + pose[1, 3],
        pose[2, 0] * p[0] + pose[2, 1] * p[1] + pose[2, 2] * p[2] + pose[2, 3],
    )


@njit(cache=True, nogil=True)
def strokes(ends, style, spheres, pose, camera, table, view, out, count):
    """Project segments ``(S, 2, 3)`` into strokes after the first ``count``; returns how many there
    are then, written or not.
    """
    near, far = view[NEAR], view[FAR]
    stack = np.empty((MAX_HALVINGS + 2, 11))
    for g in range((ends.shape[0] + GROUP - 1) // GROUP):
        if spheres.shape[0] > 0:
            x, y, z = _to_camera(pose, spheres[g])
            if not _in_view(x, y, z, spheres[g, 3], view):
                continue
        for s in range(g * GROUP, min((g + 1) * GROUP, ends.shape[0])):
            ax, ay, az = _to_camera(pose, ends[s, 0])
            bx, by, bz = _to_camera(pose, ends[s, 1])
            if (az < near and bz < near) or (az >= far and bz >= far):
                continue
            dx = bx - ax
            dy = by - ay
            dz = bz - az
            low, high = 0.0, 1.0
            if dz != 0.0:  # the part of the line, from a to b, between the near and the far plane
                t_near, t_far = (near - az) / dz, (far - az) / dz
                low, high = max(low, min(t_near, t_far)), min(high, max(t_near, t_far))
            bx = ax + high * dx
            by = ay + high * dy
            bz = max(az + high * dz, near)
            ax = ax + low * dx
            ay = ay + low * dy
            az = max(az + low * dz, near)
            half = 0.5 * style[s, 0] * view[SCALE]
            au, av = project(camera, table, ax, ay, az)
            bu, bv = project(camera, table, bx, by, bz)
            if camera[0] == 0.0:
                count = _add_stroke(out, count, au, av, az, bu, bv, bz, half, style[s], view)
                continue
            top = np.int64(0)  # typed, or numba compiles `_push` once more for the literal
            _push(stack, top, ax, ay, az, au, av, bx, by, bz, bu, bv, 0.0)
            while top >= 0:
                ax = stack[top, 0]
                ay = stack[top, 1]
                az = stack[top, 2]
                au = stack[top, 3]
                av = stack[top, 4]
                bx = stack[top, 5]
                by = stack[top, 6]
                bz = stack[top, 7]
                bu = stack[top, 8]
                bv = stack[top, 9]
                level = stack[top, 10]
                top -= 1
                bends, mu, mv = _bends(camera, table, ax, ay, az, au, av, bx, by, bz, bu, bv)
                if bends and level < MAX_HALVINGS:
                    mx = 0.5 * (ax + bx)
                    my = 0.5 * (ay + by)
                    mz = 0.5 * (az + bz)
                    _push(stack, top + 1, mx, my, mz, mu, mv, bx, by, bz, bu, bv, level + 1.0)
                    _push(stack, top + 2, ax, ay, az, au, av, mx, my, mz, mu, mv, level + 1.0)
                    top += 2
                else:
                    count = _add_stroke(out, count, au, av, az, bu, bv, bz, half, style[s], view)
    return count


@njit(cache=True, nogil=True)
def _push(stack, at, ax, ay, az, au, av, bx, by, bz, bu, bv, level):
    row = stack[at]
    row[0], row[1], row[2], row[3], row[4] = ax, ay, az, au, av
    row[5], row[6], row[7], row[8], row[9], row[10] = bx, by, bz, bu, bv, level


@njit(cache=True, nogil=True)
def _add_shape(out, count, corner, style, view):
    """Append a triangle, ``corner (3, 6)`` of x, y, z, u, v, shade, unless it misses the image."""
    u0, u1 = (
        min(corner[0, 3], corner[1, 3], corner[2, 3]),
        max(corner[0, 3], corner[1, 3], corner[2, 3]),
    )
    v0, v1 = (
        min(corner[0, 4], corner[1, 4], corner[2, 4]),
        max(corner[0, 4], corner[1, 4], corner[2, 4]),
    )
    if u1 < 0.0 or v1 < 0.0 or u0 > view[WIDTH] or v0 > view[HEIGHT]:
        return count
    if count < out.shape[0]:
        row = out[count]
        for k in range(3):
            inverse = 1.0 / corner[k, 2]
            row[4 * k], row[4 * k + 1], row[4 * k + 2], row[4 * k + 3] = (
                corner[k, 3],
                corner[k, 4],
                inverse,
                corner[k, 5] * inverse,
            )
        row[NEAREST] = 1.0 / min(corner[0, 2], corner[1, 2], corner[2, 2])
        row[FARTHEST] = 1.0 / max(corner[0, 2], corner[1, 2], corner[2, 2])
        for k in range(7):
            row[S_BIAS + k] = style[k]
    return count + 1


@njit(cache=True, nogil=True)
def _copy(source, target):
    """Copy a triangle, value by value.

    An assignment of slices costs five seconds of compilation, for the text of an error that cannot
    come.
    """
    for k in range(3):
        for c in range(6):
            target[k, c] = source[k, c]


@njit(cache=True, nogil=True)
def _shapes_of(piece, camera, table, style, view, stack, levels, out, count):
    """Project one triangle that lies before the near plane, halving it at edges that bend."""
    top = 0
    _copy(piece, stack[0])
    levels[0] = 0
    while top >= 0:
        one, level = stack[top], levels[top]
        worst, length = -1, -1.0
        mu, mv = 0.0, 0.0
        if camera[0] != 0.0 and level < 2 * MAX_HALVINGS:
            for k in range(3):
                a, b = one[k], one[(k + 1) % 3]
                bends, u, v = _bends(
                    camera, table, a[0], a[1], a[2], a[3], a[4], b[0], b[1], b[2], b[3], b[4]
                )
                here = (a[3] - b[3]) ** 2 + (a[4] - b[4]) ** 2
                if bends and here > length:
                    worst = k
                    length = here
                    mu = u
                    mv = v
        if worst < 0:
            count = _add_shape(out, count, one, style, view)
            top -= 1
            continue
        i, j = worst, (worst + 1) % 3
        other = stack[top + 1]
        _copy(one, other)
        for c in range(6):
            middle = 0.5 * (one[i, c] + one[j, c])
            other[i, c] = middle
            one[j, c] = middle
        one[j, 3], one[j, 4] = mu, mv
        other[i, 3], other[i, 4] = mu, mv
        levels[top], levels[top + 1] = level + 1, level + 1
        top += 1
    return count


@njit(cache=True, nogil=True)
def _faces_away(a, b, c):
    """Tell whether the camera lies behind a triangle that is wound to the left from its front."""
    ux = b[0] - a[0]
    uy = b[1] - a[1]
    uz = b[2] - a[2]
    vx = c[0] - a[0]
    vy = c[1] - a[1]
    vz = c[2] - a[2]
    return (uy * vz - uz * vy) * a[0] + (uz * vx - ux * vz) * a[1] + (ux * vy - uy * vx) * a[
        2
    ] >= 0.0


@njit(cache=True, nogil=True)
def shapes(corners, closed, shade, style, pose, camera, table, view, out, count):
    """Project triangles ``(T, 3, 3)`` into shapes after the first ``count``; returns how many there
    are then, written or not.
    """
    near = view[NEAR]
    stack = np.empty((2 * MAX_HALVINGS + 2, 3, 6))
    levels = np.empty(2 * MAX_HALVINGS + 2, np.int64)
    raw = np.empty((3, 4))
    piece = np.empty((3, 6))
    kept = np.empty((4, 6))
    for s in range(corners.shape[0]):
        for k in range(3):
            raw[k, 0], raw[k, 1], raw[k, 2] = _to_camera(pose, corners[s, k])
            raw[k, 3] = shade[s, k]
        if closed[s] and _faces_away(raw[0], raw[1], raw[2]):
            continue
        mx = (raw[0, 0] + raw[1, 0] + raw[2, 0]) / 3
        my = (raw[0, 1] + raw[1, 1] + raw[2, 1]) / 3
        mz = (raw[0, 2] + raw[1, 2] + raw[2, 2]) / 3
        reach2 = 0.0
        for k in range(3):
            reach2 = max(
                reach2, (raw[k, 0] - mx) ** 2 + (raw[k, 1] - my) ** 2 + (raw[k, 2] - mz) ** 2
            )
        if not _in_view(mx, my, mz, np.sqrt(reach2), view):
            continue
        n = 0
        for k in range(3):  # Sutherland and Hodgman against one plane
            a, b = raw[k], raw[(k + 1) % 3]
            if a[2] >= near:
                kept[n, 0], kept[n, 1], kept[n, 2], kept[n, 5] = a[0], a[1], a[2], a[3]
                n += 1
            if (a[2] >= near) != (b[2] >= near):
                t = (near - a[2]) / (b[2] - a[2])
                kept[n, 0], kept[n, 1] = a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])
                kept[n, 2], kept[n, 5] = near, a[3] + t * (b[3] - a[3])
                n += 1
        for k in range(n):
            kept[k, 3], kept[k, 4] = project(camera, table, kept[k, 0], kept[k, 1], kept[k, 2])
        for k in range(1, n - 1):
            for c in range(6):
                piece[0, c], piece[1, c], piece[2, c] = kept[0, c], kept[k, c], kept[k + 1, c]
            count = _shapes_of(piece, camera, table, style[s], view, stack, levels, out, count)
    return count

"""Project segments and triangles into a pinhole image: clipping, culling, projection."""

# Numba's decorators are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

import numpy as np

from alpasim_plugin.core.kernels import kernel
from alpasim_plugin.fixers.semantic_map.style import DEPTH_MAX_M, NEAR_M

# Entries of a view: focal lengths, skew and centre in pixels, image size, pixels of this image for
# one of the style.
FX, SKEW, FY, CX, CY, WIDTH, HEIGHT, SCALE = range(8)
# Columns of a stroke: ends in pixels with 1/depth, half width without fade in pixels, bias, colour.
X0, Y0, I0, X1, Y1, I1, HALF, BIAS, RED = range(9)
STROKE = 11
# Columns of a shape: three corners of x, y, 1/depth, shade/depth; depth range; bias; front and back
# colour.
NEAREST, FARTHEST, S_BIAS, FRONT = range(12, 16)
BACK = FRONT + 3
SHAPE = BACK + 3


@kernel
def _project(view, x, y, z):
    """Return the pixel (u, v) of a camera-frame point with z > 0."""
    return view[FX] * x / z + view[SKEW] * y / z + view[CX], view[FY] * y / z + view[CY]


@kernel
def to_camera(pose, p):
    """Map a point of the scene into the camera's axes by the upper ``(3, 4)`` of a transform."""
    return (
        pose[0, 0] * p[0] + pose[0, 1] * p[1] + pose[0, 2] * p[2] + pose[0, 3],
        pose[1, 0] * p[0] + pose[1, 1] * p[1] + pose[1, 2] * p[2] + pose[1, 3],
        pose[2, 0] * p[0] + pose[2, 1] * p[1] + pose[2, 2] * p[2] + pose[2, 3],
    )


@kernel
def strokes(ends, style, pose, view, out):
    """Project segments ``(S, 2, 3)`` into strokes; return how many can be seen."""
    count = 0
    for s in range(ends.shape[0]):
        ax, ay, az = to_camera(pose, ends[s, 0])
        bx, by, bz = to_camera(pose, ends[s, 1])
        if (az < NEAR_M and bz < NEAR_M) or (az >= DEPTH_MAX_M and bz >= DEPTH_MAX_M):
            continue
        dx = bx - ax
        dy = by - ay
        dz = bz - az
        low = 0.0
        high = 1.0
        if dz != 0.0:  # the part of the line between the near and the far plane
            t_near = (NEAR_M - az) / dz
            t_far = (DEPTH_MAX_M - az) / dz
            low = max(low, min(t_near, t_far))
            high = min(high, max(t_near, t_far))
        z0 = max(az + low * dz, NEAR_M)
        z1 = max(az + high * dz, NEAR_M)
        u0, v0 = _project(view, ax + low * dx, ay + low * dy, z0)
        u1, v1 = _project(view, ax + high * dx, ay + high * dy, z1)
        half = 0.5 * style[s, 0] * view[SCALE]
        if max(u0, u1) < -half or min(u0, u1) > view[WIDTH] + half:
            continue
        if max(v0, v1) < -half or min(v0, v1) > view[HEIGHT] + half:
            continue
        row = out[count]
        row[X0], row[Y0], row[I0] = u0, v0, 1.0 / z0
        row[X1], row[Y1], row[I1] = u1, v1, 1.0 / z1
        row[HALF] = half
        for k in range(4):
            row[BIAS + k] = style[s, 1 + k]
        count += 1
    return count


@kernel
def faces_away(a, b, c):
    """Return whether the camera lies behind a triangle that is wound to the left from its front."""
    ux = b[0] - a[0]
    uy = b[1] - a[1]
    uz = b[2] - a[2]
    vx = c[0] - a[0]
    vy = c[1] - a[1]
    vz = c[2] - a[2]
    nx = uy * vz - uz * vy
    ny = uz * vx - ux * vz
    nz = ux * vy - uy * vx
    return nx * a[0] + ny * a[1] + nz * a[2] >= 0.0


@kernel
def _clip(raw, kept):
    """Clip a triangle ``(3, 4)`` of x, y, z, shade at the near plane (Sutherland and Hodgman);
    return how many corners ``kept`` holds.
    """
    n = 0
    for k in range(3):
        a = raw[k]
        b = raw[(k + 1) % 3]
        if a[2] >= NEAR_M:
            for c in range(4):
                kept[n, c] = a[c]
            n += 1
        if (a[2] >= NEAR_M) != (b[2] >= NEAR_M):
            t = (NEAR_M - a[2]) / (b[2] - a[2])
            for c in range(4):
                kept[n, c] = a[c] + t * (b[c] - a[c])
            kept[n, 2] = NEAR_M
            n += 1
    return n


@kernel
def shapes(corners, closed, shade, style, pose, view, out):
    """Project triangles ``(T, 3, 3)`` into shapes, at most two of each; return how many can be
    seen.
    """
    count = 0
    raw = np.empty((3, 4))
    kept = np.empty((4, 4))
    pixels = np.empty((4, 2))
    for s in range(corners.shape[0]):
        for k in range(3):
            raw[k, 0], raw[k, 1], raw[k, 2] = to_camera(pose, corners[s, k])
            raw[k, 3] = shade[s, k]
        if closed[s] and faces_away(raw[0], raw[1], raw[2]):
            continue
        nearest = min(raw[0, 2], raw[1, 2], raw[2, 2])
        if nearest >= DEPTH_MAX_M:
            continue
        n = _clip(raw, kept)
        for k in range(n):
            pixels[k, 0], pixels[k, 1] = _project(view, kept[k, 0], kept[k, 1], kept[k, 2])
        for k in range(1, n - 1):
            outside = False
            for axis in range(2):
                low = min(pixels[0, axis], pixels[k, axis], pixels[k + 1, axis])
                high = max(pixels[0, axis], pixels[k, axis], pixels[k + 1, axis])
                outside |= high < 0.0 or low > view[WIDTH + axis]
            if outside:
                continue
            row = out[count]
            for corner, i in enumerate((0, k, k + 1)):
                inverse = 1.0 / kept[i, 2]
                row[4 * corner] = pixels[i, 0]
                row[4 * corner + 1] = pixels[i, 1]
                row[4 * corner + 2] = inverse
                row[4 * corner + 3] = kept[i, 3] * inverse
            row[NEAREST] = 1.0 / min(kept[0, 2], kept[k, 2], kept[k + 1, 2])
            row[FARTHEST] = 1.0 / max(kept[0, 2], kept[k, 2], kept[k + 1, 2])
            for c in range(7):
                row[S_BIAS + c] = style[s, c]
            count += 1
    return count

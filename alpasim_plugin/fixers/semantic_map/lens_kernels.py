"""Put segments and triangles into the image of a lens: in pieces so short that the lens bends none
of them by more than `BENT_PX`, each of which is a stroke or a shape of that image.

The depth of a point is the largest of its coordinates' sizes, |x|, |y| or |z|. In the middle of the
image that is its depth along the optical axis, as in a pinhole; beyond 90 degrees it stays positive.
"""

# Numba's decorators are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

import math

import numpy as np

from alpasim_plugin.cameras.image_map import ImageMap
from alpasim_plugin.cameras.image_map_kernel import MAP_SIZE, lens_pixel, map_numbers
from alpasim_plugin.core.kernels import kernel
from alpasim_plugin.core.types import F64, CameraSpec
from alpasim_plugin.fixers.semantic_map.kernels import (
    BIAS,
    FARTHEST,
    HALF,
    I0,
    I1,
    NEAREST,
    S_BIAS,
    X0,
    X1,
    Y0,
    Y1,
    faces_away,
    to_camera,
)
from alpasim_plugin.fixers.semantic_map.style import (
    DEPTH_MAX_M,
    NEAR_M,
    WIDTH_DEFINED_AT_PX,
)

BENT_PX = 0.1  # by how much a piece may leave its curve
LONGEST_RAD = 0.06  # of a piece, which its depth is nearly even over
SHORTEST_RAD = 0.01
DEEPEST = 64  # triangles that wait while one is divided
# Entries of a lens: those of `image_map_kernel`; the image's size, pixels of it for one of the style;
# the longest piece; the angle up to which points are shown.
WIDTH, HEIGHT, SCALE, PIECE, SHOWN_RAD, SIZE = range(MAP_SIZE, MAP_SIZE + 6)


def lens_numbers(camera: CameraSpec, lens_map: ImageMap) -> F64:
    """Return a camera's lens ``(SIZE,)`` as the kernels read it."""
    numbers = np.zeros(SIZE)
    numbers[:MAP_SIZE] = map_numbers(lens_map)
    numbers[WIDTH] = camera.width
    numbers[HEIGHT] = camera.height
    numbers[SCALE] = camera.width / WIDTH_DEFINED_AT_PX
    piece = math.sqrt(8 * BENT_PX / lens_map.px_per_rad[1])
    numbers[PIECE] = min(max(piece, SHORTEST_RAD), LONGEST_RAD)
    numbers[SHOWN_RAD] = 2 * math.atan(math.sqrt(lens_map.s_most))
    return numbers


@kernel
def _depth(p):
    return max(abs(p[0]), abs(p[1]), abs(p[2]))


@kernel
def _angle(p):
    """Return the angle of a point from the optical axis."""
    return math.atan2(math.hypot(p[0], p[1]), p[2])


@kernel
def _between(a, b):
    """Return the angle between two points as the camera sees them."""
    x = a[1] * b[2] - a[2] * b[1]
    y = a[2] * b[0] - a[0] * b[2]
    z = a[0] * b[1] - a[1] * b[0]
    return math.atan2(math.sqrt(x * x + y * y + z * z), a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@kernel
def _length(p):
    return math.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])


@kernel
def lens_strokes(ends, style, pose, lens, out):
    """Put segments ``(S, 2, 3)`` into an image as strokes ``(N, STROKE)``; return how many there
    are, which may be more than ``out`` holds.
    """
    count = 0
    last = np.empty(3)
    point = np.empty(3)
    for s in range(ends.shape[0]):
        a = to_camera(pose, ends[s, 0])
        b = to_camera(pose, ends[s, 1])
        half = 0.5 * style[s, 0] * lens[SCALE]
        whole = _between(a, b)
        if min(_angle(a), _angle(b)) - whole > lens[SHOWN_RAD]:
            continue
        pieces = max(1, math.ceil(whole / lens[PIECE]))
        for k in range(pieces + 1):
            share = _share_of_way(_length(a), _length(b), whole, k, pieces)
            for axis in range(3):
                point[axis] = a[axis] + share * (b[axis] - a[axis])
            if k > 0 and _is_drawn(last, point, lens):
                if count < len(out):
                    _fill_stroke(out[count], last, point, half, style[s], lens)
                    if _misses(out[count], lens):
                        count -= 1
                count += 1
            last[:] = point
    return count


@kernel
def _share_of_way(length_a, length_b, whole, k, pieces):
    """Return where a segment is cut the ``k``-th time into pieces that look equally long."""
    if k == 0 or k == pieces:
        return k / pieces
    weight_a = length_a * math.sin(whole * k / pieces)
    weight_b = length_b * math.sin(whole * (pieces - k) / pieces)
    return weight_a / (weight_a + weight_b)


@kernel
def _is_drawn(a, b, lens):
    """Tell whether a piece lies between the near and the far end of what is drawn, and where the
    lens is described.
    """
    nearest = min(_depth(a), _depth(b))
    farthest = max(_depth(a), _depth(b))
    is_described = max(_angle(a), _angle(b)) <= lens[SHOWN_RAD]
    return is_described and farthest >= NEAR_M and nearest < DEPTH_MAX_M


@kernel
def _fill_stroke(row, a, b, half, style, lens):
    row[X0], row[Y0] = lens_pixel(lens, a[0], a[1], a[2])
    row[X1], row[Y1] = lens_pixel(lens, b[0], b[1], b[2])
    row[I0] = 1.0 / max(_depth(a), NEAR_M)
    row[I1] = 1.0 / max(_depth(b), NEAR_M)
    row[HALF] = half
    for k in range(4):
        row[BIAS + k] = style[1 + k]


@kernel
def _misses(row, lens):
    """Tell whether a stroke lies beside the image."""
    half = row[HALF]
    if max(row[X0], row[X1]) < -half or min(row[X0], row[X1]) > lens[WIDTH] + half:
        return True
    return max(row[Y0], row[Y1]) < -half or min(row[Y0], row[Y1]) > lens[HEIGHT] + half


@kernel
def lens_shapes(corners, closed, shade, style, pose, lens, out):
    """Put triangles ``(T, 3, 3)`` into an image as shapes ``(N, SHAPE)``; return how many there are,
    which may be more than ``out`` holds.

    A triangle is halved at its longest edge, where the two halves look equally long, until no edge
    looks longer than a piece: triangles that share an edge are cut at the same places of it.
    """
    count = 0
    waiting = np.empty((DEEPEST, 3, 4))  # x, y, z, shade of corners
    edges = np.empty(3)
    for s in range(corners.shape[0]):
        for k in range(3):
            x, y, z = to_camera(pose, corners[s, k])
            waiting[0, k, 0], waiting[0, k, 1], waiting[0, k, 2] = x, y, z
            waiting[0, k, 3] = shade[s, k]
        if closed[s] and faces_away(waiting[0, 0], waiting[0, 1], waiting[0, 2]):
            continue
        left = 1
        while left > 0:
            left -= 1
            triangle = waiting[left]
            for k in range(3):
                edges[k] = _between(triangle[k], triangle[(k + 1) % 3])
            longest = np.argmax(edges)
            angles = _angle(triangle[0]), _angle(triangle[1]), _angle(triangle[2])
            depths = _depth(triangle[0]), _depth(triangle[1]), _depth(triangle[2])
            if min(angles) - edges[longest] > lens[SHOWN_RAD]:
                continue
            if edges[longest] > lens[PIECE] and max(depths) > NEAR_M and left + 2 <= DEEPEST:
                _halve(waiting, left, longest)
                left += 2
                continue
            is_described = max(angles) <= lens[SHOWN_RAD]
            if not is_described or max(depths) < NEAR_M or min(depths) >= DEPTH_MAX_M:
                continue
            if count < len(out):
                _fill_shape(out[count], triangle, style[s], lens)
                if _is_beside(out[count], lens):
                    count -= 1
            count += 1
    return count


@kernel
def _halve(waiting, place, edge):
    """Replace a triangle by its halves, at its place and after it."""
    first = edge
    second = (edge + 1) % 3
    length_a = _length(waiting[place, first])
    share = length_a / (length_a + _length(waiting[place, second]))
    waiting[place + 1] = waiting[place]
    for c in range(4):
        a = waiting[place, first, c]
        middle = a + share * (waiting[place, second, c] - a)
        waiting[place, second, c] = middle
        waiting[place + 1, first, c] = middle


@kernel
def _fill_shape(row, triangle, style, lens):
    row[NEAREST] = 0.0
    row[FARTHEST] = np.inf
    for k in range(3):
        u, v = lens_pixel(lens, triangle[k, 0], triangle[k, 1], triangle[k, 2])
        inverse = 1.0 / max(_depth(triangle[k]), NEAR_M)
        row[4 * k], row[4 * k + 1] = u, v
        row[4 * k + 2], row[4 * k + 3] = inverse, triangle[k, 3] * inverse
        row[NEAREST] = max(row[NEAREST], inverse)
        row[FARTHEST] = min(row[FARTHEST], inverse)
    for c in range(7):
        row[S_BIAS + c] = style[c]


@kernel
def _is_beside(row, lens):
    """Tell whether a shape lies beside the image."""
    for axis in range(2):
        low = min(row[axis], row[4 + axis], row[8 + axis])
        high = max(row[axis], row[4 + axis], row[8 + axis])
        if high < 0.0 or low > lens[WIDTH + axis]:
            return True
    return False

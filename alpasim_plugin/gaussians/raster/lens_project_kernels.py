"""Project prepared Gaussians through a lens, sixteen at a time, to records that are evaluated in 3D
along each pixel's ray; the definition is `tests/gaussians/lens_reference.py`.

In the camera's axes a Gaussian has its mean p at the distance n and the covariance S = L L^T with the
low-pass in it. With w = L^-1 p of length o and an orthonormal basis q1, q2, w / o, its record holds the
rows A = n q1 L^-1, B = n q2 L^-1, C = (n / o) (w / o) L^-1. On a ray d from the camera's centre its least
Mahalanobis distance is ``q^2 = (a^2 + b^2) / (c^2 + (a^2 + b^2) / o^2)`` with a = A d and so on: the
distance |w x L^-1 d|^2 / |L^-1 d|^2 of Wu et al., 3DGUT (2025), without its cancellation. Where c is
negative the peak lies behind the centre, and c is taken as 0: what is left is o^2, the value at the centre.

A ray that starts at another place s has, with s1, s2, s3 the parts of L^-1 s along q1, q2, w, the last
over o, the numerator ``|(b + s2 c - s3 b, a + s1 c - s3 a, (s1 b - s2 a) / o)|^2``: what moves evenly
while a shutter is open needs three numbers more.
"""

# Numba's decorators and vector types are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

import numpy as np

from alpasim_plugin.core.kernels import kernel
from alpasim_plugin.gaussians.constants import (
    EPS2D_PX2,
    GEO_EXTENT,
    GEO_FACTOR,
    GEO_PEAK,
    GEO_SIZE,
    POSE_ANTIALIAS,
    POSE_CENTRE,
    POSE_FAR,
    POSE_NEAR,
    POSE_ROTATION,
    POSE_SHIFT,
    POSE_TURN,
)
from alpasim_plugin.gaussians.raster import simd as v
from alpasim_plugin.gaussians.raster.lens_map_kernels import (
    added,
    moved_at,
    pixels_per_radian,
    place_on_sphere,
    scaled,
    shown,
    tangents,
    time_seen,
)
from alpasim_plugin.gaussians.raster.lens_rays import (
    LENS_COS,
    LENS_HEIGHT,
    LENS_LEAST,
    LENS_MARGIN,
    LENS_MOST,
    LENS_ROLLS,
    LENS_S_MOST,
    LENS_SIN,
    LENS_TIME,
    LENS_WIDTH,
)
from alpasim_plugin.gaussians.raster.lens_records import (
    BOTTOM,
    COLUMNS,
    CUT_SIGMA,
    DEPTH,
    DISTANCE,
    INVERSE_O2,
    KEY,
    LEFT,
    NODE,
    PASSED,
    PEAK,
    RIGHT,
    ROW_A,
    ROW_B,
    ROW_C,
    ROW_S,
    SHORT,
    TOP,
    store3,
    write_record,
)
from alpasim_plugin.gaussians.raster.lens_small_kernels import is_small, write_small
from alpasim_plugin.gaussians.raster.lens_touch_kernels import CLOSE
from alpasim_plugin.gaussians.raster.project_kernels import (
    CHUNK,
    colour_group,
    dot,
    load3,
    row,
)
from alpasim_plugin.gaussians.raster.raster_kernels import CUT

# Eight directions of the outline, of which four are the others turned about; a polygon around it.
COS = np.cos(np.arange(4) * np.pi / 4)
SIN = np.sin(np.arange(4) * np.pi / 4)
AROUND = float(1 / np.cos(np.pi / 8))
WIDE = 0.2  # of (half axis / distance)^2: the outline is too wide for eight directions
SMALL_SHIFTS = 8.0  # nearer than so many shifts of a shutter nothing is small
NEAR_SHIFTS = 1.5  # nearer than so many shifts of a shutter a Gaussian is looked for everywhere
LATE = 0.75
EVERY = 1.0e9


@kernel
def _covariance(geometry, geo, pose):
    """Return the six numbers of the covariance of sixteen Gaussians in the camera's axes."""
    f = geo + GEO_FACTOR * 16
    first = as_f64(load3(geometry, f))
    second = as_f64(load3(geometry, f + 48))
    third = as_f64(load3(geometry, f + 96))
    x = _combined(row(pose, POSE_ROTATION), first, second, third)
    y = _combined(row(pose, POSE_ROTATION + 3), first, second, third)
    z = _combined(row(pose, POSE_ROTATION + 6), first, second, third)
    return dot(x, x), dot(x, y), dot(x, z), dot(y, y), dot(y, z), dot(z, z)


@kernel
def as_f64(a):
    """Return a vector of three in float64."""
    return v.to_f64(a[0]), v.to_f64(a[1]), v.to_f64(a[2])


@kernel
def _combined(weights, a, b, c):
    return added(added(scaled(a, weights[0]), scaled(b, weights[1])), scaled(c, weights[2]))


@kernel
def _times(s, a):
    """Return a symmetric matrix times a vector."""
    return (
        dot((s[0], s[1], s[2]), a),
        dot((s[1], s[3], s[4]), a),
        dot((s[2], s[4], s[5]), a),
    )


@kernel
def _with_square(s, a):
    """Return a symmetric matrix plus ``a a^T``."""
    return (
        v.fma(a[0], a[0], s[0]),
        v.fma(a[0], a[1], s[1]),
        v.fma(a[0], a[2], s[2]),
        v.fma(a[1], a[1], s[3]),
        v.fma(a[1], a[2], s[4]),
        v.fma(a[2], a[2], s[5]),
    )


@kernel
def _kept_share(s, right, down, k, eps, n2):
    """Return the share of the determinants of the covariances in the image, without and with the
    low-pass; see Mip-Splatting.
    """
    k = v.to_f64(k[0]), v.to_f64(k[1]), v.to_f64(k[2]), v.to_f64(k[3])
    right = as_f64(right)
    down = as_f64(down)
    sr = _times(s, right)
    sd = _times(s, down)
    rr = dot(sr, right)
    rd = dot(sr, down)
    dd = dot(sd, down)
    inverse = 1.0 / n2
    uu = inverse * (k[0] * k[0] * rr + 2.0 * k[0] * k[1] * rd + k[1] * k[1] * dd)
    ww = inverse * (k[2] * k[2] * rr + 2.0 * k[2] * k[3] * rd + k[3] * k[3] * dd)
    determinant = k[0] * k[3] - k[1] * k[2]
    raw = v.maximum(rr * dd - rd * rd, 0.0) * (determinant * inverse) * (determinant * inverse)
    return raw / (raw + eps * (uu + ww) + eps * eps)


@kernel
def _low_passed(s, p, n2, right, down, k, eps):
    """Return the covariance with that of the pixel at the mean's place ``p``, float32."""
    determinant = 1.0 / (k[0] * k[3] - k[1] * k[2])
    scale = v.sqrt(n2 * eps) * determinant
    m00, m01 = k[3] * scale, v.negative(k[1] * scale)
    m10, m11 = v.negative(k[2] * scale), k[0] * scale
    s = _with_square(s, as_f64(added(scaled(right, m00), scaled(down, m10))))
    s = _with_square(s, as_f64(added(scaled(right, m01), scaled(down, m11))))
    size = v.sqrt(0.5 * (m00 * m00 + m01 * m01 + m10 * m10 + m11 * m11) / n2)
    return _with_square(s, as_f64(scaled(p, size)))


@kernel
def _cholesky(s):
    """Return L of S = L L^T, six numbers row by row, and the inverses of its diagonal."""
    l11 = v.sqrt(s[0])
    i1 = 1.0 / l11
    l21 = s[1] * i1
    l31 = s[2] * i1
    l22 = v.sqrt(v.maximum(v.fnma(l21, l21, s[3]), 1e-14 * s[3]))
    i2 = 1.0 / l22
    l32 = v.fnma(l31, l21, s[4]) * i2
    l33 = v.sqrt(v.maximum(v.fnma(l32, l32, v.fnma(l31, l31, s[5])), 1e-14 * s[5]))
    return (l11, l21, l22, l31, l32, l33), (i1, i2, 1.0 / l33)


@kernel
def _solved(lower, inverses, p):
    """Return L^-1 p."""
    x = p[0] * inverses[0]
    y = v.fnma(lower[1], x, p[1]) * inverses[1]
    z = v.fnma(lower[4], y, v.fnma(lower[3], x, p[2])) * inverses[2]
    return x, y, z


@kernel
def _row_solved(lower, inverses, q, k):
    """Return ``k q L^-1``."""
    z = q[2] * inverses[2]
    y = v.fnma(lower[4], z, q[1]) * inverses[1]
    x = v.fnma(lower[3], z, v.fnma(lower[1], y, q[0])) * inverses[0]
    return scaled((x, y, z), k)


@kernel
def _spread(lower, q):
    """Return L q."""
    return (
        lower[0] * q[0],
        v.fma(lower[1], q[0], lower[2] * q[1]),
        v.fma(lower[3], q[0], v.fma(lower[4], q[1], lower[5] * q[2])),
    )


@kernel
def _basis(w):
    """Return two unit vectors across a unit vector and each other (Duff et al., Building an
    Orthonormal Basis, Revisited, 2017).
    """
    zero = w[2] * 0.0
    sign = v.select(w[2] >= 0.0, zero + 1.0, zero - 1.0)
    a = -1.0 / (sign + w[2])
    b = w[0] * w[1] * a
    first = v.fma(sign * w[0], w[0] * a, 1.0), sign * b, v.negative(sign * w[0])
    return first, (b, v.fma(w[1], w[1] * a, sign), v.negative(w[1]))


@kernel
def _write_box(lanes, lens, place, n, first, second, moves):
    """Write the boxes of the outlines ``place + cos first + sin second``; returns the bits of those
    that are in the image, and of those to be looked for everywhere.

    An outline between its eight directions bends by no more than its middle misses the mean.
    """
    a = v.to_f32(first[0]), v.to_f32(first[1]), v.to_f32(first[2])
    b = v.to_f32(second[0]), v.to_f32(second[1]), v.to_f32(second[2])
    u, w, s = shown(lens, place)
    left, right, top, bottom = u, u, w, w
    bend_u, bend_w = v.absolute(u * 0.0), v.absolute(u * 0.0)
    for k in range(4):
        step = added(scaled(a, COS[k]), scaled(b, SIN[k]))
        u1, w1, s1 = shown(lens, added(place, step))
        u2, w2, s2 = shown(lens, added(place, scaled(step, -1.0)))
        left = v.minimum(left, v.minimum(u1, u2))
        right = v.maximum(right, v.maximum(u1, u2))
        top = v.minimum(top, v.minimum(w1, w2))
        bottom = v.maximum(bottom, v.maximum(w1, w2))
        bend_u = v.maximum(bend_u, v.absolute(0.5 * (u1 + u2) - u))
        bend_w = v.maximum(bend_w, v.absolute(0.5 * (w1 + w2) - w))
        s = v.maximum(s, v.maximum(s1, s2))
    more_u = bend_u + lens[LENS_MARGIN]
    more_w = bend_w + lens[LENS_MARGIN]
    everywhere = v.bits(s >= lens[LENS_S_MOST])
    if lens[LENS_ROLLS] > 0:
        # What the time at the box's ends, half its size away, moves it by, and half as much more for
        # what comes nearer meanwhile.
        shift_rad = v.to_f32(moves[1] / n)
        rate = abs(lens[LENS_TIME]) * (right - left) + abs(lens[LENS_TIME + 1]) * (bottom - top)
        late = rate * (shift_rad + moves[0]) * (LATE * lens[LENS_MOST])
        more_u = more_u + late + 0.1
        more_w = more_w + late + 0.1
        everywhere |= v.bits(n < NEAR_SHIFTS * moves[1])
    left, right, top, bottom = left - more_u, right + more_u, top - more_w, bottom + more_w
    v.store(lanes, LEFT * 16, left)
    v.store(lanes, RIGHT * 16, right)
    v.store(lanes, TOP * 16, top)
    v.store(lanes, BOTTOM * 16, bottom)
    in_columns = (right >= 0.5) & (left <= lens[LENS_WIDTH] - 0.5)
    in_rows = (bottom >= 0.5) & (top <= lens[LENS_HEIGHT] - 0.5)
    return v.bits(in_columns & in_rows), everywhere


@kernel
def _in_cone(p, reach, lens):
    """Return which points may lie no farther than ``reach`` outside the cone that the image shows."""
    across = v.sqrt(v.fma(p[0], p[0], p[1] * p[1]))
    return across * lens[LENS_COS] - p[2] * lens[LENS_SIN] <= reach


@kernel
def _size(geometry, geo):
    """Return a bound of the largest standard deviation."""
    total = v.load(geometry, geo + GEO_FACTOR * 16) * 0.0
    for k in range(9):
        part = v.load(geometry, geo + (GEO_FACTOR + k) * 16)
        total = v.fma(part, part, total)
    return v.to_f64(v.sqrt(total))


@kernel
def _write_shape(lanes, lens, pose, geometry, geo, p, place, n, mask, moves, moved):
    """Write the rows and boxes of Gaussians; returns the bits of those that reach the image."""
    antialias = pose[POSE_ANTIALIAS]
    eps = antialias if antialias > 0 else EPS2D_PX2
    t = v.to_f64(v.load(geometry, geo + GEO_EXTENT * 16))
    at_n2 = dot(place, place)
    n2 = v.to_f64(at_n2)
    at_n = v.sqrt(at_n2)
    h, held, _ = place_on_sphere(lens, place)
    k = pixels_per_radian(lens, h, held)
    right, down = tangents(place, at_n)
    s = _covariance(geometry, geo, pose)
    peak = v.load(geometry, geo + GEO_PEAK * 16)
    chosen = v.bits(mask)
    if antialias > 0:
        v.store(lanes, PEAK * 16, v.to_f32(_kept_share(s, right, down, k, eps, n2)))
        for lane in range(PEAK * 16, PEAK * 16 + 16):
            lanes[lane] = np.log2(lanes[lane]) / 16
        peak = peak + v.load(lanes, PEAK * 16)
        chosen &= v.bits(peak >= CUT)
    s = _low_passed(s, place, at_n2, right, down, k, eps)
    lower, inverses = _cholesky(s)
    w = _solved(lower, inverses, p)
    o2 = dot(w, w)
    inverse_o = 1.0 / v.sqrt(o2)
    w = scaled(w, inverse_o)
    q1, q2 = _basis(w)
    first = _spread(lower, q1)
    second = _spread(lower, q2)
    ratio = t * t / o2
    out = AROUND * t / v.sqrt(v.maximum(1.0 - ratio, 1.0 - CLOSE))
    size2 = v.maximum(dot(first, first), dot(second, second)) * out * out
    boxed = _write_box(lanes, lens, place, n, scaled(first, out), scaled(second, out), moves)
    everywhere = boxed[1] | v.bits(ratio >= CLOSE) | v.bits(size2 > WIDE * n * n)
    if lens[LENS_ROLLS] > 0:
        everywhere |= _write_passed(lanes, lower, inverses, pose, v.sqrt(o2), t)
    chosen &= boxed[0] | everywhere
    if chosen == 0:
        return 0
    _list_everywhere(lanes, everywhere)
    store3(lanes, ROW_A, _row_solved(lower, inverses, q1, n))
    store3(lanes, ROW_B, _row_solved(lower, inverses, q2, n))
    store3(lanes, ROW_C, _row_solved(lower, inverses, w, n * inverse_o))
    v.store(lanes, INVERSE_O2 * 16, v.to_f32(1.0 / o2))
    v.store(lanes, PEAK * 16, peak)
    v.store(lanes, DEPTH * 16, at_n)
    v.store(lanes, CUT_SIGMA * 16, v.to_f32(t))
    if lens[LENS_ROLLS] > 0:
        zero = n * 0.0
        s = _solved(lower, inverses, (zero + moved[0], zero + moved[1], zero + moved[2]))
        store3(lanes, ROW_S, (dot(s, q1), dot(s, q2), dot(s, w) * inverse_o))
        v.store(lanes, DISTANCE * 16, v.to_f32(n))
    return chosen


@kernel
def _write_passed(lanes, lower, inverses, pose, o, t):
    """Write which Gaussians the camera may pass, or be in, while it moves by half a shift to both
    sides; returns their bits.
    """
    moved = _whitened_length(lower, inverses, row(pose, POSE_SHIFT), o)
    passed = v.bits(o - moved < v.maximum(2.0 * t, 0.5 * o))
    for lane in range(16):
        lanes[PASSED * 16 + lane] = passed >> lane & 1
    return passed


@kernel
def _whitened_length(lower, inverses, shift, like):
    """Return the length of a little more than half of L^-1 times a shift."""
    zero = like * 0.0
    x, y, z = _solved(lower, inverses, (zero + shift[0], zero + shift[1], zero + shift[2]))
    return 0.55 * v.sqrt(dot((x, y, z), (x, y, z)))


@kernel
def _list_everywhere(lanes, everywhere):
    """Let boxes hold the whole image."""
    while everywhere != 0:
        lane = v.lowest_bit(everywhere)
        everywhere &= everywhere - 1
        lanes[LEFT * 16 + lane] = -EVERY
        lanes[RIGHT * 16 + lane] = EVERY
        lanes[TOP * 16 + lane] = -EVERY
        lanes[BOTTOM * 16 + lane] = EVERY


@kernel
def _project_group(cursor, group, arrays, pose, lens, moves, moving, lanes, out):
    """Project sixteen Gaussians and append those that reach the image: small ones as ellipses, the
    others with their rows.
    """
    means, geometry, sh, sh_size = arrays
    x, y, z = load3(means, group * 48)
    d = x - pose[POSE_CENTRE], y - pose[POSE_CENTRE + 1], z - pose[POSE_CENTRE + 2]
    p = (
        dot(row(pose, POSE_ROTATION), d),
        dot(row(pose, POSE_ROTATION + 3), d),
        dot(row(pose, POSE_ROTATION + 6), d),
    )
    n = v.sqrt(dot(p, p))
    geo = group * (GEO_SIZE * 16)
    t = v.to_f64(v.load(geometry, geo + GEO_EXTENT * 16))
    low_pass = np.sqrt(max(pose[POSE_ANTIALIAS], EPS2D_PX2)) / lens[LENS_LEAST]
    reach = t * v.fma(n, 1.5 * low_pass, _size(geometry, geo))
    reach = reach + 0.5 * v.fma(n, moves[0], moves[1])
    mask = (n >= pose[POSE_NEAR]) & (n <= pose[POSE_FAR]) & _in_cone(p, reach, lens)
    remaining = v.bits(mask)
    if remaining == 0:
        return
    p32 = v.to_f32(p[0]), v.to_f32(p[1]), v.to_f32(p[2])
    small = mask & (n >= SMALL_SHIFTS * moves[1])
    small = small & is_small(lens, pose, geometry, geo, p32, low_pass, moves)
    d32 = v.to_f32(d[0]), v.to_f32(d[1]), v.to_f32(d[2])
    largest = v.maximum(v.maximum(v.absolute(p[0]), v.absolute(p[1])), v.absolute(p[2]))
    v.store(lanes, KEY * 16, v.to_f32(largest))
    is_coloured = False
    if v.bits(small) != 0:
        taken, chosen = write_small(lanes, lens, pose, moving, geometry, geo, p32, small)
        remaining &= ~taken
        if chosen != 0:
            colour_group(group, d32, sh, sh_size, lanes)
            is_coloured = True
            _append(cursor, group, chosen, SHORT, lens, lanes, out)
    if remaining == 0:
        return
    place = p32
    if lens[LENS_ROLLS] > 0:
        place, _ = moved_at(p32, moving, lens, time_seen(lens, moving, p32, 0.5))
    chosen = (
        _write_shape(lanes, lens, pose, geometry, geo, p, place, n, mask, moves, moving[0])
        & remaining
    )
    if chosen != 0:
        if not is_coloured:
            colour_group(group, d32, sh, sh_size, lanes)
        _append(cursor, group, chosen, out[0], lens, lanes, out)


@kernel
def _append(cursor, group, chosen, columns, lens, lanes, out):
    """Append the records of lanes."""
    size, index, first_id, records, boxes, keys, ids = out
    place = v.fetch_add(cursor, 0, _count(chosen))
    while chosen != 0:
        lane = v.lowest_bit(chosen)
        chosen &= chosen - 1
        write_record(lanes, lane, lens, place, (size, columns), records, boxes)
        keys[place] = lanes[KEY * 16 + lane]
        ids[place] = index[group * 16 + lane] + first_id
        place += 1


@kernel
def _count(bits):
    count = 0
    while bits != 0:
        bits &= bits - 1
        count += 1
    return count


@kernel
def project_lens_part(
    cursor,
    part,
    means,
    geometry,
    sh,
    sh_size,
    index,
    first_id,
    pose,
    node,
    moved,
    motion,
    lens,
    size,
    records,
    boxes,
    keys,
    ids,
):
    """Project the Gaussians of one part and append those that reach the image; called by each
    thread, which takes bundles until none is left.

    Args:
        cursor, part, means, geometry, sh, sh_size, index, first_id, pose: See
            `project_kernels.project_part`.
        node: Place of the part's motion, -1: it does not turn in the world.
        moved: float64 ``(3,)``, by how much the camera moves in a shutter as the part sees it.
        motion: float32, `MOTION` numbers a moving node.
        lens: float64 ``(LENS_SIZE,)``.
        size: Numbers of a record.
        records: float32 output, ``size`` per splat.
        boxes: int16 output ``(N, 4)``: see `binning.tile_boxes`.
        keys: float32 output: what the order of drawing follows.
        ids: int64 output.
    """
    lanes = np.zeros(COLUMNS * 16, dtype=np.float32)
    turn = row(pose, POSE_TURN)
    shift = row(pose, POSE_SHIFT)
    # By how many radians and metres things move in a shutter.
    moves = (
        np.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2),
        np.sqrt(shift[0] ** 2 + shift[1] ** 2 + shift[2] ** 2),
    )
    groups = index.shape[0] // 16
    moving = row(moved, 0), node, motion
    arrays = means, geometry, sh, sh_size
    out = size, index, first_id, records, boxes, keys, ids
    for lane in range(16):
        lanes[NODE * 16 + lane] = node
    while True:
        begin = v.fetch_add(cursor, part + 1, CHUNK)
        if begin >= groups:
            return
        for group in range(begin, min(begin + CHUNK, groups)):
            _project_group(cursor, group, arrays, pose, lens, moves, moving, lanes, out)

"""Rigid motion and polylines: the small maths every stage shares, and motion read off recorded
poses.

Quaternions are ``wxyz``; ``T_a_b`` maps coordinates in b to coordinates in a; angles are radians,
lengths metres.
"""

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F64, Trajectory

# Columns: a level camera's x (right), y (down), z (forward) in the rig's axes (forward, left, up).
RIG_FROM_LEVEL_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def wrap_angle(angle_rad: npt.ArrayLike) -> F64:
    """Wrap angles to [-pi, pi).

    Example:
        >>> float(wrap_angle(3 * np.pi / 2)) == -np.pi / 2
        True
    """
    return (np.asarray(angle_rad, dtype=np.float64) + np.pi) % (2 * np.pi) - np.pi


def quat_from_yaw(yaw_rad: npt.ArrayLike) -> F64:
    """Return ``(..., 4)`` unit quaternions of rotations about z by ``(...)`` angles."""
    yaw = np.asarray(yaw_rad, dtype=np.float64)
    quat = np.zeros((*yaw.shape, 4))
    quat[..., 0], quat[..., 3] = np.cos(yaw / 2), np.sin(yaw / 2)
    return quat


def yaw_from_quat(quat: npt.ArrayLike) -> F64:
    """Return the heading ``(...)`` of ``(..., 4)`` quaternions: the angle of body x in the world's
    xy plane.
    """
    w, x, y, z = np.moveaxis(np.asarray(quat, dtype=np.float64), -1, 0)
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def matrix_from_quat(quat: npt.ArrayLike) -> F64:
    """Return rotation matrices ``(..., 3, 3)`` of unit quaternions ``(..., 4)``."""
    w, x, y, z = np.moveaxis(np.asarray(quat, dtype=np.float64), -1, 0)
    entries = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return np.stack(entries, axis=-1).reshape(*w.shape, 3, 3)


def turned(yaw_rad: float, pitch_rad: float) -> F64:
    """Return the rotation ``(3, 3)`` by a yaw about z and then a pitch about the turned y, which is
    positive downwards.

    It goes by the quaternion of both, as `scipy.spatial.transform.Rotation` does, whose import
    takes half a second.
    """
    cy, sy = np.cos(yaw_rad / 2), np.sin(yaw_rad / 2)
    cp, sp = np.cos(pitch_rad / 2), np.sin(pitch_rad / 2)
    w, x, y, z = cy * cp, -(sy * sp), cy * sp, sy * cp
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    return np.array(
        [
            [xx - yy - zz + ww, 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), -xx + yy - zz + ww, 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), -xx - yy + zz + ww],
        ]
    )


def quat_from_matrix(rotation: npt.ArrayLike) -> F64:
    """Return the unit quaternions ``(..., 4)`` with w >= 0 of rotation matrices ``(..., 3, 3)``.

    Takes the largest of the four candidate components, so it is stable at 180 degrees (Shepperd
    1978).
    """
    m = np.asarray(rotation, dtype=np.float64)
    batch = m.shape[:-2]
    a, b, c, d, e, f, g, h, i = m.reshape(-1, 9).T
    trace = a + e + i
    largest = np.argmax([trace, a, e, i], axis=0)
    candidates = np.array(
        [
            [1 + trace, h - f, c - g, d - b],
            [h - f, 1 + a - e - i, b + d, c + g],
            [c - g, d + b, 1 + e - i - a, f + h],
            [d - b, g + c, h + f, 1 + i - a - e],
        ]
    )
    quat = candidates[largest, :, np.arange(len(largest))]
    quat = unit(quat)
    return np.where(quat[:, :1] < 0, -quat, quat).reshape(*batch, 4)


def se3(xyz: npt.ArrayLike, quat: npt.ArrayLike) -> F64:
    """Return ``(..., 4, 4)`` transforms from positions ``(..., 3)`` and quaternions ``(...,
    4)``.
    """
    xyz_ = np.asarray(xyz, dtype=np.float64)
    out = np.zeros((*xyz_.shape[:-1], 4, 4))
    out[..., :3, :3] = matrix_from_quat(quat)
    out[..., :3, 3] = xyz_
    out[..., 3, 3] = 1.0
    return out


def rigid(rotation: npt.ArrayLike, xyz: npt.ArrayLike = (0.0, 0.0, 0.0)) -> F64:
    """Return the ``(4, 4)`` transform of a rotation matrix ``(3, 3)`` and a shift ``(3,)``."""
    out = np.eye(4)
    out[:3, :3] = rotation
    out[:3, 3] = xyz
    return out


def shifted(x_m: float, y_m: float, z_m: float = 0.0) -> F64:
    """Return the ``(4, 4)`` transform that only shifts."""
    return rigid(np.eye(3), (x_m, y_m, z_m))


def intrinsics(fx_px: float, fy_px: float, cx_px: float, cy_px: float) -> F64:
    """Return the ``(3, 3)`` intrinsics of a pinhole."""
    return np.array([[fx_px, 0.0, cx_px], [0.0, fy_px, cy_px], [0.0, 0.0, 1.0]])


def se2(x_m: float, y_m: float, yaw_rad: float, z_m: float = 0.0) -> F64:
    """Return the ``(4, 4)`` transform of a planar pose."""
    return se3([x_m, y_m, z_m], quat_from_yaw(yaw_rad))


def inverse(transform: F64) -> F64:
    """Invert rigid ``(..., 4, 4)`` transforms by transposition, exact to rounding."""
    rotation_t = np.swapaxes(transform[..., :3, :3], -1, -2)
    out = np.zeros_like(transform)
    out[..., :3, :3] = rotation_t
    out[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation_t, transform[..., :3, 3])
    out[..., 3, 3] = 1.0
    return out


def transform_points(transform: F64, points: F64) -> F64:
    """Map ``(N, 3)`` points by a ``(4, 4)`` transform."""
    return points @ transform[:3, :3].T + transform[:3, 3]


def yaw_of(transform: F64) -> float:
    """Return the heading of a ``(4, 4)`` transform."""
    return float(heading_of(transform[:, 0]))


def direction_of(yaw_rad: npt.ArrayLike) -> F64:
    """Return the unit vectors ``(..., 2)`` of headings ``(...)``."""
    return np.stack([np.cos(yaw_rad), np.sin(yaw_rad)], axis=-1)


def heading_of(direction: F64) -> F64:
    """Return the headings ``(...)`` of directions ``(..., 2+)``, of any length but zero."""
    return np.arctan2(direction[..., 1], direction[..., 0])


def unit(vectors: F64) -> F64:
    """Return vectors ``(..., D)`` at length 1; those of length 0 stay so."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def left_of(along: F64) -> F64:
    """Return vectors ``(..., 2)`` turned to the left by a right angle."""
    return np.stack([-along[..., 1], along[..., 0]], axis=-1)


def cross(a: F64, b: F64) -> F64:
    """Return the cross products ``(...)`` of planar vectors ``(..., 2+)``: positive where b points
    to the left of a.
    """
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def in_axes(vectors: F64, yaw_rad: F64) -> F64:
    """Return planar vectors ``(..., 2)`` in axes whose x has a heading ``(...)``."""
    along = direction_of(yaw_rad)
    return np.stack([np.sum(vectors * along, axis=-1), cross(along, vectors)], axis=-1)


def slerp(q0: F64, q1: F64, fraction: F64) -> F64:
    """Interpolate unit quaternions ``(N, 4)`` on the shorter arc; falls back to normalised lerp
    below 1e-8 rad, where it is exact.
    """
    dot = np.sum(q0 * q1, axis=-1, keepdims=True)
    q1 = np.where(dot < 0, -q1, q1)
    angle = np.arccos(np.clip(np.abs(dot), 0.0, 1.0))
    s = np.sin(angle)
    f = np.asarray(fraction)[..., None]
    small = s < 1e-8
    safe = np.where(small, 1.0, s)
    w0 = np.where(small, 1 - f, np.sin((1 - f) * angle) / safe)
    w1 = np.where(small, f, np.sin(f * angle) / safe)
    out = w0 * q0 + w1 * q1
    return unit(out)


def interpolate(trajectory: Trajectory, t_us: npt.ArrayLike) -> F64:
    """Return poses ``(..., 4, 4)`` at times inside the trajectory: linear in position, slerp in
    rotation.

    Raises:
        InputError: A time lies outside ``[t_us[0], t_us[-1]]``; poses are never extrapolated.
    """
    t = np.asarray(t_us, dtype=np.int64)
    first = int(trajectory.t_us[0])
    last = int(trajectory.t_us[-1])
    if t.size and (int(t.min()) < first or int(t.max()) > last):
        raise InputError(
            f"times {int(t.min())}..{int(t.max())} us: the trajectory covers {first}..{last} us",
            "ask only for times inside it",
        )
    if len(trajectory) == 1:
        return np.broadcast_to(se3(trajectory.xyz[0], trajectory.quat[0]), (*t.shape, 4, 4)).copy()
    i = np.clip(np.searchsorted(trajectory.t_us, t, side="right") - 1, 0, len(trajectory) - 2)
    # Differences in integers first: epoch microseconds do not fit a float's mantissa once squared
    # or scaled.
    span = (trajectory.t_us[i + 1] - trajectory.t_us[i]).astype(np.float64)
    f = (t - trajectory.t_us[i]).astype(np.float64) / span
    xyz = trajectory.xyz[i] * (1 - f)[..., None] + trajectory.xyz[i + 1] * f[..., None]
    quat = slerp(
        trajectory.quat[i].reshape(-1, 4), trajectory.quat[i + 1].reshape(-1, 4), f.reshape(-1)
    )
    return se3(xyz, quat.reshape(*t.shape, 4))


def trajectory_from_poses(t_us: npt.ArrayLike, poses: npt.ArrayLike) -> Trajectory:
    """Build a trajectory from times ``(T,)`` and transforms ``(T, 4, 4)``."""
    matrices = np.asarray(poses, dtype=np.float64).reshape(-1, 4, 4)
    return Trajectory(
        np.asarray(t_us, dtype=np.int64),
        matrices[:, :3, 3].copy(),
        quat_from_matrix(matrices[:, :3, :3]),
    )


def offset_trajectory(trajectory: Trajectory, T_body_other: F64) -> Trajectory:
    """Return the trajectory of a frame fixed to the body: ``T_world_other = T_world_body @
    T_body_other``.
    """
    return trajectory_from_poses(
        trajectory.t_us, se3(trajectory.xyz, trajectory.quat) @ T_body_other
    )


def arc_lengths(line: F64) -> F64:
    """Return the cumulative length ``(N,)`` along the xy projection of a polyline ``(N, 2+)``."""
    step = line[1:, :2] - line[:-1, :2]
    step *= step
    s = np.zeros(len(step) + 1)
    np.cumsum(np.sqrt(step[:, 0] + step[:, 1]), out=s[1:])
    return s


def step_lengths(line: F64) -> F64:
    """Return the distances ``(N - 1,)`` in plan view of neighbours in a polyline ``(N, 2+)``."""
    return np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1)


def resample(line: F64, s_m: npt.ArrayLike, along: F64 | None = None) -> F64:
    """Return points ``(M, D)`` of a polyline ``(N, D)`` at arc lengths ``(M,)``, clamped to its
    ends; ``along`` are its `arc_lengths`.
    """
    s = arc_lengths(line) if along is None else along
    rises = s[1:] > s[:-1]
    if not rises.all():
        keep = np.concatenate([[True], rises])
        s = s[keep]
        line = line[keep]
    query_s_m = np.asarray(s_m, dtype=np.float64)
    out = np.empty((*query_s_m.shape, line.shape[1]))
    for d in range(line.shape[1]):
        out[..., d] = np.interp(query_s_m, s, line[:, d])
    return out


def project(line: F64, xy: F64) -> tuple[float, float]:
    """Return (arc length, signed distance; left positive) of the point of a polyline ``(N, 2+)``
    nearest to ``xy``.
    """
    a = line[:-1, :2]
    b = line[1:, :2]
    d = b - a
    length2 = np.maximum(np.sum(d * d, axis=1), 1e-300)
    f = np.clip(np.sum((xy[:2] - a) * d, axis=1) / length2, 0.0, 1.0)
    offset = xy[:2] - (a + f[:, None] * d)
    distance2 = np.sum(offset * offset, axis=1)
    i = int(np.argmin(distance2))
    side = cross(d[i], offset[i])
    s = arc_lengths(line)
    return float(s[i] + f[i] * np.sqrt(length2[i])), float(np.copysign(np.sqrt(distance2[i]), side))


# front-left, front-right, rear-right, rear-left
UNIT_CORNERS = np.array([[0.5, 0.5], [0.5, -0.5], [-0.5, -0.5], [-0.5, 0.5]])


def rectangle_corners(xy: F64, yaw: F64, size: F64) -> F64:
    """Return the corners ``(N, 4, 2)`` of boxes with centres ``(N, 2)``, headings ``(N,)`` and
    (length, width) ``(N, 2)``.
    """
    local = UNIT_CORNERS * size[:, None, :]  # (N, 4, 2)
    c = np.cos(yaw)[:, None]
    s = np.sin(yaw)[:, None]
    x = local[..., 0]
    y = local[..., 1]
    return np.stack([xy[:, None, 0] + c * x - s * y, xy[:, None, 1] + s * x + c * y], axis=-1)


def densify(line: F64, max_step_m: float = 2.0) -> F64:
    """Insert points so that neighbours of a polyline ``(N, D)`` are at most ``max_step_m`` apart in
    plan view; its own vertices stay.
    """
    steps = step_lengths(line)
    count = np.maximum(np.ceil(steps / max_step_m - 1e-9).astype(np.int64), 1)  # pieces per segment
    if count.size == 0 or int(count.max()) == 1:
        return line
    segment = np.repeat(np.arange(len(count)), count)
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    fraction = (np.arange(len(segment)) - first[segment]) / count[segment]
    points = line[segment] + fraction[:, None] * (line[segment + 1] - line[segment])
    return np.concatenate([points, line[-1:]])


def centre_line(left: F64, right: F64, max_step_m: float = 2.0) -> F64:
    """Return the line ``(N, 3)`` halfway between two edges ``(L, 3)`` and ``(R, 3)`` that need not
    have the same number of points.

    Points at equal shares of both edges' lengths are averaged, at every vertex of either edge and
    at most ``max_step_m`` apart.
    """
    share_left = _shares(left)
    share_right = _shares(right)
    shares = np.unique(np.round(np.concatenate([share_left, share_right]), 9))
    length = max(float(arc_lengths(left)[-1]), float(arc_lengths(right)[-1]))
    at_left = resample(left, shares * arc_lengths(left)[-1])
    at_right = resample(right, shares * arc_lengths(right)[-1])
    middle = (at_left + at_right) / 2
    steps = step_lengths(middle)
    keep = np.concatenate([[True], steps > 1e-6 * max(length, 1.0)])
    keep[-1] = True
    return densify(middle[keep], max_step_m)


def _shares(line: F64) -> F64:
    s = arc_lengths(line)
    return s / s[-1] if s[-1] > 0 else np.linspace(0.0, 1.0, len(s))


def speeds(track: Trajectory) -> F64:
    """Return the speed in the plane ``(T,)`` at every pose of a track, by central differences; one
    pose: 0.
    """
    if len(track) < 2:
        return np.zeros(len(track))
    t_s = (track.t_us - track.t_us[0]).astype(np.float64) * 1e-6
    v = np.gradient(track.xyz[:, :2], t_s, axis=0)
    return np.hypot(v[:, 0], v[:, 1])

"""Follow points through photographs that were taken one after the other, place them, and correct
the poses of the photographs by them.

Corners (Shi and Tomasi 1994) are followed from photograph to photograph by pyramidal Lucas-Kanade
and kept where following them back ends where they began. A track of several photographs fixes a
point far better than a match of two, and its reprojection errors say how far the poses can be
trusted.

Poses of a drive come from satellite positioning and inertial sensors. They are good to centimetres
and tenths of a degree, which is more than a pixel: a reconstruction fitted to them blurs. `corrected`
corrects them by bundle adjustment (Triggs et al. 2000). The correction is small, so the given poses
stay as a prior: they fix place, direction and scale of the whole, and a photograph without tracks
keeps its pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import scipy

from alpasim_plugin.core.geometry import rigid, unit
from alpasim_plugin.core.types import F64, I64, Bool
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.fit.views import PosedView

CORNERS = 1500  # most corners of a photograph
APART_PX = 7  # least distance of two corners
QUALITY = 0.003  # least strength of a corner
BACK_PX = 0.4  # following a point there and back may end so far from where it began
WINDOW = (15, 15)
ROUNDS = 8  # Gauss-Newton steps that place a point
HUBER_PX = 1.0  # an observation with a larger error counts less
ADJUSTING_ROUNDS = 12  # of correcting poses
# Likely correction of a given pose
SIGMA_M = 0.05
SIGMA_RAD = 0.003
LARGEST_ERROR_PX = 3.0  # of observations that adjust poses
LEAST_ANGLE_RAD = 0.01  # between the rays to points that adjust poses


@dataclass(frozen=True, eq=False)
class Tracks:
    """Points that several photographs show.

    Attributes:
        view: ``(M,)`` which photograph each observation is of.
        point: ``(M,)`` which point it shows, 0..P-1, ascending.
        pixel: ``(M, 2)`` where in that photograph, pixels; the first pixel's centre is at (0.5, 0.5).
        count: P.
    """

    view: I64
    point: I64
    pixel: F64
    count: int

    def only(self, keep: Bool) -> Tracks:
        """Return the observations ``(M,)`` that are kept; points that fewer than two of them show
        are left out.
        """
        view = self.view[keep]
        point = self.point[keep]
        pixel = self.pixel[keep]
        times = np.bincount(point, minlength=self.count)
        stay = times[point] >= 2
        ids, number = np.unique(point[stay], return_inverse=True)
        return Tracks(view[stay], number.astype(np.int64), pixel[stay], len(ids))


def follow(views: Sequence[PosedView]) -> Tracks:
    """Follow corners from each photograph to the next; tracks of two observations and more, masked
    pixels left out.
    """
    greys = [cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY) for view in views]
    rows = []
    points = np.zeros((0, 2), dtype=np.float32)
    ids = np.zeros(0, dtype=np.int64)
    count = 0
    for i, grey in enumerate(greys):
        mask = views[i].mask
        free = (
            np.full(grey.shape, 255, dtype=np.uint8)
            if mask is None
            else mask.astype(np.uint8) * 255
        )
        for x, y in np.rint(points).astype(int):
            cv2.circle(free, (int(x), int(y)), APART_PX, 0, -1)
        corners = cv2.goodFeaturesToTrack(
            grey, max(CORNERS - len(points), 1), QUALITY, APART_PX, mask=free
        )
        fresh = np.zeros((0, 2), dtype=np.float32) if corners is None else corners.reshape(-1, 2)
        points = np.concatenate([points, fresh])
        ids = np.concatenate([ids, count + np.arange(len(fresh))])
        count += len(fresh)
        rows.append((np.full(len(ids), i, dtype=np.int64), ids, points.astype(np.float64) + 0.5))
        if i + 1 < len(views) and len(points):
            b = greys[i + 1]
            options = {"winSize": WINDOW, "maxLevel": 4}
            flowed, ok, _ = cv2.calcOpticalFlowPyrLK(grey, b, points[:, None], None, **options)  # type: ignore[call-overload,unused-ignore]
            back, ok_back, _ = cv2.calcOpticalFlowPyrLK(b, grey, flowed, None, **options)  # type: ignore[call-overload,unused-ignore]
            off = np.linalg.norm(back[:, 0] - points, axis=1)
            moved = flowed[:, 0]
            inside = (
                (moved[:, 0] >= 0)
                & (moved[:, 1] >= 0)
                & (moved[:, 0] <= grey.shape[1] - 1)
                & (moved[:, 1] <= grey.shape[0] - 1)
            )
            points = moved
            kept = (ok[:, 0] == 1) & (ok_back[:, 0] == 1) & (off < BACK_PX) & inside
            points = points[kept]
            ids = ids[kept]
    view, point, pixel = (np.concatenate([row[k] for row in rows]) for k in range(3))
    order = np.argsort(point, kind="stable")
    all_ = Tracks(view[order], point[order], pixel[order], count)
    return all_.only(np.ones(len(order), dtype=bool))


@dataclass(frozen=True, eq=False)
class Placed:
    """Where the points of tracks lie.

    Attributes:
        xyz: ``(P, 3)`` metres, world.
        error_px: ``(M,)`` distance of each observation from the point's projection; infinite behind
            the camera.
        angle_rad: ``(P,)`` between the outermost rays to the point: small means that its distance
            is not known.
    """

    xyz: F64
    error_px: F64
    angle_rad: F64


def place(tracks: Tracks, cameras: Sequence[PinholeCamera]) -> Placed:
    """Triangulate every point: nearest to its rays at first, then by robust reprojection error
    (Gauss-Newton, Huber weights).
    """
    R, t, K = pose_arrays(cameras)
    centre = -np.einsum("nji,nj->ni", R, t)
    local = np.einsum(
        "nij,nj->ni", np.linalg.inv(K)[tracks.view], np.c_[tracks.pixel, np.ones(len(tracks.pixel))]
    )
    ray = np.einsum("nji,nj->ni", R[tracks.view], local)
    ray = unit(ray)
    across = np.eye(3) - ray[:, :, None] * ray[:, None]
    A, b = (
        summed(values, tracks.point, tracks.count)
        for values in (across, np.einsum("nij,nj->ni", across, centre[tracks.view]))
    )
    xyz: F64 = np.asarray(
        np.linalg.solve(A + 1e-9 * np.eye(3), b[..., None])[..., 0], dtype=np.float64
    )
    for _ in range(ROUNDS):
        e, slope, _ = residuals(xyz, tracks, R, t, K)
        J = slope @ R[tracks.view]
        JT = J.transpose(0, 2, 1) * huber(e)[:, None, None]
        H, g = (
            summed(values, tracks.point, tracks.count)
            for values in (JT @ J, (JT @ e[..., None])[..., 0])
        )
        step = np.linalg.solve(
            H + 1e-9 * np.eye(3) * (1 + np.trace(H, axis1=1, axis2=2)[:, None, None]), g[..., None]
        )[..., 0]
        length = np.linalg.norm(step, axis=1, keepdims=True)
        away = np.linalg.norm(xyz - centre.mean(axis=0), axis=1, keepdims=True)
        xyz = xyz - step * np.minimum(1.0, 0.5 * (away + 1.0) / np.maximum(length, 1e-12))
    e, _, local = residuals(xyz, tracks, R, t, K)
    error = np.where(local[:, 2] > 1e-3, np.linalg.norm(e, axis=1), np.inf)
    first = np.searchsorted(tracks.point, np.arange(tracks.count))
    last = np.searchsorted(tracks.point, np.arange(tracks.count), side="right") - 1
    a, b = (xyz - centre[tracks.view[i]] for i in (first, last))
    cross = np.linalg.norm(np.cross(a, b), axis=1)
    return Placed(xyz, error, np.arctan2(cross, np.einsum("ij,ij->i", a, b)))


def pose_arrays(cameras: Sequence[PinholeCamera]) -> tuple[F64, F64, F64]:
    """Return rotations ``(V, 3, 3)`` and shifts ``(V, 3)`` world to camera, and intrinsics ``(V, 3,
    3)``.
    """
    T = np.array([camera.T_camera_world for camera in cameras])
    return T[:, :3, :3], T[:, :3, 3], np.array([camera.K for camera in cameras])


def residuals(xyz: F64, tracks: Tracks, R: F64, t: F64, K: F64) -> tuple[F64, F64, F64]:
    """Return projection minus observation ``(M, 2)`` in pixels, its derivative by the point in the
    camera's axes ``(M, 2, 3)``, and that point ``(M, 3)``.
    """
    local = np.einsum("nij,nj->ni", R[tracks.view], xyz[tracks.point]) + t[tracks.view]
    z = np.where(np.abs(local[:, 2]) < 1e-6, 1e-6, local[:, 2])
    focal = np.stack([K[tracks.view, 0, 0], K[tracks.view, 1, 1]], axis=1)
    middle = np.stack([K[tracks.view, 0, 2], K[tracks.view, 1, 2]], axis=1)
    error = focal * local[:, :2] / z[:, None] + middle - tracks.pixel
    slope = np.zeros((len(local), 2, 3))
    slope[:, 0, 0] = focal[:, 0] / z
    slope[:, 1, 1] = focal[:, 1] / z
    slope[:, :, 2] = -focal * local[:, :2] / (z**2)[:, None]
    return error, slope, local


def summed(values: F64, index: I64, count: int) -> F64:
    """Return the sums ``(count, ...)`` of the ``values (M, ...)`` of each index ``(M,)``."""
    gather = scipy.sparse.csr_matrix(
        (np.ones(len(index)), (index, np.arange(len(index)))), shape=(count, len(index))
    )
    flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
    return (gather @ flat).reshape(count, *values.shape[1:])


def huber(e: F64) -> F64:
    """Return the weights ``(M,)`` of errors ``(M, 2)``: 1 up to `HUBER_PX`, then falling as the
    error grows.
    """
    return HUBER_PX / np.maximum(np.linalg.norm(e, axis=1), HUBER_PX)


class Adjusted(NamedTuple):
    """Photographs' cameras, and the median reprojection error with the given and with these poses,
    pixels; NaN where there are too few tracks to say.
    """

    cameras: Sequence[PinholeCamera]
    before_px: float
    after_px: float


def corrected(views: Sequence[PosedView]) -> Adjusted:
    """Return cameras of views, in the order of the way and of one size, whose poses agree with what
    the views show; the same cameras where there are too few tracks to say.
    """
    cameras = [view.pinhole for view in views]
    tracks = follow(views)
    kept = tracks.only(_good(tracks, place(tracks, cameras), 3 * LARGEST_ERROR_PX))
    if kept.count < 10:
        return Adjusted(cameras, float("nan"), float("nan"))
    start = place(kept, cameras)
    before = float(np.median(start.error_px[np.isfinite(start.error_px)]))
    moved = _solve(cameras, kept, start.xyz, cameras)
    kept = tracks.only(_good(tracks, place(tracks, moved), LARGEST_ERROR_PX))
    moved = _solve(cameras, kept, place(kept, moved).xyz, moved)
    return Adjusted(moved, before, float(np.median(place(kept, moved).error_px)))


def _good(tracks: Tracks, placed: Placed, error_px: float) -> Bool:
    return (placed.error_px < error_px) & (placed.angle_rad[tracks.point] > LEAST_ANGLE_RAD)


def _solve(
    cameras: Sequence[PinholeCamera],
    tracks: Tracks,
    xyz: F64,
    begin: Sequence[PinholeCamera],
) -> list[PinholeCamera]:
    """Minimise robust reprojection error and distance from the given poses by Gauss-Newton; points
    are eliminated (Schur complement).
    """
    R0, t0, K = pose_arrays(cameras)
    R, t = (a.copy() for a in pose_arrays(begin)[:2])
    for _ in range(ADJUSTING_ROUNDS):
        step, points = _step(R, t, K, R0, t0, tracks, xyz)
        for i in range(len(R)):
            turn = cv2.Rodrigues(step[i, :3])[0]
            R[i], t[i] = turn @ R[i], turn @ t[i] + step[i, 3:]
        xyz = xyz + points
        if np.abs(step).max() < 1e-6:
            break
    return [
        replace(camera, T_camera_world=rigid(rotation, shift))
        for camera, rotation, shift in zip(cameras, R, t, strict=True)
    ]


def _step(R: F64, t: F64, K: F64, R0: F64, t0: F64, tracks: Tracks, xyz: F64) -> tuple[F64, F64]:
    """Return changes of the poses ``(V, 6)`` (turn and shift in the camera's frame) and of the
    points ``(P, 3)``.
    """
    view = tracks.view
    point = tracks.point
    views = len(R)
    points = len(xyz)
    error, slope, local = residuals(xyz, tracks, R, t, K)
    x, y, z = local.T
    o = np.zeros_like(x)
    # (M, 2, 6), the derivative of the local point by its camera's turn and shift
    by_pose = np.concatenate(
        [
            -slope
            @ np.stack(
                [np.stack([o, -z, y], 1), np.stack([z, o, -x], 1), np.stack([-y, x, o], 1)], axis=1
            ),
            slope,
        ],
        axis=2,
    )
    by_point = slope @ R[view]  # (M, 2, 3)
    weight = huber(error)[:, None, None]
    weighted_pose = by_pose.transpose(0, 2, 1) * weight
    weighted_point = by_point.transpose(0, 2, 1) * weight
    of_poses = summed(weighted_pose @ by_pose, view, views)
    pull_poses = summed((weighted_pose @ error[..., None])[..., 0], view, views)
    of_points = summed(weighted_point @ by_point, point, points)
    pull_points = summed((weighted_point @ error[..., None])[..., 0], point, points)
    prior = np.repeat([SIGMA_RAD**-2, SIGMA_M**-2], 3)
    of_poses += np.diag(prior)
    turn = np.array([cv2.Rodrigues(a @ b.T)[0][:, 0] for a, b in zip(R, R0, strict=True)])
    moved = t - np.einsum("nij,njk,nk->ni", R, R0.transpose(0, 2, 1), t0)
    pull_poses += prior * np.concatenate([turn, moved], axis=1)
    between = weighted_pose @ by_point  # (M, 6, 3)
    inverse: F64 = np.asarray(np.linalg.inv(of_points + 1e-6 * np.eye(3)), dtype=np.float64)
    # The normal equations of the poses alone.
    order = np.argsort(view, kind="stable")
    starts = np.searchsorted(view[order], np.arange(views + 1))
    blocks = scipy.sparse.bsr_matrix(
        (between[order], point[order], starts), shape=(6 * views, 3 * points)
    )
    numbers = np.arange(points + 1)
    middle = scipy.sparse.bsr_matrix((inverse, numbers[:-1], numbers), shape=(3 * points,) * 2)
    H = -(blocks @ middle @ blocks.T).toarray()
    for i in range(views):
        H[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] += of_poses[i]
    g = pull_poses.ravel() - blocks @ (middle @ pull_points.ravel())
    step: F64 = np.asarray(-np.linalg.solve(H, g).reshape(views, 6), dtype=np.float64)
    back = summed(np.einsum("nij,ni->nj", between, step[view]), point, points)
    return step, np.asarray(-np.einsum("nij,nj->ni", inverse, pull_points + back), dtype=np.float64)

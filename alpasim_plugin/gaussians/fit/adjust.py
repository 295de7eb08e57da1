"""Correct the poses of photographs by what they show: bundle adjustment (Triggs et al. 2000) over tracks, held to the given poses.

Poses of a drive come from satellite positioning and inertial sensors. They are good to centimetres and tenths of a degree, which is more
than a pixel: a reconstruction fitted to them blurs. The correction is small, so the given poses stay as a prior: they fix place, direction
and scale of the whole, and a photograph without tracks keeps its pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import scipy

from alpasim_plugin.core.types import F64, I64, Bool
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.fit.tracks import Placed, Tracks, follow, huber, place, pose_arrays, projection_slope, summed
from alpasim_plugin.gaussians.fit.views import PosedView

ROUNDS = 12
SIGMA_M, SIGMA_RAD = 0.05, 0.003  # of a given pose: what correction is likely
LARGEST_ERROR_PX, LEAST_ANGLE_RAD = 3.0, 0.01  # of observations that adjust poses, and of their points
GOOD_ERROR_PX = 1.0  # mean reprojection error of a point that is kept after that


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Photographs' cameras and the points that they show.

    Attributes:
        cameras: In the order given.
        tracks: What was used.
        placed: Its points.
        before_px, after_px: Median reprojection error with the given and with the corrected poses.
    """

    cameras: tuple[PinholeCamera, ...]
    tracks: Tracks
    placed: Placed
    before_px: float
    after_px: float


def corrected(views: Sequence[PosedView]) -> Adjusted:
    """Return cameras of views, in the order of the way and of one size, whose poses agree with what the views show."""
    return adjust([view.camera for view in views], follow(views))


def adjust(cameras: Sequence[PinholeCamera], tracks: Tracks) -> Adjusted:
    """Return cameras whose poses agree with the tracks; the same cameras where there are too few tracks to say.

    Args:
        cameras: As given.
        tracks: Over the same photographs.
    """
    placed = place(tracks, cameras)
    kept = tracks.only(_good(tracks, placed, 3 * LARGEST_ERROR_PX))
    if kept.count < 10:
        return Adjusted(tuple(cameras), kept, place(kept, cameras), float("nan"), float("nan"))
    start = place(kept, cameras)
    before = float(np.median(start.error_px[np.isfinite(start.error_px)]))
    moved = _solve(cameras, kept, start.xyz)
    placed = place(tracks, moved)
    kept = tracks.only(_good(tracks, placed, LARGEST_ERROR_PX))
    moved = _solve(cameras, kept, place(kept, moved).xyz, moved)
    placed = place(kept, moved)
    return Adjusted(tuple(moved), kept, placed, before, float(np.median(placed.error_px)))


def _good(tracks: Tracks, placed: Placed, error_px: float) -> Bool:
    return np.asarray((placed.error_px < error_px) & (placed.angle_rad[tracks.point] > LEAST_ANGLE_RAD))


def _solve(given: Sequence[PinholeCamera], tracks: Tracks, xyz: F64, begin: Sequence[PinholeCamera] | None = None) -> list[PinholeCamera]:
    """Minimise robust reprojection error and distance from the given poses by Gauss-Newton; points are eliminated (Schur complement)."""
    R0, t0, K = pose_arrays(given)
    R, t = (a.copy() for a in pose_arrays(begin or given)[:2])
    for _ in range(ROUNDS):
        step, points = _step(R, t, K, R0, t0, tracks, xyz)
        for i in range(len(R)):
            turn = cv2.Rodrigues(step[i, :3])[0]
            R[i], t[i] = turn @ R[i], turn @ t[i] + step[i, 3:]
        xyz = xyz + points
        if np.abs(step).max() < 1e-6:
            break
    out = []
    for camera, rotation, shift in zip(given, R, t, strict=True):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rotation, shift
        out.append(replace(camera, T_camera_world=T))
    return out


def _step(R: F64, t: F64, K: F64, R0: F64, t0: F64, tracks: Tracks, xyz: F64) -> tuple[F64, F64]:
    """Return changes of the poses ``(V, 6)`` (turn and shift in the camera's frame) and of the points ``(P, 3)``."""
    v, p, views = tracks.view, tracks.point, len(R)
    local = np.einsum("nij,nj->ni", R[v], xyz[p]) + t[v]
    z = np.where(np.abs(local[:, 2]) < 1e-6, 1e-6, local[:, 2])
    f, c = np.stack([K[v, 0, 0], K[v, 1, 1]], axis=1), np.stack([K[v, 0, 2], K[v, 1, 2]], axis=1)
    e = f * local[:, :2] / z[:, None] + c - tracks.at
    slope = projection_slope(local, z, f)
    A = np.concatenate([-slope @ _cross(local), slope], axis=2)  # by the pose
    B = slope @ R[v]  # by the point
    w = huber(e)[:, None, None]
    AT, BT = A.transpose(0, 2, 1) * w, B.transpose(0, 2, 1) * w
    U, ga = (summed(values, v, views) for values in (AT @ A, (AT @ e[..., None])[..., 0]))
    V, gb = (summed(values, p, len(xyz)) for values in (BT @ B, (BT @ e[..., None])[..., 0]))
    off, weight = _from_given(R, t, R0, t0), np.repeat([SIGMA_RAD**-2, SIGMA_M**-2], 3)
    U += np.diag(weight)
    ga += weight * off
    W = AT @ B  # (M, 6, 3)
    inverse: F64 = np.asarray(np.linalg.inv(V + 1e-6 * np.eye(3)), np.float64)
    H, g = _reduced(U, ga, W, inverse, gb, v, p)
    step: F64 = np.asarray(-np.linalg.solve(H, g).reshape(views, 6), np.float64)
    back = summed(np.einsum("nij,ni->nj", W, step[v]), p, len(xyz))
    return step, np.asarray(-np.einsum("nij,nj->ni", inverse, gb + back), np.float64)


def _reduced(U: F64, ga: F64, W: F64, inverse: F64, gb: F64, v: I64, p: I64) -> tuple[F64, F64]:
    """Return the normal equations of the poses alone, ``(6V, 6V)`` and ``(6V,)``."""
    views, n = len(U), len(inverse)
    order = np.argsort(v, kind="stable")
    starts = np.searchsorted(v[order], np.arange(views + 1))
    blocks = scipy.sparse.bsr_matrix((W[order], p[order], starts), shape=(6 * views, 3 * n))
    middle = scipy.sparse.bsr_matrix((inverse, np.arange(n), np.arange(n + 1)), shape=(3 * n, 3 * n))
    H = -(blocks @ middle @ blocks.T).toarray()
    for i in range(views):
        H[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] += U[i]
    g = ga.ravel() - blocks @ (middle @ gb.ravel())
    return np.asarray(H), np.asarray(g)


def _cross(a: F64) -> F64:
    """Return the matrices ``(N, 3, 3)`` that multiply vectors ``(N, 3)`` crosswise from the left."""
    x, y, z = a.T
    o = np.zeros_like(x)
    return np.stack([np.stack([o, -z, y], 1), np.stack([z, o, -x], 1), np.stack([-y, x, o], 1)], axis=1)


def _from_given(R: F64, t: F64, R0: F64, t0: F64) -> F64:
    """Return how far poses are from the given ones ``(V, 6)``: the turn as a rotation vector, and the shift, in the camera's frame."""
    turn = np.array([cv2.Rodrigues(a @ b.T)[0][:, 0] for a, b in zip(R, R0, strict=True)])
    moved = t - np.einsum("nij,njk,nk->ni", R, R0.transpose(0, 2, 1), t0)
    return np.concatenate([turn, moved], axis=1)

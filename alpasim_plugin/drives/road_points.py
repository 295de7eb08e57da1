"""Points of the road itself, which has too little contrast for features: what a plane predicts is tracked, what it misses is measured.

The next photographs are warped onto a photograph by the plane of the road ahead. What is left is a shift of a few pixels, which optical
flow finds on asphalt too; undoing the warp gives rays, and the rays give points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from alpasim_plugin.core.geometry import inverse, transform_points
from alpasim_plugin.core.types import F64, I64, U8, Bool
from alpasim_plugin.drives.ground import GroundStrip
from alpasim_plugin.drives.points import placed, small_view
from alpasim_plugin.drives.source import Points
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.fit.photographs import Picture
from alpasim_plugin.gaussians.fit.tracks import Tracks

NEAR, FAR = 2.0, 9.0  # of the piece of road that is looked at, in camera heights
ASIDE = (0.75, 1.5)  # to both sides: under the wheels, where there is least to see, and beside them
CORNERS, CONTRAST, APART_PX = (250, 60), 0.01, 6.0  # in each of the two; contrast is relative, and asphalt is faint
NEXT = (1, 2, 3)  # photographs
WINDOW_PX, BACK_PX = 21, 0.25  # of the flow; how near it must come back
MOST_PX = 12.0  # more than this and the plane was no prediction


def road_points(pictures: Sequence[Picture], poses: F64, strip: GroundStrip) -> Points:
    """Return points of the road ahead of each photograph.

    Args:
        pictures: Of the front camera, in order.
        poses: ``(N, 4, 4)`` camera to the strip's frame.
        strip: A first idea of the ground.

    Returns:
        Points in the strip's frame.
    """
    views = [small_view(replace(picture, T_world_camera=pose)) for picture, pose in zip(pictures, poses, strict=True)]
    shots = [(view.camera, np.asarray(cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)) for view in views]
    rows = [np.zeros((0, 4))]
    count = 0
    for i in range(len(shots) - 1):
        found = _tracked(i, shots, strip)
        if len(found):
            found[:, 0] += count
            count = int(found[-1, 0]) + 1
            rows.append(found)
    table = np.concatenate(rows)
    tracks = Tracks(table[:, 1].astype(np.int64), table[:, 0].astype(np.int64), table[:, 2:], count)
    return placed(tracks, views)


def _tracked(i: int, shots: Sequence[tuple[PinholeCamera, U8]], strip: GroundStrip) -> F64:
    """Return observations of the road seen in photograph ``i``: rows of track, view and pixel, sorted by track."""
    camera, image = shots[i]
    pieces = [_piece_ahead(strip, camera.centre_world, aside) for aside in ASIDE]
    masks = [_mask(camera, piece) for piece in pieces]
    masks[1] = masks[1] & ~masks[0]
    corners = [cv2.goodFeaturesToTrack(image, n, CONTRAST, APART_PX, mask=m) for n, m in zip(CORNERS, masks, strict=True) if m.any()]
    at = np.concatenate([np.zeros((0, 2)), *(one.reshape(-1, 2) for one in corners if one is not None)]).astype(np.float32)
    if not len(at):
        return np.zeros((0, 4))
    normal, away = _plane(pieces[0], camera.T_camera_world)
    rows = [_rows(np.arange(len(at)), i, at)]
    for j in (i + k for k in NEXT if i + k < len(shots)):
        other, shown = shots[j]
        move = other.T_camera_world @ inverse(camera.T_camera_world)
        H = other.K @ (move[:3, :3] + np.outer(move[:3, 3], normal) / away) @ np.linalg.inv(camera.K)
        from_corner = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
        H = np.linalg.inv(from_corner) @ H @ from_corner  # OpenCV counts from pixel centres
        warped = cv2.warpPerspective(shown, H, (camera.width, camera.height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        inside = cv2.warpPerspective(
            np.full_like(shown, 255), H, (camera.width, camera.height), flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        )
        moved, good = _flow(image, np.asarray(warped, dtype=np.uint8), at)
        cells = np.clip(np.rint(moved), 0, [camera.width - 1, camera.height - 1]).astype(np.int64)
        good &= inside[cells[:, 1], cells[:, 0]] > 0
        there = cv2.perspectiveTransform(moved[:, None].astype(np.float64), H).reshape(-1, 2)
        which = np.nonzero(good)[0]
        rows.append(_rows(which, j, there[which]))
    found = np.concatenate(rows)
    return found[np.argsort(found[:, 0], kind="stable")]


def _rows(track: I64, view: int, at: F64) -> F64:
    return np.column_stack([track, np.full(len(at), view), at + 0.5])


def _flow(image: U8, warped: U8, at: F64) -> tuple[F64, Bool]:
    """Return where points moved to, and which came back to where they were."""
    options = {"winSize": (WINDOW_PX, WINDOW_PX), "maxLevel": 2}
    moved, found, _ = cv2.calcOpticalFlowPyrLK(image, warped, at, at.copy(), flags=cv2.OPTFLOW_USE_INITIAL_FLOW, **options)  # type: ignore[call-overload]
    back, again, _ = cv2.calcOpticalFlowPyrLK(warped, image, moved, at.copy(), flags=cv2.OPTFLOW_USE_INITIAL_FLOW, **options)  # type: ignore[call-overload]
    good = (found.ravel() > 0) & (again.ravel() > 0) & (np.linalg.norm(back - at, axis=1) < BACK_PX)
    return moved, good & (np.linalg.norm(moved - at, axis=1) < MOST_PX)


def _piece_ahead(strip: GroundStrip, centre: F64, aside: float) -> F64:
    """Return corners ``(8, 3)`` of the piece of road ahead of a camera, on the strip, to ``aside`` camera heights beside the path."""
    here = strip.frame.place(centre[None])[0][0]
    out = []
    for ahead in np.linspace(NEAR, FAR, 4) * strip.height:
        k = int(np.clip(np.searchsorted(strip.frame.s, here + ahead), 0, len(strip.frame.s) - 1))
        along = strip.frame.along[k]
        left = aside * strip.height * np.array([-along[1], along[0]])
        out += [strip.frame.line[k, :2] + left, strip.frame.line[k, :2] - left]
    xy = np.array(out)
    return np.column_stack([xy, strip.z(xy)])


def _plane(piece: F64, T: F64) -> tuple[F64, float]:
    """Return the plane of a piece of road in a camera's axes: unit normal and distance, ``normal . x = distance``."""
    local = transform_points(T, piece)
    middle = local.mean(axis=0)
    normal = np.linalg.svd(local - middle)[2][2]
    return normal, float(normal @ middle)


def _mask(camera: PinholeCamera, piece: F64) -> U8:
    """Return where a photograph shows the piece, ``(H, W)``: 255 inside."""
    local = transform_points(camera.T_camera_world, piece)
    mask = np.zeros((camera.height, camera.width), np.uint8)
    if (local[:, 2] > 1e-3).all():
        pixel = local @ camera.K.T
        hull = cv2.convexHull((pixel[:, :2] / pixel[:, 2:]).clip(-1e4, 1e4).astype(np.int32))
        cv2.fillConvexPoly(mask, hull, 255)
    return mask

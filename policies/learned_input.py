"""Navigation command of the learned policy: one of five, computed from the shape of the route
ahead.
"""

from __future__ import annotations

from typing import Literal, get_args

import cv2
import numpy as np

from alpasim_plugin.core.geometry import wrap_angle
from alpasim_plugin.core.types import F32, F64, U8, CameraSpec

Command = Literal["keep", "left-ahead", "left-now", "right-ahead", "right-now"]
COMMANDS: tuple[Command, ...] = get_args(Command)

TURN_RADIUS_M = 28.0  # tighter curves are turns and are announced; wider ones belong to the road
AHEAD_M, NOW_M = 40.0, 6.0

WIDTH, HEIGHT = 192, 80  # pixels
FOCAL_PX = 125.0  # 75 degrees across
HORIZON_ROW = 18.0
CHANNELS = 4  # red, green, blue now; brightness of an earlier frame
MEAN, STD = 115.0, 64.0  # grey levels
_K = np.array([[FOCAL_PX, 0.0, WIDTH / 2], [0.0, FOCAL_PX, HORIZON_ROW], [0.0, 0.0, 1.0]])
_RIG_FROM_LEVEL_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_GREY = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # ITU-R BT.601


def route_command(route_rig: F64, late_m: float = 0.0) -> Command:
    """Return the command for a route ahead ``(20, 3)`` in the rig frame, NaN where it ends.

    A turn is a stretch of two route segments on which the route bends tighter than `TURN_RADIUS_M`.
    The nearest one within `AHEAD_M` is announced, with "now" from `NOW_M` before it. The command
    does not depend on the route's lateral position in the lane.

    Args:
        route_rig: As in `Observation`.
        late_m: Delay of the announcement, metres; negative: early.
    """
    points = route_rig[np.isfinite(route_rig).all(axis=1), :2]
    if len(points) < 4:
        return "keep"
    step = np.diff(points, axis=0)
    heading = np.arctan2(step[:, 1], step[:, 0])
    length = np.hypot(step[:, 0], step[:, 1])
    bend = wrap_angle(heading[2:] - heading[:-2]) / np.maximum(
        0.5 * (length[2:] + length[:-2]) + length[1:-1], 1e-6
    )
    begins_m = np.cumsum(length)[:-2] + late_m
    turns = np.flatnonzero((np.abs(bend) > 1.0 / TURN_RADIUS_M) & (begins_m < AHEAD_M))
    if len(turns) == 0:
        return "keep"
    first = int(turns[0])
    now = begins_m[first] < NOW_M
    if bend[first] > 0:
        return "left-now" if now else "left-ahead"
    return "right-now" if now else "right-ahead"


def view_homography(camera: CameraSpec, yaw_rad: float = 0.0) -> F64:
    """Return the homography ``(3, 3)`` from pixels of the view to pixels of the camera.

    The view is level along the rig's x axis, rotated to the left by ``yaw_rad``, at the camera's
    position: a pure rotation, so no depth is needed.
    """
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    rotation = camera.T_rig_camera[:3, :3].T @ turn @ _RIG_FROM_LEVEL_CAMERA
    return camera.K @ rotation @ np.linalg.inv(_K)


def level_view(rgb: U8, camera: CameraSpec, yaw_rad: float = 0.0) -> U8:
    """Return the view ``(80, 192, 3)`` of a frame ``(H, W, 3)``; borders are replicated.

    Frames of higher angular resolution are area-averaged first.
    """
    to_camera = view_homography(camera, yaw_rad)
    shrink = int(camera.K[0, 0] / FOCAL_PX)
    if shrink > 1:
        size = (rgb.shape[1] // shrink, rgb.shape[0] // shrink)
        scale = np.diag([size[0] / rgb.shape[1], size[1] / rgb.shape[0], 1.0])
        centre = np.array(
            [[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]]
        )  # pixel centres lie at halves
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
        to_camera = np.linalg.inv(centre) @ scale @ centre @ to_camera
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpPerspective(
        rgb, to_camera, (WIDTH, HEIGHT), flags=flags, borderMode=cv2.BORDER_REPLICATE
    )


def network_input(now: U8, before: U8) -> F32:
    """Return the network's input ``(4, 80, 192)`` from two views ``(80, 192, 3)``."""
    out = np.empty((CHANNELS, HEIGHT, WIDTH), dtype=np.float32)
    out[:3] = now.transpose(2, 0, 1)
    out[3] = before.astype(np.float32) @ _GREY
    return (out - np.float32(MEAN)) / np.float32(STD)

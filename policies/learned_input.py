"""What the learned policy's network receives: level views of the world, and one of five navigation
commands, computed from the shape of the route ahead.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import RIG_FROM_LEVEL_CAMERA, heading_of, intrinsics, wrap_angle
from alpasim_plugin.core.types import F64, U8, CameraSpec, Scenario
from policies.base import front_camera

Command = Literal["keep", "left-ahead", "left-now", "right-ahead", "right-now"]
COMMANDS: tuple[Command, ...] = get_args(Command)

TURN_RADIUS_M = 28.0  # tighter curves are turns and are announced; wider ones belong to the road
AHEAD_M = 40.0
NOW_M = 6.0

SIDE_DEG = 25.0  # a camera's axis and the middle of a side view are no farther apart
CHANNELS = 4  # red, green, blue now; brightness of an earlier frame


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
    heading = heading_of(step)
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


@dataclass(frozen=True)
class View:
    """A level image that is cut from a camera's frame.

    Attributes:
        name: Of the view.
        yaw_deg: Direction of its middle column, from the rig's x axis to the left.
        width, height: Pixels.
        focal_px: Focal length.
        horizon_row: Row of the horizon.
    """

    name: str
    yaw_deg: float
    width: int
    height: int
    focal_px: float
    horizon_row: float

    @property
    def K(self) -> F64:
        """Intrinsics ``(3, 3)``."""
        f = self.focal_px
        return intrinsics(f, f, self.width / 2, self.horizon_row)


FRONT = View("front", 0.0, 192, 80, 125.0, 18.0)  # 75 degrees across
SIDES = (
    View("left", 60.0, 160, 32, 104.3, 10.0),
    View("right", -60.0, 160, 32, 104.3, 10.0),
)


def view_camera(scenario: Scenario, view: View) -> CameraSpec:
    """Return the camera that a view is cut from: `front_camera`, or for a view to the side the
    pinhole whose axis is nearest to the view's.

    Raises:
        InputError: No pinhole looks there.
    """
    if view.yaw_deg == 0.0:
        return front_camera(scenario)
    yaw_rad = np.deg2rad(view.yaw_deg)
    middle = np.array([np.cos(yaw_rad), np.sin(yaw_rad), 0.0])
    pinholes = [camera for camera in scenario.cameras if camera.lens is None]
    nearness = {camera.name: float(camera.T_rig_camera[:3, 2] @ middle) for camera in pinholes}
    for camera in sorted(pinholes, key=lambda pinhole: (-nearness[pinhole.name], pinhole.name)):
        if nearness[camera.name] > np.cos(np.deg2rad(SIDE_DEG)):
            return camera
    raise InputError(
        f"scene {scenario.scene_id!r}: no pinhole for the view {view.name!r}, {view.yaw_deg:g} degrees from ahead, among its cameras {', '.join(camera.name for camera in scenario.cameras)}",
        f"Add a camera with `yaw_deg: {view.yaw_deg:g}` to `cameras`, use `cameras: {{rig: surround-6}}`, or choose another policy.",
    )


def view_homography(camera: CameraSpec, yaw_rad: float = 0.0, view: View = FRONT) -> F64:
    """Return the homography ``(3, 3)`` from pixels of the view to pixels of the camera.

    The view is level, rotated to the left by a further ``yaw_rad``, at the camera's position: a
    pure rotation, so no depth is needed.
    """
    yaw_rad = yaw_rad + np.deg2rad(view.yaw_deg)
    c = np.cos(yaw_rad)
    s = np.sin(yaw_rad)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    rotation = camera.T_rig_camera[:3, :3].T @ turn @ RIG_FROM_LEVEL_CAMERA
    return camera.K @ rotation @ np.linalg.inv(view.K)


def level_view(rgb: U8, camera: CameraSpec, yaw_rad: float = 0.0, view: View = FRONT) -> U8:
    """Return the view of a frame ``(H, W, 3)``, of the view's size; borders are replicated.

    Frames of higher angular resolution are area-averaged first.
    """
    size, to_camera = sampled_at(camera, view, yaw_rad)
    if size != (camera.width, camera.height):
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    size = (view.width, view.height)
    return cv2.warpPerspective(rgb, to_camera, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)


def sampled_at(camera: CameraSpec, view: View, yaw_rad: float = 0.0) -> tuple[tuple[int, int], F64]:
    """Return the width and height to which a camera's frames are reduced, and the homography from
    pixels of the view to pixels of that size.
    """
    size = camera.width, camera.height
    to_camera = view_homography(camera, yaw_rad, view)
    shrink = int(camera.K[0, 0] / view.focal_px)
    if shrink <= 1:
        return size, to_camera
    smaller = camera.width // shrink, camera.height // shrink
    scale = np.diag([smaller[0] / camera.width, smaller[1] / camera.height, 1.0])
    # Pixel centres lie at halves.
    centre = intrinsics(1.0, 1.0, 0.5, 0.5)
    return smaller, np.linalg.inv(centre) @ scale @ centre @ to_camera

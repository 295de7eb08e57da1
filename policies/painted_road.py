"""A painted road seen through a pinhole camera, by casting every pixel onto the ground plane.

It needs no renderer, so a policy can be checked without a scene.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from alpasim_plugin.core.geometry import intrinsics, rigid, se2
from alpasim_plugin.core.types import F32, F64, U8, CameraSpec

Colour = tuple[int, int, int]
WHITE = (235, 235, 235)
YELLOW = (230, 190, 60)
ASPHALT = (95, 95, 98)
GRASS = (80, 110, 60)
SKY = (170, 195, 225)
LINE_WIDTH_M = 0.15
DASH_M = 3.0
PERIOD_M = 9.0
NOISE = 4.0  # grey levels
SUPERSAMPLE = 2
MOST_PX = 640


def pinhole_camera(
    name: str = "front",
    width: int = 256,
    height: int = 144,
    hfov_deg: float = 70.0,
    mount_m: tuple[float, float, float] = (1.6, 0.0, 1.5),
    pitch_deg: float = 0.0,
    yaw_deg: float = 0.0,
) -> CameraSpec:
    """Return a camera that looks along the rig's x axis, turned to the left by ``yaw_deg``; a
    positive pitch looks down.
    """
    f = width / 2 / np.tan(np.radians(hfov_deg) / 2)
    K = intrinsics(f, f, width / 2, height / 2)
    pitch = np.radians(pitch_deg)
    yaw = np.radians(yaw_deg)
    c = np.cos(yaw)
    s = np.sin(yaw)
    forward = np.array([np.cos(pitch) * c, np.cos(pitch) * s, -np.sin(pitch)])
    right = np.array([s, -c, 0.0])
    T = rigid(np.stack([right, np.cross(forward, right), forward], axis=1), mount_m)
    return CameraSpec(name, width, height, K, T)


@dataclass(frozen=True)
class Line:
    """A painted line at ``offset_m`` to the left of the ego lane's centre."""

    offset_m: float
    dashed: bool = False
    colour: Colour = WHITE


@dataclass(frozen=True)
class PaintedRoad:
    """A road of constant curvature through the world's origin, where its ego lane runs along x;
    grass and sky around it.
    """

    curvature_1pm: float = 0.0  # left positive
    lines: tuple[Line, ...] = (Line(1.75, dashed=True), Line(-1.75), Line(5.25, colour=YELLOW))
    road_m: tuple[float, float] = (-3.0, 6.5)

    def pose(self, s_m: float, offset_m: float = 0.0, yaw_rad: float = 0.0) -> F64:
        """Return the pose ``(4, 4)`` at arc length s of the ego lane, ``offset_m`` to its left and
        turned by ``yaw_rad`` from it.
        """
        k = self.curvature_1pm
        angle = k * s_m
        x = s_m if k == 0 else float(np.sin(angle)) / k
        y = 0.0 if k == 0 else (1 - float(np.cos(angle))) / k
        return se2(
            x - offset_m * float(np.sin(angle)),
            y + offset_m * float(np.cos(angle)),
            angle + yaw_rad,
        )

    def coordinates(self, x_m: F64, y_m: F64) -> tuple[F64, F64]:
        """Return arc length and offset to the left of world points."""
        k = self.curvature_1pm
        if k == 0:
            return x_m, y_m
        sign = float(np.sign(k))
        radius = np.hypot(x_m, y_m - 1 / k)
        angle = np.arctan2(x_m * sign, (1 / k - y_m) * sign)
        return angle / k * sign, sign * (abs(1 / k) - radius)

    def image(self, camera: CameraSpec, T_world_rig: F64, seed: int = 0) -> U8:
        """Draw the road ``(H, W, 3)`` as the camera sees it from a rig pose."""
        painted = self.painted(camera, T_world_rig @ camera.T_rig_camera)
        small = cv2.resize(painted, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        noise = np.random.Generator(np.random.Philox(key=seed)).normal(0.0, NOISE, small.shape)
        return np.clip(small + noise, 0, 255).astype(np.uint8)

    def painted(self, camera: CameraSpec, T: F64) -> F32:
        """Draw the road at `SUPERSAMPLE` times the camera's size, or at `MOST_PX` columns, seen
        from the pose ``(4, 4)``.
        """
        K = camera.K
        rotation = T[:3, :3]
        scale = min(SUPERSAMPLE, MOST_PX / camera.width)
        u = (np.arange(round(camera.width * scale)) + 0.5) / scale
        v = (np.arange(round(camera.height * scale)) + 0.5) / scale
        # A ray is linear in the pixel: one outer sum per axis.
        across = (u - K[0, 2]) / K[0, 0]
        down = (v - K[1, 2]) / K[1, 1]
        ray = [
            rotation[i, 0] * across[None, :] + (rotation[i, 1] * down + rotation[i, 2])[:, None]
            for i in range(3)
        ]
        image = np.empty((len(v), len(u), 3), dtype=np.float32)
        image[:] = SKY
        ground = ray[2] < -T[2, 3] / 400.0
        depth = -T[2, 3] / ray[2][ground]
        s, offset = self.coordinates(
            T[0, 3] + depth * ray[0][ground], T[1, 3] + depth * ray[1][ground]
        )
        image[ground] = self.colours(s, offset)
        return image

    def colours(self, s_m: F64, offset_m: F64) -> F32:
        """Return the colours ``(N, 3)`` of ground points in road coordinates."""
        # Numbers of mark_types are drawn, a quarter of the bytes of colours.
        mark_types: list[Colour] = [GRASS, ASPHALT]
        on_road = (offset_m > self.road_m[0]) & (offset_m < self.road_m[1])
        index = on_road.astype(np.uint8)
        for line in self.lines:
            paint = on_road & (np.abs(offset_m - line.offset_m) < LINE_WIDTH_M / 2)
            if line.dashed:
                paint[paint] = np.mod(s_m[paint], PERIOD_M) < DASH_M
            index[paint] = len(mark_types)
            mark_types.append(line.colour)
        return np.array(mark_types, dtype=np.float32)[index]

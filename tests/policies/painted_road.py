"""A painted road seen through a pinhole camera, by casting every pixel onto the ground: independent of the project's renderers."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from alpasim_plugin.geometry import inverse, se2
from alpasim_plugin.types import CameraSpec


def front_camera(width: int = 256, height: int = 144, hfov_deg: float = 70.0, mount=(1.6, 0.0, 1.5), pitch_deg: float = 0.0) -> CameraSpec:
    """Make a front camera; positive pitch looks down."""
    f = width / 2 / np.tan(np.radians(hfov_deg) / 2)
    K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1.0]])
    p = np.radians(pitch_deg)
    forward = np.array([np.cos(p), 0, -np.sin(p)])
    right = np.array([0, -1.0, 0])
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = mount
    return CameraSpec("front", width, height, K, T)


@dataclass(frozen=True)
class PaintedRoad:
    """A road of constant curvature that starts at the world origin along x; the ego lane's centre is the x axis there.

    ``lines``: (offset to the left in metres, "solid" | "dashed", colour). ``boxes``: (s, offset, length, width, height, colour).
    """

    curvature: float = 0.0
    lines: tuple[tuple[float, str, tuple[int, int, int]], ...] = (
        (1.75, "dashed", (235, 235, 235)),
        (-1.75, "solid", (235, 235, 235)),
        (5.25, "solid", (230, 190, 60)),
    )
    road: tuple[float, float] = (-3.0, 6.5)
    asphalt: tuple[int, int, int] = (95, 95, 98)
    grass: tuple[int, int, int] = (80, 110, 60)
    sky: tuple[int, int, int] = (170, 195, 225)
    boxes: tuple[tuple[float, float, float, float, float, tuple[int, int, int]], ...] = ()
    noise: float = 4.0
    line_width: float = 0.15
    extra: tuple = field(default=())

    def pose(self, s: float, offset: float = 0.0, yaw: float = 0.0) -> np.ndarray:
        """Return T_world_rig at arc length s, ``offset`` to the left and ``yaw`` off the lane's direction."""
        k = self.curvature
        a = k * s
        x = s if k == 0 else np.sin(a) / k
        y = 0.0 if k == 0 else (1 - np.cos(a)) / k
        return se2(x - offset * np.sin(a), y + offset * np.cos(a), a + yaw)

    def road_coordinates(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        k = self.curvature
        if k == 0:
            return x, y
        r = 1 / k
        radius = np.hypot(x, y - r)
        return np.arctan2(x * np.sign(k), (r - y) * np.sign(k)) / abs(k), np.sign(k) * (abs(r) - radius)

    def image(self, camera: CameraSpec, T_world_rig: np.ndarray, seed: int = 0, supersample: int = 3) -> np.ndarray:
        """Render ``(H, W, 3)`` uint8."""
        h, w, n = camera.height * supersample, camera.width * supersample, supersample
        T = T_world_rig @ camera.T_rig_camera
        u, v = np.meshgrid((np.arange(w) + 0.5) / n, (np.arange(h) + 0.5) / n)
        rays = np.stack([(u - camera.K[0, 2]) / camera.K[0, 0], (v - camera.K[1, 2]) / camera.K[1, 1], np.ones_like(u)], -1) @ T[:3, :3].T
        depth = np.where(rays[..., 2] < -1e-6, -T[2, 3] / np.minimum(rays[..., 2], -1e-6), np.inf)
        ground = np.isfinite(depth) & (depth < 400)
        x = np.where(ground, T[0, 3] + depth * rays[..., 0], 0)
        y = np.where(ground, T[1, 3] + depth * rays[..., 1], 0)
        s, off = self.road_coordinates(x, y)
        img = np.empty((h, w, 3), np.float32)
        img[:] = self.sky
        img[ground] = self.grass
        on_road = ground & (off > self.road[0]) & (off < self.road[1])
        img[on_road] = self.asphalt
        for offset, style, colour in self.lines:
            paint = on_road & (np.abs(off - offset) < self.line_width / 2)
            if style == "dashed":
                paint &= np.mod(s, 9.0) < 3.0
            img[paint] = colour
        for s0, s1, o0, o1, colour in self.extra:
            img[on_road & (s > s0) & (s < s1) & (off > o0) & (off < o1)] = colour
        for box in sorted(self.boxes, key=lambda b: -b[0]):
            self._draw_box(img, camera, T, box, n)
        img = cv2.resize(img, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        img = img + np.random.default_rng(seed).normal(0, self.noise, img.shape)
        return np.clip(img, 0, 255).astype(np.uint8)

    def _draw_box(self, img, camera, T_world_camera, box, n) -> None:
        s, offset, length, width, height, colour = box
        centre = self.pose(s, offset)
        corners = np.array([[sx * length / 2, sy * width / 2, z, 1] for sx in (-1, 1) for sy in (-1, 1) for z in (0.0, height)])
        cam = (inverse(T_world_camera) @ centre @ corners.T).T[:, :3]
        cam[:, 2] = np.maximum(cam[:, 2], 0.1)
        uv = (camera.K @ (cam / cam[:, 2:]).T).T[:, :2] * n
        hull = cv2.convexHull(uv.astype(np.float32)).astype(np.int32)
        cv2.fillConvexPoly(img, hull, tuple(float(c) for c in colour))
        rear = [i for i in range(8) if i < 4]  # sx = -1: the face towards the ego
        face = cv2.convexHull(uv[rear].astype(np.float32)).astype(np.int32)
        cv2.fillConvexPoly(img, face, tuple(float(c) * 0.8 for c in colour))
        low = uv[[0, 2]]
        cv2.line(img, tuple(map(int, low[0])), tuple(map(int, low[1])), (20.0, 20.0, 20.0), max(1, n))

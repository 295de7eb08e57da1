"""A painted road with flat patches and with cuboids on it."""

from dataclasses import dataclass

import cv2
import numpy as np

from alpasim_plugin.core.geometry import inverse
from policies.painted_road import SUPERSAMPLE, Colour, PaintedRoad


@dataclass(frozen=True)
class Patch:
    """A flat patch of another colour, such as a crosswalk or a stain."""

    s_m: tuple[float, float]
    offset_m: tuple[float, float]
    colour: Colour


@dataclass(frozen=True)
class Block:
    """A cuboid on the road; its face towards the ego is darker and stands on a dark edge, as cars
    do.
    """

    s_m: float  # of its centre
    offset_m: float = 0.0
    size_m: tuple[float, float, float] = (4.5, 1.8, 1.5)  # length, width, height
    colour: Colour = (150, 30, 30)


@dataclass(frozen=True)
class BusyRoad(PaintedRoad):
    """A painted road with things on it."""

    patches: tuple[Patch, ...] = ()
    blocks: tuple[Block, ...] = ()

    def colours(self, s_m, offset_m):
        out = super().colours(s_m, offset_m)
        on_road = (offset_m > self.road_m[0]) & (offset_m < self.road_m[1])
        for patch in self.patches:
            inside = (
                (s_m > patch.s_m[0])
                & (s_m < patch.s_m[1])
                & (offset_m > patch.offset_m[0])
                & (offset_m < patch.offset_m[1])
            )
            out[on_road & inside] = patch.colour
        return out

    def painted(self, camera, T):
        image = super().painted(camera, T)
        for block in sorted(self.blocks, key=lambda b: -b.s_m):
            self._draw(image, camera.K, T, block)
        return image

    def _draw(self, image, K, T_world_camera, block):
        length, width, height = block.size_m
        ends = [
            (sx * length / 2, sy * width / 2, z, 1.0)
            for sx in (-1, 1)
            for z in (0.0, height)
            for sy in (-1, 1)
        ]
        T = inverse(T_world_camera) @ self.pose(block.s_m, block.offset_m)
        corners = (T @ np.array(ends).T).T[:, :3]
        if (corners[:, 2] < 0.2).all():
            return
        corners[:, 2] = np.maximum(corners[:, 2], 0.2)
        uv = ((corners / corners[:, 2:]) @ K.T)[:, :2] * SUPERSAMPLE
        shades = ((uv, 1.0), (uv[:4], 0.8))  # the whole outline, then the face towards the ego
        for points, shade in shades:
            hull = cv2.convexHull(points.astype(np.float32)).astype(np.int32)
            cv2.fillConvexPoly(image, hull, tuple(shade * c for c in block.colour))
        foot = [tuple(int(c) for c in uv[i]) for i in (0, 1)]
        cv2.line(image, foot[0], foot[1], (20.0, 20.0, 20.0), SUPERSAMPLE)

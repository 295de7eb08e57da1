"""What shines in a scene: street lamps, lit windows, lamps of road users and of traffic lights.

A lamp lights what is around it by its intensity over the square of the distance; it casts no
shadow. What is seen of it is a spot of one colour, which depth hides.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np

from alpasim_plugin.cameras.lens import focal_px_of
from alpasim_plugin.core.types import F32, F64, CameraSpec, Scenario
from alpasim_plugin.renderers.view import View, depths_of, shown_at
from alpasim_plugin.streets.build_facades import lit_windows, place_houses
from alpasim_plugin.streets.build_street import lamp_posts
from alpasim_plugin.streets.site import make_site, path_of, section_of
from alpasim_plugin.world.ground import BUILT_WHOLE_M, height_at

SIGHT_M = 150.0
NEAREST_M = 0.3
STREET_CD = 1000.0
HEAD_CD = 20_000.0  # both low beams of a vehicle
# Tangents: where a beam has fallen to 1/e sideways and below, its upper edge (ECE R112), and how
# soft that is.
BEAM_WIDTH = 0.25
BEAM_DEPTH = 0.08
CUT_OFF = -0.01
EDGE = 0.015
ABOVE_CUT_OFF = 0.01
LAMP_HEIGHT_M = 0.65
WITH_LAMPS = ("car", "truck", "bus", "motorcycle")
# Linear, white is 1: lamps are brighter, which their glow and their reflections show.
WINDOW_RGB = (0.8, 0.52, 0.25)
STREET_RGB = (6.0, 5.2, 4.0)
HEAD_RGB = (8.0, 8.0, 7.4)
TAIL_RGB = (1.5, 0.03, 0.02)
SIGNAL_RGB = {"red": (2.0, 0.04, 0.02), "yellow": (2.0, 1.0, 0.0), "green": (0.0, 1.8, 0.7)}
DARK_RGB = (0.01, 0.01, 0.01)
SIGNAL_STEP_M = 0.35  # between the lamps of a traffic light
SUBPIXEL_BITS = 4  # sixteenths


@dataclass(frozen=True, eq=False)
class Spot:
    """A square that shines to one side, ``facing (3,)``, or to all sides if that is 0."""

    middle: F64  # (3,) metres, world
    facing: F64
    half_m: float
    rgb: tuple[float, float, float]


class SceneLights:
    """The lamps of a scene at night; by day, traffic lights alone shine.

    Of a scene whose street was not built, lamps and windows are not known.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.signals = [s for s in scenario.lane_map.signals or () if s.head is not None]
        self.is_night = scenario.environment.time == "night"
        self.tips = np.zeros((0, 3))
        self.windows: list[Spot] = []
        if self.is_night and scenario.model is None and scenario.background is None:
            metres = len(path_of(scenario))
            last = int(section_of(np.array(metres - 1)))
            tips = []
            for section in range(last + 1) if metres > BUILT_WHOLE_M else (None,):
                site = make_site(scenario, partial(height_at, scenario.ground), section)
                houses = place_houses(site)
                posts = lamp_posts(site, houses)
                tips.append(posts.tip[site.owns(posts.plan)])
                half_m, places, facing = lit_windows(site, houses)
                self.windows += [
                    Spot(*actor, half_m, WINDOW_RGB) for actor in zip(places, facing, strict=True)
                ]
            self.tips = np.concatenate(tips)
        driven = [
            actor for actor in scenario.actors if actor.label in WITH_LAMPS and not actor.is_static
        ]
        self.boxes = {actor.actor_id: actor.box for actor in driven}
        self.ego_front_m = (
            scenario.vehicle.rear_axle_to_centre_m + scenario.vehicle.box.length_m / 2
        )

    def lux(self, view: View, T_world_rig: F64) -> F32:
        """Return the light ``(H, W)``, lux, that street lamps and the ego's beams throw on what a
        camera sees.
        """
        total = np.zeros(view.ground.shape, dtype=np.float32)
        is_surface = np.isfinite(view.distance_m)
        points = view.points[is_surface]
        beam = view.place - _moved(T_world_rig, self.ego_front_m, LAMP_HEIGHT_M)[:3, 3]
        from_lamp = points + beam
        local = from_lamp @ T_world_rig[:3, :3]
        ahead = np.maximum(local[:, 0], NEAREST_M)
        sideways = local[:, 1] / ahead
        upwards = local[:, 2] / ahead
        below = np.exp(-((upwards / BEAM_DEPTH) ** 2))
        above = np.exp(-np.maximum(upwards - CUT_OFF, 0) / EDGE) + ABOVE_CUT_OFF
        shape = np.exp(-((sideways / BEAM_WIDTH) ** 2)) * np.minimum(below, above)
        distance = np.maximum(np.linalg.norm(local, axis=1), 1)
        aslant = 1 - view.ground[is_surface] * (1 - np.abs(from_lamp[:, 2]) / distance)
        lux = HEAD_CD * shape * aslant * (local[:, 0] > 0) / distance**2
        for tip in self.tips[np.linalg.norm(self.tips - view.place, axis=1) < SIGHT_M]:
            lux += _street_lux(points + (view.place - tip))
        total[is_surface] = lux
        return total

    def spots(self, actors: Mapping[str, F64], t_us: int) -> list[Spot]:
        """Return what is seen of the lamps but for windows, and of the dark lamps of traffic
        lights.
        """
        spots = []
        for signal in self.signals:
            facing = -np.array([np.cos(signal.heading_rad), np.sin(signal.heading_rad), 0.0])
            state = signal.colour_at(t_us).split("_")
            for row, (colour, rgb) in enumerate(SIGNAL_RGB.items()):
                middle = signal.head + np.array([0.0, 0.0, (1 - row) * SIGNAL_STEP_M])
                lamp_rgb = rgb if colour in state else DARK_RGB
                spots.append(Spot(middle, facing, SIGNAL_STEP_M / 2, lamp_rgb))
        if not self.is_night:
            return spots
        spots += [Spot(tip, np.zeros(3), 0.25, STREET_RGB) for tip in self.tips]
        for name, box in self.boxes.items():
            if name not in actors:
                continue
            T = actors[name]
            for end, rgb in ((1, HEAD_RGB), (-1, TAIL_RGB)):
                middle = _moved(T, end * box.length_m / 2, LAMP_HEIGHT_M - box.height_m / 2)[:3, 3]
                for lateral_m in (-0.36 * box.width_m, 0.36 * box.width_m):
                    spots.append(Spot(middle + lateral_m * T[:3, 1], end * T[:3, 0], 0.09, rgb))
        return spots


def _moved(T: F64, ahead_m: float, up_m: float) -> F64:
    """Return a pose farther ahead and up in its own frame."""
    moved = T.copy()
    moved[:3, 3] += ahead_m * T[:3, 0] + up_m * T[:3, 2]
    return moved


def _street_lux(from_lamp: F64) -> F64:
    """Return the light of a street lamp at points ``(N, 3)`` relative to it."""
    distance = np.linalg.norm(from_lamp, axis=1)
    return STREET_CD * np.maximum(-from_lamp[:, 2], 0) / np.maximum(distance, 0.1) ** 3


class Rectangle(NamedTuple):
    """Where a spot shows in an image: two corners, ``(x, y)`` in sixteenths of pixels from the middle
    of the first one, and its depth, metres.
    """

    spot: Spot
    low: list[int]
    high: list[int]
    depth_m: float


def in_image(spots: Sequence[Spot], camera: CameraSpec, T_world_camera: F64) -> list[Rectangle]:
    """Return the upright rectangles that spots are in an image, the farthest first.

    Args:
        spots: In any order.
        camera: Its size and lens.
        T_world_camera: ``(4, 4)`` its pose.
    """
    offsets = np.array([spot.middle for spot in spots]).reshape(-1, 3) - T_world_camera[:3, 3]
    local = offsets @ T_world_camera[:3, :3]
    distance = np.linalg.norm(offsets, axis=1)
    depths = depths_of(camera, local)
    pixels, can_be_seen = shown_at(camera, local)
    end = 16 * np.array([camera.width, camera.height])
    rectangles = []
    for i in np.argsort(-distance, kind="stable"):
        spot = spots[i]
        depth_m = float(depths[i])
        facing = -offsets[i] @ spot.facing / distance[i] if spot.facing.any() else 1.0
        if depth_m < NEAREST_M or distance[i] > SIGHT_M or facing <= 0 or not can_be_seen[i]:
            continue
        half = focal_px_of(camera)[0] * spot.half_m / depth_m * np.array([facing, 1.0])
        low, high = (np.rint(16 * (pixels[i] - 0.5 + side * half)).astype(int) for side in (-1, 1))
        if (high >= -16).all() and (low <= end).all():  # a pixel more, however corners are rounded
            rectangles.append(Rectangle(spot, low.tolist(), high.tolist(), depth_m))
    return rectangles


def drawn(spots: Sequence[Spot], view: View) -> tuple[F32, F32]:
    """Draw spots as upright rectangles, the nearest on top.

    Returns:
        Their colours ``(H, W, 3)``, and their depths ``(H, W)``, infinite where there is none.
    """
    height, width = view.depth_m.shape
    light = np.zeros((height, width, 3), dtype=np.float32)
    front = np.full((height, width), np.inf, dtype=np.float32)
    for spot, low, high, depth_m in in_image(spots, view.camera, view.T_world_camera):
        cv2.rectangle(light, low, high, spot.rgb, cv2.FILLED, cv2.LINE_8, SUBPIXEL_BITS)
        cv2.rectangle(front, low, high, depth_m, cv2.FILLED, cv2.LINE_8, SUBPIXEL_BITS)
    return light, front

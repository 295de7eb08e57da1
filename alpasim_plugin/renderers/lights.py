"""What shines in a scene: street lamps, lit windows, lamps of road users and of traffic lights.

A lamp lights what is around it by its intensity over the square of the distance; it casts no
shadow. What is seen of it is a panel, a small square of one colour that hides and is hidden by
depth.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from alpasim_plugin.core.types import F32, F64, Scenario, Signal
from alpasim_plugin.gaussians.scene.build_facades import lit_windows, place_houses
from alpasim_plugin.gaussians.scene.build_street import lamp_posts
from alpasim_plugin.gaussians.scene.site import make_site, path_of, section_of
from alpasim_plugin.renderers.view import View
from alpasim_plugin.world.ground import BUILT_WHOLE_M, height_at

SIGHT_M, BEAM_M = 150.0, 80.0
NEAREST_M = 0.3
STREET_CD = 1000.0
HEAD_CD = 20_000.0  # both low beams of a vehicle
# Tangents: where a beam has fallen to 1/e sideways and below, its upper edge (ECE R112), and how
# soft that is.
BEAM_WIDTH, BEAM_DEPTH, CUT_OFF, EDGE = 0.25, 0.08, -0.01, 0.015
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
SUBPIXEL_BITS = 4


@dataclass(frozen=True, eq=False)
class Panels:
    """Squares that shine: corners ``(N, 4, 3)``, metres, world, and linear colours ``(N, 3)``."""

    corners: F64
    rgb: F64

    @classmethod
    def facing(
        cls, middle: F64, half_m: float, rgb: tuple[float, float, float], eye: F64
    ) -> Panels:
        """Return upright squares that face a camera."""
        towards = eye - middle
        across = np.cross(towards, [0.0, 0.0, 1.0])
        across *= half_m / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
        up = np.array([0.0, 0.0, half_m])
        corners = np.stack([-across - up, across - up, across + up, -across + up], axis=1)
        return cls(middle[:, None] + corners, np.tile(rgb, (len(middle), 1)))

    @classmethod
    def joined(cls, parts: list[Panels]) -> Panels:
        """Return the panels of all parts."""
        none = cls(np.zeros((0, 4, 3)), np.zeros((0, 3)))
        together = [none, *parts]
        return cls(
            np.concatenate([one.corners for one in together]),
            np.concatenate([one.rgb for one in together]),
        )


class SceneLights:
    """The lamps of a scene.

    Args:
        scenario: A scene; of an imported drive, whose houses are not known, only road users and the
            ego shine.
        is_night: By day, traffic lights alone shine.
    """

    def __init__(self, scenario: Scenario, *, is_night: bool) -> None:
        self.scenario, self.is_night = scenario, is_night
        self.actors = {actor.actor_id: actor for actor in scenario.actors}
        self.street, self.windows = np.zeros((0, 3)), np.zeros((0, 4, 3))
        if is_night and scenario.model is None and scenario.background is None:
            self.street, self.windows = _roadside(scenario)
        vehicle = scenario.vehicle
        front_m = vehicle.rear_axle_to_centre_m + vehicle.box.length_m / 2
        self.T_rig_lamp = np.eye(4)
        self.T_rig_lamp[:3, 3] = front_m, 0.0, LAMP_HEIGHT_M

    def lux(self, view: View, T_world_rig: F64, actors: Mapping[str, F64]) -> F32:
        """Return the light ``(H, W)``, lux, that lamps throw on what a camera sees."""
        is_surface = np.isfinite(view.distance_m)
        points, ground = view.points[is_surface], view.ground[is_surface]
        lux = np.zeros(len(points), np.float32)
        for tip in _near(self.street, view.place):
            lux += _street_lux(points - (tip - view.place).astype(np.float32))
        beams = [T_world_rig @ self.T_rig_lamp]
        beams += [T @ self._T_box_lamp(name, 1) for name, T in self._lit(actors).items()]
        for T_world_lamp in beams:
            offset = T_world_lamp[:3, 3] - view.place
            if np.linalg.norm(offset) < SIGHT_M:
                from_lamp = points - offset.astype(np.float32)
                local = from_lamp @ T_world_lamp[:3, :3].astype(np.float32)
                lit = np.flatnonzero((local[:, 0] > NEAREST_M) & (local[:, 0] < BEAM_M))
                lux[lit] += _beam_lux(local[lit], from_lamp[lit, 2], ground[lit])
        total = np.zeros(is_surface.shape, np.float32)
        total[is_surface] = lux
        return total

    def panels(self, view: View, actors: Mapping[str, F64], t_us: int) -> Panels:
        """Return what is seen of the lamps."""
        signals = self._signals(view, t_us)
        if not self.is_night:
            return Panels.joined(signals)
        windows = self.windows[np.linalg.norm(self.windows[:, 0] - view.place, axis=1) < SIGHT_M]
        parts = [
            *signals,
            Panels(windows, np.tile(WINDOW_RGB, (len(windows), 1))),
            Panels.facing(_near(self.street, view.place), 0.25, STREET_RGB, view.place),
        ]
        for name, T in self._lit(actors).items():
            for end, rgb in ((1, HEAD_RGB), (-1, TAIL_RGB)):
                T_world_lamp = T @ self._T_box_lamp(name, end)
                if (view.place - T_world_lamp[:3, 3]) @ T_world_lamp[:3, 0] * end > 0:
                    aside = 0.36 * self.actors[name].box.width_m * T_world_lamp[:3, 1]
                    both = T_world_lamp[:3, 3] + np.stack([-aside, aside])
                    parts.append(Panels.facing(both, 0.09, rgb, view.place))
        return Panels.joined(parts)

    def _signals(self, view: View, t_us: int) -> list[Panels]:
        """Return the housings and the lit lamps of the traffic lights that face a camera."""
        parts: list[Panels] = []
        for signal in self.scenario.lane_map.signals or ():
            if signal.head is not None and np.linalg.norm(signal.head - view.place) < SIGHT_M:
                parts += _signal_panels(signal, signal.head, t_us, view.place)
        return parts

    def _lit(self, actors: Mapping[str, F64]) -> Mapping[str, F64]:
        """Return the poses of the road users whose lamps are on; who is parked has none."""
        return {
            name: T
            for name, T in actors.items()
            if name in self.actors
            and self.actors[name].label in WITH_LAMPS
            and not self.actors[name].is_static
        }

    def _T_box_lamp(self, name: str, end: int) -> F64:
        """Return the middle between the lamps at the front (1) or the rear (-1) of a vehicle."""
        box = self.actors[name].box
        T = np.eye(4)
        T[0, 3] = end * (box.length_m / 2 + 0.02)
        T[2, 3] = LAMP_HEIGHT_M - box.height_m / 2
        return T


def _roadside(scenario: Scenario) -> tuple[F64, F64]:
    """Return the street lamps ``(N, 3)`` and the lit windows ``(M, 4, 3)`` of a built scene."""
    metres = len(path_of(scenario))
    sections: list[int | None] = [None]
    if metres > BUILT_WHOLE_M:
        sections = list(range(int(section_of(np.array(metres - 1))) + 1))
    tips, windows = [], []
    for section in sections:
        site = make_site(scenario, partial(height_at, scenario.ground), section)
        houses = place_houses(site)
        posts = lamp_posts(site, houses)
        tips.append(posts.tip[site.owns(posts.plan)])
        windows.append(lit_windows(site, houses))
    return np.concatenate(tips), np.concatenate(windows)


def _near(points: F64, place: F64) -> F64:
    return points[np.linalg.norm(points - place, axis=1) < SIGHT_M]


def _street_lux(from_lamp: F32) -> F32:
    """Return the light of a street lamp at points ``(N, 3)`` relative to it."""
    square = np.einsum("ni,ni->n", from_lamp, from_lamp) + np.float32(1e-3)
    downward = np.maximum(-from_lamp[:, 2], 0) / np.sqrt(square)
    return np.float32(STREET_CD) * downward / square


def _beam_lux(local: F32, upwards_m: F32, ground: F32) -> F32:
    """Return the light of a vehicle's low beams; on the ground it falls aslant.

    Args:
        local: ``(N, 3)`` points in the lamp's frame, x ahead.
        upwards_m: ``(N,)`` their heights above the lamp, world.
        ground: ``(N,)`` how much they belong to the ground.
    """
    sideways, upwards = local[:, 1] / local[:, 0], local[:, 2] / local[:, 0]
    below = np.exp(-((upwards / BEAM_DEPTH) ** 2))
    above = np.exp(-np.maximum(upwards - CUT_OFF, 0) / EDGE) + ABOVE_CUT_OFF
    shape = np.exp(-((sideways / BEAM_WIDTH) ** 2)) * np.minimum(below, above)
    square = np.einsum("ni,ni->n", local, local)
    aslant = np.abs(upwards_m) / np.sqrt(square)
    return np.float32(HEAD_CD) * shape * (1 - ground * (1 - aslant)) / np.maximum(square, 1)


def _signal_panels(signal: Signal, head: F64, t_us: int, eye: F64) -> list[Panels]:
    facing = -np.array([np.cos(signal.heading_rad), np.sin(signal.heading_rad), 0.0])
    if (eye - head) @ facing <= 0:
        return []
    across = 0.2 * np.array([-facing[1], facing[0], 0.0])
    up = np.array([0.0, 0.0, 0.55])
    ring = head + np.stack([-across - up, across - up, across + up, -across + up])
    housing = Panels(ring[None], np.array([DARK_RGB]))
    lit = []
    for colour in signal.colour_at(t_us).split("_"):
        if colour in SIGNAL_RGB:
            above_m = {"red": 0.35, "yellow": 0.0, "green": -0.35}[colour]
            middle = head + 0.05 * facing + np.array([0.0, 0.0, above_m])
            lit.append(Panels.facing(middle[None], 0.14, SIGNAL_RGB[colour], eye))
    return [housing, *lit]


def drawn(panels: Panels, view: View) -> tuple[F32, F32]:
    """Draw panels, the nearest on top.

    Returns:
        Their colours ``(H, W, 3)``, and their depths ``(H, W)``, infinite where there is none.
    """
    shape = view.distance_m.shape
    light, front = np.zeros((*shape, 3), np.float32), np.full(shape, np.inf, np.float32)
    R = view.T_world_camera[:3, :3]
    local = (panels.corners - view.place) @ R  # (N, 4, 3) camera frame
    nearest = local[..., 2].min(axis=1)
    pixels = local @ view.K.T
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = pixels[..., :2] / pixels[..., 2:] - 0.5
    limit = 2.0 * max(shape)
    seen = (nearest > NEAREST_M) & (np.abs(pixels).max(axis=(1, 2), initial=0) < limit)
    for i in np.flatnonzero(seen)[np.argsort(-nearest[seen], kind="stable")]:
        ring = np.rint(pixels[i] * (1 << SUBPIXEL_BITS)).astype(np.int32)
        cv2.fillConvexPoly(light, ring, panels.rgb[i].tolist(), cv2.LINE_8, SUBPIXEL_BITS)
        cv2.fillConvexPoly(front, ring, float(nearest[i]), cv2.LINE_8, SUBPIXEL_BITS)
    return light, front

"""Twelve drivers with a fault each, to be named by the page of causes: `LaneCamera`, `Learned` or
`ByYellow` with one thing wrong.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from alpasim_plugin.core.geometry import yaw_of
from alpasim_plugin.core.types import Observation, Plan, Route, Scenario
from policies.lane_camera import LaneCamera
from policies.learned import Learned


def _shown(observation: Observation, change) -> Observation:  # type: ignore[no-untyped-def]
    return replace(
        observation,
        frames={name: replace(f, rgb=change(f.rgb)) for name, f in observation.frames.items()},
    )


def _wrong_camera(scenario: Scenario, change) -> Scenario:  # type: ignore[no-untyped-def]
    return replace(scenario, cameras=tuple(change(camera) for camera in scenario.cameras))


class SteeringSign(LaneCamera):
    """Left and right of the plan are exchanged."""

    def act(self, observation: Observation) -> Plan:
        plan = super().act(observation)
        return replace(plan, xy=plan.xy * [1.0, -1.0], yaw=-plan.yaw, samples=())


class Latency(LaneCamera):
    """Every picture is looked at 0.8 s late, as if it were new."""

    PERIODS = 8

    def reset(self, seed: int, route: Route) -> None:
        super().reset(seed, route)
        self.waiting: list[Observation] = []

    def act(self, observation: Observation) -> Plan:
        self.waiting = [*self.waiting, observation][-1 - self.PERIODS :]
        late = self.waiting[0]
        shown = {
            name: replace(f, t_us=observation.frames[name].t_us) for name, f in late.frames.items()
        }
        return super().act(replace(observation, frames=shown, route_rig=late.route_rig))


class ByYellow(LaneCamera):
    """Keeps right of the yellow line, which it finds by its colour some metres ahead."""

    AHEAD_M, BESIDE_M = 7.0, 1.8

    def act(self, observation: Observation) -> Plan:
        c = self.camera
        p = np.linalg.inv(c.T_rig_camera) @ [self.AHEAD_M, 0.0, 0.0, 1.0]
        row = round(float(c.K[1, 1] * p[1] / p[2] + c.K[1, 2]))
        red, _, blue = (
            observation.frames[c.name].rgb[row - 2 : row + 3].astype(float).mean(axis=0).T
        )
        columns = np.flatnonzero(red - blue > 45)
        left_m = (
            -(columns.mean() - c.K[0, 2]) * p[2] / c.K[0, 0] - self.BESIDE_M
            if len(columns)
            else 0.0
        )
        t = 1e-6 * 100_000 * np.arange(41)
        bend = 2 * left_m / self.AHEAD_M**2
        x = observation.ego.speed_mps * t
        return Plan(
            observation.t_us,
            observation.t_us + (1e6 * t).astype(np.int64),
            np.stack([x, bend * x**2 / 2], axis=1),
            bend * x,
        )


class SwappedChannels(ByYellow):
    """Red and blue are exchanged."""

    def act(self, observation: Observation) -> Plan:
        return super().act(_shown(observation, lambda rgb: rgb[..., ::-1].copy()))


class WrongFocalLength(ByYellow):
    """The focal length is believed to be 1.25 times what it is."""

    def __init__(self, scenario: Scenario) -> None:
        super().__init__(
            _wrong_camera(
                scenario,
                lambda c: replace(c, K=c.K * np.array([[1.25, 1, 1], [1, 1.25, 1], [1, 1, 1]])),
            )
        )


class FrozenFrame(LaneCamera):
    """After two seconds the same picture is looked at again and again."""

    def reset(self, seed: int, route: Route) -> None:
        super().reset(seed, route)
        self.queries, self.kept = 0, {}

    def act(self, observation: Observation) -> Plan:
        self.queries += 1
        if self.queries <= 20:
            self.kept = dict(observation.frames)
        frozen = {
            name: replace(self.kept[name], t_us=f.t_us) for name, f in observation.frames.items()
        }
        return super().act(
            replace(
                observation, frames=frozen, route_rig=np.full_like(observation.route_rig, np.nan)
            )
        )


class MirroredPicture(Learned):
    """The picture is mirrored."""

    def act(self, observation: Observation) -> Plan:
        return super().act(_shown(observation, lambda rgb: rgb[:, ::-1].copy()))


class WrongUnit(LaneCamera):
    """The speed is taken for km/h."""

    def act(self, observation: Observation) -> Plan:
        return super().act(
            replace(
                observation, ego=replace(observation.ego, speed_mps=observation.ego.speed_mps / 3.6)
            )
        )


class WorldAxes(LaneCamera):
    """The plan has the world's axes."""

    def act(self, observation: Observation) -> Plan:
        plan, yaw = super().act(observation), yaw_of(observation.ego.T_world_rig)
        c, s = np.cos(yaw), np.sin(yaw)
        return replace(
            plan, xy=plan.xy @ np.array([[c, s], [-s, c]]), yaw=plan.yaw + yaw, samples=()
        )


class WrongPitch(ByYellow):
    """The camera is believed to look six degrees further down than it does."""

    def __init__(self, scenario: Scenario) -> None:
        a = np.deg2rad(-6.0)
        pitch = np.array(
            [
                [1, 0, 0, 0],
                [0, np.cos(a), -np.sin(a), 0],
                [0, np.sin(a), np.cos(a), 0],
                [0, 0, 0, 1.0],
            ]
        )
        super().__init__(
            _wrong_camera(scenario, lambda c: replace(c, T_rig_camera=c.T_rig_camera @ pitch))
        )


class TimeStep(LaneCamera):
    """Poses are meant every 0.1 s and stamped every 0.2 s."""

    def act(self, observation: Observation) -> Plan:
        plan = super().act(observation)
        return replace(plan, times_us=plan.t_us + 2 * (plan.times_us - plan.t_us), samples=())


class Blind(LaneCamera):
    """No picture is looked at: the ego keeps its speed and goes straight."""

    def act(self, observation: Observation) -> Plan:
        plan = super().act(observation)
        x = observation.ego.speed_mps * 1e-6 * (plan.times_us - plan.t_us)
        return replace(plan, xy=np.stack([x, 0 * x], axis=1), yaw=0 * x, samples=())


class UpsideDown(Learned):
    """The picture stands on its head."""

    def act(self, observation: Observation) -> Plan:
        return super().act(_shown(observation, lambda rgb: cv2.flip(rgb, 0)))

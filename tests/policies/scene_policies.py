"""Policies that look up what their scenario holds: its recording, its map, its clock."""

from dataclasses import replace

import numpy as np

from alpasim_plugin.core.geometry import inverse, resample, transform_points
from alpasim_plugin.core.types import Plan
from policies.base import plan_times, seconds
from policies.simple import ConstantVelocity, LogReplay


class Replays(LogReplay):
    """The recording with the perfect controller."""


class FollowsRecording(LogReplay):
    """The recording with a vehicle model."""

    controller = "bicycle"


class FollowsMap(ConstantVelocity):
    """The centre of the nearest lane, at its own speed; the map is kept, and read in every query."""

    def __init__(self, scenario):
        self.scenario = scenario

    def act(self, observation):
        T = observation.ego.T_world_rig
        centres = [lane.centre for lane in self.scenario.lane_map.lanes.values()]
        gaps_m = [np.hypot(*(centre[:, :2] - T[:2, 3]).T).min() for centre in centres]
        ahead = transform_points(inverse(T), centres[int(np.argmin(gaps_m))])
        ahead = ahead[ahead[:, 0] > 1.0]
        line = np.concatenate(
            [np.zeros((1, 3)), ahead, ahead[-1:] + 200 * (ahead[-1:] - ahead[-2:-1])]
        )
        times = plan_times(observation.t_us)
        xy = resample(line, observation.ego.speed_mps * seconds(times))[:, :2]
        yaw = np.unwrap(np.arctan2(*np.gradient(xy, axis=0).T[::-1]))
        return Plan(observation.t_us, times, xy, yaw)


class CountsFromStart(ConstantVelocity):
    """Has a table of one row for every tenth of a second of the scenario."""

    def __init__(self, scenario):
        self.start_us = scenario.start_us
        self.rows = [1.0] * 60

    def act(self, observation):
        self.rows[(observation.t_us - self.start_us) // 100_000]
        return super().act(observation)


class SwapsAxes(LogReplay):
    """The recording with x and y in each other's place."""

    def act(self, observation):
        plan = super().act(observation)
        return replace(plan, xy=plan.xy[:, ::-1].copy())

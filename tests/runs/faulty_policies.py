"""Policies with one fault each: for the page of a failure, what must stand first on it, and for
scenes that say which faults they catch.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from alpasim_plugin.core.geometry import yaw_of
from alpasim_plugin.core.types import Plan, SensorSpec
from policies.base import follow, make_path, plan_times, route_points, seconds, smooth_line
from policies.lane_camera import LaneCamera
from policies.simple import PurePursuit


class Follower(PurePursuit):
    """Follows the route; looks at no image, though it receives one."""

    sensors: Sequence[SensorSpec] = (SensorSpec("front"),)

    def reset(self, seed, route):
        super().reset(seed, route)
        self.queries = 0

    def act(self, observation):
        self.queries += 1
        return self.spoil(super().act(observation), observation)

    def spoil(self, plan, observation):
        return plan


class WorldFrame(Follower):
    def spoil(self, plan, observation):
        T = observation.ego.T_world_rig
        return replace(plan, xy=plan.xy @ T[:2, :2].T + T[:2, 3], yaw=plan.yaw + yaw_of(T))


class WorldAxes(Follower):
    def spoil(self, plan, observation):
        T = observation.ego.T_world_rig
        return replace(plan, xy=plan.xy @ T[:2, :2].T, yaw=plan.yaw + yaw_of(T))


class NotANumber(Follower):
    """Divides by the yaw rate, which is zero on a straight."""

    def spoil(self, plan, observation):
        xy = plan.xy.copy()
        xy[5:] *= np.nan if self.queries > 20 else 1.0
        return replace(plan, xy=xy)


class RaisesInNumpy(Follower):
    def spoil(self, plan, observation):
        gaps = np.hypot(*plan.xy.T)[self.queries * 3 :]
        return replace(plan, debug={"nearest": np.argmin(gaps)})  # the line to name


class RaisesAtFrame30(Follower):
    def spoil(self, plan, observation):
        if self.queries == 30:
            raise RuntimeError("thirty")
        return plan


class TimeStep(Follower):
    def spoil(self, plan, observation):
        return replace(plan, times_us=plan.t_us + 2 * (plan.times_us - plan.t_us))


class SpeedDoubled(Follower):
    def spoil(self, plan, observation):
        return replace(plan, xy=2 * plan.xy)


class Centimetres(Follower):
    def spoil(self, plan, observation):
        return replace(plan, xy=100 * plan.xy)


class SwappedAxes(Follower):
    def spoil(self, plan, observation):
        return replace(plan, xy=plan.xy[:, ::-1].copy(), yaw=np.pi / 2 - plan.yaw)


class EmptyPlan(Follower):
    def spoil(self, plan, observation):
        return replace(plan, times_us=plan.times_us[:0], xy=plan.xy[:0], yaw=plan.yaw[:0])


class ConstantPlan(Follower):
    def spoil(self, plan, observation):
        x = 8.0e-6 * (plan.times_us - plan.t_us)
        return replace(plan, xy=np.stack([x, 0.02 * x], axis=1), yaw=0 * x + 0.02)


class Jitter(Follower):
    def spoil(self, plan, observation):
        side = np.random.Generator(np.random.Philox(self.queries)).choice([-14.0, 14.0])
        x = plan.xy[:, 0]
        y = plan.xy[:, 1] + side * np.minimum(x / 20.0, 1.0) ** 2
        yaw = np.arctan2(np.gradient(y), np.gradient(x)).astype(np.float64)
        return replace(plan, xy=np.stack([x, y], axis=1), yaw=yaw)


class OtherCamera(Follower):
    sensors: Sequence[SensorSpec] = (SensorSpec("rear"),)


class StopsForever(Follower):
    """Stops for something that it sees at once, and never goes on."""

    def spoil(self, plan, observation):
        reach_m = np.hypot(*plan.xy.T)
        room_m = observation.ego.speed_mps**2 / 6.0
        share = np.minimum(1.0, room_m / np.maximum(reach_m[-1], 0.1))
        t = np.linspace(0.0, 1.0, len(plan.xy))
        shape = (2 * t - t**2) * len(t)
        rows = np.interp(share * shape, np.arange(len(t)), np.arange(len(t)))
        xy = np.stack([np.interp(rows, np.arange(len(t)), plan.xy[:, k]) for k in (0, 1)], axis=1)
        return replace(plan, xy=xy)


class BlindToCars(Follower):
    """Has no fault but that it does not look."""


class NeverBrakes(PurePursuit):
    """Follows the route at the speed that it has at first, in bends as well."""

    def act(self, observation):
        times = plan_times(observation.t_us)
        speed_mps = observation.ego.speed_mps
        if self.cruise_mps is None:
            self.cruise_mps = speed_mps
        path = make_path(smooth_line(route_points(observation.route_rig)), speed_mps=speed_mps)
        xy, yaw = follow(path, self.cruise_mps * seconds(times), speed_mps)
        return Plan(observation.t_us, times, xy, yaw)


class SpeedInKmh(PurePursuit):
    """Takes its speed in km/h for m/s."""

    def act(self, observation):
        kmh = replace(observation.ego, speed_mps=3.6 * observation.ego.speed_mps)
        return super().act(replace(observation, ego=kmh))


class Looker(LaneCamera):
    """Looks at lane markings and cars."""

    def seen(self, observation):
        return observation

    def act(self, observation):
        return super().act(self.seen(observation))


def changed(observation, change):
    """Return an observation with changed images."""
    frames = {
        name: replace(frame, rgb=change(frame.rgb)) for name, frame in observation.frames.items()
    }
    return replace(observation, frames=frames)


class MirroredImages(Looker):
    def seen(self, observation):
        return changed(observation, lambda rgb: rgb[:, ::-1].copy())


class IgnoresRoute(Looker):
    def seen(self, observation):
        return replace(observation, route_rig=np.full_like(observation.route_rig, np.nan))


class LateFrames(Looker):
    """Looks at images of 0.8 s ago as if they were new."""

    def reset(self, seed, route):
        super().reset(seed, route)
        self.waiting = []

    def seen(self, observation):
        self.waiting = [*self.waiting, observation][-9:]
        frames = {
            name: replace(frame, t_us=observation.frames[name].t_us)
            for name, frame in self.waiting[0].frames.items()
        }
        return replace(observation, frames=frames)


class LateImages(LateFrames):
    """Looks at them alone: it has no route."""

    def seen(self, observation):
        route = np.full_like(observation.route_rig, np.nan)
        return replace(super().seen(observation), route_rig=route)


class BlackImages(Looker):
    """Has a camera that gives black images."""

    def seen(self, observation):
        return changed(observation, np.zeros_like)


class BrakesLate(Looker):
    """Believes what is ahead to be twice as far away."""

    def _obstacle_now(self, observation):
        track = super()._obstacle_now(observation)
        return None if track is None else replace(track, distance_m=3.0 * track.distance_m + 10.0)


class ByYellow(Looker):
    """Keeps right of the yellow line, which it finds by its colour some metres ahead."""

    AHEAD_M = 7.0
    BESIDE_M = 1.8

    def __init__(self, scenario):
        super().__init__(scenario)

    def act(self, observation):
        c = self.camera
        p = np.linalg.inv(c.T_rig_camera) @ [self.AHEAD_M, 0.0, 0.0, 1.0]
        row = round(float(c.K[1, 1] * p[1] / p[2] + c.K[1, 2]))
        rows = self.seen(observation).frames[c.name].rgb[row - 2 : row + 3].astype(float)
        red, _, blue = rows.mean(axis=0).T
        columns = np.flatnonzero(red - blue > 45)
        left_m = 0.0
        if len(columns):
            left_m = -(columns.mean() - c.K[0, 2]) * p[2] / c.K[0, 0] - self.BESIDE_M
        t = 0.1 * np.arange(41)
        bend = 2 * left_m / self.AHEAD_M**2
        x = observation.ego.speed_mps * t
        times = observation.t_us + (1e6 * t).astype(np.int64)
        return Plan(
            observation.t_us, times, np.stack([x, bend * x**2 / 2], axis=1), np.asarray(bend * x)
        )


class SwappedChannels(ByYellow):
    def seen(self, observation):
        return changed(observation, lambda rgb: rgb[..., ::-1].copy())


# Scenario -> policy -> a word of the sentence that must stand first
FAULTS = {
    "bend": {
        WorldFrame: "not the world's",
        WorldAxes: "in the rig frame x is forward",
        NotANumber: "not finite",
        RaisesInNumpy: "faulty_policies.py:",
        RaisesAtFrame30: "faulty_policies.py:",
        TimeStep: "off by 0.5",
        SpeedDoubled: "off by 2",
        Centimetres: "centimetres",
        SwappedAxes: "in the rig frame x is forward",
        EmptyPlan: "(0, 2)",
        ConstantPlan: "lead straight on",
        Jitter: "from query to query",
        StopsForever: "where the recording drives",
    },
    "hard/hard_brake": {
        BlindToCars: "no plan brakes",
        BrakesLate: "leads into the car ahead (`leader`)",
    },
    "smoke/curve": {
        MirroredImages: "read mirrored",
        LateImages: "queries late",
        SwappedChannels: "red and blue",
    },
    "urban/junction_right": {IgnoresRoute: "of a right-hand bend"},
}
# Words that name a cause: beside a fault of another kind they are false.
CAUSES = (
    "world coordinates",
    "world's axes",
    "mirrored",
    "exchanged",
    "off by",
    "looks like",
    "sideways",
    "backwards",
    "late",
)

"""Twenty policies with one fault each, the scenes they fail in, and the cause that would be right:
what the page of a failure is judged by. They are no copies of `tests.runs.faulty_policies`.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from alpasim_plugin.core.types import Plan, SensorSpec
from policies.base import (
    follow,
    make_path,
    plan_times,
    route_points,
    seconds,
    smooth_line,
    speed_profile,
)
from policies.simple import PurePursuit
from tests.runs.faulty_policies import Follower, Looker, changed
from tests.runs.grey_renderer import GREY

HERE = "tests.pages.cause_policies"
BARE = """
environment: {{buildings: 0, trees_per_100m: 0, poles_spacing_m: 0{weather}}}
cameras: [{{width: 128, height: 72}}]
timing: {{duration_us: {duration_us}}}
"""


def scene(road, ego, actors="", weather="", duration_us=7_000_000):
    """Return the text of a scenario without surroundings."""
    text = f"version: 1\ndescription: A place.\nroad: {road}\nego: {ego}\n"
    text += f"actors: {actors}\n" if actors else ""
    return text + BARE.format(weather=weather, duration_us=duration_us)


def bend(curvature_1pm, lane="", weather=""):
    """Return a bend after 25 m of straight road, at 8 m/s."""
    arc = f"{{kind: arc, length_m: 50, curvature_per_m: {curvature_1pm}}}"
    end = "{kind: straight, length_m: 40}"
    road = f"{{{lane}segments: [{{kind: straight, length_m: 25}}, {arc}, {end}]}}"
    ego = "{speed_mps: 8, cruise_mps: 8, max_lateral_accel_mps2: 4}"
    return scene(road, ego, weather=weather)


STRAIGHT = "{segments: [{kind: straight, length_m: 220}]}"
TEN = "{speed_mps: 10, cruise_mps: 10}"
SCENES = {
    "left": bend(0.04),
    "right": bend(-0.04),
    "left-rain": bend(0.04, weather=", rain: 30"),
    "straight": scene(STRAIGHT, TEN),
    "straight-night": scene(STRAIGHT, TEN, weather=", time: night"),
    "oncoming": scene(STRAIGHT, TEN, "[{kind: oncoming, id: oncoming, s_m: 120, speed_mps: 10}]"),
    "two-lanes": scene(
        "{lanes_forward: 2, segments: [{kind: straight, length_m: 220}]}",
        "{lane: 1, speed_mps: 10, cruise_mps: 10}",
        "[{kind: drive, id: beside, lane: 0, s_m: 10, speeds: [[0, 10], [9, 10]]}]",
    ),
}


class AtSpeed(Follower):
    """Follows the route at the speed that it wishes for, also in bends."""

    def wish_mps(self, observation):
        raise NotImplementedError

    def act(self, observation):
        self.queries += 1
        if self.cruise_mps is None:
            self.cruise_mps = self.wish_mps(observation)
        times = plan_times(observation.t_us)
        speed_mps = max(observation.ego.speed_mps, 0.0)
        path = make_path(smooth_line(route_points(observation.route_rig)), speed_mps=speed_mps)
        limits = np.full(len(path.xy), self.cruise_mps)
        xy, yaw = follow(path, speed_profile(speed_mps, limits, seconds(times)), speed_mps)
        return Plan(observation.t_us, times, xy, yaw)


class MphAsMps(AtSpeed):
    """Drives the number of its miles per hour in metres per second."""

    def wish_mps(self, observation):
        return 2.237 * observation.ego.speed_mps


class FullThrottle(AtSpeed):
    """Asks for the greatest speed that it has learnt, wherever it is."""

    def wish_mps(self, observation):
        return 22.0


class MpsAsKmh(AtSpeed):
    """Divides its speed by 3.6 once too often and crawls."""

    def wish_mps(self, observation):
        return observation.ego.speed_mps / 3.6


class KeepsSpeedInTurn(AtSpeed):
    """Does not slow down for the turn at a junction."""

    def wish_mps(self, observation):
        return observation.ego.speed_mps


class HalfGainLeft(Follower):
    """Steers half as much as it should, to the left alone."""

    def spoil(self, plan, observation):
        half = np.where(plan.xy[:, 1] > 0.0, 0.5, 1.0)
        yaw = np.where(plan.yaw > 0.0, 0.5, 1.0) * plan.yaw
        return replace(plan, xy=plan.xy * np.stack([0 * half + 1, half], axis=1), yaw=yaw)


class SteeringOffset(Follower):
    """Its zero of the steering angle lies to the left."""

    def spoil(self, plan, observation):
        x = plan.xy[:, 0]
        near = np.minimum(x, 12.0)
        y = plan.xy[:, 1] + 0.03 * near * (x - near / 2)
        return replace(plan, xy=np.stack([x, y], axis=1), yaw=plan.yaw + 0.03 * near)


class CutsCorners(Follower):
    """Drives straight to the point of the route that is 25 m ahead."""

    def spoil(self, plan, observation):
        route = observation.route_rig[np.isfinite(observation.route_rig[:, 0]), :2]
        goal = route[min(6, len(route) - 1)]
        way_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(plan.xy, axis=0).T))])
        heading = np.arctan2(goal[1], goal[0])
        xy = way_m[:, None] * [np.cos(heading), np.sin(heading)]
        return replace(plan, xy=xy, yaw=np.full(len(way_m), heading))


class Overshoots(Follower):
    """Corrects every deviation too far, and the next one farther."""

    def spoil(self, plan, observation):
        aside = 0.012 * self.queries * np.sin(2 * np.pi * self.queries / 22)
        x = plan.xy[:, 0]
        near = np.minimum(x, 8.0)
        y = plan.xy[:, 1] + aside * near / 2
        return replace(plan, xy=np.stack([x, y], axis=1), yaw=plan.yaw + aside * (x < 8.0) / 2)


class MissesTheTurn(Follower):
    """Takes a tight turn of the route for a mistake of the map, and goes straight on."""

    def act(self, observation):
        points = observation.route_rig[np.isfinite(observation.route_rig[:, 0]), :2]
        heading = np.unwrap(np.arctan2(*np.diff(points, axis=0).T[::-1]))
        if len(heading) > 1 and np.abs(np.diff(heading)).max() > 0.2:
            straight = np.stack([np.linspace(0, 80, 20), np.zeros(20), np.zeros(20)], axis=1)
            observation = replace(observation, route_rig=straight)
        return super().act(observation)


class SwervesLeft(Follower):
    """Changes to the lane on its left after three seconds, without a look."""

    def spoil(self, plan, observation):
        if self.queries <= 28:
            return plan
        y = plan.xy[:, 1] + 3.5 * np.clip(plan.xy[:, 0] / 15.0, 0.0, 1.0)
        return replace(plan, xy=np.stack([plan.xy[:, 0], y], axis=1))


class PlansFromBumper(Follower):
    """Its plans begin at the front bumper."""

    def spoil(self, plan, observation):
        return replace(plan, xy=plan.xy + np.array([3.8, 0.0]))


class HoldsPlans(Follower):
    """Repeats a plan for two seconds, as if nothing had moved since."""

    def spoil(self, plan, observation):
        if self.queries % 20 == 1:
            self.kept = plan
        times = self.kept.times_us - self.kept.t_us + observation.t_us
        return replace(self.kept, t_us=observation.t_us, times_us=times)


class NeverForgets(Follower):
    """Sums up how far the route lies aside, over all of its drives."""

    sum_m = 0.0

    def spoil(self, plan, observation):
        near = observation.route_rig[3, 1]
        NeverForgets.sum_m += 0.02 * float(near) if np.isfinite(near) else 0.0
        x = plan.xy[:, 0]
        y = plan.xy[:, 1] + NeverForgets.sum_m * np.minimum(x, 10.0) / 10.0
        return replace(plan, xy=np.stack([x, y], axis=1))


def braking(plan, speed_mps, brake_mps2):
    """Return a plan along the same way that brakes to a stop."""
    t = (plan.times_us - plan.t_us) * 1e-6
    t = np.minimum(t, speed_mps / brake_mps2)
    reached = speed_mps * t - brake_mps2 * t**2 / 2
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(plan.xy, axis=0).T))])
    xy = np.stack([np.interp(reached, way, plan.xy[:, k]) for k in (0, 1)], axis=1)
    return replace(plan, xy=xy, yaw=np.interp(reached, way, plan.yaw))


class BrakesForDarkness(Follower):
    """Takes darkness for an obstacle."""

    def spoil(self, plan, observation):
        if observation.frames["front"].rgb.mean() > 45:
            return plan
        return braking(plan, max(observation.ego.speed_mps, 0.0), 3.0)


class StraightInRain(Follower):
    """Loses its way where the picture has too little contrast."""

    def act(self, observation):
        lower = observation.frames["front"].rgb[36:].astype(float).mean(axis=2)
        if lower.std() < LEAST_CONTRAST:
            observation = replace(observation, route_rig=np.full((20, 3), np.nan))
        return super().act(observation)


LEAST_CONTRAST = 22.0


class BrakesForOncoming(PurePursuit):
    """Brakes for a car in the opposite lane."""

    sensors: Sequence[SensorSpec] = ()

    def __init__(self, scenario):
        super().__init__(scenario)
        self.actors = scenario.actors

    def act(self, observation):
        plan = super().act(observation)
        position = observation.ego.T_world_rig[:2, 3]
        forward = observation.ego.T_world_rig[:2, 0]
        for actor in self.actors:
            t_us = actor.track.t_us
            place = [np.interp(observation.t_us, t_us, actor.track.xyz[:, k]) for k in (0, 1)]
            if 0.0 < (place - position) @ forward < 50.0:
                return braking(plan, max(observation.ego.speed_mps, 0.0), 2.5)
        return plan


class BrakesThrice(Looker):
    """Brakes for the first three queries with a car near ahead, and never again."""

    def reset(self, seed, route):
        super().reset(seed, route)
        self.braked = 0

    def _obstacle_now(self, observation):
        track = super()._obstacle_now(observation)
        if track is not None and track.distance_m < 25.0:
            self.braked += 1
        return track if self.braked <= 3 else None


class BrakesWeakly(Looker):
    """Brakes with 1 m/s2 at the most."""

    def act(self, observation):
        plan = super().act(observation)
        t = (plan.times_us - plan.t_us) * 1e-6
        speed_mps = max(observation.ego.speed_mps, 0.0)
        t = np.minimum(t, speed_mps / 1.0)
        x = np.maximum(plan.xy[:, 0], speed_mps * t - t**2 / 2)
        return replace(plan, xy=np.stack([x, plan.xy[:, 1]], axis=1))


class StopsTooClose(Looker):
    """Measures to the windscreen of the car ahead, not to its rear bumper."""

    def _obstacle_now(self, observation):
        track = super()._obstacle_now(observation)
        return None if track is None else replace(track, distance_m=track.distance_m + 7.0)


class WrongCrop(Looker):
    """Cuts the right part off its images and stretches what is left."""

    def seen(self, observation):
        def crop(rgb):
            height, width = rgb.shape[:2]
            left = np.ascontiguousarray(rgb[:, : width * 7 // 10])
            return cv2.resize(left, (width, height), interpolation=cv2.INTER_LINEAR)

        route = np.full_like(observation.route_rig, np.nan)
        return replace(changed(observation, crop), route_rig=route)


@dataclass(frozen=True)
class Fault:
    """A faulty policy, where it drives, and what its page must say first.

    Attributes:
        policy: The class.
        scenes: Keys of `SCENES`, or names of shipped scenarios.
        cause: What is right, in words.
        needs: Patterns that must all match the first sentence, in any case.
        kinds: Keys of `NAMING` that are no false causes of it.
        renderer: Behind which it drives.
    """

    policy: type
    scenes: tuple[str, ...]
    cause: str
    needs: tuple[str, ...]
    kinds: tuple[str, ...] = ()
    renderer: str = GREY

    @property
    def name(self):
        return f"{HERE}:{self.policy.__name__}"

    def is_right(self, sentence):
        return all(re.search(pattern, sentence, re.IGNORECASE) for pattern in self.needs)

    def false_causes(self, sentences):
        return [
            (kind, sentence)
            for sentence in sentences
            for kind, pattern in NAMING.items()
            if kind not in self.kinds
            and re.search(pattern, POLICY_NAME.sub("", sentence), re.IGNORECASE)
        ]


POLICY_NAME = re.compile(rf"{re.escape(HERE)}:\w+")
# What names a cause of a kind: beside a fault of another kind it is false.
NAMING = {
    "speed": r"times as (fast|slow)|too (fast|slow)|off by|km/h|mph|looks like",
    "frame": r"world's|world coordinates|x is forward|sideways|backwards",
    "mirror": r"mirrored|upside down|exchanged",
    "late": r"\blate\b|latency|delay",
    "weather": r"\bnight\b|\brain\b|\bfog\b|\bsnow\b|low sun|\bdusk\b|in the dark",
    "swing": r"side to side|swings|oscillat",
    "hold": r"same plan\b|unchanged|not renewed",
    "memory": r"\breset\b|same seed|drive before",
    "origin": r"first pose",
    "inside": r"inside of the bend|cuts",
}
SPEED = (r"m/s.*recording|recording.*m/s",)
TWENTY = (
    Fault(
        MphAsMps,
        ("left",),
        "it drives 13 m/s and more in the bend where the recording drives 8 m/s",
        SPEED,
        ("speed",),
    ),
    Fault(
        HalfGainLeft,
        ("left", "right"),
        "it is carried to the right out of left-hand bends, and of no other",
        (r"\bright\b", r"left-hand|(bends?|turns?|road|route) (to the )?left"),
    ),
    Fault(
        BrakesThrice,
        ("hard/hard_brake",),
        "in the last second before the contact no plan brakes any more",
        (r"last second", r"no plan brakes|brakes no more|does not brake|no longer|without braking"),
        renderer="clean",
    ),
    Fault(
        WrongCrop,
        ("smoke/curve",),
        "it drives aside of the recorded path from the beginning, always to the same side",
        (r"\d m (to the )?right|right of", r"path|route|lane"),
        renderer="clean",
    ),
    Fault(
        BrakesForDarkness,
        ("straight", "straight-night"),
        "it stops at night and not by day",
        (r"\bnight\b",),
        ("weather", "speed"),
        "clean",
    ),
    Fault(
        FullThrottle,
        ("right",),
        "it drives faster and faster, in the bend far faster than the recording",
        SPEED,
        ("speed",),
    ),
    Fault(
        MpsAsKmh,
        ("straight",),
        "it drives 2.8 m/s where the recording drives 10 m/s",
        SPEED,
        ("speed",),
    ),
    Fault(
        KeepsSpeedInTurn,
        ("urban/junction_left",),
        "it drives 8 m/s in the turn that the recording drives with 5 m/s",
        SPEED,
        ("speed",),
    ),
    Fault(
        SteeringOffset,
        ("straight",),
        "it drives left of its path on a straight road",
        (r"\bleft\b", r"path|route|recording"),
    ),
    Fault(
        CutsCorners,
        ("left",),
        "it leaves the road on the inside of the bend",
        (r"\bleft\b", r"left-hand|inside|(bends?|turns?) (to the )?left"),
        ("inside",),
    ),
    Fault(
        Overshoots,
        ("straight",),
        "it swings from side to side, farther each time",
        (r"side to side|swings|oscillat|crosses",),
        ("swing",),
    ),
    Fault(
        MissesTheTurn,
        ("urban/junction_right",),
        "its plans go straight on where the route turns right",
        (r"route|recording|recorded", r"right-hand|(bends?|turns?) (to the )?right"),
    ),
    Fault(
        StraightInRain,
        ("left", "left-rain"),
        "it leaves the road in rain and not where it is dry",
        (r"\brain\b",),
        ("weather",),
        "clean",
    ),
    Fault(
        NeverForgets,
        ("left",),
        "its plans depend on drives before: a reset does not forget them",
        (r"\breset\b|same seed|drive before",),
        ("memory",),
    ),
    Fault(
        BrakesWeakly,
        ("hard/hard_brake",),
        "in the last second it brakes with 1 m/s2, where several were needed",
        (r"last second", r"brakes", r"needed|would have|too little"),
        renderer="clean",
    ),
    Fault(
        StopsTooClose,
        ("hard/hard_brake",),
        "it brakes hard in the last second and lacks the last metres",
        (r"last second", r"brakes"),
        renderer="clean",
    ),
    Fault(
        BrakesForOncoming,
        ("oncoming",),
        "it brakes for the oncoming car, which is in the other lane",
        (r"oncoming", r"brak|stands|slow"),
        ("speed",),
    ),
    Fault(
        HoldsPlans,
        ("left",),
        "the same plan comes again and again",
        (r"same plan\b|unchanged|not renewed|queries late",),
        ("hold", "late"),
    ),
    Fault(
        PlansFromBumper,
        ("right",),
        "the first pose of its plans lies 3.8 m ahead of the ego",
        (r"first pose lies 3\.\d m",),
        ("origin", "speed"),
    ),
    Fault(
        SwervesLeft,
        ("two-lanes",),
        "it moves to the left into the car beside it",
        (r"\bleft\b", r"`beside`"),
    ),
)

"""Trials of a policy along a logged drive: what its plans depend on, and which single change of
what it sees or answers mends them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from alpasim_plugin.core.errors import PolicyError
from alpasim_plugin.core.geometry import arc_lengths, yaw_of
from alpasim_plugin.core.interfaces import Policy
from alpasim_plugin.core.types import (
    F64,
    U8,
    CameraSpec,
    Observation,
    Plan,
    Route,
    SensorSpec,
    Trajectory,
)
from alpasim_plugin.runs.guards import checked_plan, reset_policy

AHEAD_S = (
    0.5,
    1.0,
    1.5,
)  # where plans are compared with the recording: what is driven of a plan is its beginning
CHANGED_M = 0.05  # plans further apart than this, 2 s ahead, are not the same
CAP_M = 10.0  # of one distance: a plan that is far off is wrong, not infinitely wrong
WORSE = 1.2  # a change that makes the error this much larger is not driven
MOST_S = 120.0  # of all trials together; a slow policy gets fewer
PULSES = (0.1, 0.4, 0.7)  # where pictures are disturbed, as shares of the drive before the failure

See = Callable[[Observation], Observation]
Answer = Callable[[Plan, Observation], Plan]


@dataclass(frozen=True)
class Trial:
    """One change.

    Attributes:
        name: What is changed, for a table.
        cause: What is wrong with the policy if the change mends it.
        see, answer: Change the observation, and the plan.
        of_pictures: It changes the pictures.
    """

    name: str
    cause: str
    see: See = lambda observation: observation
    answer: Answer = lambda plan, _: plan
    of_pictures: bool = False


class Changed(Policy):
    """A policy under a trial.

    Args:
        own: The policy.
        trial: What is changed.
    """

    def __init__(self, own: Policy, trial: Trial) -> None:
        self.own, self.trial = own, trial
        self.sensors: Sequence[SensorSpec] = own.sensors
        self.controller = own.controller

    def reset(self, seed: int, route: Route) -> None:
        """Reset the policy."""
        self.own.reset(seed, route)

    def act(self, observation: Observation) -> Plan:
        """Return the changed plan of the changed observation."""
        return self.trial.answer(self.own.act(self.trial.see(observation)), observation)


def pictures(change: Callable[[U8, CameraSpec], U8]) -> See:
    """Return the change of an observation that changes every picture."""

    def see(observation: Observation) -> Observation:
        cameras = observation.cameras
        frames = {
            name: replace(f, rgb=change(f.rgb, cameras[name]))
            for name, f in observation.frames.items()
        }
        return replace(observation, frames=frames)

    return see


def warped(zoom: float = 1.0, right_rad: float = 0.0, down_rad: float = 0.0) -> See:
    """Return the change that shows pictures as a camera of ``zoom`` times the focal length would,
    turned by small angles.
    """

    def change(rgb: U8, camera: CameraSpec) -> U8:
        K = camera.K
        cx, cy = K[0, 2], K[1, 2]
        shift = K[0, 0] * np.tan(right_rad), K[1, 1] * np.tan(down_rad)
        matrix = np.array(
            [[zoom, 0.0, cx * (1 - zoom) - shift[0]], [0.0, zoom, cy * (1 - zoom) - shift[1]]]
        )
        size = (rgb.shape[1], rgb.shape[0])
        return np.asarray(
            cv2.warpAffine(
                rgb, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            ),
            dtype=np.uint8,
        )

    return pictures(change)


def brightness(factor: float) -> See:
    """Return the change that multiplies the pictures' brightness."""
    return pictures(
        lambda rgb, _: np.clip(rgb.astype(np.float32) * factor, 0, 255).astype(np.uint8)
    )


def speed(factor: float) -> See:
    """Return the change that multiplies the ego speed in the observation."""
    return lambda o: replace(o, ego=replace(o.ego, speed_mps=o.ego.speed_mps * factor))


def route(change: Callable[[F64], F64]) -> See:
    """Return the change of the route, ``(20, 3)`` metres, rig frame."""
    return lambda o: replace(o, route_rig=change(o.route_rig.copy()))


def moved(change: Callable[[F64, F64, Observation], tuple[F64, F64]]) -> Answer:
    """Return the change of a plan's ``xy`` ``(T, 2)`` and ``yaw`` ``(T,)``; samples are left
    out.
    """

    def answer(plan: Plan, observation: Observation) -> Plan:
        xy, yaw = change(plan.xy.copy(), plan.yaw.copy(), observation)
        return replace(plan, xy=xy, yaw=yaw, samples=())

    return answer


def later(plan: Plan, factor: float) -> Plan:
    """Return a plan whose poses are reached after ``factor`` times as long."""
    at = plan.times_us[0] + (plan.times_us - plan.times_us[0]) * factor
    columns = [np.interp(plan.times_us, at, values) for values in (*plan.xy.T, np.unwrap(plan.yaw))]
    return replace(plan, xy=np.stack(columns[:2], axis=1), yaw=columns[2], samples=())


def _turned(xy: F64, yaw: F64, by_rad: float) -> tuple[F64, F64]:
    c, s = np.cos(by_rad), np.sin(by_rad)
    return xy @ np.array([[c, s], [-s, c]]), yaw + by_rad


MIRROR = np.array([1.0, -1.0])


def _seen(name: str, cause: str, see: See) -> Trial:
    """Return a change of the pictures."""
    return Trial(name, cause, see, of_pictures=True)


def trials(camera_x_m: float) -> Iterator[Trial]:
    """Give the changes that are tried, with the fault that each would undo.

    Args:
        camera_x_m: Where the camera is on the rig, for plans that count from it.
    """
    mirrored = moved(lambda p, a, _: (p * MIRROR, -a))
    yield Trial(
        "plan mirrored",
        "its plan has the wrong sign: left and right are exchanged",
        answer=mirrored,
    )
    for factor, unit in (
        (3.6, "km/h for m/s"),
        (1 / 3.6, "m/s for km/h"),
        (1 / 0.3048, "feet for metres"),
        (0.3048, "metres for feet"),
    ):
        what = f"its plan has the wrong unit ({unit}): it goes {1 / factor:.2g} times as far as it should"
        yield Trial(
            f"plan scaled by {factor:.3g}",
            what,
            answer=moved(lambda p, a, _, k=factor: (p * k, a)),  # type: ignore[misc]
        )
    for factor in (0.5, 2.0):
        what = f"the time step of its plan is wrong: poses come after {1 / factor:g} times as long as they should"
        yield Trial(
            f"plan in {factor:g} times the time",
            what,
            answer=lambda p, _, k=factor: later(p, k),  # type: ignore[misc]
        )
    world = moved(lambda p, a, o: _turned(p, a, -yaw_of(o.ego.T_world_rig)))
    yield Trial(
        "plan turned into the rig", "its plan has the world's axes, not the rig's", answer=world
    )
    yield Trial(
        "x and y of the plan exchanged",
        "it exchanges x and y",
        answer=moved(lambda p, a, _: (p[:, ::-1].copy(), np.pi / 2 - a)),
    )
    if abs(camera_x_m) > 0.3:
        shift = moved(lambda p, a, _: (p + np.array([camera_x_m, 0.0]), a))
        yield Trial(
            "plan counted from the camera",
            "its plan counts from the camera, not from the rear axle",
            answer=shift,
        )
    yield _seen(
        "colours exchanged",
        "it exchanges red and blue of the picture",
        pictures(lambda rgb, _: rgb[..., ::-1].copy()),
    )
    yield _seen(
        "picture mirrored",
        "it reads the picture mirrored",
        pictures(lambda rgb, _: rgb[:, ::-1].copy()),
    )
    yield _seen(
        "picture upside down",
        "it reads the picture upside down",
        pictures(lambda rgb, _: rgb[::-1].copy()),
    )
    for zoom in (0.5, 0.67, 0.8, 1.25, 1.5, 2.0):
        yield _seen(
            f"focal length x {zoom:g}",
            f"it takes the focal length for {zoom:g} times what it is",
            warped(zoom),
        )
    for degrees in (-6.0, -3.0, 3.0, 6.0):
        side, slope = ("right", "down") if degrees > 0 else ("left", "up")
        by, rad = f"{abs(degrees):g} degrees", np.deg2rad(degrees)
        yield _seen(
            f"camera turned {side} {by}",
            f"it takes the camera to look {by} further {side} than it does",
            warped(right_rad=rad),
        )
        yield _seen(
            f"camera turned {slope} {by}",
            f"it takes the camera to look {by} further {slope} than it does",
            warped(down_rad=rad),
        )
    for factor in (0.5, 2.0):
        yield _seen(
            f"brightness x {factor:g}",
            f"it expects pictures of {factor:g} times the brightness",
            brightness(factor),
        )
    for factor in (3.6, 1 / 3.6):
        yield Trial(
            f"speed x {factor:.3g}",
            f"it takes its speed for {1 / factor:.2g} times what it is (unit)",
            speed(factor),
        )
    yield Trial(
        "route mirrored",
        "it reads the route with the wrong sign",
        route(lambda xyz: xyz * [1.0, -1.0, 1.0]),
    )


# --- along the logged drive


def plans_over(
    policy: Policy, observations: Sequence[Observation], seed: int, its_route: Route
) -> list[Plan]:
    """Query a policy along observations that it does not influence.

    Raises:
        PolicyError: It raised, or broke its contract.
    """
    reset_policy(policy, seed, its_route)
    return [checked_plan(policy, observation) for observation in observations]


def ahead(plan: Plan, seconds: Sequence[float] = AHEAD_S) -> F64:
    """Return where a plan is after some seconds ``(S, 2)``, metres, rig frame; beyond its end its
    last pose.
    """
    at = plan.t_us + np.asarray(seconds) * 1e6
    return np.stack([np.interp(at, plan.times_us, plan.xy[:, k]) for k in (0, 1)], axis=1)


def apart_m(one: Sequence[Plan], other: Sequence[Plan]) -> F64:
    """Return the distance of plans 2 s ahead ``(Q,)``, metres."""
    return np.array(
        [
            float(np.hypot(*(ahead(a, [2.0]) - ahead(b, [2.0]))[0]))
            for a, b in zip(one, other, strict=True)
        ]
    )


def error_m(
    plans: Sequence[Plan], observations: Sequence[Observation], recorded: Trajectory
) -> float:
    """Return the mean distance of plans from the recorded drive, from the place of it that is
    nearest to the ego on, metres.

    Args:
        plans: As the policy gave them.
        observations: What they were made from.
        recorded: The recorded rig poses, world.
    """
    path, seconds = recorded.xyz[:, :2], (recorded.t_us - recorded.t_us[0]) * 1e-6
    along, found = arc_lengths(path), []
    for plan, observation in zip(plans, observations, strict=True):
        T = observation.ego.T_world_rig
        near = int(np.argmin(np.hypot(*(path - T[:2, 3]).T)))
        then = np.interp(seconds[near] + np.asarray(AHEAD_S), seconds, along)
        wanted = np.stack([np.interp(then, along, path[:, k]) for k in (0, 1)], axis=1)
        given = ahead(plan) @ T[:2, :2].T + T[:2, 3]
        found.append(np.minimum(np.hypot(*(given - wanted).T), CAP_M).mean())
    return float(np.mean(found))


@dataclass(frozen=True)
class Tried:
    """A trial along the logged drive.

    Attributes:
        error_m: `error_m` of its plans; None where the policy could not answer.
        why_not: What the policy said then.
        moved_m: Largest distance of its plans, 2 s ahead, from those without the change.
    """

    trial: Trial
    error_m: float | None
    why_not: str = ""
    moved_m: float = 0.0


@dataclass(frozen=True)
class Dependence:
    """How far the plans go with one of the inputs.

    Attributes:
        what: The input, and what was done to it.
        apart_m: Largest distance of the plans, 2 s ahead, from those without the change.
    """

    what: str
    apart_m: float

    @property
    def is_used(self) -> bool:
        """Tell whether the plans change at all."""
        return self.apart_m > CHANGED_M


@dataclass(frozen=True)
class Pulse:
    """One query whose picture was disturbed.

    Attributes:
        t_us: Its time.
        after_us: When the plans changed first, after it; None: never.
    """

    t_us: int
    after_us: int | None


@dataclass(frozen=True)
class Findings:
    """What the trials along a logged drive found.

    Attributes:
        own_error_m: Of the policy as it is.
        tried: All trials, the best first.
        depends: On which inputs the plans depend.
        pulses: When plans react to a disturbed picture.
        repeatable: Whether the policy gives the same plans for the same observations; without it
            nothing else can be told.
        left_out: How many trials there was no time for.
    """

    own_error_m: float
    tried: tuple[Tried, ...]
    depends: tuple[Dependence, ...]
    pulses: tuple[Pulse, ...]
    repeatable: bool
    left_out: int = 0

    def promising(self, at_most: int) -> list[Tried]:
        """Return the trials worth a drive, the best first: they change the plans, and not for much
        worse.
        """
        moving = [one for one in self.tried if one.error_m is not None and one.moved_m > CHANGED_M]
        return [one for one in moving if (one.error_m or 0.0) < WORSE * self.own_error_m][:at_most]


GREY = pictures(lambda rgb, _: np.full_like(rgb, 128))
NEGATIVE = pictures(lambda rgb, _: 255 - rgb)
NO_ROUTE = route(lambda xyz: np.full_like(xyz, np.nan))
INPUTS: Sequence[tuple[str, See]] = (
    ("pictures, grey or changed", GREY),
    ("route, taken away", NO_ROUTE),
    ("speed, a fifth higher", speed(1.2)),
)


def investigate(
    make: Callable[[], Policy],
    given: Sequence[Plan],
    observations: Sequence[Observation],
    recorded: Trajectory,
    **reset: Any,
) -> Findings:
    """Try all changes along a logged drive, without driving.

    Args:
        make: Builds the policy.
        given: Its plans as they were driven ``(Q,)``.
        observations: What they were made from ``(Q,)``, up to the failure.
        recorded: The recorded rig poses, world.
        reset: ``seed`` and ``its_route`` of the drive.
    """
    began = time.monotonic()
    again = plans_over(make(), observations, **reset)
    own = error_m(given, observations, recorded)
    if apart_m(given, again).max() > CHANGED_M:
        return Findings(own, (), (), (), False)

    def with_change(see: See) -> list[Plan]:
        return plans_over(make(), [see(one) for one in observations], **reset)

    depends = tuple(
        found
        for what, see in INPUTS
        if (found := _dependence(what, lambda see=see: with_change(see), given))  # type: ignore[misc]
    )
    pulses = tuple(_pulses(make, given, observations, **reset)) if observations[0].frames else ()
    mount_x_m = max(
        (float(c.T_rig_camera[0, 3]) for c in observations[0].cameras.values()), default=0.0
    )
    all_trials = list(trials(mount_x_m))
    tried = []
    seen_m = 0.0
    for trial in all_trials:
        if time.monotonic() - began > MOST_S:
            break
        try:
            plans = plans_over(Changed(make(), trial), observations, **reset)
        except PolicyError as error:
            tried.append(Tried(trial, None, error.message))
            continue
        moved_m = float(apart_m(given, plans).max())
        tried.append(Tried(trial, error_m(plans, observations, recorded), moved_m=moved_m))
        seen_m = max(seen_m, moved_m) if trial.of_pictures else seen_m
    tried.sort(key=lambda one: np.inf if one.error_m is None else one.error_m)
    depends = tuple(
        replace(one, apart_m=max(one.apart_m, seen_m)) if "pictures" in one.what else one
        for one in depends
    )
    return Findings(own, tuple(tried), depends, pulses, True, len(all_trials) - len(tried))


def _dependence(
    what: str, plans: Callable[[], list[Plan]], given: Sequence[Plan]
) -> Dependence | None:
    try:
        return Dependence(what, float(apart_m(given, plans()).max()))
    except PolicyError:  # it refuses such an input, so it looks at it
        return Dependence(f"{what}: refused", np.inf)


def _pulses(
    make: Callable[[], Policy],
    given: Sequence[Plan],
    observations: Sequence[Observation],
    **reset: Any,
) -> Iterator[Pulse]:
    """Disturb one picture at a time and see when the plans change."""
    for k in sorted({int(share * len(observations)) for share in PULSES}):
        shown = [NEGATIVE(one) if i == k else one for i, one in enumerate(observations)]
        try:
            apart = apart_m(given, plans_over(make(), shown, **reset))
        except PolicyError:
            continue
        hit = np.flatnonzero(apart > CHANGED_M)
        t_us = observations[k].t_us
        yield Pulse(t_us, int(observations[hit[0]].t_us - t_us) if len(hit) else None)

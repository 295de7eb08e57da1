"""Conformance test of a policy: synthetic situations, and a readable sentence for every fault.

What is checked: the policy's cameras exist; plans are finite, begin now, at the ego, in the rig
frame (x forward, y left), in metres, radians and microseconds; they reach two seconds ahead; the
same seed gives the same plans; a reset forgets the drive before; an older frame is accepted; the
plan is in time.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from alpasim_plugin.core.errors import PolicyError, SimrunError
from alpasim_plugin.core.geometry import inverse, se2, trajectory_from_poses, transform_points
from alpasim_plugin.core.interfaces import Policy
from alpasim_plugin.core.plan_check import (
    blank_scenario,
    sensors_problem,
    shape_problem,
    unit_guess,
)
from alpasim_plugin.core.types import (
    F64,
    CameraSpec,
    EgoState,
    Frame,
    Observation,
    Plan,
    Route,
    Scenario,
)
from policies.base import make_policy
from policies.painted_road import PaintedRoad, pinhole_camera

MIN_HORIZON_S = 2.0
MAX_STEP_S = 0.5
FIRST_POSE_M = 0.5
START_US = 1_700_000_000_000_000  # epoch time, so that a policy that counts in float32 fails
STEP_US = 100_000
# Away from the origin: world coordinates differ from rig coordinates.
T_WORLD_ROAD = se2(1200.0, -800.0, 0.7)


def time_fault(plan: Plan, now: int) -> str:
    """Check that times are integer microseconds, begin at the observation, increase, and reach far
    enough in fine enough steps.
    """
    times = plan.times_us
    if not np.issubdtype(times.dtype, np.integer):
        return f"times_us is {times.dtype}, not integer microseconds"
    first = int(times[0])
    if first != now:
        guess = "a plan begins at its observation"
        if START_US <= first < now:
            guess = "it is stale, an earlier observation's plan"
        elif abs(first - now // 1000) < 1000:
            guess = "it looks like milliseconds"
        elif abs(first - now // 1_000_000) < 10:
            guess = "it looks like seconds"
        elif first == 0:
            guess = "it looks like times relative to now"
        return f"times_us begins at {first}, the observation is at {now} us: {guess}"
    steps = np.diff(times)
    if (steps <= 0).any():
        return f"times_us does not increase strictly after row {int(np.argmax(steps <= 0))}"
    horizon_s = int(times[-1] - times[0]) * 1e-6
    widest_s = int(steps.max()) * 1e-6
    if horizon_s < MIN_HORIZON_S:
        is_thousandth = MIN_HORIZON_S / 1000 <= horizon_s < 0.02
        guess = "; the steps look like milliseconds" if is_thousandth else ""
        return f"the plan ends {horizon_s:.3f} s ahead; the controller needs {MIN_HORIZON_S:.0f} s{guess}"
    if widest_s > MAX_STEP_S:
        return f"poses of the plan are up to {widest_s:.2f} s apart; {MAX_STEP_S} s is the most"
    return ""


def frame_fault(plan: Plan) -> str:
    """Check that a plan begins at the rig's origin, that yaw is in radians, and that it follows the
    motion.
    """
    away_m = float(np.hypot(*plan.xy[0]))
    if away_m > FIRST_POSE_M:
        from_world_m = float(np.hypot(*(plan.xy[0] - T_WORLD_ROAD[:2, 3])))
        guess = "a plan begins at the ego, in its rig frame"
        if from_world_m < 100.0:
            guess = "it looks like world coordinates"
        return f"the first pose lies {away_m:.1f} m from the rig's origin: {guess}"
    widest = float(np.abs(plan.yaw).max())
    if widest > 2 * np.pi:
        return f"yaw reaches {widest:.1f}: it looks like degrees, needed are radians"
    step = np.diff(plan.xy, axis=0)
    length = np.hypot(step[:, 0], step[:, 1])
    middle = 0.5 * (plan.yaw[1:] + plan.yaw[:-1])
    along = np.abs(step[:, 0] * np.cos(middle) + step[:, 1] * np.sin(middle))
    if ((length > 0.3) & (along < 0.8 * length)).any():
        return "the plan moves sideways: yaw and the direction of motion differ by more than 37 degrees"
    return ""


def unit_fault(plan: Plan) -> str:
    """Check the advance in the first second of a plan made at 10 m/s on a free straight."""
    t_s = (plan.times_us - plan.times_us[0]) * 1e-6
    x, y = (float(np.interp(1.0, t_s, plan.xy[:, d])) for d in (0, 1))
    distance = float(np.hypot(x, y))
    if not 4.0 <= distance <= 14.0:
        unit = unit_guess(distance / 10.0)
        guess = f"it looks like {unit}" if unit else "a car does between 4 and 14 m, forwards"
    elif x > abs(y):
        return ""
    elif -x > abs(y):
        guess = "it runs backwards, x is forward"
    else:
        guess = "it runs sideways, x is forward and y is left"
    return f"at 10 m/s on a free straight the plan advances {distance:.2f} in the first second: {guess}"


def side_fault(left: Plan, right: Plan) -> str:
    """Check that a left-hand road leads further left than a right-hand one."""
    y_left, y_right = float(left.xy[-1, 1]), float(right.xy[-1, 1])
    if y_left >= y_right - 0.5:
        return ""
    return f"a left-hand road leads to y = {y_left:.1f} m and a right-hand one to y = {y_right:.1f} m: y is mirrored, it points left"


def difference(one: Sequence[Plan], other: Sequence[Plan] | str) -> float:
    """Return the largest difference of two drives' plans in metres or radians; infinite where times
    or shapes differ, or where the policy raised in the other one.
    """
    if isinstance(other, str) or len(one) != len(other):
        return float("inf")
    largest = 0.0
    for p, q in zip(one, other, strict=True):
        if p.xy.shape != q.xy.shape or not np.array_equal(p.times_us, q.times_us):
            return float("inf")
        largest = max(largest, np.abs(p.xy - q.xy).max(), np.abs(p.yaw - q.yaw).max())
    return float(largest)


def remarks(plans: Mapping[str, Sequence[Plan]]) -> list[str]:
    """List legal but unusual properties."""
    out = []
    if {"left", "right"} <= plans.keys() and difference(plans["left"], plans["right"]) == 0:
        out.append(
            "the plan depends neither on the route nor on the frames: left and right give the same"
        )
    if "standing" in plans:
        last = plans["standing"][-1]
        out.append(
            f"from standstill on a free road it moves {float(np.hypot(*(last.xy[-1] - last.xy[0]))):.1f} m within its horizon"
        )
    if not any(plan.samples for drive in plans.values() for plan in drive):
        out.append("it carries no sampled alternatives, so plan metrics see one trajectory")
    return out


# Of every plan, given the plan and the time of its observation; a later check needs what the earlier
# ones assure.
PLAN_FAULTS: tuple[tuple[str, Callable[[Plan, int], str], str], ...] = (
    (
        "values",
        lambda plan, now: shape_problem(plan, min_rows=2),
        "shapes fit and every value is finite",
    ),
    ("times", time_fault, f"times begin now, increase, and reach {MIN_HORIZON_S:.0f} s"),
    (
        "frame",
        lambda plan, now: frame_fault(plan),
        "plans begin at the ego and yaw follows the motion",
    ),
)


@dataclass(frozen=True)
class Check:
    """One property and whether it holds; ``sentence`` says what was found."""

    name: str
    ok: bool
    sentence: str


@dataclass(frozen=True)
class Report:
    """What a conformance run found."""

    checks: tuple[Check, ...]
    notes: tuple[str, ...] = ()
    latency_ms: tuple[float, float] = (
        0.0,
        0.0,
    )  # median and worst policy query, the first excluded

    @property
    def ok(self) -> bool:
        """Return whether every check passed."""
        return all(check.ok for check in self.checks)

    @property
    def failures(self) -> tuple[str, ...]:
        """Give the sentences of the failed checks."""
        return tuple(check.sentence for check in self.checks if not check.ok)

    def __str__(self) -> str:
        lines = [
            f"{'ok  ' if check.ok else 'FAIL'} {check.name}: {check.sentence}"
            for check in self.checks
        ]
        lines += [f"note {note}" for note in self.notes]
        median_ms, worst_ms = self.latency_ms
        lines.append(f"plans in {median_ms:.1f} ms (median), {worst_ms:.1f} ms (worst)")
        return "\n".join(lines)


@dataclass(frozen=True)
class Situation:
    """A stretch of road driven at a constant speed, with a policy query every 0.1 s; a blank one
    shows the policy a grey picture.
    """

    name: str
    curvature_1pm: float = 0.0
    speed_mps: float = 10.0
    frame_age_us: int = 0
    steps: int = 6
    is_blank: bool = False


STRAIGHT = Situation("straight")
LEFT = Situation("left", 1 / 60)
SLOW_LEFT = Situation("left", 1 / 60, speed_mps=4.0)
RIGHT = Situation("right", -1 / 60)
STANDING = Situation("standing", speed_mps=0.0)
OLD_FRAME = Situation("old frame", frame_age_us=STEP_US)
LONG = Situation("long drive", 1 / 200, steps=40)
BLANK = Situation("nothing to see", steps=12, is_blank=True)


def canned_scenario(cameras: Sequence[CameraSpec] = (pinhole_camera(),)) -> Scenario:
    """Return the scenario that `check_policy` plays by default: straight on at 10 m/s, no actors,
    an empty map.
    """
    t_us = START_US - 1_000_000 + STEP_US * np.arange(80)
    poses = [T_WORLD_ROAD @ se2(10.0 * (int(t) - START_US) * 1e-6, 0.0, 0.0) for t in t_us]
    log = trajectory_from_poses(t_us, np.array(poses))
    return replace(blank_scenario("conformance", log, cameras), start_us=START_US)


def check_policy(
    policy: Policy | str, scenario: Scenario | None = None, latency_limit_ms: float = 100.0
) -> Report:
    """Drive a policy through the canned situations and report every breach of the contract.

    A policy with ``controller = "perfect"`` replays a recording, so it is only queried where
    `canned_scenario` has a recording.

    Args:
        policy: A policy made for ``scenario``, or its name (see `make_policy`).
        scenario: Whose cameras the frames imitate; by default `canned_scenario`.
        latency_limit_ms: Longest acceptable median time of a policy query.

    Raises:
        InputError: The name is unknown, or its module cannot be imported.
    """
    scenario = canned_scenario() if scenario is None else scenario
    if not isinstance(policy, str):
        return _checked(policy, scenario, latency_limit_ms)
    try:
        made = make_policy(policy, scenario)
    except PolicyError as error:
        return Report((Check("made", False, error.message),))
    report = _checked(made, scenario, latency_limit_ms)
    with suppress(SimrunError):  # what it did before is the result
        made.close()
    return report


def _checked(policy: Policy, scenario: Scenario, latency_limit_ms: float) -> Report:
    known = {camera.name: camera for camera in scenario.cameras}
    fault = sensors_problem(policy.sensors)
    if not fault:
        used = sorted({sensor.camera for sensor in policy.sensors})
        unknown = [name for name in used if name not in known]
        if unknown:
            fault = f"the policy asks for cameras {unknown}; the scenario has {sorted(known)}"
    if fault:
        return Report((Check("sensors", False, fault),))
    cameras = {name: known[name] for name in used}
    checks = [Check("sensors", True, f"asks for {used or 'no camera'}")]
    replays = getattr(policy, "controller", "") == "perfect"
    situations = [STRAIGHT, OLD_FRAME]
    if not replays:
        situations += [LEFT, RIGHT, STANDING, LONG, BLANK]
    plans: dict[str, list[Plan]] = {}
    durations_ms: list[float] = []
    for situation in situations:
        driven = _drive(policy, situation, cameras, durations_ms)
        if isinstance(driven, str):
            checks.append(Check("plans", False, driven))
        else:
            plans[situation.name] = driven
            checks += _plan_faults(situation, driven)
    notes: tuple[str, ...] = ()
    if all(check.ok for check in checks):
        straight = plans["straight"]
        checks += [Check(name, True, sentence) for name, _, sentence in PLAN_FAULTS]
        fine = "at 10 m/s a plan advances as a car does"
        checks.append(_check("units", unit_fault(straight[0]), fine))
        if not replays:
            fault = side_fault(plans["left"][-1], plans["right"][-1])
            checks.append(_check("side", fault, "no road leads to its wrong side"))
        checks += _memory_checks(policy, cameras, straight, OLD_FRAME if replays else SLOW_LEFT)
        notes = tuple(remarks(plans))
    latency_ms = (0.0, 0.0)
    if durations_ms:
        latency_ms = (float(np.median(durations_ms)), max(durations_ms))
        sentence = f"plans in {latency_ms[0]:.1f} ms, the limit is {latency_limit_ms:.0f} ms"
        checks.append(Check("latency", latency_ms[0] <= latency_limit_ms, sentence))
    return Report(tuple(checks), notes, latency_ms)


def observations(situation: Situation, cameras: dict[str, CameraSpec]) -> Iterator[Observation]:
    """Yield what the policy sees in a situation: painted frames, history, ego state and route."""
    road = PaintedRoad(situation.curvature_1pm)

    def pose(t_us: int) -> F64:
        return T_WORLD_ROAD @ road.pose(situation.speed_mps * (t_us - START_US) * 1e-6)

    for step in range(situation.steps):
        now = START_US + step * STEP_US
        times = np.arange(START_US - 10 * STEP_US, now + 1, STEP_US)
        T_world_rig = pose(now)
        frames = {}
        for name, camera in cameras.items():
            seen_us = now - situation.frame_age_us
            rgb = road.image(camera, inverse(T_WORLD_ROAD) @ pose(seen_us), seed=step)
            rgb = np.full_like(rgb, 128) if situation.is_blank else rgb
            rgb.setflags(write=False)  # a policy that scribbles on its input is found out
            frames[name] = Frame(seen_us, name, rgb)
        ahead = situation.speed_mps * (now - START_US) * 1e-6 + 80 / 19 * np.arange(20)
        route = np.array([(T_WORLD_ROAD @ road.pose(float(s)))[:3, 3] for s in ahead])
        ego = EgoState(
            now,
            T_world_rig,
            situation.speed_mps,
            0.0,
            situation.speed_mps * situation.curvature_1pm,
        )
        history = trajectory_from_poses(times, np.array([pose(int(t)) for t in times]))
        yield Observation(
            now, frames, cameras, ego, history, transform_points(inverse(T_world_rig), route)
        )


def _drive(
    policy: Policy, situation: Situation, cameras: dict[str, CameraSpec], durations_ms: list[float]
) -> list[Plan] | str:
    """Return the plans, or a sentence where the policy raised."""
    road = PaintedRoad(situation.curvature_1pm)
    where = f"in the situation {situation.name!r} the policy"
    plans: list[Plan] = []
    try:
        policy.reset(
            0, Route(np.array([(T_WORLD_ROAD @ road.pose(float(s)))[:3, 3] for s in range(120)]))
        )
        for step, observation in enumerate(observations(situation, cameras)):
            began = time.perf_counter()
            plans.append(policy.act(observation))
            if step:
                durations_ms.append(1e3 * (time.perf_counter() - began))
    except SimrunError as error:
        return f"{where} failed: {error.message}"
    except Exception as error:  # whatever a foreign policy raises is a result of the check
        at = traceback.extract_tb(error.__traceback__)[-1]
        return f"{where} raised {type(error).__name__}: {error} in query {len(plans) + 1} ({at.filename}:{at.lineno})"
    return plans


def _plan_faults(situation: Situation, plans: list[Plan]) -> list[Check]:
    """Return the first fault of a situation's plans."""
    for name, fault_of, _ in PLAN_FAULTS:
        for step, plan in enumerate(plans):
            fault = fault_of(plan, START_US + step * STEP_US)
            if fault:
                return [Check(name, False, f"in the situation {situation.name!r} {fault}")]
    return []


def _memory_checks(
    policy: Policy, cameras: dict[str, CameraSpec], straight: list[Plan], other: Situation
) -> list[Check]:
    """Compare fresh drives with the one that was driven first of all."""
    again = _drive(policy, STRAIGHT, cameras, [])
    _drive(policy, other, cameras, [])  # ends elsewhere, at another speed
    after = _drive(policy, STRAIGHT, cameras, [])
    same = "the same seed and observations give the same plans"
    apart = difference(straight, again)
    if apart > 0:
        sentence = f"it does not hold that {same}: they differ by up to {apart:.3g} m"
        return [Check("determinism", False, sentence)]
    forgets = "a reset forgets the drive before"
    apart = difference(straight, after)
    fault = f"it does not hold that {forgets}: plans differ by up to {apart:.3g} m" if apart else ""
    return [Check("determinism", True, same), _check("reset", fault, forgets)]


def _check(name: str, fault: str, fine: str) -> Check:
    return Check(name, not fault, fault or fine)

"""Conformance test of a policy: synthetic situations, and a readable sentence for every fault.

What is checked: the policy's cameras exist; plans are finite, begin now, at the ego, in the rig
frame (x forward, y left), in metres, radians and microseconds; they reach two seconds ahead; they
turn with a mirrored scene, and with a mirrored image or route alone; they begin with the ego's
speed; the same seed gives the same plans; a reset forgets the rollout before; an older frame is
accepted; the plan is in time. Notes say which inputs the plan follows, and how late.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from alpasim_plugin.core.errors import PolicyError, SimrunError, is_interruption
from alpasim_plugin.core.geometry import inverse, se2, trajectory_from_poses, transform_points
from alpasim_plugin.core.interfaces import Policy
from alpasim_plugin.core.parts.blame import defined, noted, raised, runs_users_code
from alpasim_plugin.core.plan_check import (
    blank_scenario,
    plan_problem,
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
    read_only,
)
from policies.base import make_policy
from policies.painted_road import PaintedRoad, pinhole_camera

MIN_HORIZON_S = 2.0
MAX_STEP_S = 0.5
LATENCY_MS = 100.0  # of a policy query, in the median
FIRST_POSE_M = 0.5
START_US = 1_700_000_000_000_000  # epoch time, so that a policy that counts in float32 fails
STEP_US = 100_000
# Away from the origin: world coordinates differ from rig coordinates.
YAW_RAD = 0.7
T_WORLD_ROAD = se2(1200.0, -800.0, YAW_RAD)
LEAST_M = 0.5  # at the end of a plan: what is less says nothing of sides
BEGIN_S = 0.3  # a plan's first part, in which a car hardly changes its speed
# Of the ego's speed, with which a plan may begin
LEAST_SHARE = 0.65
MOST_SHARE = 1.6
MOST_MPS = 25.0


def time_fault(plan: Plan, now: int) -> str:
    """Check that times are integer microseconds, begin at the observation, increase, and reach far
    enough in fine enough steps.
    """
    problem = plan_problem(plan, now)
    if problem:
        return problem
    times = plan.times_us
    steps = np.diff(times)
    horizon_s = int(times[-1] - times[0]) * 1e-6
    widest_s = int(steps.max()) * 1e-6
    if horizon_s < MIN_HORIZON_S:
        return f"the plan ends {horizon_s:.3f} s ahead; the controller needs {MIN_HORIZON_S:.0f} s"
    if widest_s > MAX_STEP_S:
        return f"poses of the plan are up to {widest_s:.2f} s apart; {MAX_STEP_S} s is the most"
    return ""


def frame_fault(plan: Plan) -> str:
    """Check that a plan begins at the rig's origin, that yaw is in radians, and that it follows the
    motion.
    """
    away_m = float(np.hypot(*plan.xy[0]))
    if away_m > FIRST_POSE_M:
        return f"the first pose lies {away_m:.1f} m from the rig's origin: plans are in the rig frame, not the world's"
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


def direction_fault(plans: Sequence[Plan]) -> str:
    """Check that plans made on a straight road lead straight on in the rig frame, in the median."""
    x, y = np.median([plan.xy[-1] for plan in plans], axis=0)
    if x < -LEAST_M or abs(y) > max(abs(x) / 2, LEAST_M):
        return f"on a straight road the plan leads to x = {x:.1f}, y = {y:.1f} m; in the rig frame x is forward and y is left"
    return ""


def side_fault(plans: Mapping[str, Sequence[Plan]]) -> str:
    """Check that a bend to the left leads further left than one to the right, and further left than
    straight on where the image alone or the route alone bends.
    """
    by_m = {"route": _end_m(plans[ROUTE_LEFT.name], plans[STRAIGHT.name])}
    if {one.name for one in IMAGES} <= plans.keys():
        by_m["image"] = _end_m(plans[IMAGE_LEFT.name], plans[NO_ROUTE.name])
    mirrored = " and the ".join(what for what, m in by_m.items() if m < -LEAST_M)
    if mirrored:
        return f"where the {mirrored} alone bends left the plan leads further right: it is read mirrored, or y does not point left"
    left_m, right_m = (_end_m(plans[road.name]) for road in (LEFT, RIGHT))
    if left_m < right_m - LEAST_M:
        return f"a left-hand road leads to y = {left_m:.1f} m and a right-hand one to y = {right_m:.1f} m: y does not point left"
    return ""


def _end_m(plans: Sequence[Plan], others: Sequence[Plan] = ()) -> float:
    """Return how far to the left the last three plans end, or further than others, by the
    least of the three; 0 where they disagree on the side.
    """
    ends_m = [float(plan.xy[-1, 1]) for plan in plans[-3:]]
    if others:
        ends_m = [m - float(plan.xy[-1, 1]) for m, plan in zip(ends_m, others[-3:], strict=True)]
    if min(ends_m) < 0 < max(ends_m):
        return 0.0
    return min(ends_m, key=abs)


def speed_fault(fast: Plan, slow: Plan) -> str:
    """Check the speed with which plans begin that were made at 10 and at 4 m/s: not both at the
    same wrong multiple of it, and in a car's range.
    """
    begins_mps = []
    for plan in (fast, slow):
        t_s = (plan.times_us - plan.times_us[0]) * 1e-6
        x, y = (float(np.interp(BEGIN_S, t_s, plan.xy[:, axis])) for axis in (0, 1))
        begins_mps.append(math.hypot(x, y) / BEGIN_S)
    at_fast = begins_mps[0] / STRAIGHT.speed_mps
    at_slow = begins_mps[1] / SLOW_LEFT.speed_mps
    observation = (
        f"at 10 m/s plans begin with {begins_mps[0]:.4g} m/s, at 4 m/s with {begins_mps[1]:.4g}"
    )
    unit = unit_guess(at_fast)
    if unit and unit_guess(at_slow) == unit:
        return f"{observation}: it looks like {unit}"
    is_one_factor = max(at_fast, at_slow) < 1.25 * min(at_fast, at_slow)
    if is_one_factor and not LEAST_SHARE < at_fast < MOST_SHARE:
        return f"{observation}: as if time steps or lengths were off by {at_fast:.2g}"
    if begins_mps[0] > MOST_MPS:
        return f"{observation}: a car does not reach that"
    return ""


def _late(straight: Sequence[Plan], bent: Sequence[Plan]) -> int | None:
    """Return how many queries after the change of the scene plans differ; None where they never
    do.
    """
    for step in range(CHANGE, min(len(straight), len(bent))):
        if difference([bent[step]], [straight[step]]):
            return step - CHANGE
    return None


def difference(first: Sequence[Plan], other: Sequence[Plan] | str) -> float:
    """Return the largest difference of two drives' plans in metres or radians; infinite where times
    or shapes differ, or where the policy raised in the other one.
    """
    if isinstance(other, str) or len(first) != len(other):
        return float("inf")
    largest = 0.0
    for p, q in zip(first, other, strict=True):
        if p.xy.shape != q.xy.shape or not np.array_equal(p.times_us, q.times_us):
            return float("inf")
        largest = max(largest, np.abs(p.xy - q.xy).max(), np.abs(p.yaw - q.yaw).max())
    return float(largest)


def remarks(plans: Mapping[str, Sequence[Plan]]) -> list[Check]:
    """List legal but unusual properties, by the plans of each situation."""
    out = []
    probes = [("route_rig", STRAIGHT, ROUTE_LEFT)]
    if {one.name for one in IMAGES} <= plans.keys():
        probes.append(("images", NO_ROUTE, IMAGE_LEFT))
    for source, straight, left in probes:
        late = _late(plans[straight.name], plans[left.name])
        if late is None:
            finding = f"a bend in {source} changed no plan within {STEPS - CHANGE} queries"
            out.append(Check(source, True, finding))
        elif late > 0:
            finding = f"a bend in {source} changes the plan {late} queries late"
            out.append(Check("lag", True, finding))
    last = plans[STANDING.name][-1]
    moves_m = float(np.hypot(*(last.xy[-1] - last.xy[0])))
    finding = f"from standstill on a free road it moves {moves_m:.1f} m within its horizon"
    out.append(Check("standstill", True, finding))
    if not any(plan.samples for driven in plans.values() for plan in driven):
        finding = "it carries no sampled alternatives, so plan metrics see one trajectory"
        out.append(Check("samples", True, finding))
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
    notes: tuple[Check, ...] = ()  # legal but unusual
    # Median and worst policy query, the first excluded
    latency_ms: tuple[float, float] = (
        0.0,
        0.0,
    )

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
        lines += [f"note {note.name}: {note.sentence}" for note in self.notes]
        median_ms, worst_ms = self.latency_ms
        if worst_ms:
            lines.append(f"plans in {median_ms:.1f} ms (median), {worst_ms:.1f} ms (worst)")
        return "\n".join(lines)


STEPS = 14
CHANGE = 3  # the step from which the scene of a probe differs


@dataclass(frozen=True)
class Situation:
    """A stretch of road driven at a constant speed, with a policy query every 0.1 s; a blank one
    shows the policy a grey image; without a route, all its points are NaN. From step `CHANGE` on, the image and the route may bend
    otherwise than the road.
    """

    name: str
    curvature_1pm: float = 0.0
    speed_mps: float = 10.0
    frame_age_us: int = 0
    steps: int = 6
    is_blank: bool = False
    has_route: bool = True
    image_1pm: float | None = None
    route_1pm: float | None = None


BEND = 1 / 60
STRAIGHT = Situation("straight", steps=STEPS)
LEFT = Situation("left", BEND)
SLOW_LEFT = Situation("left", BEND, speed_mps=4.0)
RIGHT = Situation("right", -BEND)
STANDING = Situation("standing", speed_mps=0.0)
OLD_FRAME = Situation("old frame", frame_age_us=STEP_US)
LONG = Situation("long drive", 1 / 200, steps=25)
BLANK = Situation("nothing to see", steps=12, is_blank=True)
ROUTE_LEFT = Situation("the route alone bends left", steps=STEPS, route_1pm=BEND)
# Without a route, a policy that may do without one has the images alone.
NO_ROUTE = Situation("no route", steps=STEPS, has_route=False)
IMAGE_LEFT = replace(NO_ROUTE, name="no route, the image bends left", image_1pm=BEND)
IMAGES = (NO_ROUTE, IMAGE_LEFT)
CAMERAS = (
    pinhole_camera(),
    pinhole_camera("left", mount_m=(1.6, 0.5, 1.5), yaw_deg=60.0),
    pinhole_camera("right", mount_m=(1.6, -0.5, 1.5), yaw_deg=-60.0),
)


def canned_scenario(cameras: Sequence[CameraSpec] = CAMERAS) -> Scenario:
    """Return the scenario that `check_policy` plays by default: straight on at 10 m/s, no actors,
    an empty map; cameras to the front and to the sides.
    """
    t_us = START_US - 1_000_000 + STEP_US * np.arange(80)
    poses = [T_WORLD_ROAD @ se2(10.0 * (int(t) - START_US) * 1e-6, 0.0, 0.0) for t in t_us]
    log = trajectory_from_poses(t_us, np.array(poses))
    return replace(blank_scenario("conformance", log, cameras), start_us=START_US)


def check_policy(policy: Policy | str, scenario: Scenario | None = None) -> Report:
    """Drive a policy through the canned situations and report every breach of the contract.

    A policy with ``controller = "perfect"`` replays a recording, so it is only queried where
    `canned_scenario` has a recording.

    Args:
        policy: A policy made for ``scenario``, or its name (see `make_policy`).
        scenario: Whose cameras the frames imitate; by default `canned_scenario`.

    Raises:
        InputError: The name is unknown, or its module cannot be imported.
    """
    scenario = canned_scenario() if scenario is None else scenario
    if not isinstance(policy, str):
        return _checked(policy, scenario)
    try:
        made = make_policy(policy, scenario)
    except PolicyError as error:
        return Report((Check("made", False, f"{error.message}; {error.hint}"),))
    report = _checked(made, scenario)
    with suppress(SimrunError):  # what it did before is the result
        made.close()
    return report


def _checked(policy: Policy, scenario: Scenario) -> Report:
    """Return what a policy does in the situations, one after the other."""
    rig = {camera.name: camera for camera in scenario.cameras}
    fault = sensors_problem(policy.sensors) or _camera_fault(policy, rig)
    if fault:
        return Report((Check("sensors", False, fault),))
    used = sorted({sensor.camera for sensor in policy.sensors})
    cameras = {name: rig[name] for name in used}
    replays = getattr(policy, "controller", "") == "perfect"
    situations = [STRAIGHT, OLD_FRAME]
    if not replays:
        situations += [LEFT, RIGHT, ROUTE_LEFT, STANDING, LONG, BLANK, *(IMAGES if cameras else ())]
    durations_ms: list[float] = []
    plans, plan_checks = _plans_in(situations, policy, cameras, durations_ms)
    checks = [Check("sensors", True, f"asks for {used or 'no camera'}"), *plan_checks]
    notes: tuple[Check, ...] = ()
    if all(check.ok for check in checks):
        driving_checks, notes = _driving_checks(policy, cameras, plans, replays)
        checks += driving_checks
    latency_ms = (0.0, 0.0)
    if durations_ms:
        latency_ms = (float(np.median(durations_ms)), max(durations_ms))
        sentence = f"plans in {latency_ms[0]:.1f} ms, the limit is {LATENCY_MS:.0f} ms"
        checks.append(Check("latency", latency_ms[0] <= LATENCY_MS, sentence))
    return Report(tuple(checks), notes, latency_ms)


def _camera_fault(policy: Policy, names: Collection[str]) -> str:
    """Say which cameras a policy asks for that the scenario lacks; empty if none."""
    unknown = sorted({sensor.camera for sensor in policy.sensors} - {*names})
    if not unknown:
        return ""
    return f"the policy asks for cameras {unknown}; the scenario has {sorted(names)}"


def _plans_in(
    situations: Sequence[Situation],
    policy: Policy,
    cameras: dict[str, CameraSpec],
    durations_ms: list[float],
) -> tuple[dict[str, list[Plan]], list[Check]]:
    """Return the plans of a policy by situation, and the first fault of each kind in them."""
    plans: dict[str, list[Plan]] = {}
    faults: dict[str, Check] = {}
    for situation in situations:
        driven = _drive(policy, situation, cameras, durations_ms)
        if not isinstance(driven, str):
            plans[situation.name] = driven
            fault = _plan_fault(situation, driven)
            if fault is not None:
                faults.setdefault(fault.name, fault)
        elif situation not in IMAGES:  # a policy may need the route
            text = f"in the situation {situation.name!r} {driven}"
            faults.setdefault("plans", Check("plans", False, text))
    return plans, [*faults.values()]


def _driving_checks(
    policy: Policy, cameras: dict[str, CameraSpec], plans: dict[str, list[Plan]], replays: bool
) -> tuple[list[Check], tuple[Check, ...]]:
    """Check where the plans of a policy lead, whose form has no fault, and what it remembers.

    Args:
        policy: The policy.
        cameras: Those that it uses.
        plans: By situation.
        replays: It drives a recorded way, whatever it sees.

    Returns:
        The checks, and remarks that are no faults.
    """
    straight = plans["straight"]
    checks = [Check(name, True, sentence) for name, _, sentence in PLAN_FAULTS]
    fine = "plans lead on along the road, in the rig frame"
    checks.append(_check("direction", direction_fault(straight), fine))
    checks += _memory_checks(policy, cameras, straight, OLD_FRAME if replays else SLOW_LEFT)
    if replays:
        return checks, ()
    if all(check.ok for check in checks):
        checks.append(_check("side", side_fault(plans), "no road leads to its wrong side"))
    slow = _drive(policy, SLOW_LEFT, cameras, [])
    if not slow or isinstance(slow, str):
        return checks, ()
    fault = speed_fault(straight[0], slow[0])
    checks.append(_check("speed", fault, "plans begin with a speed that a car can have"))
    return checks, tuple(remarks(plans))


def observations(situation: Situation, cameras: dict[str, CameraSpec]) -> Iterator[Observation]:
    """Yield what the policy sees in a situation: painted frames, history, ego state and route."""
    road = PaintedRoad(situation.curvature_1pm)

    def along(t_us: int) -> float:
        return situation.speed_mps * (t_us - START_US) * 1e-6

    def pose(t_us: int) -> F64:
        return T_WORLD_ROAD @ road.pose(along(t_us))

    for step in range(situation.steps):
        now = START_US + step * STEP_US
        painted = road
        ahead = road
        if step >= CHANGE:
            painted = road if situation.image_1pm is None else PaintedRoad(situation.image_1pm)
            ahead = road if situation.route_1pm is None else PaintedRoad(situation.route_1pm)
        frames = {}
        for name, camera in cameras.items():
            seen_us = now - situation.frame_age_us
            rgb = painted.image(camera, painted.pose(along(seen_us)), seed=step)
            rgb = np.full_like(rgb, 128) if situation.is_blank else rgb
            frames[name] = read_only(Frame(seen_us, name, rgb))
        T_ahead_rig = ahead.pose(along(now))
        points = [ahead.pose(along(now) + 80 / 19 * number)[:3, 3] for number in range(20)]
        route = transform_points(inverse(T_ahead_rig), np.array(points))
        if not situation.has_route:
            route = np.full_like(route, np.nan)
        yaw_rate = situation.speed_mps * situation.curvature_1pm
        ego = EgoState(now, pose(now), situation.speed_mps, 0.0, yaw_rate)
        times = np.arange(START_US - 10 * STEP_US, now + 1, STEP_US)
        history = trajectory_from_poses(times, np.array([pose(int(t)) for t in times]))
        specs = {name: read_only(camera) for name, camera in cameras.items()}
        yield Observation(now, frames, specs, read_only(ego), read_only(history), route)


def _drive(
    policy: Policy, situation: Situation, cameras: dict[str, CameraSpec], durations_ms: list[float]
) -> list[Plan] | str:
    """Return the plans, or a sentence where the policy raised."""
    road = PaintedRoad(situation.curvature_1pm)
    plans = []
    name = f"{type(policy).__name__} in the check"
    route = np.array([(T_WORLD_ROAD @ road.pose(float(s)))[:3, 3] for s in range(120)])
    method = "reset"
    try:
        with noted(PolicyError, name, defined(policy, method), runs_users_code(policy, method)):
            policy.reset(0, Route(route))
        method = "act"
        for step, observation in enumerate(observations(situation, cameras)):
            began = time.perf_counter()
            with noted(PolicyError, name, defined(policy, method), runs_users_code(policy, method)):
                plans.append(policy.act(observation))
            if step:
                durations_ms.append(1e3 * (time.perf_counter() - began))
    except SimrunError as error:
        return f"the policy failed: {error.message}"
    except BaseException as error:  # whatever a foreign policy raises is a result of the check
        if is_interruption(error):
            raise
        message = raised(error, defined(policy, method))
        return f"the policy raised in query {len(plans) + 1}: {message}"
    return plans


def _plan_fault(situation: Situation, plans: list[Plan]) -> Check | None:
    """Return the first fault of a situation's plans."""
    for name, fault_of, _ in PLAN_FAULTS:
        for step, plan in enumerate(plans):
            fault = fault_of(plan, START_US + step * STEP_US)
            if fault:
                return Check(name, False, f"in the situation {situation.name!r} {fault}")
    return None


def _memory_checks(
    policy: Policy, cameras: dict[str, CameraSpec], straight: list[Plan], other: Situation
) -> list[Check]:
    """Compare fresh drives with the one that was driven first of all."""
    short = replace(STRAIGHT, steps=6)
    straight = straight[: short.steps]
    again = _drive(policy, short, cameras, [])
    _drive(policy, other, cameras, [])  # ends elsewhere, at another speed
    after = _drive(policy, short, cameras, [])
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

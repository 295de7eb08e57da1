"""Conformance test of a policy: synthetic situations, and a readable sentence for every fault.

What is checked: the policy's cameras exist; plans are finite, begin now, at the ego, in the rig
frame (x forward, y left), in metres, radians and microseconds; they reach two seconds ahead; they
turn with a mirrored scene, and with a mirrored image or route alone; they begin with the ego's
speed; the same seed gives the same plans; a reset forgets the rollout before; an older frame is
accepted; the plan is in time. Notes say which inputs the plan follows, and how late.

Situations begin when the scenario begins that the policy was made for. They have its cameras, not
its road and its traffic: what a policy looks up of them would contradict what it is shown, so such a
policy is driven along the recording alone, and nothing is said of where it leads.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from alpasim_plugin.core.errors import PolicyError, SimrunError, is_interruption
from alpasim_plugin.core.geometry import (
    arc_lengths,
    interpolate,
    inverse,
    project,
    resample,
    se2,
    trajectory_from_poses,
    transform_points,
)
from alpasim_plugin.core.interfaces import Policy
from alpasim_plugin.core.parts.blame import defined, noted, raised, runs_users_code
from alpasim_plugin.core.plan_check import (
    blank_scenario,
    plan_problem,
    sensors_problem,
    shape_problem,
    unit_guess,
)
from alpasim_plugin.core.recorded_state import ego_state_from_log
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
USUAL_LAG = 1  # queries, which a filter or a threshold takes
NEAR_M = 20.0  # a first pose that lies farther away looks like coordinates of the world
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


def time_fault(plan: Plan, now: int, least_s: float = MIN_HORIZON_S) -> str:
    """Check that times are integer microseconds, begin at the observation, increase, and reach
    ``least_s`` ahead in fine enough steps.
    """
    problem = plan_problem(plan, now)
    if problem:
        return problem
    times = plan.times_us
    steps = np.diff(times)
    horizon_s = int(times[-1] - times[0]) * 1e-6
    widest_s = int(steps.max()) * 1e-6
    if horizon_s < least_s:
        return f"the plan ends {horizon_s:.3f} s ahead; the controller needs {least_s:.3g} s"
    if widest_s > MAX_STEP_S:
        return f"poses of the plan are up to {widest_s:.2f} s apart; {MAX_STEP_S} s is the most"
    return ""


def frame_fault(plan: Plan) -> str:
    """Check that a plan begins at the rig's origin, that yaw is in radians, and that it follows the
    motion.
    """
    away_m = float(np.hypot(*plan.xy[0]))
    if away_m > FIRST_POSE_M:
        frame = "plans begin at the ego, in the middle of its rear axle"
        if away_m > NEAR_M:
            frame = "plans are in the rig frame, not the world's"
        return f"the first pose lies {away_m:.1f} m from the rig's origin: {frame}"
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

    Only who drives straight on along a straight road says by a bend that it reads it mirrored; who
    is carried aside there has another fault.
    """
    probes = {"route": (STRAIGHT, ROUTE_LEFT)}
    if {situation.name for situation in IMAGES} <= plans.keys():
        probes["image"] = (NO_ROUTE, IMAGE_LEFT)
    sources = []
    for source, (straight, left) in probes.items():
        further_left_m = _end_m(plans[left.name], plans[straight.name])
        aside_m = float(np.median([plan.xy[-1, 1] for plan in plans[straight.name]]))
        if further_left_m < -LEAST_M and abs(aside_m) < abs(further_left_m) / 2:
            sources.append(source)
    if sources:
        return f"where the {' and the '.join(sources)} alone bends left the plan leads further right: it is read mirrored, or y does not point left"
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
        ends_m = [
            end_m - float(plan.xy[-1, 1]) for end_m, plan in zip(ends_m, others[-3:], strict=True)
        ]
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
    if {situation.name for situation in IMAGES} <= plans.keys():
        probes.append(("images", NO_ROUTE, IMAGE_LEFT))
    for source, straight, left in probes:
        late = _late(plans[straight.name], plans[left.name])
        if late is None:
            finding = f"a bend in {source} changed no plan within {STEPS - CHANGE} queries"
            out.append(Check(source, True, finding))
        elif late > USUAL_LAG:
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


# Of every plan, given the plan, the time of its observation and how far it must reach in seconds; a
# later check needs what the earlier ones assure.
PLAN_FAULTS: tuple[tuple[str, Callable[[Plan, int, float], str], str], ...] = (
    (
        "values",
        lambda plan, now, least_s: shape_problem(plan, min_rows=2),
        "shapes fit and every value is finite",
    ),
    ("times", time_fault, f"times begin now, increase, and reach {MIN_HORIZON_S:.0f} s"),
    (
        "frame",
        lambda plan, now, least_s: frame_fault(plan),
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
    otherwise than the road. A recorded one is the recorded drive of the scenario, from ``first_step``
    on as far as it lasts.
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
    is_recorded: bool = False
    first_step: int = 0


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
RECORDED = Situation("the recorded drive", steps=STEPS, is_recorded=True)
RECORDED_LATER = replace(RECORDED, name="the recorded drive, one second later", first_step=10)
RECORDED_OLD_FRAME = replace(RECORDED, name="old frame", frame_age_us=STEP_US)
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


@dataclass(frozen=True)
class WatchedScenario(Scenario):
    """A scenario that notes which of its members are read that the situations do not have.

    Attributes:
        looked_up: Their names.
    """

    looked_up: set[str] = field(default_factory=set)

    @classmethod
    def of(cls, scenario: Scenario) -> WatchedScenario:
        """Return a scenario that is watched."""
        watched = object.__new__(cls)
        vars(watched).update(vars(scenario), looked_up=set())
        return watched

    def __getattribute__(self, name: str) -> Any:
        is_copied = name == "__getstate__"  # by a copy of all, as for another process
        if is_copied or not (name in SAME_IN_SITUATIONS or name.startswith("__")):
            vars(self)["looked_up"].add("all" if is_copied else name)
        return super().__getattribute__(name)


# What the situations have in common with the scenario that they are driven in.
SAME_IN_SITUATIONS = {
    "looked_up",
    "period_us",
    "scene_id",
    "source",
    "source_part",
    "seed",
    "vehicle",
    "cameras",
    "rates",
    "start_us",
    "end_us",
    "warmup_us",
    "latency",
    "environment",
    "degradation",
    "content_hash",
    "notes",
    "varied",
    "files",
    "standing",
    "stop_at_path_end",
}


def check_policy(policy: Policy | str, scenario: Scenario | None = None) -> Report:
    """Drive a policy through the situations and report every breach of the contract.

    A policy with ``controller = "perfect"`` replays a recording, and one that looks up the map, the
    recording or the road users of its ``scenario`` may follow them: such a policy is driven along
    the recording alone. What a policy looks up is only noticed where it is made here.

    Args:
        policy: A policy made for ``scenario``, or its name (see `make_policy`).
        scenario: In which it drives, with whose cameras; by default `canned_scenario`.

    Raises:
        InputError: The name is unknown, or its module cannot be imported.
    """
    place = Place() if scenario is None else Place.of(scenario)
    scenario = canned_scenario() if scenario is None else scenario
    if not isinstance(policy, str):
        return _checked(policy, scenario, place, set())
    watched = WatchedScenario.of(scenario)
    # The canned scenario holds nothing but the straight road of its situations.
    looked_up = set() if place.recording is None else watched.looked_up
    try:
        made = make_policy(policy, watched)
    except PolicyError as error:
        return Report((Check("made", False, f"{error.message}; {error.hint}"),))
    looked_up.discard("route")  # each reset gives that of its situation in its place
    report = _checked(made, scenario, place, looked_up)
    with suppress(SimrunError):  # what it did before is the result
        made.close()
    return report


@dataclass(frozen=True)
class Place:
    """When situations are driven, and what is recorded there.

    Attributes:
        start_us: When each begins.
        recording: The scenario whose recorded drive is driven as well; None where the straight road
            is the recorded drive.
    """

    start_us: int = START_US
    recording: Scenario | None = None

    @classmethod
    def of(cls, scenario: Scenario) -> Place:
        """Return the place of a scenario."""
        return cls(scenario.start_us, scenario)

    def times_us(self, situation: Situation) -> list[int]:
        """Return when the policy is queried: at the most as long as a recorded drive lasts."""
        steps = range(situation.first_step, situation.first_step + situation.steps)
        times_us = [self.start_us + step * STEP_US for step in steps]
        if self.recording is None or not situation.is_recorded:
            return times_us
        last_us = int(self.recording.ego_log.t_us[-1]) - STEP_US  # a plan has two poses
        return [t_us for t_us in times_us if t_us <= last_us]

    def horizon_s(self, situation: Situation, now_us: int) -> float:
        """Return how far a plan must reach: along a recorded drive up to the last step before its
        end.
        """
        if self.recording is None or not situation.is_recorded:
            return MIN_HORIZON_S
        left_us = int(self.recording.ego_log.t_us[-1]) - now_us
        return min(MIN_HORIZON_S, left_us * 1e-6 - MAX_STEP_S)

    def route(self, situation: Situation) -> Route:
        """Return the route of a situation, world, as read-only as a run gives it."""
        if self.recording is not None and situation.is_recorded:
            return read_only(self.recording.route)
        road = PaintedRoad(situation.curvature_1pm)
        points = [(T_WORLD_ROAD @ road.pose(float(s)))[:3, 3] for s in range(120)]
        return Route(np.array(points))


def _checked(policy: Policy, scenario: Scenario, place: Place, looked_up: set[str]) -> Report:
    """Return what a policy does in the situations, one after the other.

    Args:
        policy: The policy.
        scenario: Whose cameras the frames imitate.
        place: Where it is driven.
        looked_up: What it has read of its scenario that the situations do not have; grows as the
            policy drives.
    """
    rig = {camera.name: camera for camera in scenario.cameras}
    fault = sensors_problem(policy.sensors) or _camera_fault(policy, rig)
    if fault:
        return Report((Check("sensors", False, fault),))
    used = sorted({sensor.camera for sensor in policy.sensors})
    drives = _TestDrives(policy, {name: rig[name] for name in used}, place)
    replays = getattr(policy, "controller", "") == "perfect"
    plans: dict[str, list[Plan]] = {}
    plan_checks: list[Check] = []
    if place.recording is None or not (replays or looked_up):
        plans, plan_checks = drives.plans_in(_situations(replays, has_cameras=bool(used)))
    follows_scene = place.recording is not None and (replays or bool(looked_up))
    if follows_scene:
        drives = replace(drives, durations_ms=[])
        plans, plan_checks = drives.plans_in([RECORDED, RECORDED_OLD_FRAME])
    checks = [Check("sensors", True, f"asks for {used or 'no camera'}"), *plan_checks]
    notes: tuple[Check, ...] = ()
    if all(check.ok for check in checks):
        checks += [Check(name, True, sentence) for name, _, sentence in PLAN_FAULTS]
        if follows_scene:
            checks += _memory_checks(drives, plans[RECORDED.name], RECORDED, RECORDED_LATER)
        else:
            way_checks, notes = _way_checks(drives, plans, replays)
            checks += way_checks
    if follows_scene:
        notes = (Check("recording", True, _followed(looked_up)),)
    if not drives.durations_ms:
        return Report(tuple(checks), notes, (0.0, 0.0))
    median_ms = float(np.median(drives.durations_ms))
    sentence = f"plans in {median_ms:.1f} ms, the limit is {LATENCY_MS:.0f} ms"
    checks.append(Check("latency", median_ms <= LATENCY_MS, sentence))
    return Report(tuple(checks), notes, (median_ms, max(drives.durations_ms)))


def _situations(replays: bool, has_cameras: bool) -> list[Situation]:
    """Return the situations on roads of our own: all of them for a policy that plans, and for one
    that replays a recording those without a bend.
    """
    if replays:
        return [STRAIGHT, OLD_FRAME]
    roads = [STRAIGHT, OLD_FRAME, LEFT, RIGHT, ROUTE_LEFT, STANDING, LONG, BLANK]
    return [*roads, *IMAGES] if has_cameras else roads


def _followed(looked_up: Collection[str]) -> str:
    """Say why a policy was driven along the recording alone."""
    reason = "it replays the recording"
    if looked_up:
        reason = f"it looks up {', '.join(sorted(looked_up))} of its scenario"
    return (
        f"{reason}, so it was driven along the recorded drive alone, where it leads was not checked"
    )


def _camera_fault(policy: Policy, names: Collection[str]) -> str:
    """Say which cameras a policy asks for that the scenario lacks; empty if none."""
    unknown = sorted({sensor.camera for sensor in policy.sensors} - {*names})
    if not unknown:
        return ""
    return f"the policy asks for cameras {unknown}; the scenario has {sorted(names)}"


@dataclass(frozen=True)
class _TestDrives:
    """The drives of a policy in a place.

    Attributes:
        policy: The policy.
        cameras: Those that it uses.
        place: Where it is driven.
        durations_ms: Of its queries, the first of each drive excluded.
    """

    policy: Policy
    cameras: dict[str, CameraSpec]
    place: Place
    durations_ms: list[float] = field(default_factory=list)

    def plans_in(
        self, situations: Sequence[Situation]
    ) -> tuple[dict[str, list[Plan]], list[Check]]:
        """Return the plans by situation, and the first fault of each kind in them."""
        plans: dict[str, list[Plan]] = {}
        faults: dict[str, Check] = {}
        for situation in situations:
            driven = self.drive(situation, self.durations_ms)
            if not isinstance(driven, str):
                plans[situation.name] = driven
                fault = self._plan_fault(situation, driven)
                if fault is not None:
                    faults.setdefault(fault.name, fault)
            elif situation not in IMAGES:  # a policy may need the route
                text = f"in the situation {situation.name!r} {driven}"
                faults.setdefault("plans", Check("plans", False, text))
        return plans, [*faults.values()]

    def drive(self, situation: Situation, durations_ms: list[float]) -> list[Plan] | str:
        """Return the plans, or a sentence where the policy raised."""
        policy = self.policy
        plans = []
        name = f"{type(policy).__name__} in the check"
        method = "reset"
        try:
            with noted(PolicyError, name, defined(policy, method), runs_users_code(policy, method)):
                policy.reset(0, self.place.route(situation))
            method = "act"
            views = observations(situation, self.cameras, self.place)
            for step, observation in enumerate(views):
                began = time.perf_counter()
                with noted(
                    PolicyError, name, defined(policy, method), runs_users_code(policy, method)
                ):
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

    def _plan_fault(self, situation: Situation, plans: list[Plan]) -> Check | None:
        """Return the first fault of a situation's plans."""
        times_us = self.place.times_us(situation)
        for name, fault_of, _ in PLAN_FAULTS:
            for now, plan in zip(times_us, plans, strict=True):
                fault = fault_of(plan, now, self.place.horizon_s(situation, now))
                if fault:
                    return Check(name, False, f"in the situation {situation.name!r} {fault}")
        return None


def _way_checks(
    drives: _TestDrives, plans: dict[str, list[Plan]], replays: bool
) -> tuple[list[Check], tuple[Check, ...]]:
    """Check where the plans of a policy lead, whose form has no fault, and what it remembers.

    Args:
        drives: Of the policy.
        plans: By situation.
        replays: It drives a recorded way, whatever it sees.

    Returns:
        The checks, and remarks that are no faults.
    """
    straight = plans[STRAIGHT.name]
    fine = "plans lead on along the road, in the rig frame"
    checks = [_check("direction", direction_fault(straight), fine)]
    checks += _memory_checks(drives, straight, STRAIGHT, OLD_FRAME if replays else SLOW_LEFT)
    if replays:
        return checks, ()
    if all(check.ok for check in checks):
        checks.append(_check("side", side_fault(plans), "no road leads to its wrong side"))
    slow = drives.drive(SLOW_LEFT, [])
    if not slow or isinstance(slow, str):
        return checks, ()
    fault = speed_fault(straight[0], slow[0])
    checks.append(_check("speed", fault, "plans begin with a speed that a car can have"))
    return checks, tuple(remarks(plans))


def observations(
    situation: Situation, cameras: dict[str, CameraSpec], place: Place | None = None
) -> Iterator[Observation]:
    """Yield what the policy sees in a situation: painted frames, history, ego state and route.

    Args:
        situation: The situation.
        cameras: Whose frames it sees, by name.
        place: Where it is; by default that of `canned_scenario`.
    """
    place = Place() if place is None else place
    if situation.is_recorded:
        yield from _recorded_observations(situation, cameras, place)
        return
    road = PaintedRoad(situation.curvature_1pm)

    def along(t_us: int) -> float:
        return situation.speed_mps * (t_us - place.start_us) * 1e-6

    def pose(t_us: int) -> F64:
        return T_WORLD_ROAD @ road.pose(along(t_us))

    for step, now in enumerate(place.times_us(situation)):
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
        times = np.arange(place.start_us - 10 * STEP_US, now + 1, STEP_US)
        history = trajectory_from_poses(times, np.array([pose(int(t)) for t in times]))
        specs = {name: read_only(camera) for name, camera in cameras.items()}
        yield Observation(
            now, frames, specs, read_only(ego), read_only(history), route, road_users={}
        )


def _recorded_observations(
    situation: Situation, cameras: dict[str, CameraSpec], place: Place
) -> Iterator[Observation]:
    """Yield what the policy sees along a recorded drive: states, history and route are recorded,
    the images are those of a straight road.
    """
    scenario = place.recording
    assert scenario is not None, "only a place with a recording has a recorded drive"
    log = scenario.ego_log
    specs = {name: read_only(camera) for name, camera in cameras.items()}
    road = PaintedRoad()
    for now in place.times_us(situation):
        ego = ego_state_from_log(log, now, scenario.vehicle)
        past = log.t_us <= now
        poses = interpolate(log, np.unique([*log.t_us[past], now]))
        history = trajectory_from_poses(np.unique([*log.t_us[past], now]), poses)
        seen_us = now - situation.frame_age_us
        driven_m = ego.speed_mps * (seen_us - place.start_us) * 1e-6
        frames = {}
        for name, camera in cameras.items():
            rgb = road.image(camera, road.pose(driven_m), seed=now % 1000)
            frames[name] = read_only(Frame(seen_us, name, rgb))
        route = _route_ahead(scenario.route, ego.T_world_rig)
        road_users = {
            actor.actor_id: interpolate(actor.track, now)
            for actor in scenario.actors
            if actor.track.t_us[0] <= now <= actor.track.t_us[-1]
        }
        yield Observation(
            now, frames, specs, read_only(ego), read_only(history), route, road_users=road_users
        )


def _route_ahead(route: Route, T_world_rig: F64) -> F64:
    """Return the route ahead ``(20, 3)`` in the rig frame, z = 0; rows of NaN where it ends."""
    ahead = np.full((20, 3), np.nan)
    if len(route.xyz) < 2:
        return ahead
    begin_m, _ = project(route.xyz, T_world_rig[:2, 3])
    stations_m = begin_m + 80 / 19 * np.arange(len(ahead))
    is_on_route = stations_m <= arc_lengths(route.xyz)[-1]
    points = resample(route.xyz, stations_m[is_on_route])
    ahead[is_on_route] = transform_points(inverse(T_world_rig), points)
    ahead[is_on_route, 2] = 0.0
    return ahead


def _memory_checks(
    drives: _TestDrives, before: list[Plan], drive: Situation, other: Situation
) -> list[Check]:
    """Compare fresh drives with the one that was driven first of all.

    Args:
        drives: Of the policy.
        before: The plans of the first of all.
        drive: Which situation that was.
        other: One that ends elsewhere, at another speed.
    """
    short = replace(drive, steps=min(drive.steps, 6))
    before = before[: short.steps]
    again = drives.drive(short, [])
    drives.drive(other, [])
    after = drives.drive(short, [])
    same = "the same seed and observations give the same plans"
    apart = difference(before, again)
    if apart > 0:
        sentence = f"it does not hold that {same}: they differ by up to {apart:.3g} m"
        return [Check("determinism", False, sentence)]
    forgets = "a reset forgets the drive before"
    apart = difference(before, after)
    fault = f"it does not hold that {forgets}: plans differ by up to {apart:.3g} m" if apart else ""
    return [Check("determinism", True, same), _check("reset", fault, forgets)]


def _check(name: str, fault: str, fine: str) -> Check:
    return Check(name, not fault, fault or fine)

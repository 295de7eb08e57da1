"""The conformance check on good policies and on ones that are broken on purpose: each fault has its
sentence.
"""

import copy
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from alpasim_plugin.core.types import Plan, Scenario, SensorSpec
from policies import conformance
from policies.conformance import WatchedScenario, canned_scenario, check_policy
from policies.simple import PurePursuit
from scenarios.load import load_scenario
from tests.examples import first_of, first_rows_of
from tests.runs import faulty_policies

SCENARIO = canned_scenario()
SCENE_POLICIES = Path(__file__).with_name("scene_policies.py")


class Honest(PurePursuit):
    """Drives well; the subclasses spoil its plans."""

    def __init__(self):
        super().__init__(SCENARIO)

    def act(self, observation):
        return self.spoil(super().act(observation), observation)

    def spoil(self, plan, observation):
        return plan


class MirroredY(Honest):
    def spoil(self, plan, observation):
        return replace(plan, xy=plan.xy * [1, -1], yaw=-plan.yaw)


class Centimetres(Honest):
    spoil = faulty_policies.Centimetres.spoil


class SwappedAxes(Honest):
    spoil = faulty_policies.SwappedAxes.spoil


class MillisecondSteps(Honest):
    def spoil(self, plan, observation):
        return replace(plan, times_us=plan.times_us[0] + (plan.times_us - plan.times_us[0]) // 1000)


class FloatTimes(Honest):
    def spoil(self, plan, observation):
        return replace(plan, times_us=plan.times_us.astype(np.float32))


class Stale(Honest):
    kept: Plan | None = None

    def reset(self, seed, route):
        super().reset(seed, route)
        self.kept = None

    def spoil(self, plan, observation):
        self.kept = self.kept or plan
        return self.kept


class NotANumber(Honest):
    def spoil(self, plan, observation):
        xy = plan.xy.copy()
        xy[7, 1] = np.nan
        return replace(plan, xy=xy)


class Degrees(Honest):
    def spoil(self, plan, observation):
        return replace(plan, yaw=np.degrees(plan.yaw))


class WorldFrame(Honest):
    spoil = faulty_policies.WorldFrame.spoil


class WorldAxes(Honest):
    """Answers in the world's axes, the pose staying at the origin."""

    spoil = faulty_policies.WorldAxes.spoil


class Short(Honest):
    def spoil(self, plan, observation):
        return replace(plan, times_us=plan.times_us[:11], xy=plan.xy[:11], yaw=plan.yaw[:11])


class Transposed(Honest):
    def spoil(self, plan, observation):
        return replace(plan, xy=plan.xy.T.copy())


class BareArray(Honest):
    def spoil(self, plan, observation):
        return plan.xy  # type: ignore[return-value]


class CameraNames(Honest):
    sensors = ("front",)  # type: ignore[assignment]


class Random(Honest):
    count = 0

    def spoil(self, plan, observation):
        self.count += 1  # survives the reset
        return replace(
            plan, xy=plan.xy + 0.01 * self.count * np.linspace(0, 1, len(plan.xy))[:, None]
        )


class Remembers(Honest):
    """Its cruising speed survives a reset once it has been slow."""

    slowest = np.inf

    def spoil(self, plan, observation):
        speed = observation.ego.speed_mps
        self.slowest = min(self.slowest, speed) if 0 < speed < 8 else self.slowest
        return replace(plan, xy=plan.xy * (0.9 if self.slowest < 8 else 1.0))


class Raises(Honest):
    def spoil(self, plan, observation):
        raise ZeroDivisionError("speed")


class Scribbles(Honest):
    sensors: Sequence[SensorSpec] = (SensorSpec("front"),)

    def spoil(self, plan, observation):
        observation.frames["front"].rgb[:] = 0
        return plan


class NeedsFreshFrames(Honest):
    sensors: Sequence[SensorSpec] = (SensorSpec("front"),)

    def spoil(self, plan, observation):
        if observation.frames["front"].t_us != observation.t_us:
            raise ValueError("the frame is old")
        return plan


class OtherCamera(Honest):
    sensors: Sequence[SensorSpec] = (SensorSpec("roof"),)


@pytest.mark.parametrize(
    "name", first_of(["lane-camera", "log-replay", "learned", "pure-pursuit"], 2)
)
def test_shipped_policy_conforms(name, monkeypatch):
    monkeypatch.setattr(conformance, "LATENCY_MS", 1000.0)
    report = check_policy(name)
    assert report.ok, str(report)
    assert {
        "sensors",
        "values",
        "times",
        "frame",
        "direction",
        "determinism",
        "reset",
        "latency",
    } <= {c.name for c in report.checks}


@pytest.mark.parametrize(
    ("broken", "sentence"),
    first_rows_of(
        [
            (MirroredY, "y does not point left"),
            (Centimetres, "centimetres"),
            (SwappedAxes, "y is left"),
            (WorldAxes, "in the rig frame"),
            (MillisecondSteps, "the plan ends 0.005 s ahead"),
            (FloatTimes, "float32, not integer microseconds"),
            (Stale, "times_us starts at"),
            (NotANumber, "first in row 7"),
            (Degrees, "it looks like degrees"),
            (WorldFrame, "in the rig frame, not the world's"),
            (Short, "the plan ends 1.000 s ahead"),
            (
                Transposed,
                "xy (2, 51), yaw (51,); needed are (T,), (T, 2), (T,) with T >= 2; xy looks transposed",
            ),
            (BareArray, "act returned a ndarray of shape (51, 2), not a Plan"),
            (CameraNames, "sensors is ('front',), not a tuple of SensorSpec"),
            (Random, "the same seed and observations give the same plans: they differ by up to"),
            (Remembers, "a reset forgets the drive before: plans differ by up to"),
            (Raises, "in query 1: ZeroDivisionError: speed"),
            (Scribbles, "read-only"),
            (
                NeedsFreshFrames,
                "in the situation 'old frame' the policy raised in query 1: ValueError: the frame is old",
            ),
            (OtherCamera, "asks for cameras ['roof']; the scenario has ['front', 'left', 'right']"),
        ],
        8,
    ),
)
def test_broken_policy_gets_its_sentence(broken, sentence):
    report = check_policy(broken(), SCENARIO)
    assert not report.ok
    assert any(sentence in failure for failure in report.failures), str(report)
    assert sentence in str(report)


def test_blind_policy_passes_with_a_note():
    report = check_policy("constant-velocity")
    assert report.ok
    assert report.notes[0].name == "route_rig"


@pytest.mark.parametrize(
    ("policy", "is_checked_in_situations"),
    [
        ("Replays", False),
        ("FollowsRecording", False),
        ("FollowsMap", False),
        ("CountsFromStart", True),
    ],
)
def test_policy_that_looks_up_its_scenario_is_driven_in_it(policy, is_checked_in_situations):
    report = check_policy(f"{SCENE_POLICIES}:{policy}", load_scenario("smoke/curve"))
    assert {"determinism", "reset"} <= {check.name for check in report.checks}
    assert [check for check in report.checks if not check.ok and check.name != "latency"] == []
    says_why = any(note.name == "recording" for note in report.notes)
    assert says_why is not is_checked_in_situations
    is_side_checked = any(check.name == "side" for check in report.checks)
    assert is_side_checked is is_checked_in_situations


def test_fault_along_the_recording_is_found_where_it_ends_soon():
    scenario = load_scenario("smoke/straight", overrides=("timing.duration_us=900000",))
    report = check_policy(f"{SCENE_POLICIES}:SwapsAxes", scenario)
    assert any("the plan moves sideways" in failure for failure in report.failures)
    assert check_policy(f"{SCENE_POLICIES}:Replays", scenario).ok


def test_only_what_the_situations_do_not_have_is_noted_as_looked_up():
    watched = WatchedScenario.of(SCENARIO)
    assert isinstance(watched, Scenario)
    assert watched.cameras == SCENARIO.cameras
    assert watched.looked_up == set()
    assert watched.lane_map is SCENARIO.lane_map
    assert watched.looked_up == {"lane_map"}
    copy.copy(watched)
    assert "all" in watched.looked_up


def test_a_policy_that_resets_itself_with_the_scenarios_route_is_driven_in_every_situation():
    report = check_policy("tests.runs.faulty_policies:MirroredImages", load_scenario("smoke/curve"))
    faults = [check.sentence for check in report.checks if not check.ok]
    assert any("mirrored" in fault for fault in faults), faults


def ends_aside(**left_m):
    """Return plans of 40 m by situation, three each, that end so far to the left."""
    names = ("STRAIGHT", "NO_ROUTE", "IMAGE_LEFT", "ROUTE_LEFT", "LEFT", "RIGHT")
    plans = {}
    for name in names:
        xy = np.array([[0.0, 0.0], [40.0, left_m.get(name, 0.0)]])
        plan = Plan(0, np.array([0, 4_000_000]), xy, np.zeros(2))
        plans[getattr(conformance, name).name] = [plan, plan, plan]
    return plans


def test_only_who_drives_straight_on_along_a_straight_road_reads_a_bend_mirrored():
    mirrored = conformance.side_fault(ends_aside(IMAGE_LEFT=-6.0, LEFT=3.0, RIGHT=-3.0))
    assert "the image alone bends left" in mirrored
    both = conformance.side_fault(ends_aside(IMAGE_LEFT=-6.0, ROUTE_LEFT=-4.0))
    assert "the route and the image alone bends left" in both
    # Carried to the right on a straight road as well, until it sees none: an image that is cut.
    aside = ends_aside(NO_ROUTE=-14.0, IMAGE_LEFT=-20.0, STRAIGHT=-14.0, ROUTE_LEFT=-14.0)
    lost = ends_aside()[conformance.NO_ROUTE.name]
    for name in (conformance.STRAIGHT.name, conformance.NO_ROUTE.name):
        aside[name] = [*aside[name], *aside[name], *lost]
    assert conformance.side_fault(aside) == ""

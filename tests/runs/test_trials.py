"""Single changes of what a policy sees and answers, along a drive that it does not influence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.core.geometry import quat_from_yaw, se2, yaw_of
from alpasim_plugin.core.interfaces import Policy
from alpasim_plugin.core.types import (
    CameraSpec,
    EgoState,
    Frame,
    Observation,
    Plan,
    Route,
    SensorSpec,
    Trajectory,
)
from alpasim_plugin.runs.trials import (
    Changed,
    Trial,
    error_m,
    investigate,
    later,
    moved,
    pictures,
    speed,
    trials,
    warped,
)

CAMERA = CameraSpec("front", 64, 36, np.array([[40.0, 0, 32], [0, 40, 18], [0, 0, 1]]), np.eye(4))
ROUTE = Route(np.zeros((2, 3)))
TIMES = np.arange(0, 4_000_001, 100_000, dtype=np.int64)


def observed(t_us: int, left: float, yaw: float = 0.3) -> Observation:
    """Return an observation at a heading whose picture is bright on the left by as much as the path
    goes there.
    """
    rgb = np.full((36, 64, 3), 100, dtype=np.uint8)
    rgb[:, :32] += np.uint8(round(50 * max(left, 0.0)))
    rgb[:, 32:] += np.uint8(round(50 * max(-left, 0.0)))
    ego = EgoState(t_us, se2(1e-6 * t_us * 8.0, 0.0, yaw), 8.0)
    track = Trajectory(
        np.array([t_us]), ego.T_world_rig[None, :3, 3], quat_from_yaw(np.array([yaw]))
    )
    return Observation(
        t_us,
        {"front": Frame(t_us, "front", rgb)},
        {"front": CAMERA},
        ego,
        track,
        np.full((20, 3), np.nan),
    )


class ToTheBright(Policy):
    """Goes to the side that is brighter."""

    sensors: Sequence[SensorSpec] = (SensorSpec("front"),)

    def reset(self, seed: int, route: Route) -> None:
        self.seen: list[Observation] = []

    def act(self, observation: Observation) -> Plan:
        self.seen.append(observation)
        return self.plan(observation, observation)

    def plan(self, observation: Observation, looked_at: Observation) -> Plan:
        rgb = looked_at.frames["front"].rgb.astype(float)
        left = (rgb[:, :32].mean() - rgb[:, 32:].mean()) / 50
        t = 1e-6 * TIMES
        return Plan(
            observation.t_us,
            observation.t_us + TIMES,
            np.stack([8.0 * t, 0.5 * left * t**2], axis=1),
            left * t / 8,
        )


class Late(ToTheBright):
    """Looks at the picture of three queries ago."""

    def act(self, observation: Observation) -> Plan:
        self.seen.append(observation)
        return self.plan(observation, self.seen[max(0, len(self.seen) - 4)])


class Frozen(ToTheBright):
    """Looks at the fifth picture for ever."""

    def act(self, observation: Observation) -> Plan:
        self.seen.append(observation)
        return self.plan(observation, self.seen[min(4, len(self.seen) - 1)])


class WrongSign(ToTheBright):
    """Goes to the darker side."""

    def act(self, observation: Observation) -> Plan:
        plan = super().act(observation)
        return replace(plan, xy=plan.xy * [1, -1], yaw=-plan.yaw)


DRIVE = [observed(100_000 * k, 0.6 + 0.3 * np.sin(k), yaw=0.0) for k in range(20)]
RECORDED = Trajectory(
    TIMES * 2,
    np.stack([16e-6 * TIMES, 0.12 * (1e-6 * TIMES) ** 2, 0.0 * TIMES], axis=1),
    quat_from_yaw(np.zeros(len(TIMES))),
)


def found(make: Callable[[], Policy]):  # type: ignore[no-untyped-def]
    """Investigate a policy along `DRIVE`."""
    policy = make()
    policy.reset(0, ROUTE)
    return investigate(
        make, [policy.act(one) for one in DRIVE], DRIVE, RECORDED, seed=0, its_route=ROUTE
    )


def named(name: str) -> Trial:
    """Return a trial by its name."""
    return next(one for one in trials(1.5) if one.name == name)


def test_a_wrong_sign_is_what_a_mirrored_plan_mends() -> None:
    findings = found(WrongSign)
    assert "plan mirrored" in [one.trial.name for one in findings.promising(3)]
    assert findings.own_error_m > min(
        one.error_m for one in findings.tried if one.error_m is not None
    )


def test_a_plan_that_is_right_has_nothing_to_mend() -> None:
    findings = found(ToTheBright)
    assert not [
        one.trial.name
        for one in findings.promising(3)
        if one.trial.name.startswith("plan mirrored")
    ]
    assert {one.what.split(",")[0]: one.is_used for one in findings.depends} == {
        "pictures": True,
        "route": False,
        "speed": False,
    }
    assert {one.after_us for one in findings.pulses} == {0}


def test_a_late_policy_reacts_late_by_as_much() -> None:
    assert {one.after_us for one in found(Late).pulses} == {300_000}


def test_a_frozen_picture_is_heard_before_it_freezes_and_not_after() -> None:
    pulses = found(Frozen).pulses
    assert pulses[0].after_us is not None
    assert pulses[0].after_us >= 0
    assert [one.after_us for one in pulses[1:]] == [None, None]


def test_a_policy_that_does_not_repeat_itself_is_not_tried() -> None:
    class Random(ToTheBright):
        calls = 0

        def act(self, observation: Observation) -> Plan:
            Random.calls += 1
            plan = super().act(observation)
            return replace(plan, xy=plan.xy * [1, Random.calls])

    findings = found(Random)
    assert not findings.repeatable
    assert not findings.tried


def turned_to_world(plan: Plan, observation: Observation) -> Plan:
    """Return a plan in the world's axes, as a policy that forgot its heading gives it."""
    a = yaw_of(observation.ego.T_world_rig)
    turn = np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]])
    return replace(plan, xy=plan.xy @ turn, yaw=plan.yaw + a)


FAULTS = {
    "plan mirrored": Trial("", "", answer=moved(lambda p, a, _: (p * [1, -1], -a))),
    "plan scaled by 3.6": Trial("", "", answer=moved(lambda p, a, _: (p / 3.6, a))),
    "plan in 0.5 times the time": Trial(
        "", "", answer=lambda p, _: replace(p, times_us=p.t_us + 2 * (p.times_us - p.t_us))
    ),
    "plan turned into the rig": Trial("", "", answer=turned_to_world),
    "x and y of the plan exchanged": Trial(
        "", "", answer=moved(lambda p, a, _: (p[:, ::-1], np.pi / 2 - a))
    ),
    "plan counted from the camera": Trial("", "", answer=moved(lambda p, a, _: (p - [1.5, 0], a))),
    "colours exchanged": Trial("", "", pictures(lambda rgb, _: rgb[..., ::-1].copy())),
    "picture mirrored": Trial("", "", pictures(lambda rgb, _: rgb[:, ::-1].copy())),
    "picture upside down": Trial("", "", pictures(lambda rgb, _: rgb[::-1].copy())),
    "speed x 3.6": Trial("", "", speed(1 / 3.6)),
    "route mirrored": Trial("", "", lambda o: replace(o, route_rig=o.route_rig * [1, -1, 1])),
}


class Asked(ToTheBright):
    """Goes where the picture, the speed and the route lead, in three colours."""

    def plan(self, observation: Observation, looked_at: Observation) -> Plan:
        weighed = looked_at.frames["front"].rgb[:18] * np.array([1.0, 2.0, 4.0])
        plan = super().plan(observation, looked_at)
        y = weighed[:, :32].mean() - weighed[:, 32:].mean() + looked_at.route_rig[0, 1]
        t = 1e-6 * TIMES
        return replace(plan, xy=np.stack([looked_at.ego.speed_mps * t, 1e-2 * y * t], axis=1))


@pytest.mark.parametrize("name", FAULTS)
def test_a_change_undoes_the_fault_that_it_names(name: str) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (36, 64, 3)).astype(np.uint8)
    seen = observed(0, 0.0)
    seen = replace(
        seen,
        frames={"front": replace(seen.frames["front"], rgb=rgb)},
        route_rig=np.arange(60.0).reshape(20, 3),
    )
    broken, right = Changed(Asked(), FAULTS[name]), Asked()
    corrected = Changed(broken, named(name))
    for policy in (corrected, right):
        policy.reset(0, ROUTE)
    wanted, given = right.act(seen), corrected.act(seen)
    early = slice(0, 20)  # a plan that is meant twice as fast ends at half its time
    at = [np.interp(wanted.times_us[early], given.times_us, given.xy[:, k]) for k in (0, 1)]
    assert np.allclose(np.stack(at, axis=1), wanted.xy[early], atol=1e-6)


@pytest.mark.parametrize(
    ("change", "expected"),
    [(warped(zoom=1.5), (32 + 15, 18 + 7.5)), (warped(down_rad=0.1), (42, 23 - 40 * np.tan(0.1)))],
)
def test_a_picture_is_seen_as_the_camera_that_was_believed_would(
    change, expected: tuple[float, float]
) -> None:  # type: ignore[no-untyped-def]
    rgb = np.zeros((36, 64, 3), dtype=np.uint8)
    rgb[22:25, 41:44] = 255
    seen = observed(0, 0.0)
    shown = (
        change(replace(seen, frames={"front": replace(seen.frames["front"], rgb=rgb)}))
        .frames["front"]
        .rgb
    )
    y, x = np.nonzero(shown[..., 0] > 100)
    assert np.allclose((x.mean(), y.mean()), expected, atol=0.6)


def test_a_plan_along_the_recording_has_no_error_and_one_beside_it_its_distance() -> None:
    straight = Trajectory(
        TIMES * 2,
        np.stack([16e-6 * TIMES, 0 * TIMES, 0 * TIMES], axis=1),
        quat_from_yaw(np.zeros(len(TIMES))),
    )
    seen, t = observed(0, 0.0, yaw=0.0), 1e-6 * TIMES
    plan = Plan(0, TIMES, np.stack([8.0 * t, 0 * t], axis=1), 0 * t)
    assert error_m([plan], [seen], straight) == pytest.approx(0.0, abs=1e-9)
    assert error_m(
        [replace(plan, xy=plan.xy + np.array([0, 2.0]))], [seen], straight
    ) == pytest.approx(2.0)
    assert error_m([later(plan, 0.5)], [seen], straight) > 5.0

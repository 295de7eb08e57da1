"""Where a rollout ends: by time, at a goal on the road, or where the road that is known ends; never
because the ego is faster than the recording.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.core.geometry import quat_from_yaw
from alpasim_plugin.core.path_end import PathEnd, PathTracker, remaining
from alpasim_plugin.core.types import Actor, Box, Plan, SensorSpec, Trajectory
from alpasim_plugin.runs.cell import find_rollout_state
from alpasim_plugin.runs.plan import RunOptions, make_plan
from alpasim_plugin.runs.rollout import run_rollout
from alpasim_plugin.runs.run import execute_run
from alpasim_plugin.runs.score_logs import check_complete
from evaluators import rollout_values, score
from evaluators.metrics.outcomes import OUTCOMES
from scenarios.load import load_scenario
from scenarios.suite import expand
from tests.runs.grey_renderer import GREY, Grey
from tests.runs.short_runs import Announced

FAST = f"{__name__}:Fast"


class Fast:
    """Drives straight on at a multiple of the speed that it has at first: twice."""

    sensors: tuple[SensorSpec, ...] = ()
    times = 2.0

    def reset(self, seed, route):
        self.speed_mps = None

    def act(self, observation):
        if self.speed_mps is None:
            self.speed_mps = self.times * observation.ego.speed_mps
        times = observation.t_us + 100_000 * np.arange(41, dtype=np.int64)
        x = self.speed_mps * 1e-6 * (times - observation.t_us)
        return Plan(observation.t_us, times, np.stack([x, 0 * x], axis=1), 0 * x)


class AsFast(Fast):
    """Drives straight on at the speed that it has at first: it never brakes."""

    times = 1.0


class Creeping(Fast):
    """Drives straight on at a fifth of the speed that it has at first."""

    times = 0.2


class Standing(Fast):
    """Brakes to a stop and stands."""

    times = 0.0


def ended(scenario, policy):
    """Drive, and return why the rollout ended, its log, and its outcomes with the preset strict."""
    recorder = run_rollout(scenario, Grey(), policy, 0)
    log = recorder.log()
    values = rollout_values(score(log, scenario.scene, "strict"), "strict")
    outcomes = {name for name in OUTCOMES if name in values and values[name].value}
    return recorder.facts()["ended"], log, outcomes


def shortened(scenario, keep_m, stands):
    """Cut the recording after some metres, behind which nothing is known; it ends there in motion,
    or stands there for the rest of the time.
    """
    log = scenario.ego_log
    x = np.minimum(log.xyz[:, 0], keep_m) if stands else log.xyz[:, 0] * keep_m / log.xyz[-1, 0]
    xyz = np.column_stack([x, log.xyz[:, 1:]])
    return replace(
        scenario,
        ego_log=Trajectory(log.t_us, xyz, quat_from_yaw(np.zeros(len(x)))),
        path_beyond=np.zeros((0, 3)),
        path_end="record",
    )


def last_us(scenario):
    return int(run_rollout(scenario, Grey(), Fast(), 0).log().ego.t_us[-1])


def test_a_rollout_ends_where_a_moving_recording_ends(straight_road):
    scenario = shortened(straight_road, 25.0, stands=False)
    rollout = run_rollout(scenario, Grey(), Fast(), 0)
    ego = rollout.log().ego
    rig_x = ego.xyz[:, 0] - scenario.vehicle.rear_axle_to_centre_m
    assert ego.t_us[-1] < scenario.end_us
    assert rig_x[-1] > 25.0 >= rig_x[-2] - 1e-6  # the first pose beyond the end is the last one
    assert rollout.facts()["passed_path_end"]


def test_a_score_takes_a_log_that_ends_there_and_refuses_one_cut_before_or_later(
    straight_road,
):
    scenario = shortened(straight_road, 25.0, stands=False)
    log = run_rollout(scenario, Grey(), Fast(), 0).log()
    check_complete(Path("rollout.asl"), log, scenario.scene)
    ego = log.ego
    shorter = Trajectory(ego.t_us[:-1], ego.xyz[:-1], ego.quat[:-1])
    later = Trajectory(
        np.append(ego.t_us, ego.t_us[-1] + 100_000),
        np.vstack([ego.xyz, ego.xyz[-1] + [1, 0, 0]]),
        ego.quat[[*range(len(ego)), -1]],
    )
    for other in (shorter, later):
        with pytest.raises(InfrastructureError):
            check_complete(Path("rollout.asl"), replace(log, ego=other), scenario.scene)


@pytest.mark.parametrize("context_us", [0, 300_000])
def test_a_score_takes_a_log_of_a_recording_that_begins_with_the_drive(straight_road, context_us):
    start_us = int(straight_road.ego_log.t_us[0]) + context_us
    scenario = replace(straight_road, start_us=start_us, end_us=start_us + 1_000_000)
    log = run_rollout(scenario, Grey(), Standing(), 0).log()
    check_complete(Path("rollout.asl"), log, scenario.scene)
    ego = log.ego
    shorter = Trajectory(ego.t_us[:-1], ego.xyz[:-1], ego.quat[:-1])
    with pytest.raises(InfrastructureError, match="9 of 10 control steps"):
        check_complete(Path("rollout.asl"), replace(log, ego=shorter), scenario.scene)


def test_it_goes_on_where_the_recorded_car_stands_or_the_scenario_says_so(
    straight_road,
):
    assert last_us(shortened(straight_road, 20.0, stands=True)) == straight_road.end_us
    assert (
        last_us(replace(shortened(straight_road, 25.0, stands=False), stop_at_path_end=False))
        == straight_road.end_us
    )


def test_a_path_that_comes_back_beside_its_own_end_has_not_been_passed(
    straight_road,
):
    angle = np.linspace(0.0, 2 * np.pi - 0.3, 301)
    xyz = np.stack([30 * np.sin(angle), 30 - 30 * np.cos(angle), 0 * angle], axis=1)
    log = Trajectory(np.linspace(0, 3_000_000, 301).astype(np.int64), xyz, quat_from_yaw(angle))
    end = PathEnd(replace(shortened(straight_road, 25.0, stands=False), ego_log=log))
    assert not end.ends_rollout(np.array([2.0, 0.1]))  # on the first metres, ahead of the last ones
    assert end.ends_rollout((xyz[-1] + 3.0 * (xyz[-1] - xyz[-2]))[:2])


ROAD = """version: 1
road:
  speed_limit_mps: 14
  segments: [{kind: straight, length_m: 110}]
ego: {speed_mps: 9, cruise_mps: 9}
timing: {duration_us: 8000000}
"""
# A closed loop has no lane behind its end: the road would meet itself.
LOOP = """version: 1
road: {segments: [{kind: arc, length_m: 188.5, curvature_per_m: 0.033333}]}
ego: {start_m: 100, speed_mps: 8, cruise_mps: 8}
timing: {duration_us: 6000000}
"""


@pytest.mark.slow
def test_alpasims_preset_drives_on_and_only_what_passed_the_end_is_driven_again(tmp_path):
    (tmp_path / "road.yaml").write_text(ROAD)

    def plan(preset):
        refs = expand(str(tmp_path / "road.yaml"))
        return make_plan(refs, (GREY,), ("log-replay", FAST), (0,), RunOptions(preset))

    out = tmp_path / "run"
    execute_run(plan("paper"), out, 1, ["simrun"], Announced(), report=False)
    remedies = {
        cell.policy.name: find_rollout_state(cell, out)[0] for cell in plan("alpasim").cells
    }
    assert remedies == {"log-replay": "score", FAST: "drive"}
    assert {find_rollout_state(cell, out)[0] for cell in plan("strict").cells} == {"score"}


@pytest.mark.parametrize("name", ["smoke/straight", "real/us101"])
@pytest.mark.parametrize("stop", [True, False])
def test_the_key_in_the_file_decides(stop, name):
    override = () if stop else ("timing.stop_at_path_end=false",)
    scenario = load_scenario(name, overrides=override)
    assert scenario.stop_at_path_end is stop
    assert scenario.varied == {}
    assert scenario.content_hash == load_scenario(name).content_hash  # it is the same scene


def test_who_never_brakes_comes_past_a_walker_who_waits_for_him():
    waits = load_scenario("hard/crossing_pedestrian", overrides=("actors.walker.yields=true",))
    why, log, outcomes = ended(waits, AsFast())
    crossing_m = 20.0 + 55.0
    assert (why, outcomes, log.ego.xyz[-1, 0] > crossing_m) == ("time", set(), True)


@pytest.mark.parametrize("policy", [Creeping, Standing, AsFast, Fast])
def test_a_drawn_scene_ends_by_time_however_fast_one_drives(policy):
    scenario = load_scenario("smoke/straight")
    why, log, _ = ended(scenario, policy())
    assert (why, int(log.ego.t_us[-1])) == ("time", scenario.end_us)


def test_a_road_goes_on_for_as_long_as_the_fastest_admissible_drive_needs(tmp_path):
    (tmp_path / "road.yaml").write_text(ROAD)
    scenario = load_scenario(tmp_path / "road.yaml")
    assert any("goes on straight for 41 m" in note for note in scenario.notes)
    assert scenario.path_beyond[-1, 0] >= 20 + 14 * 8.5
    assert not PathEnd(scenario).ends_rollout(np.array([20 + 14 * 8.5, 0.0]))


def test_who_is_faster_than_admissible_comes_to_the_end_of_the_road(tmp_path):
    (tmp_path / "road.yaml").write_text(ROAD)
    why, log, outcomes = ended(load_scenario(tmp_path / "road.yaml"), Fast())
    assert (why, outcomes) == ("road", set())
    assert log.ego.xyz[-1, 0] > 135.0


def test_a_road_that_closes_on_itself_ends_where_it_is_written_to(tmp_path):
    (tmp_path / "loop.yaml").write_text(LOOP)
    scenario = load_scenario(tmp_path / "loop.yaml")
    assert len(scenario.notes) == 0
    end = PathEnd(scenario)
    angles = np.linspace(100.0, 178.0, 79) / 30.0  # nearly once around: beside the first metres
    for angle in angles:
        assert not end.ends_rollout(np.array([30 * np.sin(angle), 30 - 30 * np.cos(angle)]))
    assert end.kind == "road"


def test_the_second_time_around_is_not_the_first():
    angle = np.linspace(0.0, 4 * np.pi, 401)
    rings = np.stack([30 * np.sin(angle), 30 - 30 * np.cos(angle), 0 * angle], axis=1)
    tracker = PathTracker(rings)
    s_m = [tracker.follow(xy) for xy in rings[::4, :2]]
    assert np.all(np.diff(s_m) > 0)
    assert s_m[-1] == pytest.approx(4 * np.pi * 30, rel=1e-3)
    assert len(remaining(rings, rings[:301:4])) == 100


def test_who_turns_off_the_route_does_not_come_to_its_end(straight_road):
    end = PathEnd(shortened(straight_road, 25.0, stands=False))
    for x_m in np.arange(0.0, 60.0, 1.0):
        assert not end.ends_rollout(np.array([x_m, max(x_m - 5.0, 0.0)]))


@pytest.mark.parametrize("gap_m", [4.0, 60.0])
def test_a_recording_that_ends_shortly_before_a_contact_ends_in_danger(straight_road, gap_m):
    scenario = shortened(straight_road, 25.0, stands=False)
    track = Trajectory(
        straight_road.ego_log.t_us[[0, -1]],
        np.tile([25.0 + 3.9 + 2.3 + gap_m, 0.0, 0.75], (2, 1)),
        quat_from_yaw(np.zeros(2)),
    )
    queue = Actor("queue", "car", Box(4.6, 1.85, 1.5), track, is_static=True)
    why, _, outcomes = ended(replace(scenario, actors=(queue,)), Fast())
    assert why == "record"
    assert outcomes == ({"ended_in_danger"} if gap_m < 10 else set())


GATES = {
    "limit": "{version: 1, metrics: {ended_in_danger: {max: 0}}}",
    "pair": "{version: 1, metrics: {ended_in_danger: {max_new: 0}}}",
}


@pytest.mark.parametrize(("behind_m", "code"), [(20.0, 1), (120.0, 0)])
def test_a_gate_that_names_it_is_red_where_a_rollout_ended_in_danger(tmp_path, behind_m, code):
    (tmp_path / "road.yaml").write_text(ROAD)
    end_m = float(load_scenario(tmp_path / "road.yaml").path_beyond[-1, 0])
    queue = [[seconds, end_m + behind_m, -1.75, 0.0] for seconds in (0, 9)]
    scene = f"{ROAD}actors: [{{kind: logged, id: queue, points: {queue}}}]\n"
    (tmp_path / "road.yaml").write_text(scene)
    words = ["--renderer", GREY, "--policy", f"log-replay,{FAST}", "--quiet", "--no-report"]
    run = str(tmp_path / "run")
    assert run_command([*words, str(tmp_path / "road.yaml"), "--workers", "1", "--out", run]) == 0
    for name, text in GATES.items():
        (tmp_path / f"{name}.yaml").write_text(text)
        assert run_command(["gate", run, "--gate", str(tmp_path / f"{name}.yaml")]) == code


def test_a_recorded_log_goes_on_along_its_map():
    scenario = load_scenario("real/us101")
    assert scenario.path_end == "road"
    reached = np.linalg.norm(scenario.route.xyz - scenario.path_beyond[-1], axis=1)
    assert reached.min() < 1e-6

"""A scene on a map goes on behind the expert's arrival, so that a slower policy comes to the goal."""

import json
from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.core.interfaces import Policy
from alpasim_plugin.core.types import Plan, Trajectory
from alpasim_plugin.log.run_folder.manifests import read_run_json
from alpasim_plugin.runs.cell import find_rollout_state
from alpasim_plugin.runs.plan import RunOptions, as_driven, make_plan
from alpasim_plugin.runs.rollout import run_rollout
from alpasim_plugin.runs.run import execute_run
from alpasim_plugin.runs.score_logs import check_complete
from evaluators import rollout_values, score
from evaluators.metrics.outcomes import OUTCOMES, REACHED
from evaluators.metrics.presets import PRESETS
from evaluators.metrics.score import up_to
from policies.base import make_policy
from scenarios.load import load_scenario
from scenarios.suite import ScenarioRef
from tests.files.opendrive_text import lane, road, section
from tests.runs.grey_renderer import GREY, Grey
from tests.runs.short_runs import Announced

ROUTE = ("map.route.from=1:20", "map.route.to=1:220")
BOTH = (lane(1, 1, 1), lane(-1, -1, -1))
LIGHT = (
    '<signals><signal id="7" s="120" t="-5" type="1000001" dynamic="yes" orientation="+" '
    'zOffset="0" height="3" width="0.4"/></signals>'
)


def map_file(folder, with_light=False):
    """A straight road of 500 m, with one lane each way."""
    text = road("1", section(0, *BOTH), length=500)
    if with_light:
        text = text.replace("</road>", f"{LIGHT}</road>")
    file = folder / "map.xodr"
    file.write_text(f"<OpenDRIVE>{text}</OpenDRIVE>", encoding="utf-8")
    return file


def scene(folder, *overrides, with_light=False, seed=None):
    chosen = (*ROUTE, "map.vehicles=0", "map.pedestrians=0", *overrides)
    return load_scenario(map_file(folder, with_light), seed, chosen)


class Steady(Policy):
    """Drives straight on at a share of the speed that it has at first, and turned from the start."""

    sensors = ()
    share = 1.0
    turned_rad = 0.0

    def reset(self, seed, route):
        self.speed_mps = None

    def act(self, observation):
        if self.speed_mps is None:
            self.speed_mps = self.share * observation.ego.speed_mps
        times = observation.t_us + 100_000 * np.arange(41, dtype=np.int64)
        way_m = self.speed_mps * 1e-6 * (times - observation.t_us)
        turned_rad = self.turned_rad * 0.1 * way_m / max(way_m[-1], 1.0)
        return Plan(
            observation.t_us, times, np.stack([way_m, way_m * turned_rad], axis=1), turned_rad
        )


class Slow(Steady):
    share = 0.7


class Fast(Steady):
    share = 1.5


class FailsLate(Steady):
    share = 0.0

    def act(self, observation):
        if observation.t_us > 20_000_000:
            raise ZeroDivisionError
        return super().act(observation)


class Standing(Steady):
    share = 0.0


class Astray(Steady):
    turned_rad = 1.0


def driven(scenario, policy):
    """Return why a rollout ended, its log, and its scores with the preset strict."""
    recorder = run_rollout(scenario, Grey(), policy, 0)
    log = recorder.log()
    return (
        recorder.facts()["ended"],
        log,
        rollout_values(score(log, scenario.scene, "strict"), "strict"),
    )


def outcomes(values):
    return {name for name in OUTCOMES if name in values and values[name].value}


def test_who_is_slower_than_the_expert_comes_to_the_goal(tmp_path):
    scenario = scene(tmp_path)
    why, log, values = driven(scenario, Slow())
    assert (why, outcomes(values)) == ("goal", set())
    assert log.ego.t_us[-1] > scenario.ego_log.t_us[-1] + 5_000_000
    assert values["progress"].value >= REACHED
    check_complete(tmp_path, log, scenario.scene)
    rows = np.flatnonzero(log.ego.t_us <= scenario.recorded_until_us + 2_000_000)
    ego = Trajectory(log.ego.t_us[rows], log.ego.xyz[rows], log.ego.quat[rows])
    with pytest.raises(InfrastructureError, match=r"of 595 control steps"):
        check_complete(tmp_path, replace(log, ego=ego), scenario.scene)


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_every_preset_scores_a_drive_that_lasts_longer_than_the_recorded_one(tmp_path, preset):
    scenario = scene(tmp_path)
    log = run_rollout(scenario, Grey(), Slow(), 0).log()
    values = rollout_values(score(log, scenario.scene, preset), preset)
    odd = {name: v.value for name, v in values.items() if v.valid and not np.isfinite(v.value)}
    assert odd.keys() <= {"min_distance_to_obstacle_m"}  # nobody else is there


IN_TIME = sorted(name for name, chosen in PRESETS.items() if chosen.until_recorded)


@pytest.mark.parametrize("preset", IN_TIME)
def test_who_is_compared_in_time_has_made_less_way_than_the_expert(tmp_path, preset):
    scenario = scene(tmp_path)
    log = run_rollout(scenario, Grey(), Slow(), 0).log()
    shorter = run_rollout(as_driven(scenario, preset), Grey(), Slow(), 0).log()
    assert shorter.ego.t_us[-1] <= scenario.recorded_until_us < log.ego.t_us[-1]
    whole, cut = (
        rollout_values(score(rollout, scenario.scene, preset), preset) for rollout in (log, shorter)
    )
    assert whole == cut
    names = {"nuplan": "nuplan_progress", "navsim": "navsim_ep"}
    made = whole[names.get(preset, "progress_rel")].value
    assert 0.65 < made < 0.8


def test_presets_that_compare_in_time_are_those_of_other_benchmarks():
    assert IN_TIME == ["alpasim", "alpasim@6f1029c", "navsim", "nuplan"]


def test_a_rollout_cut_at_a_time_has_nothing_of_later(tmp_path):
    scenario = scene(tmp_path, "map.vehicles=6", seed=1)
    log = run_rollout(scenario, Grey(), Slow(), 0).log()
    last_us = int(log.ego.t_us[50]) + 1
    cut = up_to(log, last_us)
    assert cut.ego.t_us[-1] == log.ego.t_us[50]
    assert len(cut.actors) > 0
    assert all(actor.track.t_us[-1] <= last_us for actor in cut.actors.values())
    assert [plan.now_us for plan in cut.plans] == [
        plan.now_us for plan in log.plans if plan.now_us < log.ego.t_us[50]
    ]
    assert up_to(log, int(log.ego.t_us[-1])).plans == log.plans


def test_who_never_moves_is_stopped_by_the_time_limit_and_has_stalled(tmp_path):
    scenario = scene(tmp_path)
    arrived_s = scenario.ego_log.t_us[-1] * 1e-6
    assert scenario.end_us * 1e-6 == pytest.approx(1.5 * arrived_s + 30.0, abs=0.01)
    why, log, values = driven(scenario, Standing())
    assert why == "time"
    assert "stalled" in outcomes(values)
    assert log.ego.t_us[-1] > scenario.end_us - scenario.rates.control_us


def test_who_is_lost_gets_no_time_beyond_the_experts(tmp_path):
    scenario = scene(tmp_path)
    why, log, values = driven(scenario, Astray())
    assert why == "time"
    assert "offroad" in outcomes(values)
    arrived_us = scenario.ego_log.t_us[-1]
    assert arrived_us <= log.ego.t_us[-1] < arrived_us + scenario.rates.control_us
    check_complete(tmp_path, log, scenario.scene)


def test_log_replay_ends_at_the_goal(tmp_path):
    scenario = scene(tmp_path)
    why, log, values = driven(scenario, make_policy("log-replay", scenario))
    assert (why, outcomes(values)) == ("goal", set())
    late_us = log.ego.t_us[-1] - scenario.ego_log.t_us[-1]
    assert 0 < late_us <= 2 * scenario.rates.control_us


def test_one_cycle_of_the_slowest_light_of_the_route_may_be_missed(tmp_path):
    scenario = scene(tmp_path, with_light=True)
    (signal,) = scenario.lane_map.signals
    cycle_us = sum(us for _, us in signal.phases)
    assert cycle_us > 30_000_000
    assert scenario.end_us == round(1.5 * scenario.ego_log.t_us[-1]) + cycle_us


@pytest.mark.parametrize("seconds", [10, 90])
def test_a_duration_in_the_file_is_kept(tmp_path, seconds):
    stated = scene(tmp_path, f"timing.duration_us={seconds * 1_000_000}")
    assert stated.end_us - stated.start_us == seconds * 1_000_000
    free = scene(tmp_path)
    length = min(len(stated.ego_log), len(free.ego_log))
    assert np.array_equal(stated.ego_log.xyz[:length], free.ego_log.xyz[:length])
    assert (len(stated.ego_log) < len(free.ego_log)) == (seconds == 10)


def test_who_does_not_stop_at_the_goal_drives_as_long_as_the_expert(tmp_path):
    scenario = scene(tmp_path, "timing.stop_at_path_end=false")
    why, log, _ = driven(scenario, Slow())
    assert why == "time"
    late_us = scenario.ego_log.t_us[-1] - log.ego.t_us[-1]
    assert 0 <= late_us < scenario.rates.control_us


def test_a_stated_duration_is_kept_where_a_drive_does_not_stop_at_the_goal(tmp_path):
    stated = scene(
        tmp_path,
        "timing.duration_us=40000000",
        "timing.stop_at_path_end=false",
        "map.route.to=1:60",
    )
    log = run_rollout(stated, Grey(), Steady(), 0).log()
    assert log.ego.t_us[-1] > stated.start_us + 40_000_000 - stated.rates.control_us


@pytest.mark.parametrize("stops", ["true", "false"])
@pytest.mark.parametrize(
    ("key", "text"),
    [
        (
            "start_us",
            r"timing\.start_us=30000000: the first frame is at 30\.00 s of a recorded drive",
        ),
        (
            "warmup_us",
            r"timing\.warmup_us=30000000: warmup_us = 30000000, and the expert's drive ends",
        ),
    ],
)
def test_a_drive_that_begins_behind_the_experts_arrival_is_refused(tmp_path, key, text, stops):
    with pytest.raises(InputError, match=text):
        scene(tmp_path, f"timing.{key}=30000000", f"timing.stop_at_path_end={stops}")


def short_plan(folder, policy, preset):
    """A run of one short scene, in which the expert drives 40 m."""
    map_file(folder)
    (folder / "map.yaml").write_text(
        "version: 1\n"
        'map: {opendrive: map.xodr, route: {from: "1:20", to: "1:60"}, vehicles: 0}\n'
        "timing: {start_us: 0}\n"
    )
    refs = [ScenarioRef(str(folder / "map.yaml"))]
    return make_plan(refs, (GREY,), (f"{__name__}:{policy}",), (0,), RunOptions(preset))


def state_of(plan, out):
    (cell,) = plan.cells
    return find_rollout_state(cell, out)[0]


def test_a_rollout_that_had_longer_is_driven_again_where_the_preset_gives_less_time(tmp_path):
    out = tmp_path / "run"
    plan = short_plan(tmp_path, "Standing", "strict")
    execute_run(plan, out, 1, ["simrun"], Announced(), report=False)
    assert state_of(short_plan(tmp_path, "Standing", "paper"), out) == "score"
    for preset in IN_TIME:
        assert state_of(short_plan(tmp_path, "Standing", preset), out) == "drive"


def test_who_came_to_the_goal_in_the_experts_time_is_scored_again_where_it_stops_there(tmp_path):
    out = tmp_path / "run"
    plan = short_plan(tmp_path, "Fast", "nuplan")
    execute_run(plan, out, 1, ["simrun"], Announced(), report=False)
    assert state_of(short_plan(tmp_path, "Fast", "strict"), out) == "score"
    assert state_of(short_plan(tmp_path, "Fast", "alpasim"), out) == "drive"


def test_a_failure_behind_the_experts_arrival_is_none_of_a_preset_that_ends_there(tmp_path):
    out = tmp_path / "run"
    plan = short_plan(tmp_path, "FailsLate", "strict")
    execute_run(plan, out, 1, ["simrun"], Announced(), report=False)
    assert state_of(plan, out) == "none"
    alpasim = short_plan(tmp_path, "FailsLate", "alpasim")
    assert state_of(alpasim, out) == "drive"
    execute_run(alpasim, tmp_path / "alone", 1, ["simrun"], Announced(), report=False)
    assert state_of(alpasim, tmp_path / "alone") == "none"
    manifest = find_rollout_state(alpasim.cells[0], tmp_path / "alone")[1].manifest
    assert (manifest.ok, manifest.steps) == (True, manifest.most_steps)


def test_a_dry_run_counts_the_frames_of_the_time_that_the_preset_gives(tmp_path, capsys):
    short_plan(tmp_path, "Standing", "strict")

    def frames(preset):
        parts = ["--renderer", "clean", "--policy", "lane-camera", "--preset", preset]
        assert run_command([*parts, "--dry-run", "--json", str(tmp_path / "map.yaml")]) == 0
        return json.loads(capsys.readouterr().out)["camera_frames"]

    whole, cut = frames("strict"), frames("alpasim")
    assert 0 < cut < whole / 3


def test_a_plan_and_its_run_state_the_time_that_the_preset_gives(tmp_path):
    plan = short_plan(tmp_path, "Standing", "alpasim")
    execute_run(plan, tmp_path / "run", 1, ["simrun"], Announced(), report=False)
    (facts,) = read_run_json(tmp_path / "run").scenes.values()
    (scenario,) = plan.scenarios.values()
    seconds = (scenario.recorded_until_us - scenario.start_us) * 1e-6
    assert facts.duration_s == pytest.approx(seconds)


def test_traffic_goes_on_without_a_jump_and_without_contact_when_the_expert_has_arrived(tmp_path):
    scenario = scene(tmp_path, "map.route.to=1:100", "map.vehicles=6", with_light=True, seed=1)
    arrived_us = int(scenario.ego_log.t_us[-1])
    beyond = [a.track for a in scenario.actors if a.track.t_us[-1] > arrived_us + 5_000_000]
    assert len(beyond) > 0
    for track in beyond:
        speed_mps = np.hypot(*np.diff(track.xyz[:, :2], axis=0).T) / 0.05
        assert np.abs(np.diff(speed_mps)).max() < 8.0 * 0.05 + 1e-6
    log = run_rollout(scenario, Grey(), Standing(), 0).log()
    late = [a for a in log.actors.values() if a.track.t_us[-1] > arrived_us]
    assert len(late) > 0
    for number, actor in enumerate(late):
        for other in late[number + 1 :]:
            _, row, other_row = np.intersect1d(
                actor.track.t_us, other.track.t_us, return_indices=True
            )
            apart = np.hypot(*(actor.track.xyz[row] - other.track.xyz[other_row])[:, :2].T)
            assert apart.min() > 1.0


@pytest.mark.parametrize("name", ["smoke/straight", "smoke/lead_car", "real/us101"])
def test_scenes_without_a_goal_end_when_they_did(name):
    scenario = load_scenario(name)
    assert scenario.recorded_until_us == scenario.end_us


def test_a_log_is_not_read_behind_its_end(tmp_path):
    scenario = scene(tmp_path)
    policy = make_policy("log-replay", replace(scenario, end_us=int(scenario.ego_log.t_us[-1])))
    assert policy.log is not None
    assert policy.log.t_us[-1] == scenario.ego_log.t_us[-1]

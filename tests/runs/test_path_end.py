"""Where a rollout ends: at the end of the recorded path, unless the car stands there, or scenario
or preset say no.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.core.geometry import quat_from_yaw
from alpasim_plugin.core.types import Plan, SensorSpec, Trajectory
from alpasim_plugin.runs.cell import find_rollout_state
from alpasim_plugin.runs.loop_state import PathEnd
from alpasim_plugin.runs.plan import RunOptions, make_plan
from alpasim_plugin.runs.rollout import run_rollout
from alpasim_plugin.runs.run import execute_run
from alpasim_plugin.runs.score_logs import check_complete
from scenarios.load import load_scenario
from scenarios.suite import expand
from tests.runs.grey_renderer import GREY, Grey
from tests.runs.short_runs import Announced

FAST = f"{__name__}:Fast"


class Fast:
    """Drives straight on at twice the speed that it has at first."""

    sensors: tuple[SensorSpec, ...] = ()

    def reset(self, seed, route):
        self.speed_mps = 0.0

    def act(self, observation):
        self.speed_mps = self.speed_mps or 2 * observation.ego.speed_mps
        times = observation.t_us + 100_000 * np.arange(41, dtype=np.int64)
        x = self.speed_mps * 1e-6 * (times - observation.t_us)
        return Plan(observation.t_us, times, np.stack([x, 0 * x], axis=1), 0 * x)


def shortened(scenario, keep_m, stands):
    """Cut the recording after some metres; it ends there in motion, or stands there for the rest of
    the time.
    """
    log = scenario.ego_log
    x = np.minimum(log.xyz[:, 0], keep_m) if stands else log.xyz[:, 0] * keep_m / log.xyz[-1, 0]
    xyz = np.column_stack([x, log.xyz[:, 1:]])
    return replace(scenario, ego_log=Trajectory(log.t_us, xyz, quat_from_yaw(np.zeros(len(x)))))


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
    log = run_rollout(shortened(straight_road, 25.0, stands=False), Grey(), Fast(), 0).log()
    check_complete(Path("rollout.asl"), log)
    ego = log.ego
    shorter = Trajectory(ego.t_us[:-1], ego.xyz[:-1], ego.quat[:-1])
    later = Trajectory(
        np.append(ego.t_us, ego.t_us[-1] + 100_000),
        np.vstack([ego.xyz, ego.xyz[-1] + [1, 0, 0]]),
        ego.quat[[*range(len(ego)), -1]],
    )
    for other in (shorter, later):
        with pytest.raises(InfrastructureError):
            check_complete(Path("rollout.asl"), replace(log, ego=other))


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
    end = PathEnd(log)
    assert not end.ends_rollout(np.array([2.0, 0.1]))  # on the first metres, ahead of the last ones
    assert end.ends_rollout((xyz[-1] + 3.0 * (xyz[-1] - xyz[-2]))[:2])


def test_alpasims_preset_drives_on_and_only_what_passed_the_end_is_driven_again(
    tmp_path,
):
    def plan(preset):
        refs = expand("smoke/straight", ("timing.duration_us=2000000", "degradation.kind=none"))
        return make_plan(refs, (GREY,), ("constant-velocity", FAST), (0,), RunOptions(preset))

    scene = load_scenario("smoke/straight", overrides=("timing.duration_us=2000000",))
    assert scene.stop_at_path_end
    execute_run(plan("paper"), tmp_path, 1, ["simrun"], Announced(), report=False)
    remedies = {
        cell.policy.name: find_rollout_state(cell, tmp_path)[0] for cell in plan("alpasim").cells
    }
    assert remedies == {"constant-velocity": "score", FAST: "drive"}
    assert {find_rollout_state(cell, tmp_path)[0] for cell in plan("strict").cells} == {"score"}


@pytest.mark.parametrize("name", ["smoke/straight", "real/us101"])
@pytest.mark.parametrize("stop", [True, False])
def test_the_key_in_the_file_decides(stop, name):
    override = () if stop else ("timing.stop_at_path_end=false",)
    scenario = load_scenario(name, overrides=override)
    assert scenario.stop_at_path_end is stop
    assert scenario.varied == {}
    assert scenario.content_hash == load_scenario(name).content_hash  # it is the same scene

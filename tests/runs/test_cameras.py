"""Frames are rendered only when the policy takes them."""

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.core.clock import Clock
from alpasim_plugin.core.geometry import se2
from alpasim_plugin.core.types import Rates, SensorSpec
from alpasim_plugin.runs.cameras import CameraRig
from alpasim_plugin.runs.loop_state import LoopState


def rendered_steps(scenario, rates, sensors):
    scenario = replace(scenario, rates=rates)
    clock = Clock(scenario.start_us, scenario.end_us, rates)
    rig = CameraRig(scenario, sensors, clock)
    state = LoopState.at_start(scenario, clock.n_steps)
    return [
        tick.step for tick in clock.ticks() if rig.requests(tick, replace_end(state, tick.t_us), {})
    ]


def replace_end(state, t_us):  # type: ignore[no-untyped-def]
    log = state.scenario.ego_log
    upto = int(np.searchsorted(log.t_us, t_us, side="right"))
    return type(log)(log.t_us[:upto], log.xyz[:upto], log.quat[:upto])


def test_a_policy_without_cameras_costs_no_frame(straight_road):
    assert rendered_steps(straight_road, Rates(), []) == []


def test_frames_that_a_slower_policy_never_sees_are_skipped(straight_road):
    rates = Rates(control_us=100_000, camera_us=100_000, policy_us=500_000)
    assert rendered_steps(straight_road, rates, [SensorSpec("front")]) == [0, 5, 10, 15, 20, 25]


def test_a_slow_camera_is_rendered_at_its_own_times(straight_road):
    rates = Rates(control_us=100_000, camera_us=300_000, policy_us=100_000)
    assert rendered_steps(straight_road, rates, [SensorSpec("front")]) == list(range(0, 30, 3))


def test_the_sensor_may_ask_for_a_period_of_its_own(straight_road):
    assert rendered_steps(straight_road, Rates(), [SensorSpec("front", 1_000_000)]) == [0, 10, 20]


def test_shutter_start_and_end_poses_follow_the_motion(straight_road):
    camera = replace(straight_road.cameras[0], shutter_us=50_000)
    scenario = replace(straight_road, cameras=(camera,))
    clock = Clock(scenario.start_us, scenario.end_us, Rates())
    rig = CameraRig(scenario, [SensorSpec("front")], clock)
    tick = list(clock.ticks())[10]
    (request,) = rig.requests(tick, replace_end(LoopState.at_start(scenario, 30), tick.t_us), {})
    moved = request.T_world_camera[1, :3, 3] - request.T_world_camera[0, :3, 3]
    np.testing.assert_allclose(moved, [0.5, 0.0, 0.0], atol=1e-9)


def test_a_rolling_shutter_exposes_rows_and_road_users_at_their_own_times(
    straight_road,
):
    camera = replace(straight_road.cameras[0], shutter_us=30_000)
    scenario = replace(straight_road, cameras=(camera,))
    clock = Clock(scenario.start_us, scenario.end_us, Rates())
    rig = CameraRig(scenario, [SensorSpec("front")], clock)
    history = replace_end(LoopState.at_start(scenario, 30), clock.start_us + 1_000_000)
    first, second = list(clock.ticks())[:2]
    (begun,) = rig.requests(first, history, {"car": se2(20.0, 0.0, 0.0)})
    (request,) = rig.requests(
        second, history, {"car": se2(21.0, 0.0, 0.0), "new": se2(5.0, 0.0, 0.0)}
    )
    assert begun.exposure.actors_start["car"][0, 3] == 20.0
    assert request.exposure.actors_start["car"][0, 3] == pytest.approx(20.7)
    assert request.exposure.actors_start["new"][0, 3] == 5.0
    assert request.exposure.share.shape == (camera.height, 1)
    assert request.exposure.share[[0, -1], 0].tolist() == [0.0, 1.0]


def test_every_frame_but_the_last_is_taken_when_all_rates_agree(straight_road):
    # No drive follows the last instant, so nobody would look at its frame.
    assert rendered_steps(straight_road, Rates(), [SensorSpec("front")]) == list(range(30))

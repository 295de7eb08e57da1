"""Closed loop behind a fixer: drafts along the plan, whole blocks, and the history of true
frames.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.core.errors import FixerError, InputError, RendererError
from alpasim_plugin.core.types import (
    Latency,
    SensorSpec,
)
from alpasim_plugin.fixers import fixer_settings, make_fixer
from tests.examples import first_of
from tests.fixers.block_fixers import (
    Blend,
    GivesFloats,
    GuardSteps,
    LosesAFrame,
    Raises,
    ShiftsTime,
    fixed_offline,
)
from tests.runs.fixed_drives import Watching, Zigzag, assert_same_pictures, drive, rendered

pytestmark = pytest.mark.slow


# --- speculative


@pytest.mark.parametrize("mode", first_of(["chunk", "speculative"]))
def test_the_streaming_network_has_the_history_of_the_true_frames(straight_road, mode):
    sizes = ("dit.width=32", "dit.blocks=1", "dit.head_width=16", "dit.mlp_width=32")
    small = ("weights.bundle=null", *sizes, "untrained=random", "uses_map=false")

    def network():
        return make_fixer(
            "onefixer-dit-tiny",
            fixer_settings("onefixer-dit-tiny", small),
            scene_id="straight-road",
            threads=1,
        )  # type: ignore[return-value]

    scenario = replace(straight_road, end_us=2_000_000)
    run = drive(scenario, Zigzag, network, mode=mode, tolerance_m=0.01)
    if mode == "speculative":
        assert run.session.facts()["redrafts"] > 0
    offline = fixed_offline(network(), rendered(scenario, run.requests))
    shown = (
        range(13) if mode == "chunk" else (4, 12)
    )  # in speculative mode a block's last frame is of the true block
    for i in shown:
        assert_same_pictures(run.frames[i : i + 1], offline[i : i + 1])


@pytest.mark.parametrize("tolerance_m", first_of([0.02, 0.0, 100.0]))
def test_the_history_is_of_true_frames_whatever_the_forecasts_were(straight_road, tolerance_m):
    run = drive(straight_road, Zigzag, tolerance_m=tolerance_m, tolerance_deg=180.0)
    facts = run.session.facts()
    assert facts["forecast_error"]["camera_m"] > 0.05
    assert (facts["redrafts"] > 0) == (tolerance_m < 100.0)
    true = rendered(straight_road, run.requests)
    (fixer,) = run.fixers
    assert_same_pictures(
        [frame for block in fixer.taken for frame in block], true[:29]
    )  # 5 + 8 + 8 + 8 of 30
    offline = fixed_offline(Blend(), true)
    for last in (4, 12, 20, 28):  # a block's last frame comes from the block of true frames
        assert_same_pictures(run.frames[last : last + 1], offline[last : last + 1])


def test_a_frame_is_never_further_off_than_the_tolerance(straight_road):
    run = drive(straight_road, Zigzag, tolerance_m=0.02, tolerance_deg=0.2)
    errors = [frame.facts["pose_error_m"] for frame in run.frames]
    assert 0.0 < max(errors) <= 0.02
    assert run.session.facts()["shown_error"]["camera_deg"] <= 0.2
    assert max(frame.facts.get("forecast_error_m", 0.0) for frame in run.frames) > 0.02


@pytest.mark.slow
def test_a_reactive_actor_that_brakes_unforeseen_makes_a_new_draft(straight_road):
    ahead, parked = straight_road.actors
    idm = replace(
        ahead, behaviour=replace(ahead.behaviour, kind="idm", params={"desired_speed_mps": 3.0})
    )
    facts = drive(replace(straight_road, actors=(idm, parked))).session.facts()
    assert facts["forecast_error"]["actor_m"] > 0.02
    assert facts["forecast_error"]["camera_m"] < 1e-6
    assert facts["redrafts"] > 0


def test_a_delayed_plan_is_predicted_until_the_next_query_takes_effect(
    straight_road,
):
    scenario = replace(straight_road, warmup_us=0, latency=Latency("fixed", 400_000))
    run = drive(scenario, Zigzag, tolerance_m=100.0, tolerance_deg=180.0)
    errors = [frame.facts.get("forecast_error_m") for frame in run.frames]
    assert errors[1:5] == [
        0.0,
        0.0,
        0.0,
        0.0,
    ]  # nothing is in force yet: the vehicle coasts, and the first plan is not predicted
    # The block from 0.5 s on knows the plans of 0.1 to 0.4 s, the last of which takes effect at 0.8
    # s.
    assert max(errors[6:10]) < 1e-9 < min(errors[10:13])


def with_rear_camera(scenario):
    front = scenario.cameras[0]
    turned = front.T_rig_camera.copy()
    turned[:2, :3] *= -1
    rear = replace(front, name="rear", T_rig_camera=turned)
    return replace(scenario, cameras=(front, rear))


class BothWays(Watching):
    sensors: Sequence[SensorSpec] = (SensorSpec("front"), SensorSpec("rear"))


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["chunk", "speculative"])
def test_cameras_in_step_share_a_fixer_and_not_their_histories(straight_road, mode):
    scenario = with_rear_camera(straight_road)
    run = drive(scenario, BothWays, mode=mode)
    assert len(run.fixers) == 1
    assert {len(call) for call in run.calls} == ({2} if mode == "speculative" else {10, 16})
    for camera in ("front", "rear"):
        requests = [request for request in run.requests if request.camera.name == camera]
        offline = fixed_offline(Blend(), rendered(scenario, requests))
        assert_same_pictures([frame for frame in run.frames if frame.camera == camera], offline)


def test_the_session_of_a_finished_rollout_is_not_taken_for_another(
    straight_road,
):
    run = drive(straight_road)
    with pytest.raises(RendererError):
        run.session.render_batch(run.calls[0])


# --- chunk


@pytest.mark.parametrize("policy", first_of([Zigzag, Watching]))
def test_whole_blocks_of_true_frames_equal_the_offline_result(straight_road, policy):
    run = drive(straight_road, policy, mode="chunk")
    assert [len(call) for call in run.calls] == [5, 8, 8, 8]
    assert_same_pictures(run.frames, fixed_offline(Blend(), rendered(straight_road, run.requests)))
    assert run.policy.asked == [400_000, 1_200_000, 2_000_000, 2_800_000]
    assert (
        run.recorder.facts()["frames"] == 29
    )  # the block that the end cuts off is not made: nobody would look


def test_a_warm_up_shorter_than_the_first_block_is_refused(straight_road):
    with pytest.raises(InputError):
        drive(replace(straight_road, warmup_us=300_000), mode="chunk")


# --- faults and facts


@pytest.mark.parametrize("mode", ["speculative", "chunk"])
@pytest.mark.parametrize("fixer", [Raises, LosesAFrame, ShiftsTime, GivesFloats])
def test_a_fixer_that_breaks_its_contract_is_named(straight_road, mode, fixer):
    with pytest.raises(FixerError) as caught:
        drive(straight_road, fixer=fixer, mode=mode)
    assert caught.value.failure_class == "fixer fault"
    assert fixer.__name__ in caught.value.message


@pytest.mark.parametrize(("mode", "refused"), [("speculative", 12), ("chunk", 11)])
def test_frames_that_the_guard_refused_are_counted_and_the_rollout_goes_on(
    straight_road, mode, refused
):
    facts = drive(straight_road, fixer=GuardSteps, mode=mode).recorder.facts()
    assert facts["steps"] == 30
    assert facts["frame_events"] == {
        "fixer-nan": refused
    }  # frames 0, 3 of five and 0, 3, 6 of eight, once each


@pytest.mark.parametrize("mode", ["speculative", "chunk"])
def test_stages_are_told_apart_and_shared_by_the_frames_of_a_call(straight_road, mode):
    run = drive(straight_road, mode=mode, uses_map=True)
    facts = run.recorder.facts()
    frames = facts["frames"]
    assert facts["first_call_frames"] == (5 if mode == "chunk" else 1)
    assert len(facts["stage_ms"]["render"]) == frames
    assert set(facts["stage_ms"]) >= {"render", "map", "fix"}
    assert len(facts["stage_ms"]["map"]) == len(facts["stage_ms"]["fix"]) == frames
    assert facts["stage_ms"]["fix"].count(0.0) == (
        0 if mode == "chunk" else 30 - 5 - 4
    )  # five drafts, four whole blocks
    assert all(ms >= 0 for stage in ("render", "map", "fix") for ms in facts["stage_ms"][stage])


def test_maps_are_drawn_at_the_poses_of_the_frames(straight_road):
    class KeepsMaps(Blend):
        def step(self, block, maps):
            self.maps = [*getattr(self, "maps", []), *maps]
            return super().step(block, maps)

    run = drive(straight_road, Zigzag, KeepsMaps, uses_map=True, mode="chunk")
    (fixer,) = run.fixers
    maps = fixer.maps  # type: ignore[attr-defined]
    assert len(maps) == 29
    assert maps[0].shape == (64, 96, 3)
    assert maps[0].any()
    assert not np.array_equal(maps[5], maps[28])

"""The loop, with the real renderer, policies, vehicle and log."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin import make_policy, make_renderer, run_rollout
from alpasim_plugin.core.errors import PolicyError, RendererError
from alpasim_plugin.core.geometry import interpolate, inverse, offset_trajectory
from alpasim_plugin.core.types import (
    Frame,
    Latency,
    Plan,
    SensorSpec,
)
from alpasim_plugin.log.run_folder.schema import LOG_NAME
from alpasim_plugin.runs.recorder import Recorder
from alpasim_plugin.runs.scoring import tabulate
from evaluators import score
from policies.simple import PurePursuit
from tests.examples import first_of


def drive(scenario, policy, renderer="clean", threads=1, seed=0):
    session = make_renderer(renderer, scenario, seed, threads=threads)
    return run_rollout(
        scenario, session, make_policy(policy, scenario), seed, Recorder(scenario, seed)
    )


def digest(recorder):
    return hashlib.sha256((recorder.folder / LOG_NAME).read_bytes()).hexdigest()


def test_log_replay_reproduces_the_recorded_poses(straight_road):
    log = drive(straight_road, "log-replay").log()
    rig = offset_trajectory(log.ego, inverse(log.T_rig_box))
    recorded = interpolate(straight_road.ego_log, rig.t_us)
    assert_allclose(rig.xyz, recorded[:, :3, 3], atol=1e-4)  # poses are float32 in the log


def test_the_log_has_one_more_instant_than_steps_and_a_plan_for_each_step(
    straight_road,
):
    recorder = drive(straight_road, "lane-camera")
    log = recorder.log()
    assert len(log.ego) == 31
    assert len(log.plans) == 30
    assert len(log.images) == recorder.facts()["frames"] == 30
    assert [plan.now_us for plan in log.plans] == list(range(0, 3_000_000, 100_000))


def test_the_recorded_pose_is_forced_during_the_warm_up_only(straight_road):
    log = drive(straight_road, "constant-velocity").log()
    braking = run_rollout(
        straight_road, make_renderer("clean", straight_road), StandStill(), 0
    ).log()
    warm = log.ego.t_us <= 1_000_000
    assert_allclose(braking.ego.xyz[warm], log.ego.xyz[warm], atol=1e-4)
    assert braking.ego.xyz[-1, 0] < log.ego.xyz[-1, 0] - 2.0


@pytest.mark.parametrize("renderer", first_of(["3dgs", "clean"]))
def test_the_same_rollout_twice_is_equal_to_the_byte_for_any_number_of_threads(
    straight_road, renderer
):
    once = digest(drive(straight_road, "lane-camera", renderer, threads=1))
    assert digest(drive(straight_road, "lane-camera", renderer, threads=2)) == once


def test_seeds_change_a_sampling_policy_and_nothing_in_the_warm_up(straight_road):
    zero, one = (drive(straight_road, "lane-camera", seed=seed).log() for seed in (0, 1))
    warm = zero.ego.t_us <= 1_000_000
    assert_array_equal(zero.ego.xyz[warm], one.ego.xyz[warm])
    assert not np.array_equal(zero.ego.xyz[~warm], one.ego.xyz[~warm])


class StandStill:
    """Plans to stay where it is; asks for the camera."""

    sensors = (SensorSpec("front"),)

    def reset(self, seed, route):
        pass

    def act(self, observation):
        times = observation.t_us + np.array([0, 1_000_000, 4_000_000])
        return Plan(observation.t_us, times, np.zeros((3, 2)), np.zeros(3))


class LateBrake(StandStill):
    """Drives on for a second of questions, then stands still: shows when a plan takes effect."""

    def act(self, observation):
        plan = super().act(observation)
        if observation.t_us < 1_500_000:
            along = (plan.times_us - plan.t_us) * 1e-6 * 10.0
            return replace(plan, xy=np.stack([along, np.zeros(3)], axis=1))
        return plan


def test_the_policy_is_told_its_route_from_the_scenario_s_offset_on(straight_road):
    """And pure pursuit drives straight to where it begins."""
    asked = []

    class Asked(PurePursuit):
        def act(self, observation):
            asked.append(observation.route_rig)
            return super().act(observation)

    scenario = replace(straight_road, route_offset_m=40.0)
    log = run_rollout(scenario, make_renderer("clean", scenario), Asked(scenario), 0).log()
    whole = run_rollout(
        straight_road, make_renderer("clean", straight_road), PurePursuit(straight_road), 0
    ).log()
    assert {round(float(route[0, 0]), 1) for route in asked[:5]} == {42.1}
    assert_allclose(log.ego.xyz, whole.ego.xyz, atol=0.05)


def test_a_fixed_latency_delays_the_reaction_by_exactly_that_time(straight_road):
    def when_braking(latency):
        scenario = replace(straight_road, latency=latency)
        log = run_rollout(scenario, make_renderer("clean", scenario), LateBrake(), 0).log()
        speed = np.diff(log.ego.xyz[:, 0]) / 0.1
        return int(log.ego.t_us[int(np.argmax(speed < 9.5))])

    assert when_braking(Latency("fixed", 300_000)) - when_braking(Latency("none")) == 300_000


class Raises(StandStill):
    """Breaks."""

    def act(self, observation):
        raise ValueError("the weights are gone")


class NotFinite(StandStill):
    """Answers NaN."""

    def act(self, observation):
        return replace(super().act(observation), yaw=np.full(3, np.nan))


class Stale(StandStill):
    """Answers for an instant that has passed."""

    def act(self, observation):
        plan = super().act(observation)
        return replace(plan, times_us=plan.times_us - 1)


class BareArray(StandStill):
    """Answers with positions alone."""

    def act(self, observation):
        return super().act(observation).xy  # type: ignore[return-value]


BROKEN = [
    (Raises, "ValueError: the weights are gone"),
    (NotFinite, "not finite"),
    (Stale, "times_us starts at -1 us"),
    (BareArray, "act returned a ndarray of shape"),
]


@pytest.mark.parametrize(("policy", "found"), BROKEN)
def test_a_broken_policy_is_named_and_not_driven(straight_road, policy, found):
    with pytest.raises(PolicyError, match=found):
        run_rollout(straight_road, make_renderer("clean", straight_road), policy(), 0)


class WrongSize:
    """Gives frames of another size."""

    def render(self, request):
        return Frame(request.t_us, request.camera.name, np.zeros((2, 2, 3), dtype=np.uint8))


class Breaks:
    """Raises."""

    def render(self, request):
        raise RuntimeError("out of memory")


@pytest.mark.parametrize(
    ("renderer", "found"),
    [(WrongSize, r"uint8 \(2, 2, 3\), not uint8 \(64, 96, 3\)"), (Breaks, "out of memory")],
)
def test_a_broken_renderer_is_named_and_its_frame_not_used(straight_road, renderer, found):
    with pytest.raises(RendererError, match=found):
        run_rollout(straight_road, renderer(), StandStill(), 0)


class Writes(StandStill):
    """Writes into an array that it receives, as `pose -= origin` does by accident."""

    def __init__(self, array_of, at_reset=False):
        self.array_of = array_of
        self.at_reset = at_reset

    def reset(self, seed, route):
        super().reset(seed, route)
        if self.at_reset:
            self.array_of(route)[...] = 0

    def act(self, observation):
        if not self.at_reset:
            self.array_of(observation)[...] = 0
        return super().act(observation)


@pytest.mark.parametrize(
    "policy",
    [
        Writes(lambda seen: seen.ego.T_world_rig),
        Writes(lambda seen: seen.history.xyz),
        Writes(lambda seen: seen.frames["front"].rgb),
        Writes(lambda seen: seen.cameras["front"].K),
        Writes(lambda route: route.xyz, at_reset=True),
    ],
)
def test_a_policy_that_writes_into_what_it_receives_is_named(straight_road, policy):
    with pytest.raises(PolicyError, match="read-only"):
        run_rollout(straight_road, make_renderer("clean", straight_road), policy, 0)


class Black:
    """Gives black frames of the right form."""

    def render(self, request):
        return Frame(
            request.t_us,
            request.camera.name,
            np.zeros((request.camera.height, request.camera.width, 3), dtype=np.uint8),
        )


class WritesIntoItsRequest(Black):
    """Moves the camera that it was asked to render, in place."""

    def __init__(self, array_of):
        self.array_of = array_of

    def render(self, request):
        self.array_of(request)[...] = 0
        return super().render(request)


@pytest.mark.parametrize(
    "array_of",
    [lambda request: request.T_world_camera, lambda request: request.camera.T_rig_camera],
)
def test_a_renderer_that_writes_into_its_request_is_named(straight_road, array_of):
    with pytest.raises(RendererError, match="read-only"):
        run_rollout(straight_road, WritesIntoItsRequest(array_of), StandStill(), 0)


def test_black_frames_are_counted_not_dropped(straight_road):
    recorder = run_rollout(straight_road, Black(), StandStill(), 0)
    assert recorder.facts()["frame_events"] == {"black": 30}


def test_a_failed_rollout_leaves_no_finished_log(straight_road, tmp_path):
    recorder = Recorder(straight_road, 0, tmp_path)
    with pytest.raises(PolicyError), recorder:
        run_rollout(straight_road, make_renderer("clean", straight_road), Raises(), 0, recorder)
    assert not (tmp_path / LOG_NAME).exists()


def test_a_rollout_under_alpasim_s_presets_has_its_scene_score(straight_road):
    """The share of the recording's way, over 0.8, and nothing under other presets."""
    recorder = drive(straight_road, "log-replay")
    log = recorder.log()
    for preset in ("alpasim", "alpasim@6f1029c"):
        _, scores = tabulate(log, score(log, straight_road.scene, preset), preset)
        mark = scores.metrics["scene_score"]
        share = min(scores.metrics["progress_clipped_rel"].value / 0.8, 1.0)
        assert (mark.value, mark.valid) == (pytest.approx(share), True)
    _, scores = tabulate(log, score(log, straight_road.scene, "strict"), "strict")
    assert "scene_score" not in scores.metrics


def test_a_scene_score_that_lacks_a_metric_has_no_value(straight_road):
    log = drive(straight_road, "log-replay").log()
    series = score(log, straight_road.scene, "alpasim")
    _, scores = tabulate(
        log, [one for one in series if one.name != "gt_dist_traveled_m"], "alpasim"
    )
    mark = scores.metrics["scene_score"]
    assert (mark.value, mark.valid) == (None, False)
    assert "missing metric 'gt_dist_traveled_m'" in mark.reason

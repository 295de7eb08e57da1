"""AlpaSim's known defects and surprises, each by name: what preset ``alpasim`` reproduces, and what
``strict`` does instead.

The numbers D-01, D-02, ... are those of docs/experiments/alpasim-parity.md. Quirks of AlpaSim's
runtime, driver and physics are not about scoring a log and have no test here.
"""

import pickle
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.geometry import inverse, offset_trajectory
from alpasim_plugin.core.types import (
    LaneMap,
    LoggedImage,
    LoggedPlan,
)
from alpasim_plugin.log import read_asl
from alpasim_plugin.log.asl import AslFile, AslReader
from evaluators import PRESETS, reduce_rollout, resolve_evaluators, score
from evaluators.alpasim import (
    EvalSettings,
    ScoredRollout,
    metrics_unprocessed_table,
    over_sweeps,
    reduce_run,
    scene_score,
)
from evaluators.alpasim.settings import PlanDeviation, SceneScoreSettings, Scorers
from tests.evaluators.eval_build import (
    DT_US,
    T_RIG_BOX,
    TWO_LANES,
    by_name,
    car,
    lane,
    road_map,
    rollout,
    scene,
    scored,
    track,
    values_of,
)
from tests.log.make_rollout import write_rollout

ALPASIM = PRESETS["alpasim"]
STRICT = PRESETS["strict"]
STAND = track(np.zeros(4), 0.0)
DRIVE = track(np.arange(80) * 1.0, 0.0)
FRONT_WIDE = "camera_front_wide_120fov"


def both(log, road=TWO_LANES):
    """Score a log with ``alpasim`` and with ``strict``."""
    return scored(log, road, "alpasim"), by_name(score(log, scene(road, log), "strict"))


def values(log, preset, road=TWO_LANES):
    return {name: one.value for name, one in values_of(log, road, preset).items()}


def image(t_us, bright, camera=FRONT_WIDE):
    data = cv2.imencode(".png", np.full((4, 6, 3), bright, dtype=np.uint8))[1].tobytes()
    return LoggedImage(camera, t_us - 30_000, t_us, data)


def plan(now_us, xs, samples=(), step_us=DT_US, query_us=None):
    """A plan of box centres from ``now_us`` on; samples are (x, y) arrays at the same spacing."""

    def poses(x, y):
        return offset_trajectory(
            track(x, y, t_us=now_us + step_us * np.arange(np.size(x))), inverse(T_RIG_BOX)
        )

    return LoggedPlan(
        now_us,
        now_us + DT_US if query_us is None else query_us,
        poses(xs, 0.0),
        tuple(poses(*one) for one in samples),
    )


# --- contact


def test_d01_of_several_contacts_only_the_last_named_one_is_classified():
    # The box that the spatial index names last decides; where the car behind stands changes which
    # one that is.
    ahead = car("ahead", track(np.full(4, 4.5), 0.0))
    found = {}
    for shift in (0.0, 0.2):
        log = rollout(STAND, [ahead, car("behind", track(np.full(4, -4.5), shift))])
        alpasim, strict = both(log)
        found[shift] = (alpasim["collision_front"].value[1], alpasim["collision_rear"].value[1])
        assert (strict["collision_front"].value[1], strict["collision_rear"].value[1]) == (1.0, 1.0)
        assert values(log, "paper")["collision_at_fault"] == 1.0
    assert found == {0.0: (1.0, 0.0), 0.2: (0.0, 1.0)}
    assert (
        values(log, "alpasim")["collision_at_fault"] == 0.0
    )  # a front contact that is nobody's fault


def test_d02_invalid_values_enter_alpasims_rollout_values():
    alone = rollout(STAND)
    assert values(alone, "alpasim")["min_distance_to_obstacle_m"] == np.inf
    one = values_of(alone)["min_distance_to_obstacle_m"]
    assert (one.value, one.valid, one.reason) == (None, False, "no other actor is present")


def test_d29_braking_for_a_follower_is_never_at_fault_and_pays():
    behind = car("behind", track(np.linspace(-30.0, -1.0, 4), 0.0))
    log = rollout(
        track(np.array([0.0, 2.0, 3.0, 3.2]), 0.0),
        [behind],
        images=[image(0, 99), image(300_000, 99)],
    )
    for preset in ("alpasim", "strict"):
        got = values(log, preset)
        assert (got["collision_any"], got["collision_rear"], got["collision_at_fault"]) == (
            1.0,
            1.0,
            0.0,
        )
    run = [ScoredRollout("s", "a", tuple(score(log, scene(TWO_LANES, log), "alpasim")))]
    assert over_sweeps(reduce_run(run, ALPASIM))["avg_dist_between_incidents_at_fault"] == np.inf
    passed = {
        "progress_clipped_rel": 0.9,
        "gt_dist_traveled_m": 50.0,
        "collision_at_fault": 0.0,
        "offroad": 0.0,
    }
    assert scene_score(passed, SceneScoreSettings()).passed


# --- road


def test_d05_a_missing_map_counts_as_on_the_road_in_alpasims_combined_events():
    log = rollout(track(np.arange(4.0), 0.0), images=[image(300_000, 99)])
    run = [ScoredRollout("s", "a", tuple(score(log, scene(LaneMap({}), log), "alpasim")))]
    (one,) = reduce_run(run, ALPASIM)
    assert "offroad" not in one.values
    assert one.values["offroad_or_collision"] == 0.0
    with pytest.raises(EvaluatorError, match="missing metric 'offroad'"):
        scene_score(one.values, SceneScoreSettings())
    with pytest.raises(EvaluatorError, match="the map has no lanes"):
        score(log, scene(LaneMap({}), log), "strict")


def test_d06_far_off_the_road_is_on_the_road_for_alpasim():
    alpasim, strict = both(rollout(track(np.arange(4.0), -30.0)))
    assert not alpasim["offroad"].value.any()
    assert strict["offroad"].value.all()
    assert strict["offroad_margin_m"].value == pytest.approx(-30.0 + 1.75 - 0.94, abs=1e-6)


def test_d07_a_road_seven_metres_below_the_ego_is_searched_in_3d():
    # Alone in its lane by plan view, but 7 m above it: no lane is near, and the edges are not
    # touched either.
    alpasim, strict = both(rollout(track(np.arange(4.0), 0.0, z=7.0)))
    assert not alpasim["offroad"].value.any()
    assert not alpasim["min_distance_to_lane_boundary_m"].value.any()  # zero: not contained
    assert strict["offroad"].value.all()  # that road is another one's


def test_d08_a_seam_between_lanes_breaks_alpasims_union():
    gap = 0.05
    road = road_map(
        lane("right", 0.0),
        lane("left", 3.5 + gap),
        edges=[
            np.array([[-50.0, 1.75 + gap / 2, 0.0], [200.0, 1.75 + gap / 2, 0.0]]),
            np.array([[-50.0, -1.75, 0.0], [200.0, -1.75, 0.0]]),
        ],
    )
    log = rollout(track(np.arange(4.0), 1.75))
    alpasim, strict = both(log, road)
    assert alpasim["offroad"].value.all()
    assert not strict["offroad"].value.any()


def test_d09_alpasim_compares_headings_without_wrapping():
    west = lane("west", 0.0)
    west = replace(
        west,
        centre=np.array([*west.centre[::-1], [0, 0, 0], [0, 0.0001, 0]]),
        left=west.right[::-1],
        right=west.left[::-1],
    )
    log = rollout(track(-np.arange(4.0), 0.0, yaw=-np.pi + 1e-3))
    alpasim, strict = both(log, road_map(west, edges=TWO_LANES.road_edges))
    assert alpasim["wrong_lane"].value.all()
    assert not strict["wrong_lane"].value.any()


# --- rows and time


def test_d11_a_rollout_without_handover_is_scored_whole_by_alpasim():
    log = rollout(STAND, warmup_us=10_000_000)
    assert values(log, "alpasim")["collision_any"] == 0.0
    for one in values_of(log).values():
        assert one.value is None
        assert "never took over" in one.reason


def test_d16_the_ego_is_found_by_name_wherever_a_log_puts_it(tmp_path):
    path = write_rollout(tmp_path / "rollout.asl")
    first = tmp_path / "first.asl"
    with AslFile(first) as out:
        for entry in AslReader(path):
            if entry.WhichOneof("log_entry") == "actor_poses":
                poses = sorted(entry.actor_poses.actor_poses, key=lambda one: one.actor_id != "EGO")
                del entry.actor_poses.actor_poses[:]
                entry.actor_poses.actor_poses.extend(poses)
            out.write(entry)
    for preset in ("alpasim", "strict"):
        one, two = (scored(log, preset=preset) for log in map(read_asl, (path, first)))
        assert set(one) == set(two)
        for name, series in one.items():
            np.testing.assert_array_equal(series.value, two[name].value)


def test_d26_the_first_two_recording_based_values_are_invented_by_alpasim():
    log = rollout(track(np.arange(6) * 1.0, 2.0), log=track(np.arange(6) * 1.0, 0.0))
    alpasim, strict = both(log)
    assert alpasim["dist_to_gt_trajectory"].value == pytest.approx([0.0, 0.0, 2.0, 2.0, 2.0, 2.0])
    assert strict["dist_to_gt_trajectory"].value == pytest.approx(2.0)
    assert alpasim["progress"].value[:3] == pytest.approx([0.0, 0.2, 0.4])
    assert alpasim["progress_rel"].value[:2].tolist() == [1.0, 1.0]


# --- images


def test_d03_without_front_wide_images_alpasims_whole_aggregation_stops():
    log = rollout(STAND, images=[image(300_000, 99, "another_camera")])
    run = [ScoredRollout("s", "a", tuple(score(log, scene(TWO_LANES, log), "alpasim")))]
    with pytest.raises(EvaluatorError, match="no image of camera"):
        reduce_run(run, ALPASIM)
    assert values(log, "strict")["img_is_black"] == 0.0  # every camera counts


def test_d25_an_image_is_counted_at_every_step_since_the_image_before():
    log = rollout(STAND, images=[image(0, 99), image(300_000, 3)])
    alpasim, strict = both(log)
    assert alpasim["img_is_black"].t_us.tolist() == [0, 100_000, 200_000, 300_000]
    assert alpasim["img_is_black"].value.tolist() == [0.0, 1.0, 1.0, 1.0]
    assert (strict["img_is_black"].t_us.tolist(), strict["img_is_black"].value.tolist()) == (
        [0, 300_000],
        [0.0, 1.0],
    )


# --- plans


def test_d04_one_sample_that_is_too_short_removes_all_of_alpasims_min_ade():
    xs = np.arange(1.0, 41.0)  # 3.9 s
    log = rollout(DRIVE, plans=[plan(DT_US, xs, samples=[(xs, 0.5)])])
    alpasim, strict = both(log)
    assert not any(name.startswith("min_ade") for name in alpasim)
    assert strict["min_ade@2.5s(gt)"].value == pytest.approx([0.5])
    assert not strict["min_ade@5.0s(gt)"].valid.any()


def test_d19_the_least_number_of_plan_times_is_read_and_never_used():
    few, many = (
        EvalSettings(scorers=Scorers(plan_deviation=PlanDeviation(min_timesteps=n))).preset()
        for n in (1, 500)
    )
    assert few == many
    xs = np.arange(3.0)
    log = rollout(DRIVE, plans=[plan(0, xs), plan(DT_US, xs + 1.0)])
    for preset in (many, STRICT):  # one common time is enough in both
        assert scored(log, preset=preset)["plan_deviation"].valid.all()


def test_d28_an_answer_between_two_logged_times_is_read_from_the_next_one():
    # A sample whose error grows by 1 cm a step shows which steps were averaged: logged times every
    # 50 ms, answer at 120 ms.
    fine = track(np.arange(240) * 0.5, 0.0, t_us=50_000 * np.arange(240))
    now = 120_000
    xs = np.arange(120) * 0.5 + now * 1e-5
    log = rollout(
        fine,
        plans=[plan(now, xs, samples=[(xs, 0.01 * np.arange(120))], step_us=50_000, query_us=now)],
    )
    alpasim, strict = both(log)
    times = np.arange(150_000, 150_000 + 50_000 * 60, 50_000)
    error = 0.01 * (times - now) / 50_000
    by_horizon = [int(np.sum(times <= np.ceil((now + 500_000) / 50_000) * 50_000))]
    assert strict["min_ade@0.5s(gt)"].value == pytest.approx(error[: by_horizon[0]].mean())
    # Counted from the next logged time after now, one step is left out at the end.
    assert alpasim["min_ade@0.5s(gt)"].value == pytest.approx(
        error[: by_horizon[0] - 1].mean(), rel=1e-3
    )


# --- trust


class Bomb:
    """Leaves a file behind when unpickled."""

    def __init__(self, target):
        self.target = target

    def __reduce__(self):
        return Path.touch, (self.target,)


def test_d24_nothing_in_a_log_is_ever_unpickled(tmp_path):
    proof = tmp_path / "unpickled"
    path = write_rollout(tmp_path / "rollout.asl")
    armed = tmp_path / "armed.asl"
    with AslFile(armed) as out:
        for entry in AslReader(path):
            if entry.WhichOneof("log_entry") == "driver_return":
                entry.driver_return.debug_info.unstructured_debug_info = pickle.dumps(Bomb(proof))
            out.write(entry)
    log = read_asl(armed)
    for preset in ("alpasim", "strict"):
        found = scored(log, preset=preset)
        assert (
            not found["safety_monitor_triggered"].value.any()
            if preset == "alpasim"
            else "safety_monitor_triggered" not in found
        )
    assert not proof.exists()
    pickle.loads(pickle.dumps(Bomb(proof)))
    assert proof.exists()  # the bomb was live


class OutOfOrder:
    def __call__(self, rollout, scene):
        raise ValueError("out of order")


def test_d18_an_evaluator_that_fails_is_never_swallowed():
    log = rollout(STAND)
    for preset in ("alpasim", "strict"):
        with pytest.raises(EvaluatorError, match="out of order"):
            score(
                log, scene(TWO_LANES, log), preset, resolve_evaluators([f"{__name__}:OutOfOrder"])
            )


# --- tables over rollouts


def test_d27_times_of_written_tables_are_64_bit_integers():
    log = rollout(STAND)
    run = [
        ScoredRollout("s", "a", tuple(score(log, scene(TWO_LANES, log), preset)))
        for preset in ("alpasim", "strict")
    ]
    table = metrics_unprocessed_table(run)
    assert str(table.schema.field("timestamps_us").type) == "int64"
    empty = [row for row in table.to_pylist() if row["timestamps_us"] is None]
    assert {row["name"] for row in empty} >= {
        "plan_deviation",
        "open_loop_collision",
    }  # no plans: one row without a time each


def test_one_rollout_that_never_leaves_the_lane_has_the_same_flags_in_both():
    """The guard of this file: where no quirk is touched, the presets agree."""
    log = rollout(DRIVE, [car("far", track(np.full(80, 150.0), 3.5))])
    alpasim, strict = both(log)
    flags = (
        "collision_any",
        "collision_front",
        "collision_lateral",
        "collision_rear",
        "offroad",
        "wrong_lane",
    )
    assert all(not one[name].value.any() for one in (alpasim, strict) for name in flags)
    assert reduce_rollout(list(alpasim.values()), ALPASIM).ledger.steps_scored == 80

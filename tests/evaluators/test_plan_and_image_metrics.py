"""Plans and images: steadiness, open-loop collisions, minADE, black frames."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import inverse, offset_trajectory, se2, se3, wrap_angle
from alpasim_plugin.core.types import LoggedImage, LoggedPlan, Trajectory
from evaluators import PRESETS, score
from evaluators.metrics.collision import in_rig
from evaluators.metrics.plan import trajectory_table
from tests.evaluators.eval_build import (
    DT_US,
    T_RIG_BOX,
    TWO_LANES,
    by_name,
    car,
    rollout,
    scene,
    track,
    values_of,
)
from tests.evaluators.reference import open_loop_by_plan


def plan(now, x, y=0.0, samples=(), dt_us=DT_US):
    """A plan whose box centre runs along the given positions from step ``now`` on."""

    def poses(xs, ys):
        n = np.size(xs)
        return offset_trajectory(
            track(xs, ys, t_us=now * DT_US + dt_us * np.arange(n)), inverse(T_RIG_BOX)
        )

    return LoggedPlan(
        now * DT_US, (now + 1) * DT_US, poses(x, y), tuple(poses(*one) for one in samples)
    )


def scored(log, preset="paper"):
    return by_name(score(log, scene(TWO_LANES, log), preset))


def drive(n=40):
    return track(np.arange(n) * 1.0, 0.0)


def test_consecutive_plans_that_agree_have_no_deviation():
    plans = [plan(k, np.arange(k, k + 20.0)) for k in range(3)]
    found = scored(rollout(drive(), plans=plans))["plan_deviation"]
    assert found.t_us.tolist() == [DT_US, 2 * DT_US]
    assert found.value == pytest.approx([0.0, 0.0], abs=1e-12)


def test_plan_deviation_weighs_the_k_th_common_time_by_exp_of_minus_a_tenth_k():
    # Old plan at times 0..3, new one at 1..4 with its first pose left out: common times are 2 and
    # 3.
    plans = [plan(0, np.arange(4.0)), plan(1, np.arange(1.0, 5.0), np.array([9.0, 1.0, 3.0, 9.0]))]
    w = np.exp([0.0, -0.1])
    assert scored(rollout(drive(), plans=plans))["plan_deviation"].value == pytest.approx(
        [np.sum(w * [1.0, 3.0]) / w.sum()]
    )


def test_plans_without_a_common_time_have_no_deviation():
    found = scored(rollout(drive(), plans=[plan(0, [0.0, 1.0]), plan(20, [20.0, 21.0])]))[
        "plan_deviation"
    ]
    assert found.valid.tolist() == [False]
    assert found.reason == "the plan and the one before it share no time"


def test_empty_plans_have_no_row():
    nothing = Trajectory(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 4)))
    plans = [LoggedPlan(0, DT_US, nothing), plan(1, np.arange(1.0, 5.0))]
    found = scored(rollout(drive(), plans=plans))
    assert found["open_loop_collision"].t_us.tolist() == [DT_US]
    assert found["plan_deviation"].t_us.tolist() == []


def test_a_plan_is_tested_against_where_actors_really_are_within_three_seconds():
    parked = car("a", track(35.0, 0.0, n=40))
    slow = rollout(
        drive(),
        [parked],
        plans=[
            plan(0, np.arange(30.0)),
            plan(0 + 1, 1 + np.arange(30.0)),
            plan(2, 2 + np.arange(30.0)),
        ],
    )
    # Contact from x >= 35 - 2.25 - 2.4275 = 30.32 on: only poses at x = 31 reach it, 2.9 s after
    # step 2.
    assert scored(slow)["open_loop_collision"].value.tolist() == [0.0, 0.0, 1.0]
    assert open_loop_by_plan(slow, PRESETS["paper"]) == [False, False, True]
    jumps = [
        plan(0, np.array([0.0, 35.0]), dt_us=3_000_001),
        plan(1, np.array([1.0, 35.0]), dt_us=3_000_000),
    ]
    late = rollout(drive(), [parked], plans=jumps)
    assert scored(late)["open_loop_collision"].value.tolist() == [0.0, 1.0]


def test_the_plans_own_first_pose_does_not_count_and_a_vanished_actor_cannot_be_hit():
    there = car("a", track(0.0, 0.0, n=3))
    log = rollout(drive(), [there], plans=[plan(0, [0.0, 50.0]), plan(5, [0.0, 0.0])])
    assert scored(log)["open_loop_collision"].value.tolist() == [0.0, 0.0]


def test_open_loop_collisions_agree_with_the_twin_on_random_plans():
    rng = np.random.Generator(np.random.Philox(7))
    actors = [
        car(
            f"a{k}",
            track(rng.uniform(0, 60, 20), rng.uniform(-12, 12, 20), yaw=rng.uniform(-3, 3, 20)),
        )
        for k in range(4)
    ]
    plans = [
        plan(k, k + np.arange(12.0) + rng.normal(0, 1, 12), rng.normal(0, 2, 12), dt_us=70_000)
        for k in range(15)
    ]
    log = rollout(drive(), actors, plans=plans)
    want = open_loop_by_plan(log, PRESETS["paper"])
    assert 0 < sum(want) < len(want)
    assert scored(log)["open_loop_collision"].value.tolist() == [float(one) for one in want]


def test_min_ade_takes_the_best_sample_over_the_times_from_query_to_horizon():
    x = np.arange(12.0)
    samples = [(x, 1.0), (x, 0.4), (x, np.concatenate([[0.0], np.full(11, 0.7)]))]
    found = scored(rollout(drive(), plans=[plan(0, x, samples=samples)]))
    assert found["min_ade@0.5s(gt)"].value == pytest.approx([0.4])
    assert found["min_ade@1.0s(gt)"].value == pytest.approx([0.4])
    # The samples end 1.1 s after now.
    for name in ("min_ade@2.5s(gt)", "min_ade@5.0s(gt)"):
        assert found[name].valid.tolist() == [False]
        assert found[name].reason == "the log, the target or every sample ends before the horizon"


def test_min_ade_grows_with_the_horizon_as_a_mean_over_time():
    x = np.arange(21.0)
    y = np.arange(21.0) * 0.1  # error at the k-th time is 0.1 k
    found = scored(rollout(drive(), plans=[plan(0, x, samples=[(x, y)])]))
    assert found["min_ade@0.5s(gt)"].value == pytest.approx([0.1 * np.mean(np.arange(1, 6))])
    assert found["min_ade@1.0s(gt)"].value == pytest.approx([0.1 * np.mean(np.arange(1, 11))])


def test_min_ade_against_the_driven_path_has_its_own_name():
    x = np.arange(12.0)
    log = rollout(drive(), log=track(np.arange(40.0), 2.0), plans=[plan(0, x, samples=[(x, 0.0)])])
    own = replace(PRESETS["paper"], min_ade_target="self", min_ade_horizons_s=(1.0,))
    assert scored(log, own)["min_ade@1.0s(self)"].value == pytest.approx([0.0], abs=1e-12)
    assert scored(log)["min_ade@1.0s(gt)"].value == pytest.approx([2.0])


def test_without_samples_there_is_no_min_ade():
    assert not [
        name
        for name in scored(rollout(drive(), plans=[plan(0, np.arange(5.0))]))
        if name.startswith("min_ade")
    ]


def image(t_us, level, camera="front", suffix=".png"):
    pixels = np.full((8, 12, 3), level, dtype=np.uint8)
    return LoggedImage(camera, t_us, t_us, cv2.imencode(suffix, pixels)[1].tobytes())


def test_black_means_no_byte_above_ten():
    log = rollout(
        drive(), images=[image(0, 10), image(DT_US, 11), image(2 * DT_US, 0, suffix=".jpg")]
    )
    found = scored(log)["img_is_black"]
    assert found.t_us.tolist() == [0, DT_US, 2 * DT_US]
    assert found.value.tolist() == [1.0, 0.0, 1.0]


def test_one_black_camera_of_two_is_enough():
    log = rollout(drive(), images=[image(0, 90, "left"), image(0, 0, "right")])
    assert scored(log)["img_is_black"].value.tolist() == [1.0]


def test_a_black_frame_does_not_remove_the_rollout():
    log = rollout(drive(), images=[image(DT_US, 0)])
    values = values_of(log)
    assert values["img_is_black"].value == 1.0
    assert values["collision_any"].value == 0.0


def test_a_log_without_images_has_no_value_for_them():
    log = rollout(drive())
    value = values_of(log)["img_is_black"]
    assert (value.value, value.valid, value.reason) == (
        None,
        False,
        "no value among the scored steps",
    )


def test_bytes_that_are_no_image_are_an_error():
    log = rollout(drive(), images=[LoggedImage("front", 0, 0, b"not a picture")])
    with pytest.raises(InputError, match="13 bytes beginning b'not ', no PNG or JPEG"):
        score(log, scene(TWO_LANES, log))


def test_min_ade_names_carry_every_digit_of_the_horizon():
    xs = np.arange(1.0, 31.0)
    log = rollout(drive(), plans=[plan(1, xs, samples=[(xs, 0.5)])])
    names = [f"min_ade@{text}s(gt)" for text in ("0.25", "0.5", "2.0")]
    for name in ("alpasim", "paper"):
        chosen = replace(PRESETS[name], min_ade_horizons_s=(0.25, 0.5, 2))
        found = by_name(score(log, scene(TWO_LANES, log), chosen))
        assert [key for key in found if key.startswith("min_ade")] == names
        assert found["min_ade@0.25s(gt)"].value == pytest.approx([0.5])


def test_horizons_in_any_order_are_read_as_alpasim_reads_them():
    # Near the log's end the long horizon has no value; AlpaSim then gives it the short one's, since
    # it drops by place.
    xs = np.arange(35.0, 65.0)
    log = rollout(drive(), plans=[plan(35, xs, samples=[(xs, 0.1 * np.arange(30))])])
    found = by_name(
        score(
            log, scene(TWO_LANES, log), replace(PRESETS["alpasim"], min_ade_horizons_s=(2.0, 0.2))
        )
    )
    assert found["min_ade@2.0s(gt)"].value == pytest.approx([0.15])
    assert "min_ade@0.2s(gt)" not in found
    ours = by_name(
        score(log, scene(TWO_LANES, log), replace(PRESETS["paper"], min_ade_horizons_s=(2.0, 0.2)))
    )
    assert not ours["min_ade@2.0s(gt)"].valid.any()
    assert ours["min_ade@0.2s(gt)"].value == pytest.approx([0.15])


def test_a_picture_that_stays_while_the_car_moves_is_frozen_until_it_changes():
    log = rollout(
        drive(), images=[image(k * DT_US, level) for k, level in enumerate((90, 90, 90, 91))]
    )
    assert scored(log)["img_is_frozen"].value.tolist() == [0.0, 1.0, 1.0, 0.0]


def test_one_frozen_camera_of_two_is_enough():
    pictures = [
        image(0, 90, "left"),
        image(0, 50, "right"),
        image(DT_US, 91, "left"),
        image(DT_US, 50, "right"),
    ]
    assert scored(rollout(drive(), images=pictures))["img_is_frozen"].value.tolist() == [0.0, 1.0]


def test_equal_pictures_of_a_standing_car_are_not_frozen_but_creeping_on_behind_one_is():
    still = rollout(track(np.full(4, 3.0), 0.0), images=[image(k * DT_US, 90) for k in range(4)])
    assert scored(still)["img_is_frozen"].value.max() == 0.0
    creeping = rollout(
        track(0.06 * np.arange(4), 0.0), images=[image(k * DT_US, 90) for k in range(4)]
    )
    assert scored(creeping)["img_is_frozen"].value.tolist() == [0.0, 0.0, 1.0, 1.0]


@pytest.mark.parametrize("yaw_deg", [175.0, -100.0])
def test_plans_are_moved_to_a_box_that_is_turned_in_the_rig(yaw_deg):
    T_rig_box = se2(1.4, 0.3, np.radians(10.0), 0.8)
    poses = track([3.0, 4.0], [-2.0, 1.0], yaw=np.radians(yaw_deg))
    origin = np.array([1.0, 2.0, 0.0])
    table = trajectory_table([poses, poses], T_rig_box, origin, PRESETS["strict"])
    expected = se3(poses.xyz, poses.quat) @ T_rig_box
    for row, T_world_box in enumerate([*expected, *expected]):
        assert table.xyz[row] == pytest.approx(T_world_box[:3, 3] - origin)
        assert wrap_angle(table.yaw[row] - np.radians(yaw_deg + 10.0)) == pytest.approx(
            0.0, abs=1e-9
        )
    assert table.start.tolist() == [0, 2, 4]


def test_places_in_the_box_are_moved_to_a_rig_in_which_it_is_turned():
    log = replace(rollout(drive(2)), T_rig_box=se2(1.4, 0.3, np.radians(170.0), 0.8))
    xy = np.array([[2.0, 0.5], [-1.0, -0.7]])
    places = np.column_stack([xy, np.zeros(2), np.ones(2)]) @ log.T_rig_box.T
    np.testing.assert_allclose(in_rig(xy, log), places[:, :2], atol=1e-12)

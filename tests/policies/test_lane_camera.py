"""The camera policy really drives by its pixels: change them and the plan changes."""

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError, PolicyError
from alpasim_plugin.core.geometry import trajectory_from_poses
from alpasim_plugin.core.types import EgoState, Route
from policies.lane_camera import LaneCamera
from policies.painted_road import Line, PaintedRoad, pinhole_camera
from tests.examples import first_of, first_rows_of
from tests.policies.busy_road import Block, BusyRoad, Patch
from tests.policies.policy_world import CAMERA, close_loop, look, observe, route_of, scenario_with

ROAD = PaintedRoad()
SYMMETRIC = PaintedRoad(lines=(Line(1.75), Line(-1.75)), road_m=(-4.0, 4.0))


def policy():
    return LaneCamera(scenario_with())


def lateral(plan, index=20):
    return float(plan.xy[index, 1])  # type: ignore[attr-defined]


# --- the plan depends on the pixels


def test_plan_steers_back_to_the_lane_that_the_picture_shows():
    for offset in (-0.7, -0.3, 0.3, 0.7):
        plan = look(policy(), ROAD.image(CAMERA, ROAD.pose(0.0, offset)))
        assert plan.debug["mode"] == "lane"
        assert plan.debug["lane_offset_m"] == pytest.approx(-offset, abs=0.12)
        # The sample's own error is common to all; two opposite offsets must lead opposite ways.
        assert np.sign(plan.debug["lane_offset_m"]) == -np.sign(offset)
    left = look(policy(), ROAD.image(CAMERA, ROAD.pose(0.0, 0.6)))
    right = look(policy(), ROAD.image(CAMERA, ROAD.pose(0.0, -0.6)))
    assert lateral(right) - lateral(left) == pytest.approx(1.2, abs=0.2)


def test_shifted_picture_shifts_the_plan_although_everything_else_is_the_same():
    picture = SYMMETRIC.image(CAMERA, SYMMETRIC.pose(0.0))
    route = route_of(SYMMETRIC, SYMMETRIC.pose(0.0))
    plain = look(policy(), picture, route_rig=route)
    shifted = look(policy(), np.roll(picture, 8, axis=1), route_rig=route)
    assert shifted.debug["lane_heading_rad"] - plain.debug["lane_heading_rad"] == pytest.approx(
        -8 / CAMERA.K[0, 0], abs=0.01
    )
    assert lateral(shifted) < lateral(plain) - 0.3


def test_mirrored_picture_mirrors_what_is_seen():
    picture = ROAD.image(CAMERA, ROAD.pose(0.0, 0.5), seed=3)
    seen = look(policy(), picture)
    mirrored = look(policy(), picture[:, ::-1].copy())
    assert seen.debug["lane_offset_m"] == pytest.approx(-mirrored.debug["lane_offset_m"], abs=0.03)
    assert seen.debug["lane_width_m"] == pytest.approx(mirrored.debug["lane_width_m"], abs=0.05)


def test_blank_picture_leaves_only_the_route_and_says_so():
    blank = np.full((CAMERA.height, CAMERA.width, 3), 90, dtype=np.uint8)
    curve = PaintedRoad(curvature_1pm=1 / 60)
    plan = look(policy(), blank, route_rig=route_of(curve, curve.pose(0.0)))
    assert plan.debug["mode"] == "route"
    assert plan.debug["route_weight"] == 1.0
    assert lateral(plan, -1) > 5.0
    assert look(policy(), blank).debug["mode"] == "straight"


def test_paint_outweighs_a_route_that_lies_beside_the_lane():
    pose = ROAD.pose(0.0)
    picture = ROAD.image(CAMERA, pose)
    beside = look(policy(), picture, route_rig=route_of(ROAD, pose, 0.8))
    on = look(policy(), picture, route_rig=route_of(ROAD, pose))
    assert beside.debug["route_weight"] < 0.03
    assert abs(lateral(beside) - lateral(on)) < 0.15


def test_lane_is_remembered_over_frames_without_paint():
    one = policy()
    one.reset(0, Route(np.zeros((2, 3))))
    modes = []
    sure = 0.0
    for k in range(30):
        pose = ROAD.pose(k * 0.8, 0.4)
        picture = (
            ROAD.image(CAMERA, pose, seed=k)
            if k < 12
            else np.full((CAMERA.height, CAMERA.width, 3), 90, dtype=np.uint8)
        )
        plan = one.act(observe(picture, EgoState(k * 100_000, pose, 8.0)))
        modes.append(plan.debug["mode"])
        sure = plan.debug["lane_sigma_m"] if k == 11 else sure
        if k == 16:
            assert plan.debug["lane_offset_m"] == pytest.approx(-0.4, abs=0.15)
            assert plan.debug["lane_sigma_m"] > 1.5 * sure
    assert modes[11] == "lane"
    assert modes[14] == "memory"
    assert modes[-1] == "straight", "forgotten after 25 m"


# --- closed loop


@pytest.mark.parametrize(
    ("curvature", "speed"), first_rows_of([(-1 / 40, 8.0), (0.0, 14.0), (1 / 100, 12.0)])
)
def test_lane_is_kept_without_any_route(curvature, speed):
    drive = close_loop(policy(), PaintedRoad(curvature_1pm=curvature), speed, 5.0, with_route=False)
    assert np.abs(drive.offset_m).max() < 0.6
    assert abs(drive.s_m[-1]) > 0.8 * speed * 5.0


def test_car_ahead_is_stopped_for_and_the_car_stays_standing():
    road = BusyRoad(blocks=(Block(42.0),))
    drive = close_loop(policy(), road, 9.0, 8.0)
    front_m = drive.s_m[-1] + 1.4 + 4.855 / 2
    assert drive.speed_mps[-1] == 0.0
    assert 1.0 < 42.0 - 2.25 - front_m < 8.0, "stops short of it, but not far away"
    assert np.diff(drive.speed_mps).min() > -0.75, "and not by slamming the brakes"


@pytest.mark.parametrize(
    "flat",
    first_of(
        [
            tuple(
                Patch((30.0, 33.0), (-3.0 + i, -2.5 + i), (225, 225, 225)) for i in range(9)
            ),  # a crosswalk
            (Patch((30.0, 30.5), (-1.7, 1.7), (230, 230, 230)),),  # a stop line
            (Patch((28.0, 34.0), (-3.0, 6.5), (45, 45, 48)),),  # a shadow
        ]
    ),
    ids=["crosswalk", "stop line", "shadow"],
)
def test_flat_things_on_the_road_are_not_braked_for(flat):
    drive = close_loop(policy(), BusyRoad(patches=flat), 10.0, 4.5)
    assert drive.speed_mps.min() > 8.5
    assert np.abs(drive.offset_m).max() < 0.6


# --- the contract


def test_samples_carry_the_noise_of_the_seed_and_the_same_seed_repeats():
    drives = [close_loop(policy(), ROAD, 10.0, 1.0, seed=seed) for seed in (0, 0, 1)]
    first, again, other = (np.array([p.xy for p in d.plans]) for d in drives)
    assert np.array_equal(first, again)
    assert np.abs(first - other).max() > 0.02
    plan = drives[0].plans[-1]
    assert len(plan.samples) == 5
    assert all(sample.shape == (len(plan.times_us), 3) for sample in plan.samples)
    assert np.ptp([sample[20, 1] for sample in plan.samples]) > 0.05


def test_frame_that_is_late_is_read_for_where_the_car_was_then():
    one = policy()
    one.reset(0, Route(np.zeros((2, 3))))
    curve = PaintedRoad(curvature_1pm=1 / 50)
    for k in range(8):
        pose = curve.pose(k * 0.8 + 4.0)
        then = curve.pose((k - 3) * 0.8 + 4.0)
        times = np.arange(-300_000, 1, 100_000) + 1_000_000 + k * 100_000
        poses = np.array([curve.pose(k * 0.8 + 4.0 - 0.8 * j) for j in (3, 2, 1, 0)])
        history = trajectory_from_poses(times, poses)
        ego = EgoState(1_000_000 + k * 100_000, pose, 8.0)
        plan = one.act(
            observe(curve.image(CAMERA, then, seed=k), ego, history=history, age_us=300_000)
        )
    assert plan.debug["lane_offset_m"] == pytest.approx(0.0, abs=0.15)
    assert plan.debug["lane_heading_rad"] == pytest.approx(0.0, abs=0.03)


def test_missing_or_misshapen_frame_is_a_policy_error():
    one = policy()
    with pytest.raises(PolicyError, match=r"\(10, 10\)"):
        one.act(observe(np.zeros((10, 10, 3), dtype=np.uint8), EgoState(0, np.eye(4), 5.0)))
    without = replace(
        observe(np.zeros((144, 256, 3), dtype=np.uint8), EgoState(0, np.eye(4), 5.0)), frames={}
    )
    with pytest.raises(PolicyError, match="frames of \\[\\]"):
        one.act(without)


def test_scenario_without_a_camera_that_looks_ahead_is_refused():
    back = pinhole_camera("rear")
    turned = back.T_rig_camera.copy()
    turned[:3, :3] = np.diag([-1.0, -1.0, 1.0]) @ turned[:3, :3]
    with pytest.raises(InputError):
        LaneCamera(scenario_with(replace(back, T_rig_camera=turned)))


@pytest.mark.parametrize(
    "camera",
    [
        pinhole_camera(width=480, height=272),
        pinhole_camera(pitch_deg=6.0),
        pinhole_camera(hfov_deg=100.0, mount_m=(2.0, 0.2, 1.3)),
    ],
)
def test_other_cameras_see_the_same_lane(camera):
    one = LaneCamera(scenario_with(camera))  # type: ignore[arg-type]
    plan = look(one, ROAD.image(camera, ROAD.pose(0.0, 0.4)), camera=camera)  # type: ignore[arg-type]
    assert plan.debug["lane_offset_m"] == pytest.approx(-0.4, abs=0.12)


def test_route_half_a_lane_off_does_not_pull_the_car_out_of_its_lane():
    off, on = (close_loop(policy(), ROAD, 12.0, 3.5, route_off_m=r) for r in (0.9, 0.0))
    assert np.abs(off.offset_m - on.offset_m).max() < 0.15


@pytest.mark.slow
def test_slower_car_is_followed_at_a_distance():
    drive = close_loop(
        policy(),
        lambda t: BusyRoad(blocks=(Block(30.0 + 6.0 * t, colour=(210, 210, 215)),)),
        10.0,
        7.0,
    )
    gap = 30.0 + 6.0 * 6.9 - 2.25 - (drive.s_m[-1] + 1.4 + 4.855 / 2)
    assert gap > 4.0
    assert drive.speed_mps[-1] == pytest.approx(6.0, abs=1.5)


@pytest.mark.slow
def test_car_in_the_next_lane_is_passed():
    drive = close_loop(policy(), BusyRoad(blocks=(Block(40.0, 3.5), Block(55.0, 3.5))), 10.0, 5.0)
    assert drive.speed_mps.min() > 8.5


def test_camera_that_sees_no_road_is_refused():
    with pytest.raises(PolicyError):
        LaneCamera(scenario_with(pinhole_camera(pitch_deg=-40.0)))

"""Rollout logs that we write: order, times and numbers of every entry, and what the reader makes of
them.
"""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin.core.geometry import yaw_from_quat
from alpasim_plugin.core.types import Frame, LensModel
from alpasim_plugin.log import AslWriter, decode_image, read_asl
from alpasim_plugin.log.asl import AslReader
from tests.log.make_rollout import (
    ACTORS,
    CAMERA,
    HEADER,
    STEP_US,
    T0_US,
    ego_at,
    picture,
    plan_at,
    present,
    write_rollout,
)


def test_entries_stand_in_the_order_of_alpasims_runtime(path):
    kinds = [entry.WhichOneof("log_entry") for entry in AslReader(path)]
    start = "rollout_metadata available_cameras_request available_cameras_return driver_session_request traffic_session_request"
    frame = "batch_render_request driver_camera_image"
    step = f"{frame} driver_ego_trajectory route_request driver_request driver_return controller_request controller_return actor_poses"
    assert kinds == f"{start} actor_poses actor_poses {' '.join([step] * 4)} {frame}".split()


def test_ego_is_first_in_definitions_and_last_in_poses(path):
    entries = list(AslReader(path))
    definitions = entries[0].rollout_metadata.actor_definitions.actor_aabb
    assert [d.actor_id for d in definitions] == ["EGO", "7", "late", "wall"]
    assert [d.actor_label for d in definitions] == ["", "automobile", "person", "other"]
    assert all(
        e.actor_poses.actor_poses[-1].actor_id == "EGO"
        for e in entries
        if e.HasField("actor_poses")
    )
    objects = next(
        e for e in entries if e.HasField("traffic_session_request")
    ).traffic_session_request.logged_object_trajectories
    assert [(o.object_id, o.is_static) for o in objects] == [
        ("EGO", False),
        ("7", False),
        ("late", False),
        ("wall", True),
    ]


def test_times_and_sizes_are_exact(log):
    assert (log.start_us, log.render_start_us, log.force_gt_us, log.control_us) == (
        T0_US,
        T0_US + STEP_US,
        3 * STEP_US,
        STEP_US,
    )
    assert log.ego.t_us.tolist() == [T0_US + i * STEP_US for i in range(6)]
    assert log.ego_box == HEADER.vehicle.box
    assert {i: a.box for i, a in log.actors.items()} == {a.actor_id: a.box for a in ACTORS}
    assert (log.scene_id, log.session_uuid, log.seed) == ("test-scene", HEADER.session_uuid, 41)
    assert log.warnings == ()


def test_ego_in_the_log_is_the_box_centre(log):
    yaw = 0.3
    offset = HEADER.vehicle.rear_axle_to_centre_m
    rig = HEADER.ego_log.xyz[:6]
    expected = rig + np.array(
        [offset * np.cos(yaw), offset * np.sin(yaw), HEADER.vehicle.box.height_m / 2]
    )
    assert_allclose(log.ego.xyz, expected, atol=1e-6)
    assert_allclose(yaw_from_quat(log.ego.quat), yaw, atol=1e-7)
    assert_allclose(log.T_rig_box[:3, 3], [offset, 0, 0.8], atol=1e-6)
    assert_allclose(log.ego_log.xyz, HEADER.ego_log.xyz, atol=1e-6)


def test_actor_is_there_only_while_it_was_present(log):
    assert log.actors["late"].track.t_us.tolist() == [T0_US + 4 * STEP_US, T0_US + 5 * STEP_US]
    assert_allclose(log.actors["late"].track.xyz, ACTORS[1].track.xyz[:2], atol=1e-6)
    assert [a.is_static for a in log.actors.values()] == [False, False, True]
    assert [a.label for a in log.actors.values()] == ["automobile", "person", "other"]


def test_plans_are_absolute_and_empty_answers_are_counted_not_kept(log):
    assert [(p.now_us, p.query_us) for p in log.plans] == [
        (T0_US + i * STEP_US, T0_US + (i + 1) * STEP_US) for i in (2, 3, 4)
    ]
    assert log.info["empty_plans"] == 1
    for step, plan in zip((2, 3, 4), log.plans, strict=True):
        assert plan.trajectory.t_us[0] == plan.now_us
        assert_allclose(plan.trajectory.xyz, plan_at(step).xyz, atol=1e-6)
    assert [len(p.samples) for p in log.plans] == [0, 2, 2]


def test_png_images_come_back_pixel_for_pixel_in_time_order(log):
    assert [i.end_us for i in log.images] == [T0_US + s * STEP_US for s in range(1, 6)]
    assert all(
        i.end_us - i.start_us == CAMERA.shutter_us and i.camera == CAMERA.name for i in log.images
    )
    for step, image in enumerate(log.images, start=1):
        assert_array_equal(decode_image(image.data), picture(step))


def test_jpeg_images_come_back_close(tmp_path):
    log = read_asl(write_rollout(tmp_path / "a.asl", "jpeg"))
    assert log.images[0].data[:2] == b"\xff\xd8"
    assert np.abs(decode_image(log.images[2].data).astype(int) - picture(3)).mean() < 1.5


def test_images_can_be_left_out(path):
    log = read_asl(path, images=False)
    assert log.images == ()
    assert log.info["entries"]["driver_camera_image"] == 5


def test_camera_survives(log):
    (camera,) = log.info["cameras"]
    assert (camera.name, camera.width, camera.height) == (CAMERA.name, 64, 40)
    assert_array_equal(camera.K, CAMERA.K)
    assert_allclose(camera.T_rig_camera, CAMERA.T_rig_camera, atol=1e-6)


@pytest.mark.parametrize(
    "lens",
    [
        LensModel("opencv", (-0.25, 0.125, 0.5, -0.5, 0.25, 0.0, 0.0, 1.0, 0.125, 0.0, 0.0, 0.5)),
        LensModel("fisheye", (0.5, -0.25, 0.125, 0.0), max_angle_rad=1.5),
        LensModel("ftheta", (0.0, 92.0, -1.5), (), (1.25, 0.5, -0.5), 1.5),
        LensModel("ftheta", (0.0, 92.0), (0.0, 0.015625), (1.0, 0.0, 0.0), 1.5),
    ],
)
def test_the_lens_of_a_camera_survives(tmp_path, lens):
    with AslWriter(tmp_path / "a.asl", HEADER) as log:
        log.begin([replace(CAMERA, lens=lens)])
        log.actor_poses(T0_US + STEP_US, ego_at(1).T_world_rig, present(T0_US + STEP_US))
    info = read_asl(tmp_path / "a.asl").info
    (camera,) = info["cameras"]
    assert camera.lens == lens
    middle = np.array([[1.0, 0.0, CAMERA.K[0, 2]], [0.0, 1.0, CAMERA.K[1, 2]], [0.0, 0.0, 1.0]])
    assert_array_equal(camera.K, middle if lens.kind == "ftheta" else CAMERA.K)
    assert info["other_cameras"] == ()


def test_a_camera_behind_a_windshield_is_named_without_its_lens(tmp_path):
    with AslWriter(tmp_path / "a.asl", HEADER) as log:
        log.begin([CAMERA])
        log.actor_poses(T0_US + STEP_US, ego_at(1).T_world_rig, present(T0_US + STEP_US))
    entries = list(AslReader(tmp_path / "a.asl"))
    for entry in entries:
        for camera in entry.available_cameras_return.available_cameras:
            camera.intrinsics.bivariate_windshield_model_param.SetInParent()
    encoded = [entry.SerializeToString() for entry in entries]
    framed = b"".join(len(entry).to_bytes(4, "big") + entry for entry in encoded)
    (tmp_path / "b.asl").write_bytes(framed)
    info = read_asl(tmp_path / "b.asl").info
    assert (info["cameras"], info["other_cameras"]) == ((), (CAMERA.name,))


def test_controller_entries_hold_the_plan_in_its_own_rig_frame(path):
    requests = [e.controller_request for e in AslReader(path) if e.HasField("controller_request")]
    assert [r.coerce_dynamic_state for r in requests] == [True, True, False, False]
    assert requests[0].future_time_us == T0_US + 2 * STEP_US
    first, second = (p.pose for p in requests[2].planned_trajectory_in_rig.poses[:2])
    assert (first.vec.x, first.vec.y, first.quat.w) == pytest.approx((0, 0, 1), abs=1e-9)
    assert second.vec.x == pytest.approx(1.0, abs=1e-6)
    assert abs(second.vec.y) < 1e-6
    returned = next(e.controller_return for e in AslReader(path) if e.HasField("controller_return"))
    assert returned.states[-1].timestamp_us == T0_US + 2 * STEP_US
    assert returned.states[-1].dynamic_state.linear_acceleration.y == pytest.approx(10.0 * 0.1)


def test_ego_states_carry_speed_and_context(path):
    told = [e.driver_ego_trajectory for e in AslReader(path) if e.HasField("driver_ego_trajectory")]
    assert [len(t.trajectory.poses) for t in told] == [2, 1, 1, 1]
    assert all(len(t.dynamic_states) == len(t.trajectory.poses) for t in told)
    assert told[0].dynamic_states[0].linear_velocity.x == 10.0


def test_route_keeps_its_missing_end(path):
    route = next(e.route_request for e in AslReader(path) if e.HasField("route_request")).route
    assert len(route.waypoints) == 20
    assert np.isnan(route.waypoints[19].x)
    assert not np.isnan(route.waypoints[17].x)


def test_render_request_tells_both_shutter_ends(path):
    item = next(
        e.batch_render_request for e in AslReader(path) if e.HasField("batch_render_request")
    ).items[0]
    request = item.request
    assert (item.camera_name, request.frame_end_us - request.frame_start_us) == (
        CAMERA.name,
        30_000,
    )
    assert (request.resolution_h, request.resolution_w) == (40, 64)
    ends = request.sensor_pose
    moved = np.hypot(
        ends.end_pose.vec.x - ends.start_pose.vec.x, ends.end_pose.vec.y - ends.start_pose.vec.y
    )
    assert moved == pytest.approx(0.3, abs=1e-5)
    assert [o.track_id for o in request.dynamic_objects] == ["7", "wall"]


def test_two_writes_give_the_same_bytes(tmp_path):
    assert (
        write_rollout(tmp_path / "a.asl").read_bytes()
        == write_rollout(tmp_path / "b.asl").read_bytes()
    )


def test_log_without_context_before_the_first_frame_has_no_double_time(tmp_path):
    header = replace(HEADER, render_start_us=T0_US)
    with AslWriter(tmp_path / "a.asl", header) as log:
        log.begin([CAMERA])
        log.actor_poses(T0_US, ego_at(0).T_world_rig, present(T0_US))
    assert read_asl(tmp_path / "a.asl").ego.t_us.tolist() == [T0_US]


def test_images_of_two_cameras_come_back_in_order_of_time(tmp_path):
    side = replace(CAMERA, name="camera_cross_left_120fov")
    with AslWriter(tmp_path / "a.asl", HEADER) as log:
        log.begin([CAMERA, side])
        log.actor_poses(T0_US + STEP_US, ego_at(1).T_world_rig, present(T0_US + STEP_US))
        for camera, steps in ((CAMERA, (3, 1, 4)), (side, (2, 0))):
            for step in steps:
                frame = Frame(T0_US + step * STEP_US, camera.name, picture(step))
                log.camera_image(frame, "png", camera.shutter_us)
    images = read_asl(tmp_path / "a.asl").images
    assert [(image.end_us - T0_US) // STEP_US for image in images] == [0, 1, 2, 3, 4]
    assert [image.camera for image in images] == [
        side.name,
        CAMERA.name,
        side.name,
        CAMERA.name,
        CAMERA.name,
    ]
    for step, image in enumerate(images):
        assert_array_equal(decode_image(image.data), picture(step))


def test_answers_of_a_slow_driver_belong_to_the_oldest_open_request(tmp_path):
    with AslWriter(tmp_path / "a.asl", HEADER) as log:
        log.begin([CAMERA])
        log.actor_poses(T0_US + STEP_US, ego_at(1).T_world_rig, present(T0_US + STEP_US))
        for step in (1, 2, 3):
            log.driver_request(T0_US + step * STEP_US, T0_US + (step + 1) * STEP_US)
        for step in (1, 2):
            log.driver_return(plan_at(step))
    log = read_asl(tmp_path / "a.asl")
    assert [plan.now_us for plan in log.plans] == [T0_US + STEP_US, T0_US + 2 * STEP_US]
    assert [plan.query_us - plan.now_us for plan in log.plans] == [STEP_US, STEP_US]
    for step, plan in zip((1, 2), log.plans, strict=True):
        assert plan.trajectory.t_us[0] == plan.now_us
        assert_allclose(plan.trajectory.xyz, plan_at(step).xyz, atol=1e-6)
    assert log.info["unanswered"] == 1

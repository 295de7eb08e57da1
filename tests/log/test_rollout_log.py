"""Rollout logs: what we write is read back with its numbers, and AlpaSim's own logs read into the same type."""

from __future__ import annotations

import pickle
import struct
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alpasim_plugin.alpasim.asl import AslFile, AslReader
from alpasim_plugin.alpasim.wire import common_pb2, logging_pb2
from alpasim_plugin.errors import InputError
from alpasim_plugin.geometry import matrix_from_quat, quat_from_yaw, se2, yaw_from_quat
from alpasim_plugin.log import AslWriter, decode_image, read_asl
from alpasim_plugin.log.schema import read_poses, wire_poses, wire_trajectory
from alpasim_plugin.types import Actor, Box, RolloutLog, Trajectory
from tests.log.make_rollout import ACTORS, CAMERA, HEADER, STEP_US, T0_US, ego_at, picture, plan_at, present, straight, write_rollout

# --- our own logs -----------------------------------------------------------------------------------------------------


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write_rollout(tmp_path / "rollout.asl")


@pytest.fixture
def log(path: Path) -> RolloutLog:
    return read_asl(path)


def test_entries_stand_in_the_order_of_alpasims_runtime(path: Path) -> None:
    kinds = [entry.WhichOneof("log_entry") for entry in AslReader(path)]
    start = "rollout_metadata available_cameras_request available_cameras_return driver_session_request traffic_session_request"
    frame = "batch_render_request driver_camera_image"
    step = f"{frame} driver_ego_trajectory route_request driver_request driver_return controller_request controller_return actor_poses"
    assert kinds == f"{start} actor_poses actor_poses {' '.join([step] * 4)} {frame}".split()


def test_ego_is_first_in_definitions_and_last_in_poses(path: Path) -> None:
    entries = list(AslReader(path))
    definitions = entries[0].rollout_metadata.actor_definitions.actor_aabb
    assert [d.actor_id for d in definitions] == ["EGO", "7", "late", "wall"]
    assert [d.actor_label for d in definitions] == ["", "automobile", "person", "other"]
    assert all(e.actor_poses.actor_poses[-1].actor_id == "EGO" for e in entries if e.HasField("actor_poses"))
    objects = next(e for e in entries if e.HasField("traffic_session_request")).traffic_session_request.logged_object_trajectories
    assert [(o.object_id, o.is_static) for o in objects] == [("EGO", False), ("7", False), ("late", False), ("wall", True)]


def test_times_and_sizes_are_exact(log: RolloutLog) -> None:
    assert (log.start_us, log.render_start_us, log.force_gt_us, log.control_us) == (T0_US, T0_US + STEP_US, 3 * STEP_US, STEP_US)
    assert log.ego.t_us.tolist() == [T0_US + i * STEP_US for i in range(6)]
    assert log.ego_box == HEADER.vehicle.box
    assert {i: a.box for i, a in log.actors.items()} == {a.actor_id: a.box for a in ACTORS}
    assert (log.scene_id, log.session_uuid, log.seed) == ("test-scene", HEADER.session_uuid, 41)
    assert log.warnings == ()


def test_ego_in_the_log_is_the_box_centre(log: RolloutLog) -> None:
    yaw, offset = 0.3, HEADER.vehicle.rear_axle_to_centre_m
    rig = HEADER.ego_log.xyz[:6]
    expected = rig + np.array([offset * np.cos(yaw), offset * np.sin(yaw), HEADER.vehicle.box.height_m / 2])
    np.testing.assert_allclose(log.ego.xyz, expected, atol=1e-6)
    np.testing.assert_allclose(yaw_from_quat(log.ego.quat), yaw, atol=1e-7)
    np.testing.assert_allclose(log.T_rig_box[:3, 3], [offset, 0, 0.8], atol=1e-6)
    np.testing.assert_allclose(log.ego_log.xyz, HEADER.ego_log.xyz, atol=1e-6)


def test_actor_is_there_only_while_it_was_present(log: RolloutLog) -> None:
    assert log.actors["late"].track.t_us.tolist() == [T0_US + 4 * STEP_US, T0_US + 5 * STEP_US]
    np.testing.assert_allclose(log.actors["late"].track.xyz, ACTORS[1].track.xyz[:2], atol=1e-6)
    assert [a.is_static for a in log.actors.values()] == [False, False, True]
    assert [a.label for a in log.actors.values()] == ["automobile", "person", "other"]


def test_plans_are_absolute_and_empty_answers_are_counted_not_kept(log: RolloutLog) -> None:
    assert [(p.now_us, p.query_us) for p in log.plans] == [(T0_US + i * STEP_US, T0_US + (i + 1) * STEP_US) for i in (2, 3, 4)]
    assert log.info["empty_plans"] == 1
    for step, plan in zip((2, 3, 4), log.plans, strict=True):
        assert plan.trajectory.t_us[0] == plan.now_us
        np.testing.assert_allclose(plan.trajectory.xyz, plan_at(step).xyz, atol=1e-6)
    assert [len(p.samples) for p in log.plans] == [0, 2, 2]


def test_png_images_come_back_pixel_for_pixel_in_time_order(log: RolloutLog) -> None:
    assert [i.end_us for i in log.images] == [T0_US + s * STEP_US for s in range(1, 6)]
    assert all(i.end_us - i.start_us == CAMERA.shutter_us and i.camera == CAMERA.name for i in log.images)
    for step, image in enumerate(log.images, start=1):
        np.testing.assert_array_equal(decode_image(image.data), picture(step))


def test_jpeg_images_come_back_close(tmp_path: Path) -> None:
    log = read_asl(write_rollout(tmp_path / "a.asl", "jpeg"))
    assert log.images[0].data[:2] == b"\xff\xd8"
    assert np.abs(decode_image(log.images[2].data).astype(int) - picture(3)).mean() < 1.5


def test_images_can_be_left_out(path: Path) -> None:
    log = read_asl(path, images=False)
    assert log.images == ()
    assert log.info["entries"]["driver_camera_image"] == 5


def test_camera_survives(log: RolloutLog) -> None:
    (camera,) = log.info["cameras"]
    assert (camera.name, camera.width, camera.height) == (CAMERA.name, 64, 40)
    np.testing.assert_array_equal(camera.K, CAMERA.K)
    np.testing.assert_allclose(camera.T_rig_camera, CAMERA.T_rig_camera, atol=1e-6)


def test_controller_entries_hold_the_plan_in_its_own_rig_frame(path: Path) -> None:
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


def test_ego_states_carry_speed_and_context(path: Path) -> None:
    told = [e.driver_ego_trajectory for e in AslReader(path) if e.HasField("driver_ego_trajectory")]
    assert [len(t.trajectory.poses) for t in told] == [2, 1, 1, 1]
    assert all(len(t.dynamic_states) == len(t.trajectory.poses) for t in told)
    assert told[0].dynamic_states[0].linear_velocity.x == 10.0


def test_route_keeps_its_missing_end(path: Path) -> None:
    route = next(e.route_request for e in AslReader(path) if e.HasField("route_request")).route
    assert len(route.waypoints) == 20
    assert np.isnan(route.waypoints[19].x)
    assert not np.isnan(route.waypoints[17].x)


def test_render_request_tells_both_shutter_ends(path: Path) -> None:
    item = next(e.batch_render_request for e in AslReader(path) if e.HasField("batch_render_request")).items[0]
    request = item.request
    assert (item.camera_name, request.frame_end_us - request.frame_start_us) == (CAMERA.name, 30_000)
    assert (request.resolution_h, request.resolution_w) == (40, 64)
    ends = request.sensor_pose
    moved = np.hypot(ends.end_pose.vec.x - ends.start_pose.vec.x, ends.end_pose.vec.y - ends.start_pose.vec.y)
    assert moved == pytest.approx(0.3, abs=1e-5)
    assert [o.track_id for o in request.dynamic_objects] == ["7", "wall"]


def test_two_writes_give_the_same_bytes(tmp_path: Path) -> None:
    assert write_rollout(tmp_path / "a.asl").read_bytes() == write_rollout(tmp_path / "b.asl").read_bytes()


def test_log_without_context_before_the_first_frame_has_no_double_time(tmp_path: Path) -> None:
    header = replace(HEADER, render_start_us=T0_US)
    with AslWriter(tmp_path / "a.asl", header) as log:
        log.begin([CAMERA])
        log.actor_poses(T0_US, ego_at(0).T_world_rig, present(T0_US))
    assert read_asl(tmp_path / "a.asl").ego.t_us.tolist() == [T0_US]


# --- numbers on the wire ----------------------------------------------------------------------------------------------


@settings(max_examples=200, deadline=None)
@given(
    xyz=st.lists(st.floats(-9e4, 9e4), min_size=3, max_size=3),
    quat=st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 1e-3),
)
def test_any_pose_survives_within_float32(xyz: list[float], quat: list[float]) -> None:
    messages = wire_poses(np.array([xyz]), np.array([quat]), "a test")
    back_xyz, back_quat = read_poses(messages, "a test")
    assert np.abs(back_xyz[0] - xyz).max() <= np.spacing(np.float32(max(*np.abs(xyz), 1e-30))) / 2
    unit = np.array(quat) / np.linalg.norm(quat)
    assert 2 * np.arccos(min(1.0, abs(float(back_quat[0] @ unit)))) < 1e-6
    assert abs(np.linalg.norm(back_quat[0]) - 1) < 1e-12


@settings(max_examples=50, deadline=None)
@given(n=st.integers(0, 6), seed=st.integers(0, 1000), zeros=st.booleans())
def test_trajectory_laid_out_by_arrays_equals_one_built_message_by_message(n: int, seed: int, zeros: bool) -> None:
    rng = np.random.default_rng(seed)
    xyz = np.zeros((n, 3)) if zeros else rng.normal(size=(n, 3)) * 1000
    trajectory = Trajectory(T0_US + np.arange(n, dtype=np.int64), xyz, rng.normal(size=(n, 4)))
    poses = wire_poses(trajectory.xyz, trajectory.quat, "a test")
    slow = common_pb2.Trajectory(
        poses=[common_pb2.PoseAtTime(pose=p, timestamp_us=t) for p, t in zip(poses, trajectory.t_us.tolist(), strict=True)]
    )
    fast = wire_trajectory(trajectory, "a test")
    assert fast == slow
    assert fast.SerializeToString() == slow.SerializeToString()


def test_coordinates_too_large_for_float32_are_refused_at_writing(tmp_path: Path) -> None:
    with AslWriter(tmp_path / "a.asl", HEADER) as log, pytest.raises(InputError, match=r"position .*500001\.4") as caught:
        log.actor_poses(T0_US, se2(500_000, 0, 0), {})
    assert "local origin" in caught.value.do_this


def test_nan_pose_is_refused_at_writing(tmp_path: Path) -> None:
    with AslWriter(tmp_path / "a.asl", HEADER) as log, pytest.raises(InputError, match="nan"):
        log.actor_poses(T0_US, se2(0, 0, 0), {"7": se2(float("nan"), 0, 0)})


def test_heading_of_half_a_turn_survives() -> None:
    quat = quat_from_yaw(np.array([np.pi, -np.pi, np.pi - 1e-9]))
    _, back = read_poses(wire_poses(np.zeros((3, 3)), quat, "a test"), "a test")
    np.testing.assert_allclose(np.abs(yaw_from_quat(back)), np.pi, atol=1e-6)


@pytest.mark.parametrize(("scale", "fine"), [(1.0, True), (1 + 4.9e-5, True), (1 - 4.9e-5, True), (1 + 6e-5, False), (0.0, False)])
def test_quaternion_norm_rule(scale: float, fine: bool) -> None:
    pose = common_pb2.Pose(vec=common_pb2.Vec3(), quat=common_pb2.Quat(w=0.6 * scale, z=0.8 * scale))
    if fine:
        np.testing.assert_allclose(read_poses([pose], "a test")[1], [[0.6, 0, 0, 0.8]], atol=1e-7)
    else:
        with pytest.raises(InputError, match=r"\|q\|\^2"):
            read_poses([pose], "a test")


def test_actor_outside_the_header_is_refused(tmp_path: Path) -> None:
    with AslWriter(tmp_path / "a.asl", HEADER) as log, pytest.raises(InputError, match="'ghost'"):
        log.actor_poses(T0_US, se2(0, 0, 0), {"ghost": se2(1, 0, 0)})


def test_ids_of_actors_must_be_their_own(tmp_path: Path) -> None:
    twin = Actor("7", "automobile", Box(1, 1, 1), straight(2))
    with pytest.raises(InputError, match=r"\['7'\] are taken or repeated"):
        AslWriter(tmp_path / "a.asl", replace(HEADER, actors=(*ACTORS, twin)))
    with pytest.raises(InputError, match=r"\['EGO'\]"):
        AslWriter(tmp_path / "a.asl", replace(HEADER, actors=(replace(twin, actor_id="EGO"),)))


# --- damaged and foreign logs -----------------------------------------------------------------------------------------


def test_cut_log_gives_what_is_whole_and_a_warning(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-40])
    log = read_asl(path)
    assert len(log.images) == 4
    assert len(log.warnings) == 1
    assert "last entry cut" in log.warnings[0]


def test_cut_inside_the_first_entry_is_an_error(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(InputError, match="no rollout_metadata"):
        read_asl(path)


def test_damage_in_the_middle_is_an_error_with_its_place(path: Path) -> None:
    data = bytearray(path.read_bytes())
    first = 4 + struct.unpack(">I", data[:4])[0]
    data[first + 4 : first + 12] = b"\xff" * 8
    path.write_bytes(bytes(data))
    with pytest.raises(InputError) as caught:
        read_asl(path)
    assert "entry 1 at byte" in caught.value.with_what


def edited(path: Path, change: object) -> Path:
    """Rewrite a log entry by entry through `change`, which may return None to leave one out."""
    entries = [change(i, e) for i, e in enumerate(AslReader(path))]  # type: ignore[operator]
    with AslFile(path) as file:
        for e in entries:
            if e is not None:
                file.write(e)
    return path


def test_log_of_the_five_scored_kinds_is_enough(path: Path, log: RolloutLog) -> None:
    needed = {"rollout_metadata", "actor_poses", "driver_request", "driver_return", "driver_camera_image"}
    bare = read_asl(edited(path, lambda i, e: e if e.WhichOneof("log_entry") in needed else None))
    np.testing.assert_array_equal(bare.ego.xyz, log.ego.xyz)
    assert len(bare.plans) == len(log.plans)
    assert len(bare.images) == len(log.images)


def test_metadata_must_come_first(path: Path) -> None:
    with pytest.raises(InputError, match="first entry is available_cameras_request"):
        read_asl(edited(path, lambda i, e: None if i == 0 else e))


def test_ego_must_be_defined_first(path: Path) -> None:
    def swap(i: int, e: logging_pb2.LogEntry) -> logging_pb2.LogEntry:
        if i == 0:
            boxes = e.rollout_metadata.actor_definitions.actor_aabb
            boxes[0].actor_id, boxes[1].actor_id = boxes[1].actor_id, boxes[0].actor_id
        return e

    with pytest.raises(InputError, match="actor definitions begin with 7"):
        read_asl(edited(path, swap))


def test_log_without_ego_poses_is_refused(path: Path) -> None:
    with pytest.raises(InputError, match="no actor_poses of EGO"):
        read_asl(edited(path, lambda i, e: None if e.HasField("actor_poses") else e))


def test_time_running_backwards_is_refused(path: Path) -> None:
    def stop(i: int, e: logging_pb2.LogEntry) -> logging_pb2.LogEntry:
        if e.HasField("actor_poses"):
            e.actor_poses.timestamp_us = T0_US
        return e

    with pytest.raises(InputError, match=f"time {T0_US} us at index 1 after {T0_US} us"):
        read_asl(edited(path, stop))


def test_unset_quaternion_is_refused(path: Path) -> None:
    def unset(i: int, e: logging_pb2.LogEntry) -> logging_pb2.LogEntry:
        if e.HasField("actor_poses"):
            e.actor_poses.actor_poses[-1].actor_pose.ClearField("quat")
        return e

    with pytest.raises(InputError, match=r"\|q\|\^2 = 0"):
        read_asl(edited(path, unset))


def test_answer_without_a_question_is_refused(path: Path) -> None:
    with pytest.raises(InputError, match="driver_return without a driver_request"):
        read_asl(edited(path, lambda i, e: None if e.HasField("driver_request") else e))


def test_poses_of_undefined_actors_are_left_out_and_named(path: Path) -> None:
    def rename(i: int, e: logging_pb2.LogEntry) -> logging_pb2.LogEntry:
        for pose in e.actor_poses.actor_poses:
            if pose.actor_id == "7":
                pose.actor_id = "hidden"
        return e

    log = read_asl(edited(path, rename))
    assert set(log.actors) == {"late", "wall"}
    assert log.info["undefined_actors"] == ("hidden",)


def test_entry_of_a_future_kind_is_skipped_with_a_warning(path: Path) -> None:
    body = b"\xfa\x01\x02\x08\x01"
    path.write_bytes(path.read_bytes() + struct.pack(">I", len(body)) + body)
    log = read_asl(path)
    assert "1 entries of a kind that this version does not know" in log.warnings[0]
    assert len(log.images) == 5


class Bomb:
    """Raises when unpickled."""

    def __reduce__(self) -> tuple[object, tuple[str, ...]]:
        return (pytest.fail, ("debug bytes were unpickled",))


def test_debug_bytes_are_never_unpickled(path: Path) -> None:
    def arm(i: int, e: logging_pb2.LogEntry) -> logging_pb2.LogEntry:
        if e.HasField("driver_return"):
            e.driver_return.debug_info.unstructured_debug_info = pickle.dumps(Bomb())
        return e

    assert len(read_asl(edited(path, arm)).plans) == 3


# --- AlpaSim's own logs -----------------------------------------------------------------------------------------------


def golden(shared_data: Path) -> list[Path]:
    return sorted((shared_data / "alpasim-golden").rglob("*.asl"))


def test_every_log_written_by_alpasim_is_read(shared_data: Path) -> None:
    totals: Counter[str] = Counter()
    logs = golden(shared_data)
    assert len(logs) == 57
    for path in logs:
        log = read_asl(path)
        totals.update(log.info["entries"])
        assert log.warnings == ()
        assert (log.session_uuid, log.scene_id) == (path.parent.name, path.parent.parent.name)
        counts = log.info["entries"]
        assert len(log.plans) + log.info["empty_plans"] == counts["driver_return"] == counts["driver_request"]
        assert len(log.images) == counts["driver_camera_image"]
        assert len(log.ego) == counts["actor_poses"]
        assert log.ego.t_us[0] == log.start_us == log.ego_log.t_us[0] == 1_689_697_803_493_732
        assert log.ego.t_us[1] >= log.render_start_us == log.start_us + 100_000
        # The first logged ego pose is the recorded one moved from rig to box centre.
        expected = log.ego_log.xyz[0] + matrix_from_quat(log.ego_log.quat[0]) @ log.T_rig_box[:3, 3]
        np.testing.assert_allclose(log.ego.xyz[0], expected, atol=3e-3)
        assert all(plan.trajectory.t_us[0] == plan.now_us for plan in log.plans)
        assert all(image.data[:2] == b"\xff\xd8" for image in log.images)
    assert totals == {
        **dict.fromkeys(
            (
                "rollout_metadata",
                "available_cameras_request",
                "available_cameras_return",
                "driver_session_request",
                "traffic_session_request",
                "available_ego_masks_request",
                "available_ego_masks_return",
            ),
            57,
        ),
        "actor_poses": 4087,
        "driver_camera_image": 3754,
        **dict.fromkeys(("driver_ego_trajectory", "driver_request", "driver_return"), 3698),
        "batch_render_request": 1629,
        **dict.fromkeys(("route_request", "controller_request", "controller_return"), 1606),
    }


@pytest.mark.parametrize(
    ("scene", "control_us", "force_gt_us", "n_actors"),
    [
        ("synthetic-front-brake-a", 100_000, 1_700_000, None),
        ("synthetic-cut-in-c", 200_000, 1_800_000, None),
        ("synthetic-stacked-a", 200_000, 1_000_000, 2),
        ("synthetic-vru-offset-a", 100_000, 1_700_000, 4),
    ],
)
def test_golden_headers(shared_data: Path, scene: str, control_us: int, force_gt_us: int, n_actors: int | None) -> None:
    for path in sorted((shared_data / "alpasim-golden" / "rollouts" / scene).rglob("*.asl")):
        log = read_asl(path)
        assert (log.control_us, log.force_gt_us) == (control_us, force_gt_us)
        assert n_actors is None or len(log.actors) == n_actors
        assert decode_image(log.images[0].data).shape == (40, 64, 3)


def test_golden_ego_size_comes_from_the_first_definition(shared_data: Path) -> None:
    sizes = {read_asl(p, images=False).ego_box for p in golden(shared_data)}
    assert sizes == {Box(5.393, 2.109, 1.503), Box(5.0, 2.0, 1.6), Box(4.8, 1.95, 1.5)}


def test_golden_plans_rollout_has_empty_and_sampled_answers(shared_data: Path) -> None:
    logs = [read_asl(p) for p in sorted((shared_data / "alpasim-golden/rollouts/synthetic-plans-a").rglob("*.asl"))]
    assert [log.info["empty_plans"] for log in logs] == [0, 11]
    assert {len(plan.samples) for plan in logs[1].plans} == set(range(8))


def test_golden_log_without_actors_has_none(shared_data: Path) -> None:
    logs = list((shared_data / "alpasim-golden/cases/no-actors/rollouts").rglob("*.asl"))
    assert len(logs) == 2
    assert all(read_asl(path).actors == {} for path in logs)


def test_golden_log_of_a_failed_rollout_is_read(shared_data: Path) -> None:
    (path,) = (shared_data / "alpasim-golden/cases/failed-rollout/incomplete").rglob("*.asl")
    log = read_asl(path)
    assert (len(log.ego), log.info["empty_plans"], log.info["n_steps"]) == (27, 1, 46)

"""The fields of a rollout log that its reader knows.

A field that this version of the wire has no name for is of a newer version: it is named by its
number.
"""

from collections.abc import Iterator

from google.protobuf.message import Message
from google.protobuf.unknown_fields import UnknownFieldSet

from alpasim_plugin.core.files.fields import Fields, field_name
from alpasim_plugin.log.wire import logging_pb2

POSES = {
    "Trajectory": "poses",
    "PoseAtTime": "pose timestamp_us",
    "Pose": "quat vec",
    "Quat": "w x y z",
    "Vec3": "x y z",
    "AABB": "size_x size_y size_z",
}
ASL = Fields(
    "rollout log",
    read={
        "LogEntry": """rollout_metadata actor_poses driver_request driver_return route_request
            driver_session_request traffic_session_request available_cameras_return
            driver_camera_image""",
        "RolloutMetadata": """session_metadata actor_definitions force_gt_duration version_ids
            transform_ego_coords_rig_to_aabb ego_rig_recorded_ground_truth_trajectory""",
        "SessionMetadata": """session_uuid scene_id n_sim_steps start_timestamp_us
            control_timestep_us render_start_timestamp_us""",
        "ActorDefinitions": "actor_aabb",
        "ActorAABB": "actor_id aabb actor_label",
        "VersionIds": """runtime_version egodriver_version sensorsim_version physics_version
            traffic_version controller_version video_model_version""",
        "VersionId": "version_id git_hash",
        "ActorPoses": "timestamp_us actor_poses",
        "ActorPose": "actor_id actor_pose",
        "DriveRequest": "time_now_us time_query_us",
        "DriveResponse": "trajectory debug_info terminate_session",
        "DriveResponse.DebugInfo": "sampled_trajectories",
        "RouteRequest": "route",
        "Route": "waypoints",
        "DriveSessionRequest": "random_seed",
        "TrafficSessionRequest": "logged_object_trajectories",
        "ObjectTrajectory": "object_id is_static",
        "AvailableCamerasReturn": "available_cameras",
        "AvailableCamera": "intrinsics rig_to_camera logical_id",
        "CameraSpec": "opencv_pinhole_param resolution_h resolution_w",
        "OpenCVPinholeCameraParam": """principal_point_x principal_point_y focal_length_x
            focal_length_y radial_coeffs tangential_coeffs thin_prism_coeffs""",
        "RolloutCameraImage": "camera_image",
        "CameraImage": "frame_start_us frame_end_us image_bytes logical_id",
        **POSES,
    },
    # What other services were asked and answered, and what the policy was told: a score is made of
    # where road users were and of what was planned.
    harmless={
        "LogEntry": """render_request traffic_request traffic_return physics_request physics_return
            driver_ego_trajectory controller_request controller_return egomotion_estimate_error
            ground_truth_request available_cameras_request aggregated_render_request
            available_ego_masks_request available_ego_masks_return video_model_session_request
            video_model_session_id video_model_session_close_request video_model_chunk_request
            video_model_chunk_return batch_render_request""",
        "RolloutMetadata": "rollout_index",
        "SessionMetadata": "batch_size nre_runid nre_version nre_uuid",
        "VersionId": "grpc_api_version",
        "DriveRequest": "session_uuid renderer_data",
        "DriveResponse.DebugInfo": "unstructured_debug_info",
        "RouteRequest": "session_uuid",
        "Route": "timestamp_us",
        "DriveSessionRequest": "session_uuid debug_info rollout_spec",
        "TrafficSessionRequest": "session_uuid scene_id random_seed handover_time_us",
        "ObjectTrajectory": "aabb trajectory label_class",
        "CameraSpec": """temporary_camera_spec ftheta_param opencv_fisheye_param logical_id
            shutter_type bivariate_windshield_model_param""",
        "RolloutCameraImage": "session_uuid",
    },
)


def take_newer_fields(entry: logging_pb2.LogEntry) -> list[str]:
    """Remove the fields of an entry for which this version of the wire has no name, and return the
    names of those in messages that are read.
    """
    data = entry.SerializeToString()
    entry.DiscardUnknownFields()
    if entry.ByteSize() == len(data):
        return []
    return list(_newer_in(logging_pb2.LogEntry.FromString(data)))


def _newer_in(message: Message) -> Iterator[str]:
    holder = holder_name(message)
    for field in UnknownFieldSet(message):
        yield field_name(holder, f"field {field.field_number}")
    for described, value in message.ListFields():
        if described.message_type is None or field_name(holder, described.name) not in ASL.names():
            continue
        for part in [value] if isinstance(value, Message) else value:
            yield from _newer_in(part)


def holder_name(message: Message) -> str:
    """Return the name of a message's kind; of two kinds of one name with what holds them."""
    described = message.DESCRIPTOR
    if described.name == "DebugInfo":
        return f"{described.containing_type.name}.{described.name}"
    return str(described.name)

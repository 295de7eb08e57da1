"""The fields of an AlpaSim scene that its readers know."""

from collections.abc import Iterator

from alpasim_plugin.core.files.fields import Fields, met_in
from alpasim_plugin.core.json_types import JsonObject

RIG = "rig_trajectories.json"
META = "metadata.yaml"
USDZ = Fields(
    "AlpaSim scene",
    read={
        "archive": f"{META} {RIG} sequence_tracks.json map.xodr clipgt map_data fastmap",
        META: "scene_id",
        RIG: "T_world_base camera_calibrations rig_trajectories",
        "camera_calibration": "logical_sensor_name",
        "rig_trajectory": """T_rig_world_timestamps_us T_rig_worlds cameras_frame_timestamps_us
            rig_bbox""",
        "rig_bbox": "centroid dim rot",
        "sequence": "tracks_data cuboidtracks_data",
        "tracks_data": """tracks_id tracks_label_class tracks_flags tracks_timestamps_us
            tracks_poses""",
        "cuboidtracks_data": "cuboids_dims",
        "tables": """lane association road_boundary clip traffic_sign wait_line
            calibration_estimate""",
        "key": "map_id kind",
        "lane": "left_rail right_rail",
        "association": "subjects objects",
        "road_boundary": "location",
        "traffic_sign": "center",
        "wait_line": "location is_implicit",
        "calibration_estimate": "rig_json",
    },
    # What the scene was made of, and the weights of a renderer, which a note names.
    harmless={
        "archive": """checkpoint.ckpt nerf.ingp volume.nurec data_info.json datasource_summary.json
            parsed_config.yaml pose_record.json prompt.txt first_image.png frames""",
        META: """version_string training_date dataset_hash uuid is_resumable sensors logger
            time_range training_step_outputs""",
        RIG: "world_to_nre",
        "camera_calibration": "unique_sensor_idx",
        "rig_trajectory": "sequence_id",
        "key": "clip_id label_class_id map_id_version",
        "lane": "version",
        "association": "version",
        "road_boundary": "version",
        "clip": "version label_class_id",
        "traffic_sign": "version category",
        "wait_line": "version category",
        "calibration_estimate": "version",
    },
)


def met_in_rig(rig: JsonObject) -> Iterator[str]:
    """Yield the names of the fields of ``rig_trajectories.json``."""
    yield from met_in(RIG, rig)
    for calibration in (rig.get("camera_calibrations") or {}).values():
        yield from met_in("camera_calibration", calibration)
    for trajectory in rig["rig_trajectories"]:
        yield from met_in("rig_trajectory", trajectory)
        yield from met_in("rig_bbox", trajectory.get("rig_bbox") or ())


def met_in_sequence(sequence: JsonObject) -> Iterator[str]:
    """Yield the names of the fields of a sequence of tracks."""
    yield from met_in("sequence", sequence)
    for holder in ("tracks_data", "cuboidtracks_data"):
        yield from met_in(holder, sequence[holder])

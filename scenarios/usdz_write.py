"""Write a scenario as an AlpaSim scene (``.usdz``), whatever its source: map, recorded drive,
traffic, vehicle, cameras and ground.

The local frame and the times of the scenario are kept, so that its rollout logs fit the scene.
There is no reconstruction in it: AlpaSim's closed renderer cannot render it; ours, and every
service that needs only map, rig and tracks, can use it.
"""

import json
import uuid
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import yaml

from alpasim_plugin import __version__
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.atomic import atomic_file
from alpasim_plugin.core.geometry import se3
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.core.types import (
    Actor,
    CameraSpec,
    Scenario,
    Trajectory,
    Vehicle,
)
from alpasim_plugin.world.ground import height_at
from scenarios.ftheta import FRONT_WIDE, calibration_table
from scenarios.usdz_tables import map_tables

SHUTTER_US = 30_000  # of a camera that has none: AlpaSim wants every frame's end after its start
GROUND_MARGIN_M = 30.0
GROUND_NODES = 200_000
# The words that AlpaSim classes by; others are kept.
_LABELS = {
    "car": "automobile",
    "truck": "heavy_truck",
    "pedestrian": "person",
}


def write_usdz(path: Path, scenario: Scenario) -> None:
    """Write a scene; the same scenario gives the same bytes.

    Raises:
        InputError: It has no lane that AlpaSim could drive on, or its recording is too short for
            one frame.
        InfrastructureError: The disk refuses.
    """
    clip = scenario.scene_id
    cameras = alpasim_cameras(scenario.cameras)
    lane_map = scenario.lane_map
    if all(lane.kind == "sidewalk" for lane in lane_map.lanes.values()):
        raise InputError(
            f"scene {clip!r}: no lane",
            "export a scene with a map: AlpaSim routes and scores along lanes",
        )
    mesh = ground_mesh(scenario)
    members: dict[str, bytes] = {
        "metadata.yaml": yaml.safe_dump(
            _metadata(scenario, list(cameras)), sort_keys=False
        ).encode(),
        "rig_trajectories.json": json.dumps(_rig(scenario, cameras)).encode(),
        "sequence_tracks.json": json.dumps({clip: _tracks(scenario)}).encode(),
        **map_tables(lane_map, clip),
        "clipgt/calibration_estimate.parquet": calibration_table(cameras, clip),
        "mesh.ply": mesh,
        "mesh_ground.ply": mesh,
    }
    with (
        atomic_file(path) as partial,
        zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as archive,
    ):
        for name, data in members.items():
            archive.writestr(
                zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), data, zipfile.ZIP_DEFLATED
            )


def _tracks(scenario: Scenario) -> JsonObject:
    """Return the tracks of the road users as ``sequence_tracks.json`` holds them."""
    actors = [actor for actor in scenario.actors if len(actor.track)]
    tracks = [_lasting(actor, scenario.ego_log) for actor in actors]
    sizes = [actor.box for actor in actors]
    return {
        "tracks_data": {
            "tracks_id": [actor.actor_id for actor in actors],
            "tracks_label_class": [_LABELS.get(actor.label, actor.label) for actor in actors],
            "tracks_flags": [[] if actor.is_static else ["CONTROLLABLE"] for actor in actors],
            "tracks_timestamps_us": [track.t_us.tolist() for track in tracks],
            "tracks_poses": [
                np.column_stack([track.xyz, track.quat[:, [1, 2, 3, 0]]]).tolist()
                for track in tracks
            ],
        },
        "cuboidtracks_data": {
            "cuboids_dims": [[box.length_m, box.width_m, box.height_m] for box in sizes]
        },
    }


def alpasim_cameras(cameras: tuple[CameraSpec, ...]) -> dict[str, CameraSpec]:
    """Return the cameras by the logical ids that AlpaSim's tools know: the main one is called
    `FRONT_WIDE`, the others keep their names.

    The main camera is the one of that name, else ``front``, else the first.
    """
    names = [camera.name for camera in cameras]
    main = next(
        (name for name in (FRONT_WIDE, "front") if name in names), names[0] if names else ""
    )
    return {FRONT_WIDE if camera.name == main else camera.name: camera for camera in cameras}


def _metadata(scenario: Scenario, cameras: list[str]) -> JsonObject:
    return {
        "scene_id": scenario.scene_id,
        "version_string": f"simrun-{__version__}",
        "training_date": "1970-01-01",
        "dataset_hash": scenario.content_hash,
        "uuid": str(uuid.uuid5(uuid.NAMESPACE_URL, f"{scenario.scene_id}/{scenario.content_hash}")),
        "is_resumable": False,
        "sensors": {"camera_ids": cameras, "lidar_ids": []},
        "logger": {},
        "time_range": {
            "start": int(scenario.ego_log.t_us[0]) * 1e-6,
            "end": int(scenario.ego_log.t_us[-1]) * 1e-6,
        },
        "training_step_outputs": {},
    }


def _rig(scenario: Scenario, cameras: Mapping[str, CameraSpec]) -> JsonObject:
    log = scenario.ego_log
    frames = {name: frame_times(scenario, camera) for name, camera in cameras.items()}
    return {
        "world_to_nre": {"matrix": np.eye(4).tolist()},
        "T_world_base": np.eye(4).tolist(),
        "camera_calibrations": {
            f"{name}@0": {"logical_sensor_name": name, "T_sensor_rig": camera.T_rig_camera.tolist()}
            for name, camera in cameras.items()
        },
        "rig_trajectories": [
            {
                "sequence_id": scenario.scene_id,
                "T_rig_world_timestamps_us": log.t_us.tolist(),
                "T_rig_worlds": se3(log.xyz, log.quat).tolist(),
                "cameras_frame_timestamps_us": {
                    f"{name}@0": times for name, times in frames.items()
                },
                "rig_bbox": rig_box(scenario.vehicle),
            }
        ],
    }


def rig_box(vehicle: Vehicle) -> JsonObject:
    """Return the ego's box in the rig, as ``rig_trajectories.json`` holds it."""
    box = vehicle.box
    return {
        "centroid": [vehicle.rear_axle_to_centre_m, 0.0, box.height_m / 2],
        "dim": list(box.size_m),
        "rot": [0.0, 0.0, 0.0],
    }


def frame_times(scenario: Scenario, camera: CameraSpec) -> list[list[int]]:
    """Return start and end of every frame of a camera, integer microseconds.

    The first one ends where the scenario starts, since AlpaSim renders first there; a frame that
    would begin before the first recorded pose is left out, since AlpaSim cannot place the camera at
    its start.
    """
    first_us = int(scenario.ego_log.t_us[0])
    last_us = int(scenario.ego_log.t_us[-1])
    shutter_us = camera.shutter_us or SHUTTER_US
    period_us = camera.interval_us or scenario.rates.camera_us
    ends = range(scenario.start_us, last_us + 1, period_us)
    frames = [[end - shutter_us, end] for end in ends if end - shutter_us >= first_us]
    if not frames:
        raise InputError(
            f"scene {scenario.scene_id!r}: no frame of camera {camera.name!r} fits between {first_us} and {last_us} us",
            "export a longer recording",
        )
    return frames


def _lasting(actor: Actor, log: Trajectory) -> Trajectory:
    """Return a track of at least two poses, which AlpaSim's smoothing needs: one that has a single
    pose stands there all the time.
    """
    track = actor.track
    if len(track) > 1:
        return track
    t_us = np.array(
        [min(int(log.t_us[0]), int(track.t_us[0])), max(int(log.t_us[-1]), int(track.t_us[0]) + 1)]
    )
    return Trajectory(t_us, np.repeat(track.xyz, 2, axis=0), np.repeat(track.quat, 2, axis=0))


def ground_mesh(scenario: Scenario) -> bytes:
    """Return the ground around lanes and drive as a triangle mesh, binary PLY, for services that
    cast rays onto it.
    """
    points = [
        scenario.ego_log.xyz[:, :2],
        *(lane.centre[:, :2] for lane in scenario.lane_map.lanes.values()),
    ]
    low = np.min([xyz.min(axis=0) for xyz in points], axis=0) - GROUND_MARGIN_M
    high = np.max([xyz.max(axis=0) for xyz in points], axis=0) + GROUND_MARGIN_M
    ground = scenario.ground
    flat = float(np.ptp(ground.z)) == 0.0
    size = np.maximum(high - low, 1.0)
    step = (
        float(size.max())
        if flat
        else max(ground.cell_m, float(np.sqrt(size[0] * size[1] / GROUND_NODES)))
    )
    xs, ys = (
        low[axis] + step * np.arange(int(np.ceil(size[axis] / step)) + 1) for axis in range(2)
    )
    xy = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    vertices = np.column_stack([xy, height_at(ground, xy)]).astype("<f4")
    corner = (np.arange(len(ys) - 1)[:, None] * len(xs) + np.arange(len(xs) - 1)).ravel()
    right = corner + 1
    up = corner + len(xs)
    faces = np.concatenate(
        [np.column_stack([corner, right, up]), np.column_stack([right, up + 1, up])]
    )
    table = np.zeros(len(faces), dtype=[("n", "u1"), ("v", "<i4", (3,))])
    table["n"], table["v"] = 3, faces
    head = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    return head.encode() + vertices.tobytes() + table.tobytes()

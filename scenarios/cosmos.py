"""Cosmos-Drive-Dreams clips in RDS-HQ form: lane map, ego poses, f-theta calibration.

Layout and facts: the public data set description of NVIDIA Cosmos-Drive-Dreams (arXiv 2506.09042); data CC-BY-4.0, (c) NVIDIA. The world is
the rig frame of frame 0.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from alpasim_plugin.core.geometry import densify, quat_from_matrix
from alpasim_plugin.core.types import F64, LaneMap, Marking, Trajectory, Vehicle
from alpasim_plugin.world.ground import from_points
from scenarios.cosmos_camera import FRONT_WIDE, front_camera, read_lenses
from scenarios.cosmos_lanes import oriented_lanes
from scenarios.cosmos_layers import paint_of, read_layer, sign_pose
from scenarios.reading import SourceFiles
from scenarios.recorded import RecordedLog
from scenarios.tracks import checked_trajectory

FRAME_RATE_HZ = 30
EDGE_STEP_M = 2.0
GROUND_CELL_M = 2.0


def read_cosmos(path: str | Path) -> RecordedLog:
    """Read one clip: the folder that holds ``3d_lanes``, ``vehicle_pose`` and the other layers.

    Raises:
        InputError: A layer is missing or damaged, there are no lanes or no road boundaries, or the poses are no drive.
    """
    folder = Path(path)
    files = SourceFiles("reading a Cosmos-Drive-Dreams clip")
    if not folder.is_dir():
        raise files.fail(folder, "no such folder", "give the folder that holds 3d_lanes")
    ego_log, clip = read_poses(files, folder)
    layers = {name: read_layer(files, folder, f"3d_{name}") for name in ("lanes", "lanelines", "road_boundaries")}
    layers |= {name: read_layer(files, folder, f"3d_{name}") for name in ("wait_lines", "crosswalks", "poles", "traffic_signs")}
    if not layers["lanes"]:
        raise files.fail(folder / "3d_lanes", "a map without lanes", "use a clip with lanes")
    if not layers["road_boundaries"]:
        raise files.fail(folder / "3d_road_boundaries", "a map without road edges", "use a clip with road boundaries")
    lanes, lane_notes = oriented_lanes(files, layers["lanes"], ego_log)
    stops = [label for label in layers["wait_lines"] if label.attributes.get("is_implicit") is not True]
    lane_map = LaneMap(
        lanes=lanes,
        road_edges=tuple(densify(label.lines[0], EDGE_STEP_M) for label in layers["road_boundaries"] if len(label.lines[0]) > 1),
        crosswalks=tuple(np.concatenate([label.lines[0], label.lines[0][:1]]) for label in layers["crosswalks"]),
        stop_lines=tuple(label.lines[0] for label in stops),
        markings=tuple(
            Marking(line.lines[0], paint_of(line.attributes.get("styles"), line.attributes.get("colors"))) for line in layers["lanelines"]
        ),
        poles=tuple(label.lines[0] for label in layers["poles"]),
        signs=tuple(sign_pose(label.lines[0]) for label in layers["traffic_signs"] if len(label.lines[0]) == 8),
    )
    lenses = read_lenses(files, folder)
    if FRONT_WIDE not in lenses:
        raise files.fail(folder / "ftheta_intrinsic", f"no lens {FRONT_WIDE}", "use a clip with the front wide camera")
    surface = [e for lane in lanes.values() for e in (lane.left, lane.right) if e is not None]
    ground = from_points(np.concatenate([*surface, *lane_map.road_edges, ego_log.xyz]), GROUND_CELL_M, ego_log.xyz)
    notes = (
        "no actor tracks in this copy: the road is empty",
        "no camera extrinsics in this copy: the front wide camera is mounted as on another car of the fleet",
        "rendered through a pinhole of 90 degrees width inside the recorded 120 degree f-theta lens",
        "vehicle size and axles assumed: the clip has none; the rig's origin is taken to be on the ground under the rear axle",
        f"{len(layers['wait_lines']) - len(stops)} implicit wait lines are no painted stop lines and were left out",
        "lane lines run between the edges of neighbouring lanes and are the same paint: draw a line once",
        "road markings (6 classes of words and arrows) and traffic lights are not used",
        *lane_notes,
    )
    return RecordedLog(
        scene_id=f"cosmos-{clip}",
        source="cosmos",
        lane_map=lane_map,
        ground=ground,
        ego_log=ego_log,
        vehicle=Vehicle(),
        actors=(),
        cameras=(front_camera(lenses[FRONT_WIDE]),),
        world_origin=(0.0, 0.0, 0.0),
        content_hash=files.content_hash,
        notes=notes,
    )


def read_poses(files: SourceFiles, folder: Path) -> tuple[Trajectory, str]:
    """Read ``vehicle_pose``: one 4x4 rig-to-world matrix a frame at 30 Hz, and the clip's name.

    Times count from the clip's first microsecond, which stands in the file's name; 0 where it does not.

    Raises:
        InputError: Frames are missing, or a matrix is no rigid motion.
    """
    path = files.only(folder / "vehicle_pose", ("*.tar",), "the ego poses")
    frames: dict[int, F64] = {}
    for name, data in files.read_tar(path).items():
        match = re.search(r"\.(\d+)\.vehicle_pose\.npy$", name)
        if match is None:
            continue
        where = f"{path}, {name}"
        matrix = np.asarray(files.parse_npy(data, where), dtype=np.float64)
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or abs(np.linalg.det(matrix[:3, :3]) - 1) > 1e-3:
            raise files.fail(where, f"an array of shape {matrix.shape} that is no rigid motion", "give 4x4 rig-to-world matrices")
        frames[int(match.group(1))] = matrix
    if sorted(frames) != list(range(len(frames))):
        missing = next(i for i in range(len(frames) + 1) if i not in frames)
        raise files.fail(path, f"no frame {missing:06d} among {len(frames)} poses", "give frames numbered from 000000 without holes")
    stamp = re.match(r"(?P<clip>.+)_(?P<start>\d+)_(?P<end>\d+)$", path.stem)
    start_us = int(stamp["start"]) if stamp else 0
    poses = np.stack([frames[i] for i in range(len(frames))]) if frames else np.zeros((0, 4, 4))
    t_us = start_us + np.round(np.arange(len(poses)) * (1e6 / FRAME_RATE_HZ)).astype(np.int64)
    files.near(path, poses[:, :3, 3])
    quat = quat_from_matrix(poses[:, :3, :3])
    return checked_trajectory(files, path, t_us, poses[:, :3, 3].copy(), quat, least=2), stamp["clip"] if stamp else path.stem

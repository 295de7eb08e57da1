"""AlpaSim scenes (``.usdz``): map, recorded drive, traffic, vehicle and front camera.

The local frame of the scene is kept, so rollout logs of AlpaSim and of this package fit the same map. A scene's 3D reconstruction is a
checkpoint of a closed renderer and is not read: the map is dressed instead.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.core.geometry import quat_from_matrix
from alpasim_plugin.core.types import F64, Actor, Box, LaneMap, Scene, Trajectory, Vehicle
from alpasim_plugin.world.ground import from_points
from scenarios.cosmos_camera import FRONT_WIDE, front_wide
from scenarios.map_lines import lane_edges
from scenarios.opendrive import T_local_map, lane_map_of
from scenarios.opendrive_alpasim import alpasim_map
from scenarios.opendrive_road import parse_map
from scenarios.recorded import RecordedLog, SourceFiles, checked_trajectory
from scenarios.usdz_archive import Archive
from scenarios.usdz_tables import clipgt_map, without_rails

DOING = "reading an AlpaSim scene"
RECONSTRUCTIONS = ("checkpoint.ckpt", "nerf.ingp", "volume.nurec")
GROUND_CELL_M = 2.0
# Words in AlpaSim's free-text labels, the first match deciding; all else is "other".
LABELS = (
    ("cyclist", "cyclist"), ("bicycle", "cyclist"), ("motor", "motorcycle"), ("bike", "cyclist"), ("rider", "cyclist"),
    ("pedestrian", "pedestrian"), ("person", "pedestrian"), ("bus", "bus"), ("truck", "truck"), ("trailer", "truck"),
    ("automobile", "car"), ("car", "car"), ("vehicle", "car"),
)  # fmt: skip


@dataclass(frozen=True)
class RoadMap:
    """The map of a scene as read by its own rules, and as AlpaSim's loader reads it where that differs."""

    lane_map: LaneMap
    alpasim: LaneMap | None
    notes: tuple[str, ...]


def read_usdz(path: str | Path, rails: bool = True, needs_map: bool = True) -> RecordedLog:
    """Read a scene as a recorded log, to drive in or to score logs against.

    Args:
        path: The scene.
        rails: False drops the lanes' rails after the centres are made, so that scorers widen the centres by 1.85 m.
        needs_map: False accepts a scene without a map: scorers say what they lack.

    Raises:
        InputError: A member is missing or damaged, or there is no map.
    """
    path = Path(path)
    files = SourceFiles(DOING)
    with Archive(files, path) as archive:
        scene_id = _scene_id(archive)
        rig = _Rig(archive)
        road = _road(archive, rig)
        if needs_map and not road.lane_map.lanes:
            raise files.fail(path, "a scene without a map", "use a scene with map tables or map.xodr: its road is what gets dressed")
        actors, static = _actors(archive)
        cameras, camera_notes = front_wide(archive)
        vehicle, vehicle_notes = rig.vehicle()
        inside = [f"{name} ({archive.sizes[name]} bytes)" for name in RECONSTRUCTIONS if name in archive]
    surface = [*lane_edges(road.lane_map.lanes), *road.lane_map.road_edges, rig.ego_log.xyz]
    ground = from_points(np.concatenate(surface), GROUND_CELL_M, rig.ego_log.xyz)
    notes = (
        f"{inside[0]} is a checkpoint of a closed renderer and is not read; the map is dressed instead" if inside
        else "no reconstruction in this scene; the map is dressed instead",
        "tracks are replayed as stored, without AlpaSim's smoothing",
        *((f"{static} of {len(actors)} tracks are not marked CONTROLLABLE and stand still",) if static else ()),
        *road.notes, *camera_notes, *vehicle_notes,
    )  # fmt: skip
    return RecordedLog(
        scene_id=scene_id,
        source="usdz",
        lane_map=road.lane_map if rails else without_rails(road.lane_map),
        ground=ground,
        ego_log=rig.ego_log,
        vehicle=vehicle,
        actors=actors,
        cameras=cameras,
        world_origin=(0.0, 0.0, 0.0),
        content_hash=files.content_hash,
        notes=notes,
        first_frame_us=rig.first_frame_us(),
        alpasim_map=road.alpasim if rails or road.alpasim is None else without_rails(road.alpasim),
    )


def read_usdz_scene(path: str | Path, rails: bool = True) -> Scene:
    """Read what scorers see of a scene; see `read_usdz`."""
    record = read_usdz(path, rails, needs_map=False)
    return Scene(record.scene_id, record.lane_map, record.ego_log, record.vehicle, record.alpasim_map)


def usdz_scene_id(path: str | Path) -> str:
    """Return the scene id of a scene without reading the rest.

    Raises:
        InputError: No archive, or no usable metadata.yaml in it.
    """
    with Archive(SourceFiles(DOING), Path(path)) as archive:
        return _scene_id(archive)


def _scene_id(archive: Archive) -> str:
    document = archive.yaml("metadata.yaml")
    scene_id = document.get("scene_id") if isinstance(document, dict) else None
    if not isinstance(scene_id, str) or not scene_id:
        raise archive.files.fail(f"{archive.path}, metadata.yaml", f"scene_id {scene_id!r}", "state the scene's id")
    return scene_id


def _road(archive: Archive, rig: _Rig) -> RoadMap:
    tables, notes = clipgt_map(archive)
    if tables is not None:
        return RoadMap(tables, None, notes)
    if "map.xodr" not in archive:
        return RoadMap(LaneMap({}), None, (*notes, "no map: neither tables nor map.xodr"))
    where = f"{archive.path}, map.xodr"
    odr = parse_map(archive.files, where, archive.files.parse_xml(archive.read("map.xodr"), where))
    place = T_local_map(odr.geo_reference, rig.T_earth_local())
    lane_map, more = lane_map_of(archive.files, where, odr, place)
    return RoadMap(lane_map, alpasim_map(odr, place), (*notes, *more))


class _Rig:
    """``rig_trajectories.json``: the recorded drive and what belongs to the rig."""

    def __init__(self, archive: Archive) -> None:
        self.files, self.where = archive.files, f"{archive.path}, rig_trajectories.json"
        self._document = archive.json("rig_trajectories.json")
        rigs = self._document.get("rig_trajectories") if isinstance(self._document, dict) else None
        if not isinstance(rigs, list) or len(rigs) != 1 or not isinstance(rigs[0], dict):
            raise self.files.fail(self.where, f"{len(rigs) if isinstance(rigs, list) else 0} rigs", "give exactly one rig trajectory")
        self._rig: dict[str, Any] = rigs[0]
        poses = self._array(self._rig, "T_rig_worlds", (-1, 4, 4))
        times = self._array(self._rig, "T_rig_world_timestamps_us", (-1,))
        t_us = times.astype(np.int64)
        if (t_us != times).any():
            raise self.files.fail(self.where, "times that are not whole microseconds", "give integers")
        if len(poses) != len(t_us):
            raise self.files.fail(self.where, f"{len(poses)} poses and {len(t_us)} times", "give one time for each pose")
        turned = np.abs(np.linalg.det(poses[:, :3, :3]) - 1.0) if len(poses) else np.zeros(0)
        if len(poses) and not float(turned.max()) < 1e-3:
            raise self.files.fail(self.where, f"pose {int(np.argmax(turned))} is not a rigid motion", "give rotation matrices")
        self.ego_log: Trajectory = checked_trajectory(
            self.files, self.where, t_us, poses[:, :3, 3].copy(), quat_from_matrix(poses[:, :3, :3]), least=2
        )

    def T_earth_local(self) -> F64:
        """Return the ``(4, 4)`` pose of the local frame in earth-centred coordinates."""
        return self._array(self._document, "T_world_base", (4, 4))

    def first_frame_us(self) -> int | None:
        """Return when the first frame of the front wide camera ends, of all cameras where it has none; None without frames.

        Raises:
            InputError: A frame's times are not a pair of integers.
        """
        frames = self._rig.get("cameras_frame_timestamps_us") or {}
        calibrated = self._document.get("camera_calibrations") or {}
        try:
            ends = {str(calibrated[uid]["logical_sensor_name"]): int(times[0][1]) for uid, times in frames.items() if times}
        except (AttributeError, KeyError, IndexError, TypeError, ValueError) as error:
            found = f"camera frames: {type(error).__name__} {error}"
            raise self.files.fail(self.where, found, "give every camera a calibration and its frames as [start, end]") from error
        return ends.get(FRONT_WIDE, min(ends.values(), default=None))

    def vehicle(self) -> tuple[Vehicle, tuple[str, ...]]:
        """Return the ego's body and notes."""
        box = self._rig.get("rig_bbox")
        if not isinstance(box, dict):
            return Vehicle(), ("no rig_bbox: the default vehicle is assumed; AlpaSim wants its size in the run's settings",)
        centre, size = self._array(box, "centroid", (3,)), self._array(box, "dim", (3,))
        if not (size > 0).all():
            raise self.files.fail(self.where, f"a rig_bbox of {size.tolist()} m", "give positive sizes")
        off = [float(centre[1]), float(centre[2] - size[2] / 2)]
        notes = (
            (f"the box is {off[0]:.3f} m left of and {off[1]:.3f} m above the rig's origin; both are ignored",)
            if max(map(abs, off)) > 1e-3
            else ()
        )
        return Vehicle(Box(*(float(round(v, 6)) for v in size)), float(round(centre[0], 6))), notes

    def _array(self, owner: dict[str, Any], key: str, shape: tuple[int, ...]) -> F64:
        try:
            raw = owner[key]
            # Times are integers beyond float32; float64 holds microseconds since 1970 exactly.
            values = np.array(raw, dtype=np.float64).reshape(shape if len(raw) else (0, *shape[1:]))
        except (KeyError, TypeError, ValueError) as error:
            raise self.files.fail(self.where, f"{key}: {type(error).__name__} {error}", f"give {key} of shape {shape}") from error
        if not np.isfinite(values).all():
            raise self.files.fail(self.where, f"{key} with a value that is not finite", "repair the file")
        return values


def _actors(archive: Archive) -> tuple[tuple[Actor, ...], int]:
    """Return the tracks as actors, and how many are not marked as movable."""
    where, files = f"{archive.path}, sequence_tracks.json", archive.files
    document = archive.json("sequence_tracks.json")
    if not isinstance(document, dict) or len(document) != 1:
        raise files.fail(where, f"{len(document) if isinstance(document, dict) else 0} sequences", "give exactly one sequence")
    try:
        sequence = next(iter(document.values()))
        tracks, sizes = sequence["tracks_data"], sequence["cuboidtracks_data"]["cuboids_dims"]
        columns = [tracks[f"tracks_{name}"] for name in ("id", "label_class", "flags", "timestamps_us", "poses")]
        rows = list(zip(*columns, sizes, strict=True))
    except (KeyError, TypeError, ValueError) as error:
        raise files.fail(where, f"{type(error).__name__}: {error}", "give lists of equal length for every track") from error
    odd = next((row for row in rows if not isinstance(row[0], str | int) or not isinstance(row[2], str | list)), None)
    if odd is not None:
        raise files.fail(where, f"a track with id {odd[0]!r} and flags {odd[2]!r}", "give text as id and a list of texts as flags")
    twice = [name for name, n in Counter(row[0] for row in rows).items() if n > 1]
    if twice:
        raise files.fail(where, f"track id {twice[0]!r} twice", "give each track its own id")
    actors = []
    for name, label, flags, times, poses, size in rows:
        here = f"{where}, track {name}"
        try:
            table = np.array(poses, dtype=np.float64).reshape(len(times), 7)
            box = Box(*(float(v) for v in size))
            t_us = np.array(times, dtype=np.int64)
        except (TypeError, ValueError, OverflowError) as error:
            raise files.fail(here, f"{type(error).__name__}: {error}", "give 7 numbers a pose and 3 a size") from error
        if min(box.length_m, box.width_m, box.height_m) <= 0:
            raise files.fail(here, f"a box of {size} m", "give positive sizes")
        track = checked_trajectory(files, here, t_us, table[:, :3].copy(), table[:, [6, 3, 4, 5]].copy())
        actors.append(Actor(str(name), label_of(str(label)), box, track, is_static="CONTROLLABLE" not in flags))
    return tuple(actors), sum(a.is_static for a in actors)


def label_of(text: str) -> str:
    """Return our label for a free-text class of AlpaSim.

    Example:
        >>> label_of("heavy_truck"), label_of("person"), label_of("stroller")
        ('truck', 'pedestrian', 'other')
    """
    return next((label for word, label in LABELS if word in text.lower()), "other")

"""Put a drive into the scenario's world: up, scale, ground, the rig's path and mounts."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import (
    interpolate,
    inverse,
    left_of,
    rigid,
    se3,
    shifted,
    trajectory_from_poses,
    unit,
)
from alpasim_plugin.core.types import F64, Actor, HeightField, LaneMap, Signal, Trajectory
from alpasim_plugin.drives.ground import GroundStrip, fit_ground
from alpasim_plugin.drives.source import Points, SourceDrive
from alpasim_plugin.world.ground import from_points, height_at
from scenarios.map_lines import laid
from scenarios.opendrive import lane_map_of
from scenarios.opendrive_road import parse_map
from scenarios.recorded import SourceFiles

CAMERA_HEIGHT_M = 1.5  # assumed where neither the files nor the user say it
AHEAD_OF_AXLE_M = 1.6  # of the front camera, assumed: behind the windscreen of a car
# Speed and acceleration that no car has.
MOST_MPS = 100.0
MOST_MPS2 = 50.0
LEAST_MPS = 0.05  # the top speed of a drive whose times are in another unit
MOST_STEP_MPS = 10.0  # a smaller change of speed may be an error of the poses
OFF_THE_MAP_M = 5.0  # from the nearest lane, on the median


@dataclass(frozen=True, eq=False)
class PlacedDrive:
    """A drive in the scenario's world.

    Attributes:
        T_world_source: ``(4, 4)`` from the files' frame; scales.
        points: In the world.
        ground: Height field.
        strip: The fit behind it; None where the ground was not seen.
        ego: Rig poses.
        mounts: Camera to its pose on the rig.
        poses: Camera to its poses ``(N, 4, 4)``, in the order of the drive's images.
        actors: Road users that move.
        facts: How up, scale and ground were found, for the page of quality.
        notes: What was assumed.
    """

    T_world_source: F64
    points: Points
    ground: HeightField
    strip: GroundStrip | None
    ego: Trajectory
    mounts: Mapping[str, F64]
    poses: Mapping[str, F64]
    actors: tuple[Actor, ...]
    facts: Mapping[str, object]
    notes: tuple[str, ...]


def place(drive: SourceDrive, points: Points, camera_height_m: float | None = None) -> PlacedDrive:
    """Find up, scale and ground of a drive, and put everything into the world.

    Args:
        drive: As its files say it.
        points: In the drive's frame.
        camera_height_m: Of the front camera above the ground; None: as the poses say, or assumed
            where they have no unit.
    """
    T, strip, found_up = _levelled(drive, points)
    scale, scale_note = _scale(drive, strip, camera_height_m)
    T = np.diag([scale, scale, scale, 1.0]) @ T
    moved = points.moved(T)
    poses = {
        name: np.array([_moved(T, photograph.T_world_camera) for photograph in drive.of(name)])
        for name in drive.cameras
    }
    strip = fit_ground(moved, poses[drive.front][:, :3, 3])
    height = camera_height_m or CAMERA_HEIGHT_M
    field = strip.field() if strip else _below(poses[drive.front][:, :3, 3], height)
    first = poses[drive.front][0, :3, 3]
    shift = shifted(-first[0], -first[1], -float(height_at(field, first[None])[0]))
    T = shift @ T
    moved = moved.moved(shift)
    poses = {name: shift @ values for name, values in poses.items()}
    field = HeightField(
        field.x0_m + shift[0, 3], field.y0_m + shift[1, 3], field.cell_m, field.z + shift[2, 3]
    )
    strip = fit_ground(moved, poses[drive.front][:, :3, 3]) if strip else None
    ego, mounts = _rig(drive, poses, field)
    notes = [found_up, scale_note]
    if drive.front_xy_m is None:
        notes.append(
            f"the front camera is taken to stand {AHEAD_OF_AXLE_M:g} m ahead of the rear axle"
        )
    notes += [
        f"camera {name} took no photograph while {drive.front} did: where it stands is not known, and the scenario has no such camera"
        for name in drive.cameras
        if name not in mounts
    ]
    if strip is None:
        notes.append(
            f"the ground below the path was not seen: it is taken {height:g} m below the camera. Renderers can be measured by these "
            "photographs (simrun bench real); a drive needs photographs taken along a road"
        )
    return PlacedDrive(
        T,
        moved,
        field,
        strip,
        ego,
        mounts,
        poses,
        tuple(replace(actor, track=_moved_track(T, actor.track)) for actor in drive.actors),
        {"up": found_up, "scale": scale_note, "ground": _ground_facts(strip)},
        tuple(notes),
    )


def check_motion(drive: SourceDrive, placed: PlacedDrive) -> None:
    """Refuse a drive whose speed, or change of speed from one photograph to the next, no car has.

    Photographs without metres that were not taken along a road say nothing of speed.

    Raises:
        InputError: Names the photograph.
    """
    if drive.metric is None and placed.strip is None:
        return
    centres = placed.poses[drive.front][:, :3, 3]
    photographs = drive.of(drive.front)
    dt_s = np.diff([int(photograph.t_us or 0) for photograph in photographs]) * 1e-6
    velocity = np.diff(centres, axis=0) / dt_s[:, None]
    speed = np.linalg.norm(velocity, axis=1)
    change = np.linalg.norm(np.diff(velocity, axis=0), axis=1)
    accel = 2 * change / (dt_s[1:] + dt_s[:-1])
    jumps = np.flatnonzero((accel > MOST_MPS2) & (change > MOST_STEP_MPS))
    fast = int(np.argmax(speed))
    if speed[fast] < LEAST_MPS:
        raise InputError(
            f"{photographs[fast].location}: at most {speed[fast]:.2g} m/s in {dt_s.sum():.4g} s, slower than any car drives",
            "check the unit of the times (t_us: microseconds) and of the poses",
        )
    if speed[fast] > MOST_MPS:
        index = fast + 1
        fault = f"{speed[fast]:.0f} m/s"
    elif len(jumps):
        index = int(jumps[0]) + 2
        fault = f"its speed changes by {change[jumps[0]]:.0f} m/s in {dt_s[jumps[0] + 1]:.2g} s"
    else:
        return
    raise InputError(
        f"{photographs[index].location}, {photographs[index].file.name}: {fault}, which no car does",
        "check the order of the photographs, their times (t_us) and the unit of the poses",
    )


def _levelled(drive: SourceDrive, points: Points) -> tuple[F64, GroundStrip | None, str]:
    """Return the transform that puts the drive's up along z and its first heading along x, the
    ground, and how up was determined.
    """
    front = np.array([photograph.T_world_camera for photograph in drive.of(drive.front)])
    T = _upright(-front[:, :3, 1].mean(axis=0), front)
    strip = None
    for _ in range(3):
        strip = fit_ground(points.moved(T), front[:, :3, 3] @ T[:3, :3].T + T[:3, 3])
        if strip is None:
            break
        on_path = (strip.frame.s >= 0) & (strip.frame.s <= strip.frame.s[-1] + strip.frame.s[0])
        line = strip.frame.line[on_path]
        along = strip.frame.along[on_path]
        left = left_of(along)
        xy = np.concatenate([line[:, :2] + side * strip.height * left for side in (-1.0, 1.0)])
        A = np.column_stack([xy - xy.mean(axis=0), np.ones(len(xy))])
        slope = np.linalg.lstsq(A, strip.z(xy), rcond=None)[0]
        normal = np.array([-slope[0], -slope[1], 1.0])
        T = _upright(unit(normal) @ T[:3, :3], front)
    if strip is None:
        return T, None, "up from the camera, which is taken to stand upright on the mean"
    return T, strip, "up from the ground: the road's mean plane is taken as level"


def _upright(up: F64, front: F64) -> F64:
    """Return a rotation ``(4, 4)`` that puts ``up`` along z and the first heading of cameras ``(N,
    4, 4)`` along x.
    """
    z = unit(up)
    forward = front[min(len(front) - 1, 3), :3, 3] - front[0, :3, 3]
    if np.linalg.norm(np.cross(z, forward)) < 1e-9 or float(forward @ front[0, :3, 2]) < 0:
        forward = front[0, :3, 2]
    x = forward - z * float(forward @ z)
    x = unit(x)
    return rigid([x, np.cross(z, x), z])


def _scale(
    drive: SourceDrive, strip: GroundStrip | None, camera_height_m: float | None
) -> tuple[float, str]:
    if drive.metric is not None:
        return 1.0, f"scale from {drive.metric}"
    wanted = camera_height_m or CAMERA_HEIGHT_M
    how = "as given" if camera_height_m else "assumed; `simrun import drive` takes --camera-height"
    if strip is not None:
        return (
            wanted / strip.height,
            f"scale from the camera's height above the ground, {wanted:g} m ({how})",
        )
    reach = float(np.linalg.norm(drive.path - drive.path.mean(axis=0), axis=1).max())
    return (
        4.0 / reach,
        "scale unknown: neither poses in metres nor a ground below the camera; the path reaches 4 m from its middle",
    )


def _moved(T: F64, T_world_camera: F64) -> F64:
    """Return a rigid pose under a transform that may scale."""
    out = T @ T_world_camera
    out[:3, :3] /= np.cbrt(np.linalg.det(out[:3, :3]))
    return np.asarray(out)


def _moved_track(T: F64, track: Trajectory) -> Trajectory:
    """Return a track under a rigid transform."""
    return trajectory_from_poses(track.t_us, T @ se3(track.xyz, track.quat))


def _below(path: F64, height: float) -> HeightField:
    """Return the ground at a height below a path that saw none: the path's own heights, nearest
    first.
    """
    corners = np.array([[dx, dy, 0.0] for dx in (-60.0, 60.0) for dy in (-60.0, 60.0)])
    around = np.concatenate([path, path[:1] + corners, path[-1:] + corners])
    around[:, 2] -= height
    return from_points(around, 2.0)


def _rig(
    drive: SourceDrive, poses: Mapping[str, F64], field: HeightField
) -> tuple[Trajectory, dict[str, F64]]:
    """Return the rig's poses and the cameras' mounts; the rig's origin stands on the ground."""
    front = poses[drive.front]
    photographs = drive.of(drive.front)
    centres = front[:, :3, 3]
    step = np.gradient(centres, axis=0)
    moving = np.linalg.norm(step[:, :2], axis=1) > 0.3 * np.median(
        np.linalg.norm(step[:, :2], axis=1)
    )
    turns = []
    for pose, along in zip(front[moving], step[moving], strict=True):
        heading = unit(along[:2])
        # It looks back, or the drive goes backwards: the camera's own direction counts.
        if heading @ pose[:2, 2] < 0:
            heading = pose[:2, 2] / max(float(np.linalg.norm(pose[:2, 2])), 1e-9)
        ahead = (
            float(
                height_at(field, (pose[:2, 3] + heading)[None])[0]
                - height_at(field, (pose[:2, 3] - heading)[None])[0]
            )
            / 2
        )
        x = np.array([*heading, ahead]) / np.sqrt(1 + ahead**2)
        y = np.cross([0.0, 0.0, 1.0], x)
        y = unit(y)
        turns.append(np.stack([x, y, np.cross(x, y)]) @ pose[:3, :3])
    u, _, vt = np.linalg.svd(np.median(turns, axis=0))
    height_m = float(np.median(centres[:, 2] - height_at(field, centres)))
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    mount = rigid(turn, (AHEAD_OF_AXLE_M, 0.0, height_m))
    if drive.front_xy_m is not None:
        mount[:2, 3] = drive.front_xy_m
    ego = trajectory_from_poses(
        np.array([int(photograph.t_us or 0) for photograph in photographs]),
        np.array([pose @ inverse(mount) for pose in front]),
    )
    mounts = {drive.front: mount}
    for name in drive.cameras[1:]:
        times = [int(photograph.t_us or 0) for photograph in drive.of(name)]
        common = [i for i, t in enumerate(times) if ego.t_us[0] <= t <= ego.t_us[-1]]
        if common:
            i = common[len(common) // 2]
            mounts[name] = inverse(interpolate(ego, times[i])) @ poses[name][i]
    return ego, mounts


def _ground_facts(strip: GroundStrip | None) -> dict[str, object] | None:
    if strip is None:
        return None
    errors = np.abs(strip.section_errors)
    worst, usual = (
        (round(float(value), 4) for value in (errors.max(), np.median(errors)))
        if len(errors)
        else (None, None)
    )
    return {
        "points": strip.used,
        "camera_height_m": round(strip.height, 3),
        "sections": len(errors),
        "median_error_m": usual,
        "worst_error_m": worst,
    }


NO_MAP = "no map: the road is the driven path, 3.5 m wide, without lane markings"


def given_map(
    path: Path, drive: SourceDrive, placed: PlacedDrive
) -> tuple[LaneMap, tuple[str, ...]]:
    """Read an OpenDRIVE map in the drive's own coordinates, lay it onto the ground that was found,
    and return it with notes.

    Raises:
        InputError: The drive has no metres, the file is no map, or it lies elsewhere than the
            drive; then the offset is named.
    """
    if drive.metric is None:
        raise InputError(
            f"{path}: a map in metres for poses without a unit",
            "give poses in metres, in the map's coordinates",
        )
    odr = parse_map(path, SourceFiles().read_xml(path))
    lane_map, notes = lane_map_of(path, odr, placed.T_world_source)
    centres = np.concatenate(
        [lane.centre for lane in lane_map.lanes.values() if lane.kind == "vehicle"]
    )
    away, nearest = scipy.spatial.KDTree(centres[:, :2]).query(placed.ego.xyz[:, :2])
    if np.median(away) > OFF_THE_MAP_M:
        dx, dy = np.linalg.inv(placed.T_world_source)[:2, :2] @ np.median(
            centres[nearest, :2] - placed.ego.xyz[:, :2], axis=0
        )
        raise InputError(
            f"{path}: its nearest lane lies {np.median(away):.1f} m from the drive: {dx:+.1f} m in x and {dy:+.1f} m in y",
            "give the map of this street, in the coordinates of the poses",
        )
    return laid_map(lane_map, placed.ground), (
        f"the road is that of {path.name}, laid onto the ground that was found",
        *notes,
    )


def laid_map(lane_map: LaneMap, ground: HeightField) -> LaneMap:
    """Return a map whose lines lie on another ground; what stands on its own ground, poles, signs
    and lights, stands as high above the other one.
    """
    lanes = {}
    for key, lane in lane_map.lanes.items():
        edges: dict[str, Any] = {
            name: laid(getattr(lane, name), ground) for name in ("centre", "left", "right")
        }
        lanes[key] = replace(lane, **edges)
    road = np.concatenate([lane.centre for lane in lane_map.lanes.values()])
    nearest_road = scipy.spatial.KDTree(road[:, :2])

    def raised_m(point: F64) -> float:
        """Return how much higher the other ground is than the map's road beside a point."""
        _, i = nearest_road.query(point[:2])
        return float(height_at(ground, point[None])[0] - road[i, 2])

    def raised(points: F64) -> F64:
        return points + np.array([0.0, 0.0, raised_m(points[0])])

    def signal_on(signal: Signal) -> Signal:
        head = None if signal.head is None else raised(signal.head[None])[0]
        return replace(signal, stop=laid(signal.stop, ground), head=head)

    lines: dict[str, Any] = {
        name: tuple(laid(line, ground) for line in getattr(lane_map, name))
        for name in ("road_edges", "drivable_areas", "crosswalks", "stop_lines")
    }
    return replace(
        lane_map,
        lanes=lanes,
        markings=tuple(
            replace(marking, xyz=laid(marking.xyz, ground)) for marking in lane_map.markings
        ),
        poles=tuple(raised(pole) for pole in lane_map.poles),
        signs=tuple(
            (shifted(0.0, 0.0, raised_m(pose[:3, 3])) @ pose, box) for pose, box in lane_map.signs
        ),
        signals=lane_map.signals and tuple(signal_on(signal) for signal in lane_map.signals),
        give_way=tuple(signal_on(signal) for signal in lane_map.give_way),
        **lines,
    )

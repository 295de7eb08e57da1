"""CommonRoad scenarios (XML 2018b and 2020a) with recorded traffic.

The format is read directly from its public description (Althoff, Koschi, Manzinger 2017; commonroad.in.tum.de). A file names no recorded
ego: its planning problem asks for one. Here a recorded vehicle takes that role, so that there is a human drive to compare with.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import shapely

from alpasim_plugin.core.geometry import lane_polygon, offset_trajectory, rectangle_corners
from alpasim_plugin.core.types import F64, Actor, Box, HeightField, LaneMap, Trajectory, Vehicle
from alpasim_plugin.io.limits import TIME_STEP_S
from alpasim_plugin.world.ground import flat, from_points
from scenarios.commonroad_map import read_lanelets
from scenarios.commonroad_obstacles import Obstacle, read_obstacles
from scenarios.reading import SourceFiles
from scenarios.recorded import RecordedLog
from scenarios.road_edges import merge_areas
from scenarios.tracks import actors_of_track

VERSIONS = ("2018b", "2020a")
DEFAULT = Vehicle()


def read_commonroad(path: str | Path, ego: str | None = None) -> RecordedLog:
    """Read a scenario file.

    Args:
        path: The XML file.
        ego: Id of the recorded vehicle that becomes the ego; None picks the car with the longest drive among those that are present
            all the time, keep inside one lane (if none does: stay on the lanelets) and touch nobody; ties go to the smaller id. Lanes
            and gaps are tested with a footprint at least as large as the default vehicle's, because the evaluators score with that one.

    Raises:
        InputError: The file is missing, malformed or no CommonRoad scenario; no vehicle can be the ego; ``ego`` names none.
    """
    file = Path(path)
    files = SourceFiles("reading a CommonRoad scenario")
    root = files.read_xml(file)
    version = root.get("commonRoadVersion")
    if root.tag != "commonRoad" or version not in VERSIONS:
        found = f"root element {root.tag!r}, version {version!r}"
        raise files.fail(file, found, f"give a CommonRoad XML file of version {' or '.join(VERSIONS)}")
    dt_s = _time_step(files, file, root)
    obstacles, obstacle_notes = read_obstacles(files, file, root, np.zeros(3))
    if not obstacles:
        raise files.fail(file, "no recorded traffic, so no drive to take the ego from", "use a scenario with dynamic obstacles")
    origin = np.array([*np.round(obstacles[0].centre[0, :2]), 0.0])  # whole metres: the subtraction loses nothing
    obstacles = tuple(_moved(o, -origin) for o in obstacles)
    for obstacle in obstacles:
        files.near(f"{file}, obstacle {obstacle.obstacle_id}", obstacle.centre)
    lane_map, map_notes = read_lanelets(files, file, root, origin)
    chosen, why = _choose_ego(files, file, obstacles, lane_map, ego)
    vehicle = _vehicle(chosen.box)
    centre_log = chosen.trajectory(files, file, dt_s)
    if len(centre_log) < 2:
        raise files.fail(f"{file}, obstacle {chosen.obstacle_id}", "1 state", "choose an ego with a trajectory")
    T_centre_rig = np.eye(4)
    T_centre_rig[:3, 3] = (-vehicle.rear_axle_to_centre_m, 0.0, -chosen.box.height_m / 2)
    first, last = _time_range(obstacles, dt_s)
    actors = [actor for o in obstacles if o is not chosen for actor in _actors(files, file, o, dt_s, first, last)]
    notes = (
        why,
        f"ego box {chosen.box.length_m} x {chosen.box.width_m} m from the file; rear axle assumed {vehicle.rear_axle_to_centre_m:.2f} m "
        f"behind its centre and wheelbase {vehicle.wheelbase_m:.2f} m, in proportion to its length",
        "heights of boxes assumed by class: the format has none",
        "the planning problem is not used: it asks for a drive and records none",
        *map_notes,
        *obstacle_notes,
    )
    return RecordedLog(
        scene_id=f"commonroad-{root.get('benchmarkID') or file.stem}",
        source="commonroad",
        lane_map=lane_map,
        ground=_ground(lane_map, chosen.centre),
        ego_log=offset_trajectory(centre_log, T_centre_rig),
        vehicle=vehicle,
        actors=tuple(actors),
        cameras=(),
        world_origin=(float(origin[0]), float(origin[1]), 0.0),
        content_hash=files.content_hash,
        notes=notes,
    )


def _time_step(files: SourceFiles, path: Path, root: Element) -> float:
    try:
        dt_s = float(str(root.get("timeStepSize")))
    except ValueError as error:
        raise files.fail(path, f"timeStepSize = {root.get('timeStepSize')!r}", "give the time step in seconds") from error
    TIME_STEP_S.check(dt_s, files.doing, path, "timeStepSize")
    return dt_s


def _moved(obstacle: Obstacle, by: F64) -> Obstacle:
    return Obstacle(**{**vars(obstacle), "centre": obstacle.centre + by})


def _vehicle(box: Box) -> Vehicle:
    """Scale the default chassis to the recorded length: the file has sizes and no axles."""
    scale = box.length_m / DEFAULT.box.length_m
    return Vehicle(box=box, rear_axle_to_centre_m=DEFAULT.rear_axle_to_centre_m * scale, wheelbase_m=DEFAULT.wheelbase_m * scale)


def _time_range(obstacles: tuple[Obstacle, ...], dt_s: float) -> tuple[int, int]:
    moving = [o for o in obstacles if not o.static] or list(obstacles)
    first, last = min(int(o.steps[0]) for o in moving), max(int(o.steps[-1]) for o in moving)
    return round(first * dt_s * 1e6), round(last * dt_s * 1e6)


def _actors(files: SourceFiles, path: Path, obstacle: Obstacle, dt_s: float, first_us: int, last_us: int) -> list[Actor]:
    """Make an obstacle's actors; a static obstacle, given by one state, is there for the whole recording."""
    track = obstacle.trajectory(files, path, dt_s)
    if not obstacle.static:
        return actors_of_track(obstacle.obstacle_id, obstacle.label, obstacle.box, track)
    if last_us > first_us:
        track = Trajectory(np.array([first_us, last_us]), np.repeat(track.xyz, 2, axis=0), np.repeat(track.quat, 2, axis=0))
    return [Actor(obstacle.obstacle_id, obstacle.label, obstacle.box, track, is_static=True)]


def _choose_ego(
    files: SourceFiles, path: Path, obstacles: tuple[Obstacle, ...], lane_map: LaneMap, ego: str | None
) -> tuple[Obstacle, str]:
    moving = {o.obstacle_id: o for o in obstacles if not o.static}
    if ego is not None:
        if ego not in moving:
            raise files.fail(path, f"no moving obstacle {ego!r}", f"choose the ego among {', '.join(sorted(moving)) or 'none'}")
        return moving[ego], f"ego is the recorded vehicle {ego}, as asked"
    first = min((int(o.steps[0]) for o in moving.values()), default=0)
    last = max((int(o.steps[-1]) for o in moving.values()), default=0)
    always = [o for o in moving.values() if o.label == "car" and (o.steps[0], o.steps[-1], len(o.steps)) == (first, last, last - first + 1)]
    always.sort(key=lambda o: (-_driven_m(o), len(o.obstacle_id), o.obstacle_id))
    surface = merge_areas([lane_polygon(lane) for lane in lane_map.lanes.values()])
    corridors = _corridors(lane_map)
    on_road: list[Obstacle] = []
    for candidate in always:
        footprints = _rectangles(candidate, least=DEFAULT.box)
        if not shapely.covers(surface, footprints).all() or _touches(candidate, footprints, obstacles):
            continue
        on_road.append(candidate)
        if shapely.covers(corridors[:, None], footprints[None, :]).any(axis=0).all():
            return candidate, (
                f"ego is the recorded car {candidate.obstacle_id}: the longest drive ({_driven_m(candidate):.1f} m) among cars that are "
                "present all the time, keep inside one lane and touch nobody; choose another with ego=ID"
            )
    if on_road:
        return on_road[0], (
            f"ego is the recorded car {on_road[0].obstacle_id}: the longest drive ({_driven_m(on_road[0]):.1f} m) among cars that are "
            "present all the time, stay on the lanelets and touch nobody (none keeps inside one lane); choose another with ego=ID"
        )
    found = f"{len(moving)} moving obstacles, none a car that is present all the time, stays on the lanelets and touches nobody"
    raise files.fail(path, found, "name the recorded vehicle that shall be the ego")


def _driven_m(obstacle: Obstacle) -> float:
    return float(np.linalg.norm(np.diff(obstacle.centre[:, :2], axis=0), axis=1).sum())


def _corridors(lane_map: LaneMap) -> Any:
    """Return each lane's area joined with its predecessors and successors ``(L,)``: where a car is that keeps its lane."""
    lanes = lane_map.lanes
    before: dict[str, list[str]] = {key: [] for key in lanes}
    for key, lane in lanes.items():
        for follower in lane.successors:
            if follower in before:
                before[follower].append(key)
    joined = [
        merge_areas([lane_polygon(lanes[k]) for k in (key, *before[key], *(s for s in lane.successors if s in lanes))])
        for key, lane in lanes.items()
    ]
    return np.array(joined, dtype=object)


def _rectangles(obstacle: Obstacle, least: Box | None = None) -> Any:
    """Return the plan-view rectangles ``(T,)`` of an obstacle, at least as large as ``least``."""
    size = np.array([obstacle.box.length_m, obstacle.box.width_m])
    size = size if least is None else np.maximum(size, [least.length_m, least.width_m])
    corners = rectangle_corners(obstacle.centre[:, :2], obstacle.yaw, np.broadcast_to(size, (len(obstacle.centre), 2)))
    return shapely.polygons(corners)


def _touches(ego: Obstacle, footprints: Any, obstacles: tuple[Obstacle, ...]) -> bool:
    at = {int(step): i for i, step in enumerate(ego.steps)}
    for other in obstacles:
        if other is ego:
            continue
        shapes = _rectangles(other)
        if other.static and len(other.steps) == 1:
            if shapely.intersects(footprints, shapes[0]).any():
                return True
            continue
        common = [(at[int(step)], j) for j, step in enumerate(other.steps) if int(step) in at]
        if any(shapely.intersects(footprints[i], shapes[j]) for i, j in common):
            return True
    return False


def _ground(lane_map: LaneMap, drive: F64) -> HeightField:
    """Return a level ground for planar files, a fitted one where points have heights."""
    points = np.concatenate([e for lane in lane_map.lanes.values() for e in (lane.left, lane.right) if e is not None])
    return flat(0.0) if np.ptp(points[:, 2]) == 0 and points[0, 2] == 0 else from_points(points, drive=drive)

"""CommonRoad scenarios (XML 2018b and 2020a) with recorded traffic.

The format is read directly from its public description (Althoff, Koschi, Manzinger 2017;
commonroad.in.tum.de). A file names no recorded ego: its planning problem asks for one. Here a
recorded vehicle takes that role, so that there is a human drive to compare with.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import offset_trajectory, quat_from_yaw
from alpasim_plugin.core.limits import STEP, TIME_STEP_S
from alpasim_plugin.core.types import (
    F64,
    I64,
    Actor,
    Box,
    Trajectory,
    Vehicle,
)
from scenarios.commonroad_map import number, point, read_lanelets
from scenarios.map_lines import ground_of
from scenarios.recorded import RecordedLog, SourceFiles, actors_of_track, checked_trajectory

LABELS = {
    "car": "car",
    "taxi": "car",
    "parkedVehicle": "car",
    "priorityVehicle": "car",
    "truck": "truck",
    "bus": "bus",
    "bicycle": "cyclist",
    "motorcycle": "motorcycle",
    "pedestrian": "pedestrian",
}  # all else (train, pillar, constructionZone, building, ...) is "other"
HEIGHTS_M = {
    "car": 1.5,
    "truck": 3.2,
    "bus": 3.2,
    "pedestrian": 1.75,
    "cyclist": 1.75,
    "motorcycle": 1.5,
    "other": 1.5,
}

VERSIONS = ("2018b", "2020a")
DEFAULT = Vehicle()


@dataclass(frozen=True)
class Obstacle:
    """One recorded obstacle as a box: the format's positions are centres of shapes."""

    obstacle_id: str
    label: str
    static: bool
    box: Box
    steps: I64  # (T,) time steps
    centre: F64  # (T, 3) metres, local; z of the ground
    yaw: F64  # (T,) radians
    speed_mps: F64  # (T,); NaN where the file gives none

    def trajectory(self, files: SourceFiles, path: Path, dt_s: float) -> Trajectory:
        """Return the poses of the box centre, time in integer microseconds."""
        t_us = np.round(self.steps * (dt_s * 1e6)).astype(np.int64)
        xyz = self.centre + np.array([0.0, 0.0, self.box.height_m / 2])
        return checked_trajectory(
            f"{path}, obstacle {self.obstacle_id}", t_us, xyz, quat_from_yaw(self.yaw)
        )


def read_obstacles(
    files: SourceFiles, path: Path, root: Element, origin: F64
) -> tuple[tuple[Obstacle, ...], tuple[str, ...]]:
    """Read static and dynamic obstacles in file order, with notes on those that are not recorded
    tracks.

    Raises:
        InputError: A number is missing or broken, an id occurs twice, or a state has no time.
    """
    obstacles: list[Obstacle] = []
    skipped: Counter[str] = Counter()
    for element in (e for e in root if e.tag in ("obstacle", "staticObstacle", "dynamicObstacle")):
        where = f"{path}, obstacle {element.get('id')}"
        static = element.tag == "staticObstacle" or element.findtext("role") == "static"
        states = [
            s
            for s in (element.find("initialState"), *element.findall("trajectory/state"))
            if s is not None
        ]
        places = [place for s in states if (place := s.find("position/point")) is not None]
        if (
            not states
            or len(places) < len(states)
            or any(s.find("orientation/exact") is None for s in states)
        ):
            skipped["have states without an exact position and orientation"] += 1
            continue
        if element.find("occupancySet") is not None or (static and len(states) > 1):
            skipped["are predicted as occupied areas, not as states"] += 1
            continue
        shape = element.find("shape")
        if shape is None or len(shape) == 0:
            raise InputError(f"{where}: no shape", "give a rectangle, circle or polygon")
        size, offset, turn = _bounding_box(files, where, shape)
        label = LABELS.get(str(element.findtext("type")), "other")
        yaw = np.array(
            [number(files, where, s.find("orientation/exact"), "orientation") for s in states]
        )
        centre = np.array([point(files, where, place) for place in places]) - origin
        c, s = np.cos(yaw), np.sin(yaw)
        centre[:, :2] += np.stack(
            [c * offset[0] - s * offset[1], s * offset[0] + c * offset[1]], axis=1
        )
        times = [number(files, where, s.find("time/exact"), "time") for s in states]
        for time in times:
            STEP.check(time, where, "time step")
        steps = np.array([round(time) for time in times], dtype=np.int64)
        speeds = [s.find("velocity/exact") for s in states]
        speed = np.array(
            [np.nan if v is None else number(files, where, v, "velocity") for v in speeds]
        )
        box = Box(size[0], size[1], HEIGHTS_M[label])
        obstacles.append(
            Obstacle(str(element.get("id")), label, static, box, steps, centre, yaw + turn, speed)
        )
    ids = Counter(o.obstacle_id for o in obstacles)
    if ids and max(ids.values()) > 1:
        raise InputError(
            f"{path}: obstacle id {ids.most_common(1)[0][0]} twice", "give each obstacle its own id"
        )
    notes = [f"{n} obstacles {why} and were left out" for why, n in sorted(skipped.items())]
    notes += [
        f"{len(found)} {tag} elements were left out"
        for tag in ("environmentObstacle", "phantomObstacle")
        if (found := root.findall(tag))
    ]
    return tuple(obstacles), tuple(notes)


def _bounding_box(
    files: SourceFiles, where: str, shape: Element
) -> tuple[tuple[float, float], tuple[float, float], float]:
    """Return (length, width), the box centre in the obstacle's frame, and the box's turn against
    it.

    A single rectangle is kept as it is; circles, polygons and groups of shapes become the box
    around them.
    """
    parts = list(shape)
    if len(parts) == 1 and parts[0].tag == "rectangle":
        corners, turn, centre = _rectangle(files, where, parts[0])
        return corners, centre, turn
    clouds: list[F64] = []
    for part in parts:
        if part.tag == "circle":
            radius = number(files, where, part.find("radius"), "radius")
            middle = np.array(_centre(files, where, part))
            clouds.append(np.array([middle - radius, middle + radius]))
        elif part.tag == "polygon":
            clouds.append(
                np.array([point(files, where, p)[:2] for p in part.findall("point")]).reshape(-1, 2)
            )
        elif part.tag == "rectangle":
            (length, width), turn, centre = _rectangle(files, where, part)
            half = np.array([[length, width], [length, -width]]) / 2
            c, s = np.cos(turn), np.sin(turn)
            turned = half @ np.array([[c, s], [-s, c]])
            clouds.append(np.concatenate([turned, -turned]) + np.array(centre))
        else:
            raise InputError(f"{where}: shape {part.tag!r}", "give a rectangle, circle or polygon")
    points = np.concatenate(clouds)
    if len(points) < 2:
        raise InputError(f"{where}: a shape without extent", "give a rectangle, circle or polygon")
    low, high = points.min(axis=0), points.max(axis=0)
    size, middle = high - low, (low + high) / 2
    if not (size > 0).all():
        raise InputError(f"{where}: a shape of {size[0]} x {size[1]} m", "give positive sizes")
    return (float(size[0]), float(size[1])), (float(middle[0]), float(middle[1])), 0.0


def _rectangle(
    files: SourceFiles, where: str, part: Element
) -> tuple[tuple[float, float], float, tuple[float, float]]:
    length, width = (number(files, where, part.find(k), k) for k in ("length", "width"))
    if length <= 0 or width <= 0:
        raise InputError(f"{where}: a shape of {length} x {width} m", "give positive sizes")
    turn = part.find("orientation")
    return (
        (length, width),
        0.0 if turn is None else number(files, where, turn, "orientation"),
        _centre(files, where, part),
    )


def _centre(files: SourceFiles, where: str, part: Element) -> tuple[float, float]:
    centre = part.find("center")
    return (0.0, 0.0) if centre is None else point(files, where, centre)[:2]


def read_commonroad(path: str | Path, ego: str | None = None) -> RecordedLog:
    """Read a scenario file.

    Args:
        path: The XML file.
        ego: Id of the recorded vehicle that becomes the ego; None picks the car with the longest
            drive among those that are present all the time; ties go to the smaller id.

    Raises:
        InputError: The file is missing, malformed or no CommonRoad scenario; no vehicle can be the
            ego; ``ego`` names none.
    """
    file = Path(path)
    files = SourceFiles()
    root = files.read_xml(file)
    version = root.get("commonRoadVersion")
    if root.tag != "commonRoad" or version not in VERSIONS:
        found = f"root element {root.tag!r}, version {version!r}"
        raise InputError(
            f"{file}: {found}", f"give a CommonRoad XML file of version {' or '.join(VERSIONS)}"
        )
    dt_s = _time_step(files, file, root)
    obstacles, obstacle_notes = read_obstacles(files, file, root, np.zeros(3))
    if not obstacles:
        raise InputError(
            f"{file}: no recorded traffic, so no drive to take the ego from",
            "use a scenario with dynamic obstacles",
        )
    origin = np.array(
        [*np.round(obstacles[0].centre[0, :2]), 0.0]
    )  # whole metres: the subtraction loses nothing
    obstacles = tuple(replace(o, centre=o.centre - origin) for o in obstacles)
    for obstacle in obstacles:
        files.near(f"{file}, obstacle {obstacle.obstacle_id}", obstacle.centre)
    lane_map, map_notes = read_lanelets(files, file, root, origin)
    chosen, why = _choose_ego(files, file, obstacles, ego)
    scale = (
        chosen.box.length_m / DEFAULT.box.length_m
    )  # the file has sizes and no axles: the default chassis in proportion
    vehicle = Vehicle(
        chosen.box, DEFAULT.rear_axle_to_centre_m * scale, DEFAULT.wheelbase_m * scale
    )
    centre_log = chosen.trajectory(files, file, dt_s)
    if len(centre_log) < 2:
        raise InputError(
            f"{file}, obstacle {chosen.obstacle_id}: 1 state", "choose an ego with a trajectory"
        )
    T_centre_rig = np.eye(4)
    T_centre_rig[:3, 3] = (-vehicle.rear_axle_to_centre_m, 0.0, -chosen.box.height_m / 2)
    steps = _step_range([o for o in obstacles if not o.static] or obstacles)
    first, last = (round(step * dt_s * 1e6) for step in steps)
    actors = [
        actor
        for o in obstacles
        if o is not chosen
        for actor in _actors(files, file, o, dt_s, first, last)
    ]
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
        ground=ground_of(lane_map, chosen.centre),
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
        raise InputError(
            f"{path}: timeStepSize = {root.get('timeStepSize')!r}", "give the time step in seconds"
        ) from error
    TIME_STEP_S.check(dt_s, path, "timeStepSize")
    return dt_s


def _step_range(obstacles: Sequence[Obstacle]) -> tuple[int, int]:
    """Return the first and the last time step at which any of the obstacles is seen."""
    return min((int(o.steps[0]) for o in obstacles), default=0), max(
        (int(o.steps[-1]) for o in obstacles), default=0
    )


def _actors(
    files: SourceFiles, path: Path, obstacle: Obstacle, dt_s: float, first_us: int, last_us: int
) -> list[Actor]:
    """Make an obstacle's actors; a static obstacle, given by one state, is there for the whole
    recording.
    """
    track = obstacle.trajectory(files, path, dt_s)
    if not obstacle.static:
        return actors_of_track(obstacle.obstacle_id, obstacle.label, obstacle.box, track)
    if last_us > first_us:
        track = Trajectory(
            np.array([first_us, last_us]),
            np.repeat(track.xyz, 2, axis=0),
            np.repeat(track.quat, 2, axis=0),
        )
    return [Actor(obstacle.obstacle_id, obstacle.label, obstacle.box, track, is_static=True)]


def _choose_ego(
    files: SourceFiles,
    path: Path,
    obstacles: tuple[Obstacle, ...],
    ego: str | None,
) -> tuple[Obstacle, str]:
    moving = {o.obstacle_id: o for o in obstacles if not o.static}
    if ego is not None:
        if ego not in moving:
            raise InputError(
                f"{path}: no moving obstacle {ego!r}",
                f"choose the ego among {', '.join(sorted(moving)) or 'none'}",
            )
        return moving[ego], f"ego is the recorded vehicle {ego}, as asked"
    first, last = _step_range(list(moving.values()))
    always = [
        o
        for o in moving.values()
        if o.label == "car"
        and (o.steps[0], o.steps[-1], len(o.steps)) == (first, last, last - first + 1)
    ]
    always.sort(key=lambda o: (-_driven_m(o), len(o.obstacle_id), o.obstacle_id))
    if not always:
        raise InputError(
            f"{path}: {len(moving)} moving obstacles, none a car that is present all the time",
            "name the recorded vehicle that shall be the ego",
        )
    drive = f"the longest drive ({_driven_m(always[0]):.1f} m)"
    return (
        always[0],
        f"ego is the recorded car {always[0].obstacle_id}: {drive} among cars that are present all "
        "the time; choose another with ego=ID",
    )


def _driven_m(obstacle: Obstacle) -> float:
    return float(np.linalg.norm(np.diff(obstacle.centre[:, :2], axis=0), axis=1).sum())

"""CommonRoad scenarios (XML 2018b and 2020a) with recorded traffic.

The format is read directly from its public description (Althoff, Koschi, Manzinger 2017;
commonroad.in.tum.de). A file names no recorded ego: its planning problem asks for one. Here a
recorded vehicle takes that role, so that there is a human drive to compare with.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import shapely

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import parsing
from alpasim_plugin.core.files.limits import STEP, TIME_STEP_S
from alpasim_plugin.core.geometry import arc_lengths, offset_trajectory, quat_from_yaw, shifted
from alpasim_plugin.core.types import (
    F64,
    I64,
    Actor,
    Box,
    Trajectory,
    Vehicle,
)
from scenarios.commonroad_fields import COMMONROAD
from scenarios.commonroad_map import number, point, read_lanelets
from scenarios.map_lines import ground_of
from scenarios.recorded import RecordedLog, SourceFiles, actors_of_track, checked_trajectory, near

# All else (train, pillar, constructionZone, building, ...) is "other".
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
}
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
NO_SMALLER = 0.95  # a turned box of more than this share of the one along the frame is not used
ROUND = 0.35  # a box around a circle is by 4 / pi - 1 = 0.27 larger, and no note needs to say it
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

    def trajectory(self, path: Path, dt_s: float) -> Trajectory:
        """Return the poses of the box centre, time in integer microseconds."""
        t_us = np.round(self.steps * (dt_s * 1e6)).astype(np.int64)
        xyz = self.centre + np.array([0.0, 0.0, self.box.height_m / 2])
        location = f"{path}, obstacle {self.obstacle_id}"
        return checked_trajectory(location, t_us, xyz, quat_from_yaw(self.yaw))


def read_obstacles(path: Path, root: Element) -> tuple[list[Obstacle], list[str]]:
    """Read static and dynamic obstacles in file order, with notes on those that are not recorded
    tracks.

    Raises:
        InputError: A number is missing or broken, an id occurs twice, or a state has no time.
    """
    obstacles: dict[str, Obstacle] = {}
    skipped: Counter[str] = Counter()
    larger: list[float] = []
    for element in root:
        if element.tag not in ("obstacle", "staticObstacle", "dynamicObstacle"):
            continue
        key = str(element.get("id"))
        static = element.tag == "staticObstacle" or element.findtext("role") == "static"
        states = [*element.findall("initialState"), *element.findall("trajectory/state")]
        if not states or not all(map(_is_exact, states)):
            skipped["have states without an exact position and orientation"] += 1
            continue
        if element.find("occupancySet") is not None or (static and len(states) > 1):
            skipped["are predicted as occupied areas, not as states"] += 1
            continue
        location = f"{path}, obstacle {key}"
        with parsing(location, "correct the obstacle"):
            if key in obstacles:
                raise ValueError("its id stands twice")
            obstacles[key] = _obstacle(element, key, static, states, location)
            larger.append(_larger(element))
    notes = [f"{n} obstacles {why} and were left out" for why, n in sorted(skipped.items())]
    too_large = [share for share in larger if share > ROUND]
    if too_large:
        notes.append(
            f"{len(too_large)} obstacles are taken as the box around their shape, which is up to {max(too_large):.0%} larger"
        )
    for tag in ("environmentObstacle", "phantomObstacle"):
        count = len(root.findall(tag))
        if count:
            notes.append(f"{count} {tag} elements were left out")
    return list(obstacles.values()), notes


def _is_exact(state: Element) -> bool:
    """Tell whether a state has a position and an orientation, not ranges of them."""
    return all(state.find(tag) is not None for tag in ("position/point", "orientation/exact"))


def _obstacle(
    element: Element, key: str, static: bool, states: list[Element], location: str
) -> Obstacle:
    """Return an obstacle with its states; `ValueError` where a number is missing."""
    (length, width), offset, turn = _bounding_box(element)
    label = LABELS.get(str(element.findtext("type")), "other")
    yaw = np.array([number(state, "orientation/exact") for state in states])
    centre = np.array([point(place) for place in element.iterfind(".//position/point")])
    c = np.cos(yaw)
    s = np.sin(yaw)
    centre[:, 0] += c * offset[0] - s * offset[1]
    centre[:, 1] += s * offset[0] + c * offset[1]
    times = [number(state, "time/exact") for state in states]
    for time in times:
        STEP.check(time, location, "time step")
    steps = np.rint(times).astype(np.int64)
    box = Box(length, width, HEIGHTS_M[label])
    return Obstacle(key, label, static, box, steps, centre, yaw + turn)


def _bounding_box(
    obstacle: Element,
) -> tuple[tuple[float, float], tuple[float, float], float]:
    """Return (length, width), the box centre in the obstacle's frame, and the box's turn against
    it.

    A single rectangle is kept as it is; circles, polygons and groups of shapes become the smallest
    box around them, along the obstacle's frame where a turned one is no smaller.
    """
    parts = obstacle.findall("shape/*")
    if len(parts) == 1 and parts[0].tag == "rectangle":
        return _rectangle(parts[0])
    return _box_around(_area(parts))


def _area(parts: list[Element]) -> shapely.Geometry:
    """Return what the parts of a shape cover, in the obstacle's frame."""
    areas = []
    for part in parts:
        if part.tag == "circle":
            areas.append(shapely.Point(_centre(part)).buffer(number(part, "radius")))
        elif part.tag == "polygon":
            areas.append(shapely.Polygon([point(corner)[:2] for corner in part.findall("point")]))
        elif part.tag == "rectangle":
            (length, width), (x, y), turn = _rectangle(part)
            box = shapely.box(x - length / 2, y - width / 2, x + length / 2, y + width / 2)
            areas.append(shapely.affinity.rotate(box, turn, use_radians=True))
        else:
            raise ValueError(f"shape {part.tag!r}, neither rectangle nor circle nor polygon")
    return shapely.MultiPolygon(areas)


def _box_around(area: shapely.Geometry) -> tuple[tuple[float, float], tuple[float, float], float]:
    """Return (length, width), the centre and the turn, at most 45 degrees, of a box around an area."""
    left, low, right, high = area.bounds
    if not (right > left and high > low):
        raise ValueError(f"a shape of {right - left} x {high - low} m")
    turned = shapely.oriented_envelope(area)
    if turned.area > NO_SMALLER * (right - left) * (high - low):
        return (right - left, high - low), ((left + right) / 2, (low + high) / 2), 0.0
    corners = shapely.get_coordinates(turned)
    sides = np.diff(corners[:3], axis=0)
    along = int(np.argmax(np.abs(sides[:, 0]) / np.linalg.norm(sides, axis=1)))
    length, width = (float(np.linalg.norm(sides[k])) for k in (along, 1 - along))
    turn = float(np.arctan2(sides[along, 1], sides[along, 0]))
    turn = (turn + np.pi / 2) % np.pi - np.pi / 2
    return (length, width), (float(turned.centroid.x), float(turned.centroid.y)), turn


def _larger(obstacle: Element) -> float:
    """Return how much larger than an obstacle's shape its box is, as a share of the shape."""
    parts = obstacle.findall("shape/*")
    if len(parts) == 1 and parts[0].tag == "rectangle":
        return 0.0
    area = _area(parts)
    (length, width), _, _ = _box_around(area)
    covered = shapely.union_all(shapely.make_valid(list(area.geoms)))
    return float(length * width / covered.area) - 1.0


def _rectangle(part: Element) -> tuple[tuple[float, float], tuple[float, float], float]:
    """Return (length, width), the centre and the turn of a rectangle.

    Positions are those of an origin that ``originXShift`` moves along the length, as to a rear axle.
    """
    size = number(part, "length"), number(part, "width")
    if min(size) <= 0:
        raise ValueError(f"a shape of {size[0]} x {size[1]} m")
    shift_m = number(part, "originXShift", 0.0)
    if abs(shift_m) > size[0] / 2:
        raise ValueError(f"originXShift = {shift_m:g} m, outside of a length of {size[0]:g} m")
    x, y = _centre(part)
    turn = number(part, "orientation", 0.0)
    return size, (x - shift_m * np.cos(turn), y - shift_m * np.sin(turn)), turn


def _centre(part: Element) -> tuple[float, float]:
    centre = part.find("center")
    return (0.0, 0.0) if centre is None else point(centre)[:2]


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
    dt_s = _time_step_s(file, root)
    obstacles, obstacle_notes = read_obstacles(file, root)
    if not obstacles:
        raise InputError(
            f"{file}: no recorded traffic, so no drive to take the ego from",
            "use a scenario with dynamic obstacles",
        )
    # Whole metres: the subtraction loses nothing.
    origin = np.array([*np.round(obstacles[0].centre[0, :2]), 0.0])
    obstacles = [replace(obstacle, centre=obstacle.centre - origin) for obstacle in obstacles]
    for obstacle in obstacles:
        near(f"{file}, obstacle {obstacle.obstacle_id}", obstacle.centre)
    lane_map, map_notes = read_lanelets(file, root, origin)
    chosen, why = _choose_ego(file, obstacles, ego)
    vehicle = _vehicle(chosen.box)
    centre_log = chosen.trajectory(file, dt_s)
    if len(centre_log) < 2:
        raise InputError(
            f"{file}, obstacle {chosen.obstacle_id}: 1 state", "choose an ego with a trajectory"
        )
    T_centre_rig = shifted(-vehicle.rear_axle_to_centre_m, 0.0, -chosen.box.height_m / 2)
    notes = (
        why,
        f"ego box {chosen.box.length_m} x {chosen.box.width_m} m from the file; rear axle assumed {vehicle.rear_axle_to_centre_m:.2f} m "
        f"behind its centre and wheelbase {vehicle.wheelbase_m:.2f} m, in proportion to its length",
        "heights of boxes assumed by class: the format has none",
        "the planning problem is not used: it asks for a drive and records none",
        *map_notes,
        *obstacle_notes,
        *COMMONROAD.notes_of_xml(root),
    )
    return RecordedLog(
        scene_id=f"commonroad-{root.get('benchmarkID') or file.stem}",
        source="commonroad",
        lane_map=lane_map,
        ground=ground_of(lane_map, chosen.centre),
        ego_log=offset_trajectory(centre_log, T_centre_rig),
        vehicle=vehicle,
        actors=tuple(_actors(file, obstacles, chosen, dt_s)),
        cameras=(),
        world_origin=(float(origin[0]), float(origin[1]), 0.0),
        content_hash=files.content_hash,
        notes=notes,
    )


def _time_step_s(path: Path, root: Element) -> float:
    """Return the length of a time step, seconds.

    Raises:
        InputError: The document is no CommonRoad scenario, or it has no time step.
    """
    version = root.get("commonRoadVersion")
    if root.tag != "commonRoad" or version not in VERSIONS:
        fault = f"root element {root.tag!r}, version {version!r}"
        do_this = f"give a CommonRoad XML file of version {' or '.join(VERSIONS)}"
        raise InputError(f"{path}: {fault}", do_this)
    with parsing(path, "give the time step in seconds"):
        dt_s = float(root.get("timeStepSize", ""))
    TIME_STEP_S.check(dt_s, path, "timeStepSize")
    return dt_s


def _vehicle(box: Box) -> Vehicle:
    """Return the default chassis in proportion to a box: the file has sizes and no axles."""
    scale = box.length_m / DEFAULT.box.length_m
    return Vehicle(box, DEFAULT.rear_axle_to_centre_m * scale, DEFAULT.wheelbase_m * scale)


def _actors(path: Path, obstacles: Sequence[Obstacle], ego: Obstacle, dt_s: float) -> list[Actor]:
    """Return the obstacles other than the ego; static ones are there for the whole recording."""
    steps = np.concatenate([obstacle.steps for obstacle in obstacles if not obstacle.static])
    ends_us = np.round(np.array([steps.min(), steps.max()]) * dt_s * 1e6).astype(np.int64)
    actors = []
    for obstacle in obstacles:
        name, label, box = obstacle.obstacle_id, obstacle.label, obstacle.box
        track = obstacle.trajectory(path, dt_s)
        if obstacle.static:
            xyz, quat = (np.repeat(column, 2, axis=0) for column in (track.xyz, track.quat))
            actors.append(Actor(name, label, box, Trajectory(ends_us, xyz, quat), is_static=True))
        elif obstacle is not ego:
            actors += actors_of_track(name, label, box, track)
    return actors


def _choose_ego(path: Path, obstacles: list[Obstacle], ego: str | None) -> tuple[Obstacle, str]:
    moving = {obstacle.obstacle_id: obstacle for obstacle in obstacles if not obstacle.static}
    if ego is not None:
        if ego not in moving:
            raise InputError(
                f"{path}: no moving obstacle {ego!r}",
                f"choose the ego among {', '.join(sorted(moving)) or 'none'}",
            )
        return moving[ego], f"ego is the recorded vehicle {ego}, as asked"
    first = min((int(obstacle.steps[0]) for obstacle in moving.values()), default=0)
    last = max((int(obstacle.steps[-1]) for obstacle in moving.values()), default=0)
    always = [
        obstacle
        for obstacle in moving.values()
        if obstacle.label == "car" and np.array_equal(obstacle.steps, np.arange(first, last + 1))
    ]
    if not always:
        raise InputError(
            f"{path}: {len(moving)} moving obstacles, none a car that is present all the time",
            "name the recorded vehicle that shall be the ego",
        )
    chosen = min(
        always,
        key=lambda obstacle: (
            -_driven_m(obstacle),
            len(obstacle.obstacle_id),
            obstacle.obstacle_id,
        ),
    )
    drive = f"the longest drive ({_driven_m(chosen):.1f} m)"
    return (
        chosen,
        f"ego is the recorded car {chosen.obstacle_id}: {drive} among cars that are present all "
        "the time; choose another with ego=ID",
    )


def _driven_m(obstacle: Obstacle) -> float:
    return float(arc_lengths(obstacle.centre)[-1])

"""Recorded traffic of a CommonRoad file: shapes and states of its obstacles."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from alpasim_plugin.core.geometry import quat_from_yaw
from alpasim_plugin.core.types import F64, I64, Box, Trajectory
from alpasim_plugin.io.limits import STEP
from scenarios.commonroad_map import number, point
from scenarios.reading import SourceFiles
from scenarios.tracks import checked_trajectory

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
HEIGHTS_M = {"car": 1.5, "truck": 3.2, "bus": 3.2, "pedestrian": 1.75, "cyclist": 1.75, "motorcycle": 1.5, "other": 1.5}


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
        return checked_trajectory(files, f"{path}, obstacle {self.obstacle_id}", t_us, xyz, quat_from_yaw(self.yaw))


def read_obstacles(files: SourceFiles, path: Path, root: Element, origin: F64) -> tuple[tuple[Obstacle, ...], tuple[str, ...]]:
    """Read static and dynamic obstacles in file order, with notes on those that are no recorded tracks.

    Raises:
        InputError: A number is missing or broken, an id occurs twice, or a state has no time.
    """
    obstacles: list[Obstacle] = []
    skipped: Counter[str] = Counter()
    for element in (e for e in root if e.tag in ("obstacle", "staticObstacle", "dynamicObstacle")):
        where = f"{path}, obstacle {element.get('id')}"
        static = element.tag == "staticObstacle" or element.findtext("role") == "static"
        states = [s for s in (element.find("initialState"), *element.findall("trajectory/state")) if s is not None]
        if not states or any(s.find("position/point") is None or s.find("orientation/exact") is None for s in states):
            skipped["have states without an exact position and orientation"] += 1
            continue
        if element.find("occupancySet") is not None or (static and len(states) > 1):
            skipped["are predicted as occupied areas, not as states"] += 1
            continue
        shape = element.find("shape")
        if shape is None or len(shape) == 0:
            raise files.fail(where, "no shape", "give a rectangle, circle or polygon")
        size, offset, turn = _bounding_box(files, where, shape)
        label = LABELS.get(str(element.findtext("type")), "other")
        yaw = np.array([number(files, where, s.find("orientation/exact"), "orientation") for s in states])
        centre = np.array([point(files, where, _must(s.find("position/point"))) for s in states]) - origin
        c, s = np.cos(yaw), np.sin(yaw)
        centre[:, :2] += np.stack([c * offset[0] - s * offset[1], s * offset[0] + c * offset[1]], axis=1)
        times = [number(files, where, s.find("time/exact"), "time") for s in states]
        for time in times:
            STEP.check(time, files.doing, where, "time step")
        steps = np.array([round(time) for time in times], dtype=np.int64)
        speeds = [s.find("velocity/exact") for s in states]
        speed = np.array([np.nan if v is None else number(files, where, v, "velocity") for v in speeds])
        box = Box(size[0], size[1], HEIGHTS_M[label])
        obstacles.append(Obstacle(str(element.get("id")), label, static, box, steps, centre, yaw + turn, speed))
    ids = Counter(o.obstacle_id for o in obstacles)
    if ids and max(ids.values()) > 1:
        raise files.fail(path, f"obstacle id {ids.most_common(1)[0][0]} twice", "give each obstacle its own id")
    notes = [f"{n} obstacles {why} and were left out" for why, n in sorted(skipped.items())]
    notes += [
        f"{len(found)} {tag} elements were left out" for tag in ("environmentObstacle", "phantomObstacle") if (found := root.findall(tag))
    ]
    return tuple(obstacles), tuple(notes)


def _must(element: Element | None) -> Element:
    assert element is not None  # checked by the caller
    return element


def _bounding_box(files: SourceFiles, where: str, shape: Element) -> tuple[tuple[float, float], tuple[float, float], float]:
    """Return (length, width), the box centre in the obstacle's frame, and the box's turn against it.

    A single rectangle is kept as it is; circles, polygons and groups of shapes become the box around them.
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
            clouds.append(np.array([point(files, where, p)[:2] for p in part.findall("point")]).reshape(-1, 2))
        elif part.tag == "rectangle":
            (length, width), turn, centre = _rectangle(files, where, part)
            half = np.array([[length, width], [length, -width]]) / 2
            c, s = np.cos(turn), np.sin(turn)
            turned = half @ np.array([[c, s], [-s, c]])
            clouds.append(np.concatenate([turned, -turned]) + np.array(centre))
        else:
            raise files.fail(where, f"shape {part.tag!r}", "give a rectangle, circle or polygon")
    points = np.concatenate(clouds)
    if len(points) < 2:
        raise files.fail(where, "a shape without extent", "give a rectangle, circle or polygon")
    low, high = points.min(axis=0), points.max(axis=0)
    size, middle = high - low, (low + high) / 2
    if not (size > 0).all():
        raise files.fail(where, f"a shape of {size[0]} x {size[1]} m", "give positive sizes")
    return (float(size[0]), float(size[1])), (float(middle[0]), float(middle[1])), 0.0


def _rectangle(files: SourceFiles, where: str, part: Element) -> tuple[tuple[float, float], float, tuple[float, float]]:
    length, width = (number(files, where, part.find(k), k) for k in ("length", "width"))
    if length <= 0 or width <= 0:
        raise files.fail(where, f"a shape of {length} x {width} m", "give positive sizes")
    turn = part.find("orientation")
    return (length, width), 0.0 if turn is None else number(files, where, turn, "orientation"), _centre(files, where, part)


def _centre(files: SourceFiles, where: str, part: Element) -> tuple[float, float]:
    centre = part.find("center")
    return (0.0, 0.0) if centre is None else point(files, where, centre)[:2]

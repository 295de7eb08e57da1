"""``scenes/SCENE.json``: the part of a scenario that a report draws, so that a run folder needs no source files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field
from typing_extensions import TypedDict

from alpasim_plugin.core.geometry import yaw_from_quat
from alpasim_plugin.core.types import F64, Actor, LaneMap, Scenario, Scene, Trajectory, Vehicle
from alpasim_plugin.io.atomic import write_json
from alpasim_plugin.run_folder.schema import SCENES, slug

ACTOR_STEP_US = 250_000

Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
Line = list[Annotated[list[Coordinate], Field(min_length=2, max_length=3)]]


class DrawnLane(TypedDict, total=False):
    """A lane in a scene's file."""

    left: Line | None
    right: Line | None
    paint: Annotated[list[str], Field(min_length=2, max_length=2)]


class DrawnDrive(TypedDict):
    """The recorded drive in a scene's file."""

    x_m: list[Coordinate]
    y_m: list[Coordinate]


class Body(TypedDict, total=False):
    """The ego's body in a scene's file."""

    length_m: Coordinate
    width_m: Coordinate
    rear_axle_to_centre_m: Coordinate


class DrawnActor(TypedDict, total=False):
    """A road user in a scene's file; tracks as recorded or scripted."""

    id: str
    label: str
    static: bool
    reacts: bool
    length_m: Coordinate
    width_m: Coordinate
    t_us: list[int]
    x_m: list[Coordinate]
    y_m: list[Coordinate]
    yaw_rad: list[Coordinate]


class SceneFile(TypedDict, total=False):
    """``scenes/SCENE.json``: what the bird's-eye view draws."""

    scene_id: str
    source: str
    start_us: int
    lanes: list[DrawnLane]
    road_edges: list[Line]
    crosswalks: list[Line]
    ego_log: DrawnDrive
    vehicle: Body
    actors: list[DrawnActor]


@dataclass(frozen=True)
class LoggedScene:
    """A scene that logs are scored against, with the facts that a report shows."""

    scene: Scene
    source: str
    content_hash: str
    notes: tuple[str, ...]
    actors: Sequence[Actor]
    world_origin: tuple[float, float, float]
    start_us: int = 0
    end_us: int = 0
    warmup_us: int = 0

    @property
    def scene_id(self) -> str:
        """Give the scene's id."""
        return self.scene.scene_id

    @property
    def lane_map(self) -> LaneMap:
        """Give the map."""
        return self.scene.lane_map

    @property
    def ego_log(self) -> Trajectory:
        """Give the recorded drive."""
        return self.scene.ego_log

    @property
    def vehicle(self) -> Vehicle:
        """Give the ego's body."""
        return self.scene.vehicle


def write_scene(root: Path, scenario: Scenario | LoggedScene) -> None:
    """Write the file of a scene into a run folder."""
    write_json(root / SCENES / f"{slug(scenario.scene_id)}.json", scene_as_json(scenario))


def scene_as_json(scenario: Scenario | LoggedScene) -> dict[str, Any]:
    """Return lanes, edges, crosswalks and the logged path in world metres, rounded to a centimetre."""
    lanes = [
        {
            "id": lane.lane_id,
            "kind": lane.kind,
            "centre": _xy(lane.centre),
            "left": _xy(lane.left) if lane.left is not None else None,
            "right": _xy(lane.right) if lane.right is not None else None,
            "paint": [lane.left_paint, lane.right_paint],
        }
        for lane in scenario.lane_map.lanes.values()
    ]
    log = scenario.ego_log
    keep = np.unique(np.linspace(0, len(log) - 1, min(len(log), 400)).astype(int))
    return {
        "scene_id": scenario.scene_id,
        "source": scenario.source,
        "content_hash": scenario.content_hash,
        "notes": list(scenario.notes),
        "world_origin": list(scenario.world_origin),
        "start_us": scenario.start_us,
        "end_us": scenario.end_us,
        "warmup_us": scenario.warmup_us,
        "lanes": lanes,
        "road_edges": [_xy(edge) for edge in scenario.lane_map.road_edges],
        "crosswalks": [_xy(ring) for ring in scenario.lane_map.crosswalks],
        "ego_log": {
            "t_us": log.t_us[keep].tolist(),
            "x_m": np.round(log.xyz[keep, 0], 3).tolist(),
            "y_m": np.round(log.xyz[keep, 1], 3).tolist(),
        },
        "vehicle": {
            "length_m": scenario.vehicle.box.length_m,
            "width_m": scenario.vehicle.box.width_m,
            "rear_axle_to_centre_m": scenario.vehicle.rear_axle_to_centre_m,
        },
        "actors": [_actor(scenario, actor) for actor in scenario.actors],
    }


def _actor(scenario: Scenario | LoggedScene, actor: Actor) -> dict[str, Any]:
    """Return what a drawing needs of a road user: its size, and its track every `ACTOR_STEP_US` while the scene runs."""
    track = actor.track
    is_timed = scenario.end_us > scenario.start_us  # a scene that logs are scored against need not say when it runs
    inside = np.flatnonzero((track.t_us >= scenario.start_us) & (track.t_us <= scenario.end_us)) if is_timed else np.arange(len(track))
    if actor.is_static:
        inside = inside[:1] if len(inside) else np.array([0])
    step = max(1, round(ACTOR_STEP_US / max(1.0, float(np.median(np.diff(track.t_us)))))) if len(track) > 1 else 1
    keep = np.unique(np.concatenate([inside[::step], inside[-1:]]))
    yaw = yaw_from_quat(track.quat[keep])
    return {
        "id": actor.actor_id,
        "label": actor.label,
        "static": actor.is_static,
        "reacts": actor.behaviour.kind != "replay",
        "length_m": actor.box.length_m,
        "width_m": actor.box.width_m,
        "t_us": track.t_us[keep].tolist(),
        "x_m": np.round(track.xyz[keep, 0], 2).tolist(),
        "y_m": np.round(track.xyz[keep, 1], 2).tolist(),
        "yaw_rad": np.round(yaw, 3).tolist(),
    }


def _xy(line: F64) -> list[list[float]]:
    rounded: list[list[float]] = np.round(line[:, :2], 2).tolist()
    return rounded

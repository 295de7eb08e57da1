"""Shapes of the JSON files of a run folder, as far as readers rely on them; members that are not
named may be anything.

`alpasim_plugin.core.files.read_json_as` compares a file with one of these before any of it is
used.
"""

from typing import Annotated, Any

from pydantic import Field
from typing_extensions import TypedDict

Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
Line = list[Annotated[list[Coordinate], Field(min_length=2, max_length=3)]]
Facts = dict[str, Any]


class MapLane(TypedDict):
    """A lane of ``scenes/SCENE.json``: types of its left and right marking, and its lines."""

    markings: list[str]


class SceneFile(TypedDict, total=False):
    """``scenes/SCENE.json``: the map, the recorded drive and the road users that reports draw."""

    scene_id: str
    source: str
    start_us: int
    lanes: list[MapLane]
    road_edges: list[Line]
    crosswalks: list[Line]
    ego_log: dict[str, list[Coordinate] | list[int]]
    vehicle: dict[str, Coordinate]
    actors: list[Facts]

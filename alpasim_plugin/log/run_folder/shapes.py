"""Shapes of the JSON files of a run folder, as far as readers rely on them; members that are not
named may be anything.

`alpasim_plugin.core.files.read_json_as` compares a file with one of these before any of it is
used.
"""

from typing import Annotated, Any

from pydantic import Field
from typing_extensions import TypedDict

from alpasim_plugin.core.types import Aggregation, Direction
from alpasim_plugin.log.run_folder.checksums import FileFacts

Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
Line = list[Annotated[list[Coordinate], Field(min_length=2, max_length=3)]]
Facts = dict[str, Any]

REQUIRED_OF_RUN = (  # every run.json has them
    "key",
    "command",
    "config",
    "preset",
    "renderers",
    "policies",
    "seeds",
    "scenes",
)


class MetricFacts(TypedDict):
    """What a metric of the run is, in ``run.json``; `alpasim_plugin.core.types.MetricInfo` has the
    members that may follow.
    """

    unit: str
    direction: Direction
    aggregation: Aggregation
    help: str


class PolicyCheck(TypedDict):
    """What the check of a policy found before the run: names and sentences."""

    digest: str | None
    breaches: list[list[str]]
    notes: list[list[str]]


class RunInfo(TypedDict, total=False):
    """``run.json``."""

    key: str
    kind: str
    project: dict[str, str | bool | None]
    asked: list[str]
    parts: dict[str, Facts]
    metrics: dict[str, MetricFacts]
    fixers: dict[str, Facts]
    code: dict[str, str]
    outcome: dict[str, int]
    rollouts: list[str]
    repeat: Facts
    policy_checks: dict[str, PolicyCheck]
    command: list[str]
    version: str
    started_at: str
    preset: str
    suite: str | None
    config: Facts
    scenes: dict[str, Facts]
    renderers: list[str]
    policies: list[str]
    seeds: list[int]
    hardware: Facts
    versions: dict[str, str | None]
    weights: Facts
    left_out: list[str]
    bases: dict[str, str]


class ManifestFile(TypedDict):
    """``manifest.json`` of a rollout."""

    files: dict[str, FileFacts]
    renderer: str
    policy: str
    scene: str
    path: str
    status: str


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

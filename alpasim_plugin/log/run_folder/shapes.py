"""Shapes of the JSON files of a run folder, as far as readers rely on them; members that are not
named may be anything.

`alpasim_plugin.core.reading.read_json_as` compares a file with one of these before any of it is
used.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field
from typing_extensions import TypedDict

from alpasim_plugin.core.checksums import FileFacts
from alpasim_plugin.core.types import Aggregation, Direction

Number = float | None


class SceneFacts(TypedDict, total=False):
    """One scene of ``run.json``."""

    source: str
    content_hash: str
    notes: list[str]
    ref: dict[str, Any]


class ProjectFacts(TypedDict, total=False):
    """The user's own project, in ``run.json``."""

    commit: str | None
    committed_at: str | None
    branch: str | None
    dirty: bool | None
    reason: str


class OutcomeFacts(TypedDict):
    """How many rollouts a finished run has, in ``run.json``."""

    n_rollouts: int
    n_failed: int


class MetricFacts(TypedDict):
    """What a metric of the run is, in ``run.json``; `alpasim_plugin.core.types.MetricInfo` has the
    members that may follow.
    """

    unit: str
    direction: Direction
    aggregation: Aggregation
    help: str


class RunInfo(TypedDict, total=False):
    """``run.json``."""

    key: str
    kind: str
    project: ProjectFacts
    asked: list[str]
    parts: dict[str, dict[str, Any]]
    metrics: dict[str, MetricFacts]
    fixers: dict[str, dict[str, Any]]
    code: dict[str, str]
    outcome: OutcomeFacts
    command: list[str]
    version: str
    started_at: str
    preset: str
    suite: str | None
    config: dict[str, Any]
    scenes: dict[str, SceneFacts]
    renderers: list[str]
    policies: list[str]
    seeds: list[int]
    hardware: dict[str, Any]
    versions: dict[str, str | None]
    weights: dict[str, Any]
    left_out: list[str]
    bases: dict[str, str]


REQUIRED_OF_RUN = (
    "key",
    "command",
    "config",
    "preset",
    "renderers",
    "policies",
    "seeds",
    "scenes",
)  # every run.json has them


class ManifestFile(TypedDict):
    """``manifest.json`` of a rollout."""

    files: dict[str, FileFacts]
    renderer: str
    policy: str
    scene: str
    path: str
    status: str


class ContentsFile(TypedDict):
    """``contents.json``."""

    files: dict[str, FileFacts]
    rollouts: dict[str, str]
    run: dict[str, Any]


class Mean(TypedDict, total=False):
    """A metric of a renderer over rollouts."""

    mean: Number
    ci95: Number
    ci95_clustered: list[Number] | None
    n_rollouts: int
    n_scenes: int
    unit: str
    direction: str


class Difference(TypedDict, total=False):
    """A paired difference of a renderer from the baseline."""

    baseline: str
    diff: Number
    ci95: list[Number] | None
    p_value: Number
    verdict: str | None
    n_cells: int
    n_scenes: int


class Invalid(TypedDict, total=False):
    """Why values of a metric are not valid."""

    reasons: dict[str, int]


class Censoring(TypedDict, total=False):
    """What is not in a renderer's numbers."""

    rollouts: int
    failed: dict[str, Any]
    dropped: dict[str, Any]
    invalid: dict[str, Invalid]


class Stage(TypedDict, total=False):
    """Milliseconds of one stage of the loop."""

    per_frame_ms: Number
    p50_ms: Number
    p95_ms: Number
    share: Number


class Speed(TypedDict, total=False):
    """Milliseconds per frame of one renderer."""

    ms_per_frame_mean: Number
    ms_per_frame_p50: Number
    ms_per_frame_p95: Number
    frames_per_s: Number
    first_frame_ms: Number
    stages: dict[str, Stage]


class FailedCell(TypedDict):
    """The key of a rollout that failed."""

    renderer: str
    policy: str
    scene: str
    seed: int


class Determinism(TypedDict, total=False):
    """The rollout that was repeated."""

    status: str
    cell: dict[str, Any]
    digests: dict[str, str]
    repeated: dict[str, str]
    first_difference: dict[str, Any] | None


class Failures(TypedDict, total=False):
    """Rollouts that did not run to their end."""

    n_failed: int
    n_rollouts: int
    by_class: dict[str, int]
    cells: list[FailedCell]


class Place(TypedDict):
    """A drive with an outcome."""

    scene: str
    seed: int
    t_s: Number


class Counted(TypedDict):
    """How often an outcome came."""

    n: int
    cells: list[Place]


class Ended(TypedDict):
    """How the drives of an arm ended."""

    n_rollouts: int
    n_ended: int
    n_failed: int
    n_reached_end: int
    outcomes: dict[str, Counted]


class Summary(TypedDict, total=False):
    """``summary.json``."""

    preset: str
    outcomes: dict[str, Ended]
    metrics: dict[str, dict[str, Mean]]
    paired: dict[str, dict[str, Difference]]
    paired_with_base: dict[str, dict[str, Difference]]
    paired_arms: dict[str, dict[str, Difference]]
    censoring: dict[str, Censoring]
    failures: Failures
    speed: dict[str, Speed]
    determinism: Determinism | None
    pool: dict[str, Any]
    fixers: dict[str, dict[str, Any]]
    plans: dict[str, dict[str, Any]]


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


def pair_tables(summary: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any]]]:
    """List the tables of paired differences with the variant of each: renderers, fixers against
    their base, then policies.
    """
    keys = ("paired", "paired_with_base", "paired_arms")
    return [
        (variant, pairs)
        for key in keys
        for variant, pairs in (summary.get(key) or {}).items()
        if pairs
    ]

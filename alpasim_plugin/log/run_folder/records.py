"""What the JSON files of a run folder say, as records: ``run.json`` and ``manifest.json``.

`json_of` writes a record, `alpasim_plugin.core.files.read_record` reads it. Types are strict; members
that a record does not name are not looked at. A member whose default is None is left out of the file
where it is None: it does not apply.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator

from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.core.metric_types import MetricInfo
from alpasim_plugin.core.typed_json import from_plain, to_plain
from alpasim_plugin.core.types import Direction
from alpasim_plugin.log.run_folder.checksums import FileFacts

INFINITE = ("inf", "-inf")  # the text of a metric's value for which JSON has no number


def _number_of(value: object) -> object:
    """Return the infinite number that a text stands for; all else as it is."""
    return float(str(value)) if value in INFINITE else value


Number = Annotated[float, BeforeValidator(_number_of)]  # may be infinite
# Values of any kind, of which the file holds what `alpasim_plugin.core.typed_json` says.
Values = Annotated[JsonObject, BeforeValidator(from_plain)]
Status = Literal["ok", "failed"]


@dataclass(frozen=True)
class Project:
    """The repository from which a run was started.

    Attributes:
        commit: Full hash of the commit; None where there is none.
        dirty: Whether a file that git follows differs from the commit.
        reason: Why there is no commit, else empty.
    """

    commit: str | None
    dirty: bool | None
    reason: str


@dataclass(frozen=True)
class SceneRef:
    """How a scenario was named when it was driven.

    Attributes:
        path: Its file.
        seed: Given beside the file's; None: the file's.
        overrides: KEY=VALUE that were set in it.
        source: Plug-in that read the file; None: one of simrun's own.
    """

    path: str
    seed: int | None
    overrides: tuple[str, ...]
    source: str | None


@dataclass(frozen=True)
class SceneFacts:
    """A scene of a run.

    Attributes:
        source: Kind of its file.
        ref: How it was named; scored logs have none.
        content_hash: Digest of the resolved scenario and of every file that was read for it.
        files: Path of each of those files -> digest.
        seed: Of the scenario.
        varied: Parameter -> value in the file and value that was driven.
        duration_s: Seconds.
        rates, latency, degradation, environment, vehicle: The scenario's settings of these names.
        reconstruction: Key of its 3DGS model.
        notes: What the scenario leaves out.
    """

    source: str = ""
    ref: SceneRef | None = None
    content_hash: str = ""
    files: dict[str, str] = field(default_factory=dict)
    seed: int | None = None
    varied: Values = field(default_factory=dict)
    duration_s: float | None = None
    rates: Values | None = None
    latency: Values | None = None
    degradation: Values | None = None
    environment: Values | None = None
    vehicle: Values | None = None
    reconstruction: str | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class PartFacts:
    """A part of a run: a renderer, fixer, policy, controller, evaluator or source.

    Attributes:
        name: As the command named it.
        target: ``module:Class``.
        label: Name and what it is in a few words.
        digest: Of its code, settings and files; None for a remote service.
        trained: Its weights were trained; None where it has none.
        files: Path of each file that it declares -> digest.
        code: Path of each file of its code -> digest.
        unseen: What the digest cannot cover, in words; else empty.
        settings: As they were resolved; None where it has none.
    """

    name: str
    target: str
    label: str
    digest: str | None
    trained: bool | None
    files: dict[str, str]
    code: dict[str, str]
    unseen: str
    settings: Values | None


@dataclass(frozen=True)
class PolicyCheck:
    """What the check of a policy found before the run.

    Attributes:
        digest: Of the policy that was checked.
        breaches: Name and sentence of each rule that it breaks.
        notes: Name and sentence of what is allowed and worth knowing.
        inputs: Path of each file that it read in the check, beside those of its digest -> digest.
    """

    digest: str | None
    breaches: tuple[tuple[str, str], ...] = ()
    notes: tuple[tuple[str, str], ...] = ()
    inputs: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class RunCounts:
    """How many rollouts a run has.

    Attributes:
        n_rollouts: All of them.
        n_failed: Those that could not be run or scored.
    """

    n_rollouts: int
    n_failed: int


@dataclass(frozen=True)
class Pool:
    """Throughput of all workers of a run together, start-up included.

    Attributes:
        workers: Processes.
        threads_per_worker: Threads of each.
        wall_s: Seconds from the first rollout to the last.
        frames: Camera frames that were rendered.
        frames_per_s_total: Of all workers; None without frames.
        executor: Where rollouts ran; None: on this machine.
    """

    workers: int
    threads_per_worker: int
    wall_s: float
    frames: int
    frames_per_s_total: float | None
    executor: str | None = None


@dataclass(frozen=True)
class CellNames:
    """The key of a rollout.

    Attributes:
        renderer, policy, scene, seed: As in the tables.
    """

    renderer: str
    policy: str
    scene: str
    seed: int

    @property
    def cell(self) -> tuple[str, str, str, int]:
        """Give the key renderer, policy, scene, seed."""
        return (self.renderer, self.policy, self.scene, self.seed)


@dataclass(frozen=True)
class CellStatus(CellNames):
    """How a rollout went, by its key.

    Attributes:
        renderer, policy, scene, seed: Its key.
        status: It ran to its end and was scored, or not.
    """

    status: Status

    @property
    def ok(self) -> bool:
        """Tell whether the rollout ran to its end and was scored."""
        return self.status == "ok"


@dataclass(frozen=True)
class LogDifference:
    """Where two logs first differ.

    Attributes:
        component: What differs.
        t_us: When, microseconds.
        step: Control step; None where it belongs to none.
        what: The difference in words.
    """

    component: str
    t_us: int | None = None
    step: int | None = None
    what: str = ""


@dataclass(frozen=True)
class Repeat:
    """What driving a rollout a second time showed.

    Attributes:
        repeatable: The two logs are equal; None where nothing could be compared.
        reason: Why nothing could be compared.
        cell: The rollout that was driven twice.
        digests: Of its two logs.
        first_difference: None where they are equal.
    """

    repeatable: bool | None
    reason: str | None = None
    cell: CellNames | None = None
    digests: tuple[str, ...] = ()
    first_difference: LogDifference | None = None


@dataclass(frozen=True)
class Fork:
    """How a rollout continues another one.

    Attributes:
        after_us: When the parts were replaced, microseconds after the first frame.
        renderer, policy, seed: What took the place of the original's; None: nothing did.
        of: Name of the original rollout.
        replay: ``equal``: up to then the logs are equal, bit for bit.
    """

    after_us: int
    renderer: str | None
    policy: str | None
    seed: int | None
    of: str
    replay: Literal["equal"]


@dataclass(frozen=True)
class MetricValue:
    """One metric of one rollout.

    Attributes:
        value: None where it is not valid; the text "inf" or "-inf" in the file where it is infinite,
            for which JSON has no number.
        valid: There is a value.
        reason: Why there is none, else empty.
        unit: Of the metric.
        direction: The metric's better side.
    """

    value: Number | None
    valid: bool
    reason: str
    unit: str
    direction: Direction


@dataclass(frozen=True)
class DriveEvent:
    """The first time of an outcome among the scored steps of a rollout.

    Attributes:
        metric: The outcome's flag.
        t_us: When, microseconds, as in the log.
        t_s: The same in seconds after the first frame.
        x_m, y_m: Centre of the ego's box then, metres, world.
    """

    metric: str
    t_us: int
    t_s: float
    x_m: float
    y_m: float


@dataclass(frozen=True)
class Contact:
    """A road user that begins to touch the ego.

    Attributes:
        actor_id: Who.
        t_s: When, seconds after the log's first ego pose.
        side: ``front``, ``rear`` or ``lateral``.
        x_m, y_m: Where on the footprint, metres, rig: forward of the rear axle, and to the left.
    """

    actor_id: str
    t_s: float
    side: str
    x_m: float
    y_m: float


@dataclass(frozen=True)
class Ledger:
    """What the rules removed from one rollout, in steps of the ego's time line.

    Attributes:
        steps_total: Steps driven.
        steps_warmup: Before the policy took over.
        steps_after_event: After the first event that ends the scored part.
        steps_after_drift: After the first step beyond the preset's distance from the recorded path.
        steps_scored: Those that enter the metrics.
        dropped: Why the whole rollout does not count, else empty.
    """

    steps_total: int
    steps_warmup: int
    steps_after_event: int
    steps_after_drift: int
    steps_scored: int
    dropped: str


@dataclass(frozen=True)
class RolloutError:
    """Why a rollout could not be run or scored.

    Attributes:
        message: What is wrong with which value.
        hint: What to do.
        failure_class: Whose fault it is (docs/cli.md).
    """

    message: str
    hint: str
    failure_class: str


@dataclass(frozen=True)
class SceneScore:
    """What AlpaSim's score of a scene says of a rollout.

    Attributes:
        failure_reason: Why its score is 0; None where it is not.
    """

    failure_reason: str | None


@dataclass(frozen=True)
class Manifest(CellStatus):
    """``manifest.json`` of a rollout, which is written last: a rollout without one is unfinished.

    Attributes:
        renderer, policy, scene, seed: Its key.
        status: It ran to its end and was scored, or not.
        path: Its folder below the run folder.
        wall_s: Seconds that it took; None where it was never driven to its end.
        files: Name of each file in the folder -> its digest; empty of a failed rollout.
        rollout_key: Digest of ``made_of``.
        made_of: Digest by name of everything that decides the log.
        score_key: Digest of ``rollout_key`` and of everything that decides the scores.
        preset: Evaluator preset.
        stops_at_path_end: It was to stop at the end of the path.
        most_steps: Control steps that it had time for.
        video: Which rollouts of the run get a film.
        inputs: Path of each file that was read while it was driven, beside what ``made_of`` holds ->
            digest.
        score_inputs: The same, while it was scored.
        rewritten: Files among those, and among those that parts declare, that were changed during the
            rollout or its scoring: each command makes it again.
        frames: Camera frames.
        first_call_frames: Those of the first call, which may compile or fill caches.
        steps: Control steps.
        frame_events: Kind -> frames in which a guard saw something.
        passed_path_end: It went beyond the end of the path.
        ended: By what it ended: ``time``, or the kind of the path's end.
        stage_ms: Stage of the loop -> milliseconds of each pass.
        session_uuid: Id of the log.
        fixer: The fixer's label, mode and counters of frames; empty without one.
        has_camera: The policy has a camera.
        renderer_facts, policy_facts: Facts that these parts report, by name.
        metrics: METRIC -> value.
        events: Outcomes, by time.
        contacts: Beginnings of contacts, by time, where the preset searches between steps.
        censored: What the rules removed.
        error: Why it failed.
        traceback: Of what failed.
        final: The same code would fail again.
        copied_from: Folder of the rollout that this one is a copy of.
        reused: An earlier command drove it.
        rollout: Of a scored log: its name.
        log: Its path.
        warnings: What is odd about it.
        scene_score: AlpaSim's.
        fork: How it continues another rollout.
        node: Where Ray drove it.
    """

    path: str
    wall_s: float | None
    files: dict[str, FileFacts] = field(default_factory=dict)
    rollout_key: str | None = None
    made_of: dict[str, str | None] | None = None
    score_key: str | None = None
    preset: str | None = None
    stops_at_path_end: bool | None = None
    most_steps: int | None = None
    video: str | None = None
    inputs: dict[str, str] = field(default_factory=dict)
    score_inputs: dict[str, str] = field(default_factory=dict)
    rewritten: tuple[str, ...] = ()
    frames: int | None = None
    first_call_frames: int | None = None
    steps: int | None = None
    frame_events: dict[str, int] = field(default_factory=dict)
    passed_path_end: bool = False
    ended: str | None = None
    stage_ms: dict[str, list[float]] = field(default_factory=dict)
    session_uuid: str | None = None
    fixer: Values = field(default_factory=dict)
    has_camera: bool | None = None
    renderer_facts: Values | None = None
    policy_facts: Values | None = None
    metrics: dict[str, MetricValue] = field(default_factory=dict)
    events: tuple[DriveEvent, ...] = ()
    contacts: tuple[Contact, ...] = ()
    censored: Ledger | None = None
    error: RolloutError | None = None
    traceback: str | None = None
    final: bool | None = None
    copied_from: str | None = None
    reused: bool | None = None
    rollout: str | None = None
    log: str | None = None
    warnings: tuple[str, ...] | None = None
    scene_score: SceneScore | None = None
    fork: Fork | None = None
    node: str | None = None

    @property
    def failure_class(self) -> str:
        """Give whose fault a failed rollout is."""
        return "unknown" if self.error is None else self.error.failure_class


@dataclass(frozen=True)
class RunConfig:
    """The options of a run as they were resolved.

    Attributes:
        preset: Evaluator preset.
        images: Camera frames in the logs.
        video: Which rollouts get a film.
        device: Where renderers compute.
        baseline: RENDERER, POLICY or RENDERER/POLICY that the others are compared with.
        fixer: KEY=VALUE of the fixers' settings.
        controller: Of the plans; None: the policy's.
        evaluators: Further evaluators.
        workers: Processes.
        threads_per_worker: Threads of each.
    """

    preset: str
    images: Literal["none", "jpeg", "png"]
    video: Literal["none", "failures", "all"]
    device: str
    baseline: str | None
    fixer: tuple[str, ...]
    controller: str | None
    evaluators: tuple[str, ...]
    workers: int
    threads_per_worker: int


@dataclass(frozen=True)
class ScoreConfig:
    """By what logs were scored.

    Attributes:
        preset: Settings of the evaluator preset.
        settings: AlpaSim's, with its preset.
    """

    preset: Values
    settings: Values | None


@dataclass(frozen=True)
class RunInfo:
    """``run.json``: the command, and everything that decides the results.

    Attributes:
        key: Short digest of the command; a folder belongs to one.
        command: The command line, by words.
        config: Its options; of scored logs, the settings of preset and evaluation.
        preset: Evaluator preset.
        renderers, policies, seeds: In the order of the command.
        scenes: SCENE -> facts.
        schema_version: Version of these members.
        content: Digest of all that decides the rollouts.
        kind: ``score``, ``fork``, ``decide`` or ``vary``; None: a plain run.
        version: Of simrun.
        started_at: Date and time in UTC, ISO 8601.
        project: The repository from which the command was given.
        asked: The scenarios as the command named them.
        shard: Which part of their scenes was driven, ``I/N``; None: all of them.
        bases: RENDERER with a fixer -> the renderer below it.
        fixers: RENDERER -> its fixer.
        parts: ``KIND NAME`` -> facts of each part.
        code: Digests of simrun's code.
        metrics: METRIC -> what it is.
        unseen: ``KIND NAME`` -> what the digest of a part cannot cover.
        rewritten: Path of each file that was changed while a rollout that read it was made -> what
            follows for its rollouts, in words.
        weights: File of weights -> digest.
        hardware: Processor, cores, memory and operating system.
        versions: Library -> version.
        left_out: What the scenes leave out, in words.
        pool: Throughput of the workers.
        policy_checks: POLICY -> what its check found.
        repeat: What ``--repeat`` found.
        outcome: How many rollouts failed; None until the run is finished.
        rollouts: Folders of the rollouts, where they do not follow from scenes, renderers, policies
            and seeds.
        boundary: What ``--vary`` found (`evaluators.statistics.boundary`).
        fork: What was replaced, and when; of a fork.
        logs: Paths of the scored logs.
        alpasim: AlpaSim's aggregation of scored logs.
        exit_code: Of ``simrun score``.
    """

    key: str
    command: tuple[str, ...]
    config: RunConfig | ScoreConfig
    preset: str
    renderers: tuple[str, ...]
    policies: tuple[str, ...]
    seeds: tuple[int, ...]
    scenes: dict[str, SceneFacts]
    schema_version: int = 1
    content: str | None = None
    kind: str | None = None
    version: str | None = None
    started_at: str | None = None
    project: Project | None = None
    asked: tuple[str, ...] | None = None
    shard: str | None = None
    bases: dict[str, str] = field(default_factory=dict)
    fixers: dict[str, PartFacts] = field(default_factory=dict)
    parts: dict[str, PartFacts] = field(default_factory=dict)
    code: dict[str, str] = field(default_factory=dict)
    metrics: dict[str, MetricInfo] = field(default_factory=dict)
    unseen: dict[str, str] = field(default_factory=dict)
    rewritten: dict[str, str] = field(default_factory=dict)
    weights: dict[str, str] = field(default_factory=dict)
    hardware: Values = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()
    pool: Pool | None = None
    policy_checks: dict[str, PolicyCheck] = field(default_factory=dict)
    repeat: Repeat | None = None
    outcome: RunCounts | None = None
    rollouts: tuple[str, ...] | None = None
    boundary: Values | None = None
    fork: Fork | None = None
    logs: tuple[str, ...] | None = None
    alpasim: Values | None = None
    exit_code: int | None = None

    @property
    def is_of_logs(self) -> bool:
        """Tell whether logs were scored, and nothing was driven."""
        return self.kind == "score"

    @property
    def baseline(self) -> str | None:
        """Give the baseline that the command named; None where it named none."""
        return self.config.baseline if isinstance(self.config, RunConfig) else None


def json_of(record: object) -> JsonObject:
    """Return a record as JSON's plain data.

    Example:
        >>> json_of(RunCounts(3, 1))
        {'n_rollouts': 3, 'n_failed': 1}
    """
    content: JsonObject = {}
    for member in fields(record):  # type: ignore[arg-type]
        value = getattr(record, member.name)
        if value is None and member.default is None:
            continue
        if isinstance(record, MetricValue) and isinstance(value, float) and math.isinf(value):
            content[member.name] = str(value)
            continue
        content[member.name] = _plain(value)
    return content


def _plain(value: Any) -> Any:
    """Return a value of a record as JSON holds it."""
    if isinstance(value, MetricInfo):
        return metric_as_json(value)
    if is_dataclass(value):
        return json_of(value)
    if isinstance(value, Mapping) and _holds_records(value.values()):
        return {key: _plain(member) for key, member in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(member) for member in value]
    return to_plain(value)


def _holds_records(members: Iterable[Any]) -> bool:
    """Tell whether a mapping has records as members."""
    return any(is_dataclass(member) for member in members)


ALWAYS_STATED = ("unit", "direction", "aggregation", "help")  # members of every metric
PLAIN_METRIC = MetricInfo("", "lower", "mean", "")


def metric_as_json(metric: MetricInfo) -> JsonObject:
    """Return what a metric is, without the members that are as they usually are, and without its
    name, which is the key.
    """
    usual = asdict(PLAIN_METRIC)
    content: JsonObject = {}
    for key, value in asdict(metric).items():
        is_special = key != "name" and value != usual[key]
        if key in ALWAYS_STATED or is_special:
            content[key] = value
    return content

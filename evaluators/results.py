"""Results of a run as records: means, paired differences, verdicts, and the summary that holds them.

`evaluators.statistics` alone makes them. Pages, commands and gates read and print them, and
``summary.json`` is a `Summary` as JSON (docs/statistics.md): `to_json` writes a record,
`read_summary` reads it. A member that does not apply, or does not exist, is None and null.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import parse_json, read_bytes, read_record
from alpasim_plugin.core.files.limits import JSON_BYTES
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.core.types import Direction
from alpasim_plugin.log.run_folder.records import Pool, Repeat, RolloutError

SCHEMA = 3  # of summary.json

Bounds = tuple[float, float]  # [low, high]
Verdict = Literal["non-inferior", "worse", "undecided"]
Contrast = Literal["better", "worse"]
Cause = Literal[
    "pass",
    "regression",
    "incomplete",
    "policy",
    "renderer",
    "fixer",
    "undecided",
    "infrastructure",
    "evaluator",
]

EXIT_CODES: dict[Cause, int] = {
    "pass": 0,
    "regression": 1,
    "incomplete": 2,
    "policy": 2,
    "renderer": 2,
    "fixer": 2,
    "undecided": 3,
    "infrastructure": 4,
    "evaluator": 5,
}
WORDS: dict[Cause, str] = {
    "pass": "PASS",
    "regression": "FAIL",
    "incomplete": "INCOMPLETE",
    "policy": "POLICY FAILURE",
    "renderer": "RENDERER FAILURE",
    "fixer": "FIXER FAILURE",
    "undecided": "UNDECIDED",
    "infrastructure": "INFRASTRUCTURE FAILURE",
    "evaluator": "EVALUATOR FAILURE",
}


@dataclass(frozen=True)
class Outcome:
    """The outcome of a command about a run: a cause, with one sentence for each thing that led to
    it.
    """

    cause: Cause
    reasons: tuple[str, ...] = ()

    @property
    def exit_code(self) -> int:
        """Give the process exit code (docs/cli.md)."""
        return EXIT_CODES[self.cause]

    @property
    def title(self) -> str:
        """Give the verdict as a heading."""
        return WORDS[self.cause]

    def as_dict(self) -> dict[str, Any]:
        """Return the outcome for JSON."""
        return {"cause": self.cause, "exit_code": self.exit_code, "reasons": list(self.reasons)}


@dataclass(frozen=True)
class Mean:
    """The mean of one metric over the rollouts of a variant.

    Attributes:
        unit: Of the metric.
        direction: The metric's better side.
        n_rollouts: Cells with a value; repeats of a cell count once.
        n_scenes: Their scenes.
        n_invalid: Cells that ran to their end without a valid value.
        mean: Over cells; rates are fractions. None without a value.
        ci95: Half-width 1.96 s / sqrt(N) of the paper, as if rollouts were independent.
        ci95_clustered: 95 % interval with scenes as clusters; None where nothing says how far a
            scene that was not driven can lie.
        ci95_clustered_method: How that was made.
        n_events: Cells with the event; flags only.
        reason: Why there is no mean.
        ci95_reason, ci95_clustered_reason: Why there is no interval.
        note: What qualifies the clustered interval.
    """

    unit: str
    direction: Direction
    n_rollouts: int
    n_scenes: int
    n_invalid: int = 0
    mean: float | None = None
    ci95: float | None = None
    ci95_clustered: Bounds | None = None
    ci95_clustered_method: str | None = None
    n_events: int | None = None
    reason: str | None = None
    ci95_reason: str | None = None
    ci95_clustered_reason: str | None = None
    note: str | None = None


@dataclass(frozen=True)
class SceneCounts:
    """Which way scenes went.

    Attributes:
        up: Scenes whose mean difference is positive.
        down: Scenes whose mean difference is negative.
        same: Scenes without a difference.
        p_value: Exact two-sided p of their sign test.
    """

    up: int
    down: int
    same: int
    p_value: float


@dataclass(frozen=True)
class CellCounts:
    """Cells with an event on one side alone.

    Attributes:
        only_here: Cells with the event only behind the variant.
        only_baseline: Cells with the event only behind the baseline.
        p_value: Exact McNemar p, as if cells were independent.
    """

    only_here: int
    only_baseline: int
    p_value: float


@dataclass(frozen=True)
class Beyond:
    """Scenes of which a claim counts only its cap: an event of its own, about which the claim says
    nothing.

    Attributes:
        event: In words, with the cap.
        n: Scenes with it.
        n_scenes: Of so many.
        at_most: Largest share of other scenes that may have it (exact, one-sided 95 %).
    """

    event: str
    n: int
    n_scenes: int
    at_most: float


@dataclass(frozen=True)
class MissingPair:
    """A planned cell without a pair.

    Attributes:
        policy, scene, seed: The cell.
        missing: The side without a value.
        why: Its cause, in words.
    """

    policy: str
    scene: str
    seed: int
    missing: Literal["here", "baseline", "both"]
    why: str


@dataclass(frozen=True)
class Difference:
    """One metric of a variant minus that of its baseline, on the cells that both have.

    Attributes:
        baseline: Name of the variant that is subtracted.
        unit: Of the metric.
        direction: The metric's better side.
        margin: How much worse is accepted, in the metric's unit.
        n_cells: Cells with a value on both sides.
        n_scenes: Their scenes.
        n_missing: Planned cells without a pair.
        missing: The first of these.
        diff: Mean over scenes of each scene's mean difference.
        claim: What verdict and bounds are about: "mean" of what has bounds, else "mean cut at 4 m",
            each scene's difference counted up to the metric's cap. None: nothing says how much a
            scene that was not driven can differ, so that nothing is claimed of others.
        cut_mean: The mean that the claim is about; None without a claim.
        spread: Standard deviation between scenes of what the claim is about.
        ci95: 95 % interval, scenes as unit; None without a claim.
        method: How that was made.
        guarded: Bounds of the claim: they allow for what these scenes did not show.
        p_value: Of the test of no difference, by itself.
        p_corrected: The same after Holm's correction for all differences that were tested together
            (`evaluators.statistics.verdicts.corrected`); verdict and difference go by it.
        test: Name of the test.
        difference: What is shown on these scenes, whatever the margin; None: nothing.
        verdict: About other scenes, against the margin.
        more_scenes: The fewest more that would decide an undecided verdict, with 80 % probability if
            what these scenes show is true: as "worse" where the mean is beyond the margin, else as
            "non-inferior".
        more_scenes_to_differ: The same of ``difference``, where there is none yet.
        scenes: How many went which way.
        cells: The same of the cells of a flag.
        beyond: What lies beyond the cap of a claim.
        reason: Why numbers are None.
        note: What qualifies them.
    """

    baseline: str
    unit: str
    direction: Direction
    margin: float
    n_cells: int
    n_scenes: int
    n_missing: int = 0
    missing: tuple[MissingPair, ...] = ()
    diff: float | None = None
    claim: str | None = None
    cut_mean: float | None = None
    spread: float | None = None
    ci95: Bounds | None = None
    method: str | None = None
    guarded: Bounds | None = None
    p_value: float | None = None
    p_corrected: float | None = None
    test: str | None = None
    difference: Contrast | None = None
    verdict: Verdict = "undecided"
    more_scenes: int | None = None
    more_scenes_to_differ: int | None = None
    scenes: SceneCounts | None = None
    cells: CellCounts | None = None
    beyond: Beyond | None = None
    reason: str | None = None
    note: str | None = None


MeanTable = dict[str, dict[str, Mean]]  # VARIANT -> METRIC -> mean
DifferenceTable = dict[str, dict[str, Difference]]  # VARIANT -> METRIC -> difference


@dataclass(frozen=True)
class EventPlace:
    """The rollout in which something happened.

    Attributes:
        scene, seed: Of the rollout.
        t_s: When, seconds after the first frame; None where it is not known.
    """

    scene: str
    seed: int
    t_s: float | None = None


@dataclass(frozen=True)
class EventCount:
    """The rollouts that had an outcome.

    Attributes:
        n: How many.
        cells: The first of them.
    """

    n: int
    cells: tuple[EventPlace, ...]


@dataclass(frozen=True)
class Endings:
    """How the rollouts of a variant ended.

    Attributes:
        n_rollouts: All that were planned.
        n_ended: Of these, ran to their end or were broken by the policy.
        n_failed: Of these, with an outcome.
        n_reached_end: Without an outcome, at the end of the path.
        endings: The one way in which each rollout ended -> how many did, the best first.
        outcomes: NAME -> the rollouts with it; a rollout may have several.
        lateral_distance_m_median: Over rollouts.
    """

    n_rollouts: int
    n_ended: int
    n_failed: int
    n_reached_end: int
    endings: dict[str, int]
    outcomes: dict[str, EventCount]
    lateral_distance_m_median: float | None = None


@dataclass(frozen=True)
class Change:
    """How the rollouts of a variant ended in a run, and in the run before that drove the same scenes
    and seeds with it.

    Attributes:
        run: Place of the run before among those that were compared.
        earlier_failed, later_failed: Rollouts with an outcome, such as a collision, or that could
            not be run.
        more_failed: How many more failed in the later run; negative where fewer did.
    """

    run: int
    earlier_failed: int
    later_failed: int
    more_failed: int


@dataclass(frozen=True)
class InvalidValues:
    """Rollouts without a valid value of a metric.

    Attributes:
        rollouts: How many.
        reasons: Reason -> rollouts that have it.
    """

    rollouts: int
    reasons: dict[str, int]


@dataclass(frozen=True)
class Censoring:
    """What did not enter the means of a variant, and what rates could be without it.

    Attributes:
        rollouts: Planned.
        failed: Failure class -> rollouts.
        dropped: Reason -> rollouts that a rule removed.
        steps_total: Steps driven; the next four are parts of it.
        steps_warmup: Before the policy drives.
        steps_after_event: After the first event that ends the scored part.
        steps_after_drift: After the ego left the logged path too far.
        steps_scored: Those that enter the metrics.
        frames: Rendered in rollouts that ran to their end.
        frame_events: Kind -> frames in which a guard saw something.
        frames_passed_raw: Of these, the fixer's frame was replaced by the raw one.
        invalid: METRIC -> rollouts without a valid value.
        bounds: RATE -> least and greatest that it could be, over missing rollouts and steps that
            were cut.
        bounds_rollouts: The same over missing rollouts alone.
        bounds_rollouts_ci95: The same with sampling error; an end is None with one scene.
        cut: RATE -> rollouts that were cut before the event was seen.
    """

    rollouts: int
    failed: dict[str, int]
    dropped: dict[str, int]
    steps_total: int
    steps_warmup: int
    steps_after_event: int
    steps_after_drift: int
    steps_scored: int
    frames: int
    frame_events: dict[str, int]
    frames_passed_raw: int
    invalid: dict[str, InvalidValues]
    bounds: dict[str, Bounds]
    bounds_rollouts: dict[str, Bounds]
    bounds_rollouts_ci95: dict[str, tuple[float | None, float | None]]
    cut: dict[str, int]


@dataclass(frozen=True)
class FailedRollout:
    """A rollout that could not be run or scored.

    Attributes:
        renderer, policy, scene, seed: Its key.
        path: Its folder below the run folder.
        error: Why.
    """

    renderer: str
    policy: str
    scene: str
    seed: int
    path: str
    error: RolloutError


@dataclass(frozen=True)
class Failures:
    """The rollouts that could not be run or scored.

    Attributes:
        n_failed: How many.
        n_rollouts: Of how many.
        by_class: Failure class -> rollouts.
        cells: Each of them; empty where several runs are joined.
    """

    n_failed: int
    n_rollouts: int
    by_class: dict[str, int]
    cells: tuple[FailedRollout, ...] = ()


@dataclass(frozen=True)
class StageSpeed:
    """Milliseconds of one pass of a stage, over the passes that took place.

    Attributes:
        p50_ms, p95_ms: Median and 95th percentile.
        share: Of the time of all stages.
        per_frame_ms: Mean over all frames.
    """

    p50_ms: float
    p95_ms: float
    share: float
    per_frame_ms: float


@dataclass(frozen=True)
class Speed:
    """Time per camera frame behind a renderer, all stages of the loop together; None where no
    rollout has a frame after its first call.

    Attributes:
        ms_per_frame_p50, ms_per_frame_p95, ms_per_frame_mean: Milliseconds per frame: median, 95th
            percentile and mean.
        frames_per_s: Frames a second, of one rollout.
        first_frame_ms: Of the frames of a rollout's first call, median over rollouts.
        stages: NAME -> its own time.
    """

    ms_per_frame_p50: float | None
    ms_per_frame_p95: float | None
    ms_per_frame_mean: float | None
    frames_per_s: float | None
    first_frame_ms: float | None
    stages: dict[str, StageSpeed]


@dataclass(frozen=True)
class Slowing:
    """How the time that a policy takes for a plan grows within a rollout, median over rollouts.

    Attributes:
        early_ms, late_ms: Milliseconds of a query, in the first and in the last quarter of a
            rollout; its first query is left out.
        n_rollouts: In which it grows.
    """

    early_ms: float
    late_ms: float
    n_rollouts: int


@dataclass(frozen=True)
class DriveCalls:
    """How long an AlpaSim driver took for its drive calls, against the challenge's budget.

    Attributes:
        calls: Drive calls of all finished rollouts.
        seconds: That all of them took, on this machine.
        budget_s: That the challenge gives so many calls.
        late: Calls that took longer.
        longest_s: The longest call, seconds.
    """

    calls: int
    seconds: float
    budget_s: float
    late: int
    longest_s: float


@dataclass(frozen=True)
class FixerFacts:
    """What a fixer did over the rollouts of its renderer.

    Attributes:
        label: What it is, and whose weights it has.
        trained: Its weights were trained.
        mode: ``frame``, ``speculative`` or ``chunk``.
        rollouts: That it took part in.
        frames: Camera frames that went through it.
        blocks: Complete blocks; None in mode ``frame``.
        predicted: Frames with a draft. It and what follows: in mode ``speculative`` alone.
        hits: Of these, within tolerance.
        drafts: Blocks that were drafted.
        redrafts: Of these, in the middle of a block.
        hit_rate: Share of predicted frames within tolerance.
        forecast_error: Kind -> largest error of predicted frames.
        shown_error: Kind -> largest error of the pose of a frame that the policy received.
        redrafts_per_block: How often a block was drafted again before it was complete.
    """

    label: str
    trained: bool
    mode: str
    rollouts: int
    frames: int
    blocks: int | None = None
    predicted: int | None = None
    hits: int | None = None
    drafts: int | None = None
    redrafts: int | None = None
    hit_rate: float | None = None
    forecast_error: dict[str, float | None] | None = None
    shown_error: dict[str, float | None] | None = None
    redrafts_per_block: float | None = None


@dataclass(frozen=True)
class Summary:
    """``summary.json``: everything that pages, commands and gates say of a run's numbers.

    VARIANT is RENDERER where the run has one policy, RENDERER/POLICY where it has several.

    Attributes:
        preset: Evaluator preset with which the run was scored.
        metrics: VARIANT -> METRIC -> mean.
        paired: VARIANT -> METRIC -> difference to the baseline's renderer.
        paired_with_base: The same of renderers with a fixer to the renderer below it.
        paired_policies: RENDERER/POLICY -> METRIC -> difference to another policy.
        failures: Rollouts that could not be run or scored.
        outcomes: RENDERER/POLICY -> how its rollouts ended.
        censoring: VARIANT -> what did not enter its means.
        copies: Rollouts that were not driven, as their policy has no camera.
        fixers: VARIANT -> what its fixer did.
        speed: VARIANT -> time per frame.
        slowing: POLICY -> how much longer its plans take at the end of a rollout; only of policies
            whose plans do.
        drive_calls: POLICY -> its drive calls against the challenge's budget; only of AlpaSim's
            drivers.
        unlit_frames: RENDERER -> frames without depth in which traffic lights in view could not be
            drawn.
        pool: Throughput of the workers; None where nothing was driven.
        repeat: What ``--repeat`` found.
        exit_code: Of ``simrun score``.
        alpasim: Files of AlpaSim's aggregation, or why there are none.
        boundary: What a search for a boundary found (`evaluators.statistics.boundary`).
        runs: Folders that were joined; empty for a run's own summary.
        schema: Version of the keys.
    """

    preset: str
    metrics: MeanTable
    paired: DifferenceTable
    paired_with_base: DifferenceTable
    paired_policies: DifferenceTable
    failures: Failures
    outcomes: dict[str, Endings] = field(default_factory=dict)
    censoring: dict[str, Censoring] = field(default_factory=dict)
    copies: int = 0
    fixers: dict[str, FixerFacts] = field(default_factory=dict)
    speed: dict[str, Speed] = field(default_factory=dict)
    slowing: dict[str, Slowing] = field(default_factory=dict)
    drive_calls: dict[str, DriveCalls] = field(default_factory=dict)
    unlit_frames: dict[str, int] = field(default_factory=dict)
    pool: Pool | None = None
    repeat: Repeat | None = None
    exit_code: int | None = None
    alpasim: dict[str, Any] | None = None
    boundary: dict[str, Any] | None = None
    runs: tuple[str, ...] = ()
    schema: Literal[3] = 3

    @property
    def differences(self) -> list[tuple[str, dict[str, Difference]]]:
        """List the tables of differences with the variant of each: renderers, fixers against the
        renderer below, then policies.
        """
        blocks = (self.paired, self.paired_with_base, self.paired_policies)
        return [(variant, table) for block in blocks for variant, table in block.items() if table]


def to_json(record: Any) -> JsonObject:
    """Return a record as JSON's plain data, with every member under its name."""
    return asdict(record)


def read_summary(path: Path, do_this: str) -> Summary:
    """Read ``summary.json``.

    Args:
        path: The file.
        do_this: How to write it again, for the hints of errors.

    Raises:
        InputError: Missing or no JSON; of another schema; or a member is missing or has another
            type.
    """
    data = read_bytes(path, JSON_BYTES, do_this)
    content = parse_json(data, path, do_this)
    if isinstance(content, dict) and content.get("schema") != SCHEMA:
        number = content.get("schema", 1)  # the first one did not say so
        raise InputError(f"{path}: schema {number}, and this version reads {SCHEMA}", do_this)
    return read_record(Summary, data, path, do_this)

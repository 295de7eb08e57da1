"""The one table of a run: how the rollouts of each variant ended, its primary rate and how that
differs from its baseline's, its distance and its frame time. The terminal, report.html, summary.md
and gate.md print this object.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from alpasim_plugin.core.files import some_of
from alpasim_plugin.core.types import MetricInfo
from alpasim_plugin.log.run_folder.records import LogDifference
from evaluators.metrics.outcomes import NO_OUTCOME, NOT_RUN, OUTCOMES, REACHED_END, SHORT_OF_END
from evaluators.pages.decision import verdict_text
from evaluators.pages.fixers import fixer_cautions
from evaluators.pages.measured import measured_cautions
from evaluators.pages.policies import drive_call_lines, policy_cautions, unlit_lines
from evaluators.results import Difference, Endings, Mean
from evaluators.statistics.decision import read_decision
from evaluators.statistics.numbers import (
    DASH,
    count_of,
    fixed,
    plural,
    printed,
    scale_and_unit,
    short,
)
from evaluators.statistics.opening import Run
from evaluators.statistics.sentences import are_shipped, fewest_scenes, open_text, shipped_text
from evaluators.statistics.variants import Variant

Tone = Literal["worse", "better", "mixed", "unclear", "neutral"]

TONES: Mapping[str, Tone] = {  # of endings; the others need attention
    REACHED_END: "better",
    "collision": "worse",
    "off-road": "worse",
    OUTCOMES["policy"].words: "worse",
    NO_OUTCOME: "better",
    SHORT_OF_END: "unclear",
    NOT_RUN: "unclear",
}
UNHARMED = (REACHED_END, NO_OUTCOME, SHORT_OF_END)
FAILED = "failed"
# What the line of counts says of one rollout and of several; every other ending is a failure.
COUNTED = {
    REACHED_END: ("reaches the end", "reach the end"),
    FAILED: ("fails", "fail"),
    SHORT_OF_END: (
        "stops short of the end without a failure",
        "stop short of the end without a failure",
    ),
    NO_OUTCOME: ("without an event", "without an event"),
    NOT_RUN: ("could not be run", "could not be run"),
}
COLUMNS = (REACHED_END, "collision", "off-road", "stalled", OUTCOMES["policy"].words)
DISTANCE_NOTE = "to the side of the recorded path, mean of a rollout, median of the rollouts"
CUT_NOTE = "only up to an event that ended the scored part"
NUMBERS = ("primary rate", "median dist. m", "ms a frame")
VERDICTS: Mapping[Tone, str] = {
    "worse": "drives worse than",
    "better": "drives better than",
    "neutral": "drives no worse, by the margin, than",
}
PLACES = 2  # of failures that are named


@dataclass(frozen=True)
class PrimaryDifference:
    """A variant's primary metric minus its baseline's, in printed units.

    Attributes:
        bounds: 95 % interval over scenes; None with one scene.
        verdict: What a sentence about the variant says, unless it is undecided.
        needed: How many scenes would answer what is open; empty where it is decided, or not known.
        fewest: The number of the question that takes the fewest; None where none is known.
    """

    baseline: str
    centre: float
    bounds: tuple[float, float] | None
    margin: float
    tone: Tone
    verdict: str
    text: str
    n_scenes: int
    needed: str
    fewest: int | None

    @property
    def band(self) -> tuple[float, float]:
        """Give the ends of the band of the margin."""
        return -self.margin, self.margin


@dataclass(frozen=True)
class VariantRow:
    """One variant.

    Attributes:
        key: In ``summary.json``.
        name: What people call it.
        renderer, policy: Whose rollouts these are.
        endings: How many of its rollouts ended in which way, the best first.
        primary: Its primary rate, as a count where it is one.
        difference: None for a baseline, and where no rollouts can be paired.
        distance: Median of its distance from the logged path.
        is_cut_short: Steps after an event are not in that distance.
        places: Ending -> scene and time of its failures, the gravest first.
        is_baseline: Others are compared with it.
    """

    key: str
    name: str
    renderer: str
    policy: str
    endings: Mapping[str, int]
    primary: str
    difference: PrimaryDifference | None
    distance: str
    is_cut_short: bool
    frame_ms: str
    places: Mapping[str, Sequence[str]]
    is_baseline: bool

    @property
    def n_rollouts(self) -> int:
        """Count its rollouts."""
        return sum(self.endings.values())

    @property
    def n_failed(self) -> int:
        """Count its rollouts that had an outcome or could not be run."""
        return sum(n for name, n in self.endings.items() if name not in UNHARMED)

    @property
    def n_lost(self) -> int:
        """Count those of them that could not be run: nothing is known of how they would have ended."""
        return self.endings.get(NOT_RUN, 0)

    @property
    def share(self) -> str:
        """Say in how many of the rollouts that ran it failed; empty where it is none."""
        n_bad = self.n_failed - self.n_lost
        return f"in {n_bad} of {plural(self.n_rollouts - self.n_lost, 'rollout')}" if n_bad else ""

    @property
    def where(self) -> str:
        """Give its first failures in words."""
        texts = []
        for ending, cells in self.places.items():
            more = f" and {len(cells) - PLACES} more" if len(cells) > PLACES else ""
            texts.append(f"{ending} in {', '.join(cells[:PLACES])}{more}")
        return "; ".join([*texts, *([f"{self.n_lost} not run"] if self.n_lost else [])])


@dataclass(frozen=True)
class Overview:
    """The first screen of a run.

    Attributes:
        context: Suite, preset, size and what all variants share.
        question: What the primary metric is.
        unit: Of the differences.
        decision: What is decided about the differences.
        cautions: What a reader must know.
        remarks: What is measured beside, and is as it should be.
    """

    context: str
    rows: tuple[VariantRow, ...]
    question: str
    unit: str
    higher_is_better: bool
    decision: str
    cautions: tuple[str, ...]
    remarks: tuple[str, ...] = ()

    @property
    def failing(self) -> list[VariantRow]:
        """List the variants with a failed rollout, the worst first."""
        failing = [row for row in self.rows if row.n_failed]
        return sorted(failing, key=lambda row: -row.n_failed / row.n_rollouts)

    @property
    def badge(self) -> tuple[str, Tone]:
        """Give how many variants fail, and its colour; `counts` says how all rollouts ended."""
        if not self.rows:
            return "no rollouts", "unclear"
        n_short = sum(row.endings.get(SHORT_OF_END, 0) for row in self.rows)
        n_rollouts = sum(row.n_rollouts for row in self.rows)
        n = len(self.failing)
        total = plural(len(self.rows), "variant")
        if len(self.rows) == 1:
            (row,) = self.rows
            total = plural(n_rollouts, "rollout")
            n = row.n_failed - row.n_lost
            if row.n_lost and not n:
                return f"{row.n_lost} of {total} could not be run", "worse"
        tone: Tone = "worse" if n else "unclear" if n_short else "better"
        text = f"{n} of {total} fail{'s' if n == 1 else ''}" if n else f"no failure in {total}"
        return text, tone

    @property
    def counts(self) -> str:
        """Say how all rollouts ended, each counted once."""
        n_rollouts = sum(row.n_rollouts for row in self.rows)
        numbers = dict.fromkeys(COUNTED, 0)
        for row in self.rows:
            for name, n in row.endings.items():
                numbers[name if name in COUNTED else FAILED] += n
        parts = [f"{n} {COUNTED[key][n != 1]}" for key, n in numbers.items() if n]
        return f"{plural(n_rollouts, 'rollout')}: {', '.join(parts)}" if parts else ""

    @property
    def title(self) -> str:
        """Say which variant fails most and where, or that none does."""
        n = sum(row.n_rollouts for row in self.rows)
        if n == 0:
            return "Nothing was run: the run folder holds no rollouts"
        if not self.failing:
            reached = sum(row.endings.get(REACHED_END, 0) for row in self.rows)
            return f"{reached} of {plural(n, 'rollout')} reach the end, and none fails"
        worst = self.failing[0]
        most = "" if len(self.failing) == 1 else "most, "
        if not worst.share:
            return f"{worst.name}: {worst.n_lost} of {plural(worst.n_rollouts, 'rollout')} not run"
        return f"{worst.name} fails {most}{worst.share}: {worst.where}"

    @property
    def endings(self) -> list[tuple[str, tuple[str, ...]]]:
        """List the columns of endings with what each counts: those that every table has, and one
        for all others that occur.
        """
        ending_names = dict.fromkeys(name for row in self.rows for name in row.endings)
        columns: list[tuple[str, tuple[str, ...]]] = [(name, (name,)) for name in COLUMNS]
        others = tuple(name for name in ending_names if name not in COLUMNS)
        if others:
            columns.append((others[0] if len(others) == 1 else "other", others))
        return columns

    @property
    def heads(self) -> list[str]:
        """List the heads of the columns of `cells`."""
        return ["variant", *(name for name, _ in self.endings), *NUMBERS]

    def cells(self, row: VariantRow) -> list[str]:
        """Return a row as text; a star marks a distance that an event cut short."""
        counts = [str(sum(row.endings.get(name, 0) for name in names)) for _, names in self.endings]
        distance = f"{row.distance}*" if row.is_cut_short else row.distance
        return [row.name, *counts, row.primary, distance, row.frame_ms]

    @property
    def notes(self) -> list[str]:
        """Explain the columns as far as their heads do not."""
        notes = [f"primary rate: {self.question}", f"median dist.: {DISTANCE_NOTE}"]
        _, others = self.endings[-1]
        if len(others) > 1:
            notes.append(f"other: {', '.join(others)}")
        if any(row.is_cut_short for row in self.rows):
            notes.append(f"*: {CUT_NOTE}")
        return notes

    @property
    def axis(self) -> str:
        """Say what the differences are and which side is worse; empty without any."""
        differences = [row.difference for row in self.rows if row.difference is not None]
        if not differences:
            return ""
        margin = f", band: margin of {differences[0].margin:g}" if differences[0].margin else ""
        side = "left" if self.higher_is_better else "right"
        return (
            f"{self.question} minus {self.baselines}, {self.unit}, 95 % ({side} is worse{margin})"
        )

    @property
    def baselines(self) -> str:
        """Name what the variants are compared with; empty where they are not."""
        names = dict.fromkeys(row.difference.baseline for row in self.rows if row.difference)
        return " or ".join(names)

    @property
    def limits(self) -> tuple[float, float]:
        """Give the ends of the axis of the differences."""
        differences = [row.difference for row in self.rows if row.difference is not None]
        ends = [0.0]
        for difference in differences:
            ends += [
                difference.centre,
                difference.margin,
                -difference.margin,
                *(difference.bounds or ()),
            ]
        room = 0.04 * (max(ends) - min(ends)) or 1.0
        return min(ends) - room, max(ends) + room

    def share(self, value: float) -> float:
        """Return where a difference lies on the axis, in [0, 1]."""
        low, high = self.limits
        return (value - low) / (high - low)

    def place(self, value: float) -> str:
        """Return where a difference lies on the axis, for a style sheet."""
        return f"{100 * self.share(value):.2f}%"

    def width(self, ends: tuple[float, float]) -> str:
        """Return how long a stretch of the axis is, for a style sheet."""
        return f"{100 * (self.share(ends[1]) - self.share(ends[0])):.2f}%"


def overview_of(run: Run) -> Overview:
    """Lay out the first screen of a run."""
    summary = run.summary
    decision = read_decision(run.folder)
    boundary = summary.boundary
    is_sequential = decision is not None or boundary is not None
    differences = {} if is_sequential else differences_of(run)
    bases = set() if is_sequential else compared_with(run)
    rows = tuple(
        _row(run, name, entry, differences, name in bases)
        for name, entry in summary.outcomes.items()
    )
    primary = run.table.shown(run.table.primary)
    size = (plural(len(run.scenes), "scene"), plural(len(run.info.seeds), "seed"))
    named = some_of(run.info.asked or (), 2)
    parts = [*([named] if named else []), summary.preset, " \u00d7 ".join(size)]
    if len(run.policies) == 1:
        parts.append(f"policy {run.policies[0]}")
    elif len(run.renderers) == 1:
        parts.append(f"renderer {run.renderers[0]}")
    cautions = [
        *fixer_cautions(summary),
        *measured_cautions(run),
        *policy_cautions(run),
        *drive_call_lines(run, late=True),
        *unlit_lines(run),
    ]
    if summary.copies:
        cautions.append(
            f"{summary.copies} of {plural(len(run.rollouts), 'rollout')} are copies: "
            "a policy without a camera drives once for all renderers."
        )
    repeat = run.info.repeat
    if repeat is not None and repeat.repeatable is False:
        first = repeat.first_difference or LogDifference("log")
        step = "" if first.step is None else f" at step {first.step}"
        cautions.append(
            "The policy is not repeatable: a rollout that was driven twice differs first in "
            f"{first.component}{step}. Paired differences hold that noise too."
        )
    return Overview(
        " \u00b7 ".join(parts),
        rows,
        primary.words,
        scale_and_unit(primary, primary.unit)[1],
        primary.direction == "higher",
        boundary["sentence"]
        if boundary
        else f"{decided(rows)}{_with_shipped_scenes(run, rows)}"
        if decision is None
        else verdict_text(decision),
        tuple(cautions),
        tuple(drive_call_lines(run, late=False)),
    )


def variant_name(run: Run, name: str) -> str:
    """Return what people call a variant: its policy where a run has one renderer and several
    policies, its renderer where it has one policy, else both.
    """
    if len(run.renderers) == 1 and len(run.policies) > 1:
        return name.removeprefix(f"{run.renderers[0]}/")
    return name.removesuffix(f"/{run.policies[0]}") if len(run.policies) == 1 else name


def tone_of(entry: Difference) -> Tone:
    """Give the tone of a paired difference.

    Neutral means non-inferior: no worse than its margin, and not shown to be better.
    """
    if entry.difference == "better":
        return "better"
    if entry.verdict == "non-inferior":
        return "neutral"
    return "worse" if "worse" in (entry.difference, entry.verdict) else "unclear"


def differences_of(run: Run) -> dict[str, PrimaryDifference]:
    """Return KEY of ``summary.json`` -> the primary difference of that variant: to the baseline's
    renderer where there are several, else to its policy.
    """
    metric = run.table.shown(run.table.primary)
    return {
        key: _primary_difference(
            metric, entry, diff, variant_name(run, key), variant_name(run, entry.baseline)
        )
        for key, (entry, diff) in primary_entries(run).items()
    }


def primary_entries(run: Run) -> dict[str, tuple[Difference, float]]:
    """Return KEY of ``summary.json`` -> the difference of the primary metric that the first screen
    shows, and its value.
    """
    summary = run.summary
    blocks = [summary.paired] if summary.paired else [summary.paired_with_base]
    if not summary.paired:
        blocks.append(summary.paired_policies)
    entries: dict[str, tuple[Difference, float]] = {}
    for block in blocks:
        for key, pairs in block.items():
            entry = pairs.get(run.table.primary)
            if key not in entries and entry is not None and entry.diff is not None:
                entries[key] = entry, entry.diff
    return entries


def compared_with(run: Run) -> set[str]:
    """Return the variants, RENDERER/POLICY, that others are compared with on the first screen."""
    by_key: dict[str, Variant] = {}
    for rollout in run.rollouts:
        variant = Variant(rollout.renderer, rollout.policy)
        by_key[variant.name] = variant
        if len(run.policies) == 1:
            by_key[variant.renderer] = variant
    bases = set()
    for key, (entry, _) in primary_entries(run).items():
        base = by_key.get(entry.baseline)
        if base is None and key in by_key:  # a renderer, for each of several policies
            base = Variant(entry.baseline, by_key[key].policy)
        if base is not None:
            bases.add(base.name)
    return bases


def _primary_difference(
    metric: MetricInfo, entry: Difference, diff: float, name: str, baseline: str
) -> PrimaryDifference:
    scale, _ = scale_and_unit(metric, metric.unit)
    tone = tone_of(entry)
    verdict = f"{VERDICTS.get(tone, '')} {baseline}"
    if tone in ("worse", "better") and entry.verdict != "worse":
        verdict += " on these scenes"
    bounds = entry.ci95
    texts = printed(metric, diff, *(bounds or ()), sign=True)
    return PrimaryDifference(
        baseline,
        scale * diff,
        (scale * bounds[0], scale * bounds[1]) if bounds else None,
        scale * entry.margin,
        tone,
        verdict,
        f"{texts[0]} ({' to '.join(texts[1:])})" if bounds else texts[0],
        entry.n_scenes,
        open_text(name, baseline, entry, metric) if tone == "unclear" else "",
        fewest_scenes(entry) if tone == "unclear" else None,
    )


def decided(rows: Sequence[VariantRow]) -> str:
    """Say once what is decided about the differences, and about how many scenes would decide the
    rest; empty without any.
    """
    differences = {row.name: row.difference for row in rows if row.difference is not None}
    names_by_verdict: dict[str, list[str]] = {}
    for tone in VERDICTS:
        for name, difference in differences.items():
            if difference.tone == tone:
                names_by_verdict.setdefault(difference.verdict, []).append(name)
    parts = [f"{', '.join(names)} {verdict}" for verdict, names in names_by_verdict.items()]
    still_open = {
        name: difference for name, difference in differences.items() if difference.tone == "unclear"
    }
    if still_open:
        fewest = min(difference.n_scenes for difference in still_open.values())
        text = f"Not decided with {plural(fewest, 'scene')}"
        needed = [difference.needed or name for name, difference in still_open.items()]
        parts.append(f"{text}: {'; '.join(needed)}")
    return ". ".join(parts)


def _with_shipped_scenes(run: Run, rows: Sequence[VariantRow]) -> str:
    """Name the command that drives the shipped scenes, where they are enough for a question that is
    open; empty where they are not, or where the run is not about them.
    """
    is_shipped = all(name.startswith("suites/") for name in run.info.asked or ("",))
    names: dict[str, None] = {}  # in order, once each
    for row in rows:
        difference = row.difference
        if difference is not None and difference.fewest and are_shipped(difference.fewest):
            names |= dict.fromkeys((difference.baseline, row.key))
    if not is_shipped or not names or len(run.policies) > 1:
        return ""
    return f"; {shipped_text(list(names), run.policies)}"


def _row(
    run: Run,
    variant: str,
    entry: Endings,
    differences: Mapping[str, PrimaryDifference],
    is_baseline: bool,
) -> VariantRow:
    summary = run.summary
    renderer = variant.removesuffix(f"/{run.policies[0]}") if len(run.policies) == 1 else variant
    key = variant if variant in summary.metrics else renderer
    is_cut_short = False
    if key in summary.censoring:
        ledger = summary.censoring[key]
        is_cut_short = ledger.steps_after_event > 0 or ledger.steps_after_drift > 0
    mean_ms = summary.speed[key].ms_per_frame_mean if key in summary.speed else None
    median_m = entry.lateral_distance_m_median
    first = next((rollout for rollout in run.rollouts if rollout.variant == variant), None)
    return VariantRow(
        key,
        variant_name(run, variant),
        "" if first is None else first.renderer,
        "" if first is None else first.policy,
        entry.endings,
        _rate_text(run, summary.metrics.get(key, {}).get(run.table.primary)),
        differences.get(key),
        DASH if median_m is None else fixed(median_m, 2),
        median_m is not None and is_cut_short,
        DASH if mean_ms is None else fixed(mean_ms, 0 if mean_ms >= 10 else 1),
        _places_of(entry),
        is_baseline,
    )


def _rate_text(run: Run, primary: Mean | None) -> str:
    """Print a variant's primary metric, as a count where it is one."""
    if primary is None or primary.mean is None:
        return DASH
    rate = short(primary.mean)
    if run.table.shown(run.table.primary).in_percent:
        rate = f"{short(100 * primary.mean)}\u00a0%"
    return count_of(primary.mean, primary.n_rollouts) or rate


def _places_of(entry: Endings) -> dict[str, list[str]]:
    """Return the failures of a variant by their ending, the gravest first."""
    places: dict[str, list[str]] = {}
    for metric, events in entry.outcomes.items():
        outcome = OUTCOMES[metric]
        for cell in events.cells:
            seed = f" seed {cell.seed}" if cell.seed else ""
            when = "" if cell.t_s is None else f" at {cell.t_s:.1f}\u00a0s"
            ending = places.setdefault(outcome.ending or outcome.words, [])
            ending.append(f"{cell.scene}{seed}{when}")
    return places

"""Turn a run into table rows: text, order and hover text, without markup."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from evaluators.metrics import METRICS, MetricInfo, MetricTable
from evaluators.pages.overview import tone_of
from evaluators.results import Difference, Mean, Summary
from evaluators.statistics.numbers import (
    ARROW_WORDS,
    ARROWS,
    DASH,
    NARROW,
    Cell,
    count_of,
    decimals,
    fixed,
    missing,
    plural,
    printed,
    scale_and_unit,
    short,
)
from evaluators.statistics.opening import Run
from evaluators.statistics.sentences import claim_text

# verdict on other scenes against the margin, and the difference on these scenes -> words
VERDICT_WORDS = {
    ("undecided", "worse"): "worse on these scenes, in others undecided",
    ("undecided", "better"): "better on these scenes, in others undecided",
    ("non-inferior", "worse"): "worse within margin",
    ("non-inferior", "better"): "better",
}


@dataclass(frozen=True)
class MetricRow:
    """One metric, one cell per variant."""

    name: str
    meaning: str
    unit: str
    arrow: str
    arrow_word: str
    cells: tuple[Cell, ...]
    is_headline: bool


@dataclass(frozen=True)
class PairRow:
    """One paired difference."""

    variant: str
    baseline: str
    metric: str
    meaning: str
    diff: Cell
    interval: Cell
    p_value: Cell
    verdict: str
    tone: str
    margin: str = ""


def metric_rows(
    summary: Summary,
    reasons: Mapping[tuple[str, str], str] | None = None,
    table: MetricTable = METRICS,
) -> list[MetricRow]:
    """Lay out metrics x variants.

    Args:
        summary: The results of a run.
        reasons: (renderer, metric) -> why it is invalid, for cells without a number.
        table: What the metrics are.
    """
    variants = summary.metrics
    rows = []
    for name in table.ordered(metric for metrics in variants.values() for metric in metrics):
        facts = table.shown(name)
        entries = {variant: metrics.get(name) for variant, metrics in variants.items()}
        means = [entry for entry in entries.values() if entry is not None]
        direction = means[0].direction
        places = 1 if facts.in_percent else _places(means)
        cells = (
            metric_cell(facts, entry, places, (reasons or {}).get((variant, name), ""))
            for variant, entry in entries.items()
        )
        rows.append(
            MetricRow(
                name=name,
                meaning=facts.help,
                unit="%" if facts.in_percent else means[0].unit,
                arrow=ARROWS.get(direction, ""),
                arrow_word=ARROW_WORDS.get(direction, "neither direction is better"),
                cells=tuple(cells),
                is_headline=facts.is_headline,
            )
        )
    return rows


def _places(means: Sequence[Mean]) -> int:
    """Return how many decimals show three digits of the means and two of their intervals."""
    halves = [
        (mean.ci95_clustered[1] - mean.ci95_clustered[0]) / 2
        for mean in means
        if mean.ci95_clustered is not None
    ]
    places = decimals(*(mean.mean for mean in means))
    return max(places, decimals(*halves, digits=2)) if halves else places


def metric_cell(metric: MetricInfo, entry: Mean | None, places: int, reason: str) -> Cell:
    """Print a mean with its interval, scenes as clusters, and for rates the count."""
    if entry is None:
        return missing(reason or "not computed for this renderer")
    mean = entry.mean
    if mean is None:
        return missing(reason or entry.reason or "valid in no rollout")
    notes = [f"{plural(entry.n_rollouts, 'rollout')}, {plural(entry.n_scenes, 'scene')}"]
    if entry.n_invalid:
        notes.append(f"invalid in {entry.n_invalid} more" + (f" ({reason})" if reason else ""))
    if entry.note:
        notes.append(entry.note)
    scale = 100.0 if metric.in_percent else 1.0
    bounds = entry.ci95_clustered
    detail = DASH
    if bounds is None:
        why = entry.ci95_clustered_reason or "it needs at least two scenes"
        notes.append(f"no interval over scenes: {why}")
    else:
        detail = " to ".join(fixed(bound * scale, places) for bound in bounds)
    counted = count_of(mean, entry.n_rollouts) if metric.is_flag else ""
    if counted:
        percent = f"{NARROW}%" if bounds else ""
        detail = f"{counted.replace(' of ', '/')} ({detail}{percent})"
        if mean == 0.0 and bounds:
            most = fixed(bounds[1] * scale, places)
            notes.append(f"no event in {entry.n_rollouts}: only rates above {most} % are excluded")
    return Cell(fixed(mean * scale, places), "; ".join(notes), detail, mean)


def pair_rows(
    differences: Sequence[tuple[str, Mapping[str, Difference]]], table: MetricTable = METRICS
) -> list[PairRow]:
    """Lay out paired differences, headline metrics first within each variant.

    Args:
        differences: Variants with METRIC -> difference, in the order of the table
            (`evaluators.results.Summary.differences`).
        table: What the metrics are.
    """
    return [
        _pair_row(variant, table.shown(name), pairs[name])
        for variant, pairs in differences
        for name in table.ordered(pairs)
    ]


def _pair_row(variant: str, metric: MetricInfo, entry: Difference) -> PairRow:
    bounds = entry.ci95 or ()
    scale, unit = scale_and_unit(metric, entry.unit)
    numbers = [plural(entry.n_cells, "pair"), plural(entry.n_scenes, "scene")]
    if entry.n_missing:
        numbers.append(f"{entry.n_missing} rollouts lack a partner")
    note = ", ".join(numbers)
    diff_cell = missing(entry.reason or "no pair has this metric valid on both sides")
    bounds_cell = missing(entry.reason or "it needs at least two scenes")
    if entry.diff is not None:
        texts = printed(metric, entry.diff, *bounds, sign=True)
        diff_cell = Cell(f"{texts[0]}\u00a0{unit}".strip("\u00a0"), note, sort=scale * entry.diff)
        if bounds:
            claim = claim_text(entry, metric)
            bounds_note = f"{note}; {claim}" if claim else note
            width = scale * (bounds[1] - bounds[0])
            bounds_cell = Cell(" to ".join(texts[1:]), bounds_note, sort=width)
    hint = ""
    if entry.direction != "none":
        hint = f"margin {short(entry.margin * scale, unit)}"
        if entry.beyond is not None:
            hint += f", {entry.claim}"
    return PairRow(
        variant,
        entry.baseline,
        metric.name,
        metric.help,
        diff_cell,
        bounds_cell,
        _p_cell(entry),
        verdict_words(entry),
        tone_of(entry),
        hint,
    )


def _p_cell(entry: Difference) -> Cell:
    """Print the p-value that the verdict goes by, and on hover the one before the correction."""
    if entry.p_value is None or entry.p_corrected is None:
        return missing(entry.reason or "no test was made")
    note = f"{entry.test}; by itself p = {_p_text(entry.p_value)}"
    return Cell(_p_text(entry.p_corrected), note, sort=entry.p_corrected)


def _p_text(p: float) -> str:
    return "< 0.001" if p < 0.001 else fixed(p, 3)


def verdict_words(entry: Difference) -> str:
    """Say the verdict on other scenes, and what is shown on these."""
    if entry.difference is None:
        return entry.verdict
    return VERDICT_WORDS.get((entry.verdict, entry.difference), entry.verdict)


@dataclass(frozen=True)
class Column:
    """Head of a result column."""

    variant: str
    n_rollouts: int
    n_failed: int
    n_scenes: int


def columns(run: Run) -> list[Column]:
    """Describe each variant: how many rollouts and scenes stand behind its column."""
    heads = []
    for variant in run.variants:
        rollouts = run.rollouts_of(variant)
        done = [rollout for rollout in rollouts if rollout.ok]
        heads.append(
            Column(
                variant,
                len(done),
                len(rollouts) - len(done),
                len({rollout.scene for rollout in done}),
            )
        )
    return heads

"""Turn a run into table rows: text, order and hover text, without markup."""

from collections.abc import Mapping
from dataclasses import dataclass

from alpasim_plugin.core.json_types import JsonView
from alpasim_plugin.log.run_folder.shapes import pair_tables
from evaluators.metrics import METRICS, MetricInfo, MetricTable
from evaluators.pages.overview import tone_of
from evaluators.statistics.numbers import (
    ARROW_WORDS,
    ARROWS,
    DASH,
    NARROW,
    Cell,
    count_of,
    decimals,
    finite,
    fixed,
    interval,
    missing,
    plural,
    printed,
    scale_and_unit,
    short,
)
from evaluators.statistics.opening import Run

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
    summary: JsonView,
    reasons: Mapping[tuple[str, str], str] | None = None,
    known: MetricTable = METRICS,
) -> list[MetricRow]:
    """Lay out metrics x variants from ``summary.json``.

    Args:
        summary: Content of ``summary.json``.
        reasons: (renderer, metric) -> why it is invalid, for cells without a number.
        known: What the metrics are.
    """
    variants = summary.get("metrics") or {}
    rows = []
    for name in known.ordered(metric for metrics in variants.values() for metric in metrics):
        facts = known.shown(name)
        entries = {variant: metrics.get(name) or {} for variant, metrics in variants.items()}
        unit = next((str(entry["unit"]) for entry in entries.values() if entry.get("unit")), "")
        directions = [str(entry["direction"]) for entry in entries.values() if "direction" in entry]
        direction = directions[0] if directions else "none"
        places = 1
        if not facts.in_percent:
            means = [finite(entry.get("mean")) for entry in entries.values()]
            bounds = [interval(entry.get("ci95_clustered")) for entry in entries.values()]
            halves = [(ends[1] - ends[0]) / 2 for ends in bounds if ends]
            places = max(decimals(*means), decimals(*halves, digits=2) if halves else 0)
        cells = (
            metric_cell(facts, entry, places, (reasons or {}).get((variant, name), ""))
            for variant, entry in entries.items()
        )
        rows.append(
            MetricRow(
                name=name,
                meaning=facts.help,
                unit="%" if facts.in_percent else unit,
                arrow=ARROWS.get(direction, ""),
                arrow_word=ARROW_WORDS.get(direction, "neither direction is better"),
                cells=tuple(cells),
                is_headline=facts.is_headline,
            )
        )
    return rows


def metric_cell(metric: MetricInfo, entry: JsonView, places: int, reason: str) -> Cell:
    """Print a mean with its interval, scenes as clusters, and for rates the count."""
    mean = finite(entry.get("mean"))
    if mean is None:
        absent = "valid in no rollout" if entry else "not computed for this renderer"
        return missing(reason or str(entry.get("reason") or absent))
    n_rollouts = int(entry.get("n_rollouts") or 0)
    notes = [f"{plural(n_rollouts, 'rollout')}, {plural(int(entry.get('n_scenes') or 0), 'scene')}"]
    if entry.get("n_invalid"):
        notes.append(f"invalid in {entry['n_invalid']} more" + (f" ({reason})" if reason else ""))
    if entry.get("note"):
        notes.append(str(entry["note"]))
    scale = 100.0 if metric.in_percent else 1.0
    bounds = interval(entry.get("ci95_clustered"))
    detail = DASH
    if bounds is None:
        why = entry.get("ci95_clustered_reason") or "it needs at least two scenes"
        notes.append(f"no interval over scenes: {why}")
    else:
        detail = " to ".join(fixed(bound * scale, places) for bound in bounds)
    counted = count_of(mean, n_rollouts) if metric.is_flag else ""
    if counted:
        percent = f"{NARROW}%" if bounds else ""
        detail = f"{counted.replace(' of ', '/')} ({detail}{percent})"
        if mean == 0.0 and bounds:
            most = fixed(bounds[1] * scale, places)
            notes.append(f"no event in {n_rollouts}: only rates above {most} % are excluded")
    return Cell(fixed(mean * scale, places), "; ".join(notes), detail, mean)


def pair_rows(summary: JsonView, known: MetricTable = METRICS) -> list[PairRow]:
    """Lay out the paired differences, headline metrics first within each variant; those with a
    fixer's own base come last.
    """
    rows = []
    for variant, pairs in pair_tables(summary):
        rows += [
            _pair_row(variant, known.shown(name), pairs[name]) for name in known.ordered(pairs)
        ]
    return rows


def _pair_row(variant: str, metric: MetricInfo, entry: JsonView) -> PairRow:
    difference = finite(entry.get("diff"))
    p = finite(entry.get("p_value"))
    bounds = interval(entry.get("ci95")) or ()
    scale, unit = scale_and_unit(metric, str(entry.get("unit", "")))
    counts = [(entry.get("n_cells"), "pair"), (entry.get("n_scenes"), "scene")]
    numbers = [plural(int(count), noun) for count, noun in counts if count is not None]
    if entry.get("n_missing"):
        numbers.append(f"{entry['n_missing']} rollouts lack a partner")
    reason = str(entry.get("reason") or "")
    note = ", ".join(numbers)
    diff_cell = missing(reason or "no pair has this metric valid on both sides")
    bounds_cell = missing(reason or "it needs at least two scenes")
    if difference is not None:
        texts = printed(metric, difference, *bounds, sign=True)
        diff_cell = Cell(f"{texts[0]}\u00a0{unit}".strip("\u00a0"), note, sort=scale * difference)
        if bounds:
            bounds_cell = Cell(" to ".join(texts[1:]), note, sort=scale * (bounds[1] - bounds[0]))
    p_cell = missing(reason or "no test was made")
    if p is not None:
        text = "< 0.001" if p < 0.001 else fixed(p, 3)
        p_cell = Cell(text, str(entry.get("test") or ""), sort=p)
    tone = tone_of(entry)
    verdict = str(entry.get("verdict"))
    margin = finite(entry.get("margin"))
    hint = ""
    if margin is not None and entry.get("direction") != "none":
        hint = f"margin {short(margin * scale, unit)}"
    return PairRow(
        variant,
        str(entry.get("baseline") or DASH),
        metric.name,
        metric.help,
        diff_cell,
        bounds_cell,
        p_cell,
        VERDICT_WORDS.get((verdict, str(entry.get("difference"))), verdict),
        tone,
        hint,
    )


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
        done = [r for r in rollouts if r.ok]
        heads.append(
            Column(variant, len(done), len(rollouts) - len(done), len({r.scene for r in done}))
        )
    return heads

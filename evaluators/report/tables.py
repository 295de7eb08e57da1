"""Turn a run into table rows: text, order and hover text, without markup."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from alpasim_plugin.log.run_folder.rows import Rollout
from alpasim_plugin.log.run_folder.schema import WHY_NAME
from alpasim_plugin.log.run_folder.shapes import pair_tables
from evaluators.metrics import METRICS, MetricInfo, MetricTable
from evaluators.metrics.outcomes import POLICY_FAULT, in_words, outcomes_of, told
from evaluators.opening import Run
from evaluators.report.flips import colours_of
from evaluators.report.numbers import (
    ARROW_WORDS,
    ARROWS,
    DASH,
    LEAST_SPAN,
    NARROW,
    Cell,
    count_of,
    decimals,
    duration,
    finite,
    fixed,
    interval,
    missing,
    plural,
    short,
)
from evaluators.report.rollouts import COLLISION
from evaluators.report.verdict import more_scenes_text, tone_of


@dataclass(frozen=True)
class Span:
    """An interval on an axis that the rows of one table share, in percent of the axis width."""

    centre: float
    low: float | None = None
    high: float | None = None
    zero: float | None = None


@dataclass(frozen=True)
class MetricRow:
    """One metric, one cell per variant."""

    name: str
    meaning: str
    unit: str
    arrow: str
    arrow_word: str
    cells: tuple[Cell, ...]
    spans: tuple[Span | None, ...]
    is_headline: bool
    scale_text: str = ""


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
    span: Span | None
    hint: str = ""  # the margin, and how many more scenes would decide


def metric_rows(
    summary: Mapping[str, Any],
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
    for name in known.ordered(m for metrics in variants.values() for m in metrics):
        entries = [metrics.get(name) or {} for metrics in variants.values()]
        unit = next((str(e["unit"]) for e in entries if e.get("unit")), "")
        direction = next((str(e["direction"]) for e in entries if e.get("direction")), "none")
        facts = known.shown(name)
        percent = facts.in_percent
        reason_of = [(reasons or {}).get((variant, name), "") for variant in variants]
        halves = [
            (ends[1] - ends[0]) / 2 for e in entries if (ends := interval(e.get("ci95_clustered")))
        ]
        means = [m for e in entries if (m := finite(e.get("mean")))]
        places = (
            1 if percent else max(decimals(*means), decimals(*halves, digits=2) if halves else 0)
        )
        cells = tuple(
            metric_cell(facts, e, places, why) for e, why in zip(entries, reason_of, strict=True)
        )
        spans, scale_text = _spans(
            entries, 100.0 if percent else 1.0, facts.is_flag, "%" if percent else unit
        )
        rows.append(
            MetricRow(
                name=name,
                meaning=facts.help,
                unit="%" if percent else unit,
                arrow=ARROWS.get(direction, ""),
                arrow_word=ARROW_WORDS.get(direction, "neither direction is better"),
                cells=cells,
                spans=spans,
                is_headline=facts.is_headline,
                scale_text=scale_text,
            )
        )
    return rows


def metric_cell(
    metric: MetricInfo, entry: Mapping[str, Any], places: int, reason: str = ""
) -> Cell:
    """Print a mean with its interval, scenes as clusters, and for rates the count."""
    mean = finite(entry.get("mean"))
    n_rollouts, n_scenes = int(entry.get("n_rollouts") or 0), int(entry.get("n_scenes") or 0)
    if mean is None:
        stated = reason or str(entry.get("reason") or "")
        return missing(
            stated or ("valid in no rollout" if entry else "not computed for this renderer")
        )
    scale = 100.0 if metric.in_percent else 1.0
    clustered = interval(entry.get("ci95_clustered"))
    notes = [f"{plural(n_rollouts, 'rollout')}, {plural(n_scenes, 'scene')}"]
    if entry.get("n_invalid"):
        notes.append(f"invalid in {entry['n_invalid']} more" + (f" ({reason})" if reason else ""))
    if clustered is None:
        notes.append(
            f"no interval over scenes: {entry.get('ci95_clustered_reason') or 'it needs at least two scenes'}"
        )
    if entry.get("note"):
        notes.append(str(entry["note"]))
    counted = count_of(mean, n_rollouts) if metric.is_flag else ""
    detail = DASH if clustered is None else " to ".join(fixed(v * scale, places) for v in clustered)
    if counted:
        detail = (
            f"{counted.replace(' of ', '/')} ({detail}{'' if clustered is None else NARROW + '%'})"
        )
        if mean == 0.0 and clustered is not None:
            notes.append(
                f"no event in {n_rollouts}: only rates above {fixed(clustered[1] * scale, places)} % are excluded"
            )
    return Cell(fixed(mean * scale, places), "; ".join(notes), detail, mean)


def _spans(
    entries: list[Mapping[str, Any]], scale: float, rate: bool, unit: str
) -> tuple[tuple[Span | None, ...], str]:
    """Place means and intervals of one metric on one axis that includes zero."""
    values: list[float] = [0.0]
    for e in entries:
        mean = finite(e.get("mean"))
        if mean is not None:
            values.append(mean)
            values += interval(e.get("ci95_clustered")) or ()
    low, high = min(values), max(values)
    if rate:
        low, high = max(low, 0.0), min(max(high, 0.02), 1.0)
    high = max(high, LEAST_SPAN.get(unit, 0.0)) if low == 0.0 else high
    if high <= low:
        return tuple(None for _ in entries), ""

    def place(value: float) -> float:
        return round(100.0 * (min(max(value, low), high) - low) / (high - low), 2)

    spans: list[Span | None] = []
    for e in entries:
        mean = finite(e.get("mean"))
        if mean is None:
            spans.append(None)
            continue
        outer = interval(e.get("ci95_clustered"))
        spans.append(
            Span(
                place(mean),
                place(outer[0]) if outer else None,
                place(outer[1]) if outer else None,
                zero=place(0.0) if low < 0.0 else None,
            )
        )
    places = 0 if scale == 100.0 and high >= 0.1 else decimals(low * scale, high * scale, digits=2)
    tail = f"\u00a0{unit}" if unit else ""
    return tuple(spans), f"{fixed(low * scale, places)} to {fixed(high * scale, places)}{tail}"


def pair_rows(summary: Mapping[str, Any], known: MetricTable = METRICS) -> list[PairRow]:
    """Lay out the paired differences, headline metrics first within each variant; those with a
    fixer's own base come last.
    """
    rows = []
    for variant, pairs in pair_tables(summary):
        for name in known.ordered(pairs):
            entry = pairs[name] or {}
            stats = {
                **((summary.get("metrics") or {}).get(variant, {}).get(name) or {}),
                **entry,
            }  # older summaries: in metrics only
            rows.append(
                _pair_row(
                    variant,
                    known.shown(name),
                    entry,
                    str(stats.get("unit", "")),
                    str(stats.get("direction", "none")),
                )
            )
    return rows


def _pair_row(
    variant: str, metric: MetricInfo, entry: Mapping[str, Any], unit: str, direction: str
) -> PairRow:
    diff = finite(entry.get("diff"))
    bounds = interval(entry.get("ci95"), diff)
    scale, unit = (100.0, "points") if metric.in_percent else (1.0, unit)
    tail = f"\u00a0{unit}" if unit else ""
    note = _pair_note(entry)
    reason = str(entry.get("reason") or "")
    diff_cell = missing(reason or "no pair has this metric valid on both sides")
    bounds_cell = missing(reason or "it needs at least two scenes")
    span = None
    if diff is not None:
        ends = bounds or ()
        places = 1 if scale == 100.0 else decimals(*(v * scale for v in (diff, *ends)), digits=3)
        diff_cell = Cell(fixed(diff * scale, places, sign=True) + tail, note, sort=diff * scale)
        if bounds is not None:
            low, high = (fixed(v * scale, places, sign=True) for v in bounds)
            bounds_cell = Cell(f"{low} to {high}", note, sort=bounds[1] - bounds[0])
            reach = max(map(abs, (diff, *bounds))) or 1.0
            span = Span(*(round(50 + 46 * v / reach, 2) for v in (diff, *bounds)), zero=50.0)
    p = finite(entry.get("p_value"))
    p_cell = (
        missing(reason or "no test was made")
        if p is None
        else Cell(p_text(p), str(entry.get("test") or ""), sort=p)
    )
    tone = tone_of(entry, direction)
    verdict = str(entry.get("verdict") or {"unclear": "undecided"}.get(tone, tone))
    verdict = {
        ("undecided", "worse"): "worse, margin undecided",
        ("non-inferior", "worse"): "worse within margin",
        ("non-inferior", "better"): "better",
    }.get((verdict, str(entry.get("difference"))), verdict)
    margin, more = finite(entry.get("margin")), more_scenes_text(entry.get("more_scenes"))
    said = (
        [f"margin {short(margin * scale, unit)}"]
        if margin is not None and entry.get("direction") != "none"
        else []
    )
    base, hint = (
        str(entry.get("baseline") or "\u2014"),
        "; ".join([*said, *([more] if more else [])]),
    )
    return PairRow(
        variant,
        base,
        metric.name,
        metric.help,
        diff_cell,
        bounds_cell,
        p_cell,
        verdict,
        tone,
        span,
        hint,
    )


def _pair_note(entry: Mapping[str, Any]) -> str:
    said = []
    if entry.get("n_cells") is not None:
        said.append(plural(int(entry["n_cells"]), "pair"))
    if entry.get("n_scenes") is not None:
        said.append(plural(int(entry["n_scenes"]), "scene"))
    if entry.get("n_missing"):
        said.append(f"{entry['n_missing']} cells lack a partner")
    return ", ".join(said)


def p_text(p: float) -> str:
    """Print a p-value."""
    return "< 0.001" if p < 0.001 else fixed(p, 3)


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


MAX_SCENE_ROWS = 600  # more are a page that loads and scrolls slowly
TELLING_ROWS = 200  # shown of a larger run
SCENE_METRICS = ("lateral_distance_m", "progress")


@dataclass(frozen=True)
class Chip:
    """One rollout in the scene table: its seed and how it ended."""

    text: str
    state: str  # ok | collision | offroad (and whatever else touches nothing) | failed
    title: str
    folder: str | None
    clip: str | None


@dataclass(frozen=True)
class SceneRow:
    """One scene under one renderer and policy."""

    scene: str
    renderer: str
    policy: str
    variant: int
    chips: tuple[Chip, ...]
    collisions: Cell
    offroad: Cell
    values: tuple[Cell, ...]


def scene_rows(run: Run, interesting: Sequence[str] = ()) -> tuple[list[SceneRow], int]:
    """Lay out scenes x variants, in the order of the run; where there is no room for all, the most
    telling scenes first.

    Args:
        run: The run.
        interesting: Its scenes, the most telling first.

    Returns:
        The rows, and how many more there are than are shown.
    """
    groups: dict[tuple[str, str, str], list[Rollout]] = {}
    for rollout in run.rollouts:
        groups.setdefault((rollout.scene, rollout.renderer, rollout.policy), []).append(rollout)
    renderer_index = {name: i for i, name in enumerate(run.renderers)}
    is_large, colours = len(groups) > MAX_SCENE_ROWS, colours_of(run)
    rank = {
        name: i for i, name in enumerate(interesting if interesting and is_large else run.scenes)
    }
    keys = sorted(groups, key=lambda k: (rank[k[0]], renderer_index[k[1]], k[2]))
    rows = []
    for key in keys[: TELLING_ROWS if is_large else MAX_SCENE_ROWS]:
        done = [r for r in groups[key] if r.ok]
        chips = tuple(_chip(run, r) for r in sorted(groups[key], key=lambda r: r.seed))
        collisions, offroad = _count(done, COLLISION), _count(done, ("offroad",))
        values = tuple(_mean(run, done, name) for name in SCENE_METRICS)
        rows.append(SceneRow(*key, colours[key[1], key[2]][0], chips, collisions, offroad, values))
    return rows, len(keys) - len(rows)


def _chip(run: Run, rollout: Rollout) -> Chip:
    had = told(outcomes_of(rollout))
    if had:
        letters = "".join(dict.fromkeys(one.letter for one in had))
        state = _state(had[0].name)
        letter = f" {letters}"
        said = in_words(one.name for one in had)
    elif not rollout.ok:
        state = "failed"
        letter = " F"
        said = f"failed ({rollout.failure_class or 'unknown cause'})"
    else:
        state = "ok"
        letter = ""
        said = "no event"
    facts = [f"seed {rollout.seed}: {said}"]
    facts += [f"{rollout.frames} frames"] if rollout.frames is not None else []
    facts += [duration(rollout.wall_s)] if rollout.wall_s is not None else []
    return Chip(
        f"{rollout.seed}{letter}",
        state,
        ", ".join(facts),
        (run.href(rollout, WHY_NAME) if had else None) or run.href(rollout),
        run.href(rollout, "front.mp4"),
    )


def _state(outcome: str) -> str:
    """Return how a chip with an outcome is drawn."""
    if outcome == POLICY_FAULT:
        return "failed"
    return "collision" if outcome.startswith("collision") else "offroad"


def _count(done: list[Rollout], names: tuple[str, ...]) -> Cell:
    known = [r for r in done if any(r.metrics.get(name) is not None for name in names)]
    k = sum(r.flag(*names) for r in known)
    return (
        Cell(f"{k} of {len(known)}", sort=k / len(known), tone="worse" if k else "")
        if known
        else _nothing(done)
    )


def _mean(run: Run, done: list[Rollout], name: str) -> Cell:
    values = [v for r in done if (v := r.metrics.get(name)) is not None]
    if not values:
        return _nothing(done)
    mean = float(np.mean(values))
    note = "" if len(values) == len(done) else f"valid in {len(values)} of {len(done)}"
    return Cell(
        f"{fixed(100 * mean, 1)}\u00a0%" if run.table.shown(name).in_percent else short(mean, "m"),
        note,
        sort=mean,
    )


def _nothing(done: list[Rollout]) -> Cell:
    return missing("no rollout finished" if not done else "the metric is valid in no rollout")

"""Say in sentences what a run found, from the numbers of ``summary.json`` alone: the one builder of
the verdict for the terminal, the report and Markdown.

The words of a difference come from the paired comparison and its correction for many questions
from `evaluators.statistics.verdicts`; nothing is tested here. The title answers the one question
that the run declared before it was driven (`MetricTable.primary`); everything else is secondary.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Any, Literal

from alpasim_plugin.log.run_folder.shapes import pair_tables
from evaluators.opening import Run
from evaluators.report.fixers import fixer_cautions
from evaluators.report.numbers import (
    count_of,
    finite,
    interval,
    plural,
    short,
)
from evaluators.statistics.intervals import FEW_SCENES
from evaluators.statistics.outcomes import outcome_table, sentence
from evaluators.statistics.sentences import difference_text
from evaluators.statistics.verdicts import shown_questions

Tone = Literal["worse", "better", "mixed", "unclear", "neutral", "broken"]

GRAVEST_FIRST: tuple[Tone, ...] = ("worse", "mixed", "better", "unclear", "neutral")
LEADING = 4  # variants named in the headline
COMPARED = 3  # comparisons named in the title
NO_PAIR = "no metric is valid in both members of any pair"


@dataclass(frozen=True)
class Point:
    """What was found for one variant.

    Attributes:
        name: What sentences call it.
        tone: Of its differences.
        sentence: The verdict; empty where it is compared with nothing.
        text: Every difference that the verdict rests on, with intervals.
        lead: The one difference that says most.
        baseline: What it is compared with; empty where with nothing.
        variant: Its key in ``summary.json``.
    """

    name: str
    tone: Tone
    text: str
    sentence: str = ""
    lead: str = ""
    baseline: str = ""
    variant: str = ""


@dataclass(frozen=True)
class Finding:
    """The head of a report.

    Attributes:
        title: The differences; of one variant alone how its rollouts ended.
        tone: Of the differences.
        points: One a comparison.
        cautions: What a reader must know.
        outcomes: Variant, as sentences call it, and how its rollouts ended.
    """

    title: str
    tone: Tone
    points: tuple[Point, ...] = ()
    cautions: tuple[str, ...] = ()
    outcomes: tuple[tuple[str, str], ...] = ()

    @property
    def head(self) -> str:
        """Give how the rollouts of all variants ended; the title where there is one variant."""
        if len(self.outcomes) < 2:
            return self.title
        named = [f"{name}: {text}" for name, text in self.outcomes[:LEADING]]
        more = len(self.outcomes) - LEADING
        return "; ".join([*named, f"and {more} more"] if more > 0 else named)

    def name_of(self, point: Point) -> str:
        """Name a point, with its baseline where not all points have the same."""
        several = len({one.baseline for one in self.points}) > 1
        return f"{point.name} \u2212 {point.baseline}" if several and point.baseline else point.name


def find(run: Run) -> Finding:
    """Derive the main finding of a run."""
    if not run.rollouts:
        return Finding("Nothing was run: the run folder holds no rollouts", "broken")
    table = run.summary.get("outcomes") or outcome_table(run.rollouts)
    outcomes = tuple((variant_name(run, name), sentence(entry)) for name, entry in table.items())
    cautions = _cautions(run)
    if not any(rollout.ok for rollout in run.rollouts):
        title = f"Nothing could be scored: all {plural(len(run.rollouts), 'rollout')} failed"
        return Finding(title, "broken", (), cautions, outcomes)
    comparisons = list(pair_tables(run.summary))
    if not comparisons:
        title = f"{plural(len(outcomes), 'variant')} driven, none of which can be paired"
        if len(outcomes) == 1:
            title = ": ".join(outcomes[0])
        alone = (
            Point(variant_name(run, variant), "neutral", _alone(run, variant), variant=variant)
            for variant in run.variants
        )
        return Finding(title, "neutral", tuple(alone), cautions, outcomes)
    questions = [_questions(run, pairs) for _, pairs in comparisons]
    primary = run.table.primary
    if primary and not all(primary in names for names in questions):
        words = run.table.shown(primary).words
        cautions += (
            f"Not every comparison has a value of the primary question, {words}: "
            "the headline is about all questions, corrected together.",
        )
        primary = ""
    p_values = {
        (row, name): finite(pairs[name].get("p_value"))
        for row, (_, pairs) in enumerate(comparisons)
        for name in questions[row]
    }
    shown = shown_questions(p_values, primary)
    points = tuple(
        _point(
            run, variant, pairs, questions[row], {name for i, name in shown if i == row}, primary
        )
        for row, (variant, pairs) in enumerate(comparisons)
    )
    sentences = [point.sentence for point in points[:COMPARED]]
    if len(points) > COMPARED:
        sentences.append(f"and {len(points) - COMPARED} more")
    title = "; ".join(sentences)
    if points[0].tone == "unclear":
        title = title[0].upper() + title[1:]
    tones = {point.tone for point in points}
    tone = next(tone for tone in GRAVEST_FIRST if tone in tones)
    return Finding(title, tone, points, cautions, outcomes)


def variant_name(run: Run, name: str) -> str:
    """Return what sentences call a variant: its policy where a run has one renderer, its renderer
    where it has one policy, else both.
    """
    if len(run.renderers) == 1 and len(run.policies) > 1:
        return name.removeprefix(f"{run.renderers[0]}/")
    return name.removesuffix(f"/{run.policies[0]}") if len(run.policies) == 1 else name


def tone_of(entry: Mapping[str, Any], direction: str) -> Tone:
    """Give the tone of one paired difference, or where no verdict is stated whether its interval
    excludes zero.

    Neutral means non-inferior: no worse than its margin, and not shown to be better.

    Args:
        entry: One metric of ``summary.json``'s ``paired``.
        direction: "lower", "higher" or "none": which way is better.
    """
    stated = str(entry.get("verdict") or "").lower()
    if stated:
        shown = entry.get("difference")
        if shown == "better" or (shown == "worse" and stated != "non-inferior"):
            return "better" if shown == "better" else "worse"
        known: dict[str, Tone] = {"worse": "worse", "better": "better", "undecided": "unclear"}
        return known.get(stated, "neutral")
    difference = finite(entry.get("diff"))
    bounds = interval(entry.get("ci95"), difference)
    if difference is None or bounds is None or bounds[0] <= 0.0 <= bounds[1]:
        return "unclear"
    if direction not in ("lower", "higher"):
        return "neutral"
    return "worse" if (difference > 0) == (direction == "lower") else "better"


def _questions(run: Run, pairs: Mapping[str, Any]) -> list[str]:
    """Return the metrics whose differences the head of a report is about."""
    known = [name for name in pairs if finite(pairs[name].get("diff")) is not None]
    headline = [name for name in run.table.headline if name in known]
    return without_repeated(headline, "collision_any") or list(run.table.ordered(known))


def without_repeated(names: Sequence[str], dropped: str) -> list[str]:
    """Leave out one of the two collision rates where both are there."""
    both = "collision_any" in names and "collision_at_fault" in names
    return [name for name in names if not (both and name == dropped)]


def _point(
    run: Run,
    variant: str,
    pairs: Mapping[str, Any],
    questions: Sequence[str],
    shown: AbstractSet[str],
    primary: str,
) -> Point:
    """Describe one comparison; a difference that is not shown among so many questions is
    undecided.
    """
    stats = run.summary.get("metrics", {}).get(variant, {})
    baseline = next((str(p["baseline"]) for p in pairs.values() if p.get("baseline")), "")
    name, other = variant_name(run, variant), variant_name(run, baseline) or "the baseline"
    if not questions:
        nothing = f"nothing to compare between {name} and {other}"
        return Point(name, "unclear", NO_PAIR, nothing, "", other, variant)
    tones = {}
    for metric in questions:
        tone = tone_of(pairs[metric], str(stats.get(metric, {}).get("direction", "none")))
        is_chance = tone in ("worse", "better") and metric not in shown
        tones[metric] = "unclear" if is_chance else tone
    asked = [primary] if primary else list(questions)
    others = [metric for metric in questions if metric not in asked]
    worse, better = (
        _listing(run, [metric for metric in asked if tones[metric] == side])
        for side in ("worse", "better")
    )
    where = f" in {_listing(run, asked)}" if primary else ""
    tone = "unclear"
    verdict = f"no difference shown between {name} and {other}{where}"
    if worse and better:
        tone = "mixed"
        verdict = f"{name} is worse than {other} in {worse} and better in {better}"
    elif worse:
        tone = "worse"
        verdict = f"{name} drives worse than {other} in {worse}"
    elif better:
        tone = "better"
        verdict = f"{name} drives better than {other} in {better}"
    elif all(tones[metric] == "neutral" for metric in asked):
        tone = "neutral"
        verdict = f"{name} drives no worse than {other}{where} by more than the margin"
    shown_sides = [metric for metric in asked if tones[metric] in ("worse", "better")]
    if any(pairs[metric].get("verdict") != "worse" for metric in shown_sides):
        verdict += " on these scenes"
    texts = {metric: _difference(run, variant, metric, pairs[metric]) for metric in questions}
    sides = [
        f"{side} in {_listing(run, found)}"
        for side in ("worse", "better")
        if (found := [metric for metric in others if tones[metric] == side])
    ]
    secondary = " and ".join(sides)
    first = next((metric for metric in asked if tones[metric] in ("worse", "better")), asked[0])
    lead = ". Secondary: ".join(part for part in (texts[first], secondary) if part)
    details = "; ".join(texts[metric] for metric in others)
    rest = ": ".join(part for part in (secondary, details) if part)
    asked_text = "; ".join(texts[metric] for metric in asked)
    text = ". Secondary: ".join(part for part in (asked_text, rest) if part)
    return Point(name, tone, text, verdict, lead, other, variant)


def _listing(run: Run, metrics: Sequence[str]) -> str:
    words = [run.table.shown(metric).words for metric in metrics]
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def _difference(run: Run, variant: str, metric: str, entry: Mapping[str, Any]) -> str:
    """Say what both variants have, their difference, its interval, and what would decide it."""
    levels = run.summary.get("metrics", {})
    base = str(entry.get("baseline"))
    if base not in levels:  # with several policies: the same policy behind the baseline's renderer
        base = next((f"{base}/{p}" for p in run.policies if variant.endswith(f"/{p}")), base)
    facts = run.table.shown(metric)
    here, there = _level(run, variant, metric), _level(run, base, metric)
    return f"{facts.words}: {here} against {there} ({difference_text(entry, facts)})"


def _level(run: Run, variant: str, metric: str) -> str:
    stats = run.summary.get("metrics", {}).get(variant, {}).get(metric, {})
    mean, facts = finite(stats.get("mean")), run.table.shown(metric)
    if mean is None:
        return "no valid value"
    counted = count_of(mean, int(stats.get("n_rollouts") or 0)) if facts.is_flag else ""
    if counted:
        return counted
    if facts.is_flag or facts.in_percent:
        return f"{short(100 * mean)}\u00a0%"
    return short(mean, str(stats.get("unit", "")))


def _alone(run: Run, variant: str) -> str:
    stats = run.summary.get("metrics", {}).get(variant, {})
    names = [
        name
        for name in run.table.headline
        if name in stats and name not in ("progress", run.table.primary)
    ]
    names = without_repeated(names, "collision_at_fault")
    texts = [f"{run.table.shown(name).words}: {_level(run, variant, name)}" for name in names]
    return "; ".join(texts) or "no metric"


def _cautions(run: Run) -> tuple[str, ...]:
    cautions = [*fixer_cautions(run.summary)]
    failed = Counter(r.failure_class or "unknown cause" for r in run.rollouts if not r.ok)
    if failed:
        causes = ", ".join(f"{name} {count}" for name, count in failed.most_common())
        cautions.append(
            f"{failed.total()} of {plural(len(run.rollouts), 'rollout')} could not be run "
            f"({causes}); they are in no average. See Failures."
        )
    repeat = run.info.get("repeat") or {}
    if repeat.get("repeatable") is False:
        first = repeat.get("first_difference") or {"component": "log", "step": None}
        step = "" if first["step"] is None else f" at step {first['step']}"
        cautions.append(
            "The policy is not repeatable: a rollout that was driven twice differs first in "
            f"{first['component']}{step}. Paired differences hold that noise too."
        )
    scenes = {rollout.scene for rollout in run.rollouts if rollout.ok}
    if len(scenes) == 1:
        cautions.append(
            "One scene only: the result says nothing about other scenes, and no interval over "
            "scenes exists."
        )
    elif 1 < len(scenes) < FEW_SCENES:
        cautions.append(
            f"Only {len(scenes)} scenes: intervals over scenes are wide and lean on few values."
        )
    return tuple(cautions)

"""Summarise a run in one sentence, from the numbers of ``summary.json`` alone.

The verdict words come from the paired comparison; this module never tests anything itself, so that
the sentence and the table below it cannot disagree. The sentence answers the one question that the
run declared before it was driven (`MetricTable.primary`); what else is found stands behind it as
secondary.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from alpasim_plugin.log.run_folder.shapes import pair_tables
from evaluators.opening import Run
from evaluators.report.fixers import fixer_cautions
from evaluators.report.numbers import count_of, decimals, finite, fixed, interval, plural, short
from evaluators.report.provenance import repeat_caution
from evaluators.statistics.outcomes import outcome_table, sentence
from evaluators.statistics.verdicts import holm

Tone = Literal["worse", "better", "mixed", "unclear", "neutral", "broken"]

MANY_SCENES = 1000  # an estimate beyond this says no more than "many"
LEVEL = 0.05  # of the primary question, and of all others together
LEADING = 4  # arms named in the headline
FEW_SCENES = 10  # below this an interval over scenes leans heavily on its assumptions


@dataclass(frozen=True)
class Point:
    """What was found for one arm.

    Attributes:
        name: What sentences call it.
        tone: Of its differences.
        text: What they are.
        worse, better: Metrics that the headline names as that.
        asked: Metrics that the headline is about; empty: all that are compared.
        baseline: What it is compared with; empty where with nothing.
        lead: The one difference that says most, with its interval.
        variant: Its key in ``summary.json``.
    """

    name: str
    tone: Tone
    text: str
    worse: tuple[str, ...] = ()
    better: tuple[str, ...] = ()
    asked: tuple[str, ...] = ()
    baseline: str = ""
    lead: str = ""
    variant: str = ""


@dataclass(frozen=True)
class Finding:
    """The head of a report: how the drives ended, what differs between arms, one point per
    comparison, and caveats.

    Attributes:
        title: The differences; of one arm alone how its drives ended.
        tone: Of the differences.
        points: What was compared.
        cautions: What a reader must know.
        outcomes: Arm, as it is called in the run, and how its drives ended.
    """

    title: str
    tone: Tone
    points: tuple[Point, ...] = ()
    cautions: tuple[str, ...] = ()
    outcomes: tuple[tuple[str, str], ...] = ()

    @property
    def head(self) -> str:
        """Give how the drives of all arms ended, in one sentence; the differences where there are
        none.
        """
        if len(self.outcomes) < 2:
            return self.title
        shown = "; ".join(f"{name}: {text}" for name, text in self.outcomes[:LEADING])
        return shown + (
            f"; and {len(self.outcomes) - LEADING} more" if len(self.outcomes) > LEADING else ""
        )

    def name_of(self, point: Point) -> str:
        """Name a point; with what it is compared where not all are with the same."""
        several = len({one.baseline for one in self.points}) > 1
        return f"{point.name} \u2212 {point.baseline}" if several and point.baseline else point.name


def find(run: Run) -> Finding:
    """Derive the main finding of a run."""
    done = sum(r.ok for r in run.rollouts)
    if not run.rollouts:
        return Finding("Nothing was run: the run folder holds no rollouts", "broken")
    ended = endings(run)
    if done == 0:
        return Finding(
            f"Nothing could be scored: all {plural(len(run.rollouts), 'rollout')} failed",
            "broken",
            (),
            _cautions(run),
            ended,
        )
    compared = list(pair_tables(run.summary))
    asked = {
        (i, m): p
        for i, (_, pairs) in enumerate(compared)
        for m in _lead(run, pairs)
        if (p := finite(pairs[m].get("p_value"))) is not None
    }
    primary = declared(run, compared)
    families = [
        [key for key in asked if (key[1] == primary) == first] for first in (True, False)
    ]  # one comparison: at the full level
    shown = {
        key
        for keys in families
        for key, p in zip(keys, holm([asked[key] for key in keys]), strict=True)
        if (p or 0.0) <= LEVEL
    }
    points = tuple(
        _paired_point(
            run,
            variant,
            pairs,
            frozenset(m for j, m in asked if i == j and (j, m) not in shown),
            primary,
        )
        for i, (variant, pairs) in enumerate(compared)
    )
    cautions = _cautions(run)
    if compared and run.table.primary and not primary:
        text = f"Not every comparison has a value of the primary question, {run.table.shown(run.table.primary).words}"
        cautions += (f"{text}: the headline is about all questions, corrected together.",)
    if points:
        title = "; ".join(_clause(run, point) for point in points[:3])
        title += f"; and {len(points) - 3} more" if len(points) > 3 else ""
        tones = {point.tone for point in points}
        order: tuple[Tone, ...] = ("worse", "mixed", "better", "unclear", "neutral")
        tone = next(t for t in order if t in tones)
        return Finding(
            title[0].upper() + title[1:] if points[0].tone == "unclear" else title,
            tone,
            points,
            cautions,
            ended,
        )
    title = (
        f"{ended[0][0]}: {ended[0][1]}"
        if len(ended) == 1
        else f"{plural(len(ended), 'arm')} driven, none of which can be paired"
    )
    alone = tuple(
        Point(arm_label(run, name), "neutral", _alone(run, name), variant=name)
        for name in run.variants
    )
    return Finding(title, "neutral", alone, cautions, ended)


def declared(run: Run, compared: Sequence[tuple[str, Mapping[str, Any]]]) -> str:
    """Return the metric of the run's primary question; empty where it declared none, or not every
    comparison has a value of it.

    Then the headline is about all questions, corrected together: which one answers it may not
    depend on what was found.
    """
    primary = run.table.primary
    return primary if all(primary in _lead(run, pairs) for _, pairs in compared) else ""


def endings(run: Run) -> tuple[tuple[str, str], ...]:
    """Return each arm, as it is called in the run, and how its drives ended; without times in runs
    of earlier versions.
    """
    table = run.summary.get("outcomes") or outcome_table(run.rollouts)
    return tuple((arm_label(run, name), sentence(entry)) for name, entry in table.items())


def arm_label(run: Run, name: str) -> str:
    """Return what sentences call an arm: its policy where a run has one renderer, its renderer
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


def _clause(run: Run, point: Point) -> str:
    baseline = point.baseline
    if point.tone == "worse":
        return f"{point.name} drives worse than {baseline} in {_listing(run, point.worse)}"
    if point.tone == "better":
        return f"{point.name} drives better than {baseline} in {_listing(run, point.better)}"
    if point.tone == "mixed":
        return f"{point.name} is worse than {baseline} in {_listing(run, point.worse)} and better in {_listing(run, point.better)}"
    if point.tone == "neutral":
        where = (
            f"in {_listing(run, point.asked)} by more than the margin"
            if point.asked
            else "by more than the margins"
        )
        return f"{point.name} drives no worse than {baseline} {where}"
    if point.text == NO_PAIR:
        return f"nothing to compare between {point.name} and {baseline}"
    where = f" in {_listing(run, point.asked)}" if point.asked else ""
    return f"no difference shown between {point.name} and {baseline}{where}"


NO_PAIR = "no metric is valid in both members of any pair"


def _listing(run: Run, metrics: Sequence[str]) -> str:
    words = [run.table.shown(m).words for m in metrics]
    return words[0] if len(words) == 1 else ", ".join(words[:-1]) + " and " + words[-1]


def _lead(run: Run, pairs: Mapping[str, Any]) -> list[str]:
    """Return the differences that a head of a report asks for."""
    lead = [
        m for m in run.table.headline if m in pairs and finite(pairs[m].get("diff")) is not None
    ]
    if "collision_at_fault" in lead and "collision_any" in lead:
        lead.remove("collision_any")
    return lead or [m for m in run.table.ordered(pairs) if finite(pairs[m].get("diff")) is not None]


def _paired_point(
    run: Run, variant: str, pairs: Mapping[str, Any], chance: frozenset[str], primary: str
) -> Point:
    """Describe one comparison; what may be chance among so many questions is called undecided."""
    stats = run.summary.get("metrics", {}).get(variant, {})
    lead = _lead(run, pairs)
    tones = {m: tone_of(pairs[m], str(stats.get(m, {}).get("direction", "none"))) for m in lead}
    tones = {
        m: "unclear" if m in chance and tone in ("worse", "better") else tone
        for m, tone in tones.items()
    }
    asked = (primary,) if primary else ()
    named = asked or lead
    kinds = {tones[m] for m in named if tones[m] in ("worse", "better")}
    tone: Tone = "mixed" if len(kinds) == 2 else next(iter(kinds)) if kinds else "unclear"
    if not kinds and named and all(tones[m] == "neutral" for m in named):
        tone = "neutral"
    said = [m for m in lead if tones[m] in ("worse", "better")]
    others = [m for m in lead if m not in named]

    def described(names: Sequence[str]) -> str:
        moved = [
            m
            for m in names
            if m in said or (m != "progress" and finite(pairs[m].get("diff")) != 0.0)
        ]
        parts = [
            _difference(
                run,
                variant,
                m,
                pairs[m],
                brief=bool(said) and tones[m] == "unclear" and m != primary,
            )
            for m in sorted(moved, key=lambda m: m not in said)
        ]
        return "; ".join(
            parts
            + [
                _nothing_seen(run, variant, m, pairs[m])
                for m in names
                if m not in moved and m != "progress"
            ]
        )

    worse, better = ([m for m in said if tones[m] == kind] for kind in ("worse", "better"))
    baseline = str(
        next((p.get("baseline") for p in pairs.values() if p.get("baseline")), "the baseline")
    )
    text, lines = (
        described(named),
        {m: _difference(run, variant, m, pairs[m], brief=False) for m in lead},
    )
    if primary:
        ways = (
            (kind, [m for m in of if m != primary])
            for kind, of in (("worse", worse), ("better", better))
        )
        found = [f"{kind} in {_listing(run, of)}" for kind, of in ways if of]
        second = f". Secondary: {' and '.join(found)}" if found else ""
        first, rest = lines[primary] + second, described(others)
        text += (second or ". Secondary") + (f": {rest}" if rest else "") if rest or found else ""
    else:
        # The first difference that is shown says most; where none is, the one that is largest
        # against its margin.
        def against_margin(m: str) -> float:
            return abs(float(pairs[m]["diff"])) / max(finite(pairs[m].get("margin")) or 0.0, 1e-3)

        shown = [m for m in lead if pairs[m].get("difference") in ("better", "worse")]
        first = lines.get(next(iter(shown), max(lead, key=against_margin, default="")), "")
    worse_here, better_here = (tuple(m for m in of if m in named) for of in (worse, better))
    return Point(
        arm_label(run, variant),
        tone,
        text or NO_PAIR,
        worse_here,
        better_here,
        asked,
        arm_label(run, baseline),
        first,
        variant,
    )


def _nothing_seen(run: Run, variant: str, metric: str, entry: Mapping[str, Any]) -> str:
    """Say what a difference of zero excludes, and what not."""
    facts, level = run.table.shown(metric), _level(run, variant, metric)
    bounds = interval(entry.get("ci95"), 0.0)
    if bounds is None:
        return f"{facts.words}: {level} in both; one scene excludes no difference"
    scale, unit = (100.0, "points") if facts.in_percent else (1.0, str(entry.get("unit") or ""))
    low, high = -bounds[0] * scale, bounds[1] * scale
    places = 1 if scale == 100.0 else decimals(low, high, digits=3)
    ends = (
        fixed(high, places)
        if fixed(high, places) == fixed(low, places)
        else f"+{fixed(high, places)} or \u2212{fixed(low, places)}"
    )
    return f"{facts.words}: {level} in both; a difference beyond {ends}\u00a0{unit} is excluded, a smaller one is not".replace(
        "\u00a0 ", " "
    )


def _difference(run: Run, variant: str, metric: str, entry: Mapping[str, Any], brief: bool) -> str:
    here, there = (
        _level(run, name, metric)
        for name in (variant, _baseline_variant(run, variant, str(entry.get("baseline"))))
    )
    facts = run.table.shown(metric)
    if brief:
        return f"{facts.words}: {here} against {there}, undecided"
    stats = run.summary.get("metrics", {}).get(variant, {}).get(metric, {})
    unit = str(stats.get("unit", ""))
    scale, unit = (100.0, "points") if facts.in_percent else (1.0, unit)
    difference = float(entry["diff"]) * scale
    bounds = interval(entry.get("ci95"), float(entry["diff"]))
    ends = (bounds[0] * scale, bounds[1] * scale) if bounds else ()
    places = 1 if scale == 100.0 else decimals(difference, *ends, digits=3)
    tail = f"\u00a0{unit}" if unit else ""
    text = f"{facts.words}: {here} against {there} ({fixed(difference, places, sign=True)}{tail}"
    if ends:
        text += f", 95\u00a0% interval {fixed(ends[0], places, sign=True)} to {fixed(ends[1], places, sign=True)}"
    needed = more_scenes_text(entry.get("more_scenes"))
    margin = finite(entry.get("margin"))
    if needed and margin is not None:
        text += f"; {needed} on the margin of {short(margin * scale, unit)}"
    return f"{text})"


def _baseline_variant(run: Run, variant: str, baseline: str) -> str:
    """Return the key of a variant's baseline in ``summary.json``: RENDERER, or with several
    policies RENDERER/POLICY of the same policy.
    """
    if baseline in run.summary.get("metrics", {}):
        return baseline
    return next(
        (f"{baseline}/{policy}" for policy in run.policies if variant.endswith(f"/{policy}")),
        baseline,
    )


def more_scenes_text(more: Any) -> str:
    """Say how many more scenes would decide an undecided verdict; empty where that is unknown."""
    if not isinstance(more, int) or more <= 0:
        return ""
    if more > MANY_SCENES:
        return f"more than {MANY_SCENES} more scenes would decide"
    return f"about {plural(more, 'more scene')} would decide"


def _level(run: Run, variant: str, metric: str) -> str:
    stats = run.summary.get("metrics", {}).get(variant, {}).get(metric, {})
    mean, unit = finite(stats.get("mean")), str(stats.get("unit", ""))
    if mean is None:
        return "no valid value"
    if run.table.shown(metric).is_flag:
        counted = count_of(mean, int(stats.get("n_rollouts") or 0))
        return counted if counted else f"{short(100 * mean)}\u00a0%"
    return (
        f"{short(100 * mean)}\u00a0%" if run.table.shown(metric).in_percent else short(mean, unit)
    )


def _alone(run: Run, variant: str) -> str:
    stats = run.summary.get("metrics", {}).get(variant, {})
    names = [
        m for m in run.table.headline if m in stats and m not in ("progress", run.table.primary)
    ]
    if "collision_at_fault" in names and "collision_any" in names:
        names.remove("collision_at_fault")
    return (
        "; ".join(f"{run.table.shown(m).words}: {_level(run, variant, m)}" for m in names)
        or "no metric"
    )


def _cautions(run: Run) -> tuple[str, ...]:
    said = [*fixer_cautions(run.summary), *(f"{line}." for line in plan_warnings(run.summary))]
    failed = [r for r in run.rollouts if not r.ok]
    if failed:
        classes: dict[str, int] = {}
        for rollout in failed:
            name = rollout.failure_class or "unknown cause"
            classes[name] = classes.get(name, 0) + 1
        causes = ", ".join(
            f"{name} {n}" for name, n in sorted(classes.items(), key=lambda item: -item[1])
        )
        said.append(
            f"{len(failed)} of {plural(len(run.rollouts), 'rollout')} could not be run ({causes}); they are in no average. See Failures."
        )
    said += repeat_caution(run)
    scenes = {r.scene for r in run.rollouts if r.ok}
    if len(scenes) == 1:
        said.append(
            "One scene only: the result says nothing about other scenes, and no interval over scenes exists."
        )
    elif 1 < len(scenes) < FEW_SCENES:
        said.append(
            f"Only {len(scenes)} scenes: intervals over scenes are wide and lean on few values."
        )
    return tuple(said)


def plan_warnings(summary: Mapping[str, Any]) -> list[str]:
    """Say in one sentence each whose plans do not fit the vehicle; variants with the same sentence
    share it.
    """
    by_text: dict[str, list[str]] = {}
    for name, entry in (summary.get("plans") or {}).items():
        if entry.get("warning"):
            by_text.setdefault(str(entry["warning"]), []).append(name)
    return [
        f"{', '.join(names)}: {text} (simrun check policy tests units)"
        for text, names in by_text.items()
    ]

"""The one table of a run: how the rollouts of each variant ended, its primary rate and how that
differs from its baseline's, its distance and its frame time. The terminal, report.html, summary.md
and gate.md print this object.

A difference is called what the paired comparison says and its correction for several variants
(`evaluators.statistics.verdicts`) leaves; nothing is tested here.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from alpasim_plugin.core.files import some_of
from alpasim_plugin.core.json_types import JsonView
from alpasim_plugin.log.run_folder.shapes import pair_tables
from evaluators.metrics.outcomes import NO_OUTCOME, NOT_RUN, OUTCOMES, REACHED_END, SHORT_OF_END
from evaluators.pages.decision import verdict_text
from evaluators.pages.fixers import fixer_cautions
from evaluators.statistics.decision import read_decision
from evaluators.statistics.numbers import (
    DASH,
    count_of,
    finite,
    fixed,
    interval,
    plural,
    printed,
    scale_and_unit,
    short,
)
from evaluators.statistics.opening import Run
from evaluators.statistics.outcomes import DISTANCE, outcome_table
from evaluators.statistics.sentences import MANY_SCENES
from evaluators.statistics.verdicts import shown_questions

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
COLUMNS = (REACHED_END, "collision", "off-road", "stalled", OUTCOMES["policy"].words)
NUMBERS = ("primary rate", "median dist. m", "ms a frame")
VERDICTS: Mapping[Tone, str] = {
    "worse": "drives worse than",
    "better": "drives better than",
    "neutral": "drives no worse, by the margin, than",
}
PLACES = 2  # of failures that are named


@dataclass(frozen=True)
class Difference:
    """A variant's primary metric minus its baseline's, in printed units.

    Attributes:
        bounds: 95 % interval over scenes; None with one scene.
        verdict: What a sentence about the variant says, unless it is undecided.
        more_scenes: How many more would decide; None where it is decided, or not known.
    """

    baseline: str
    centre: float
    bounds: tuple[float, float] | None
    margin: float
    tone: Tone
    verdict: str
    text: str
    n_scenes: int
    more_scenes: int | None


@dataclass(frozen=True)
class VariantRow:
    """One variant.

    Attributes:
        key: In ``summary.json``.
        name: What people call it.
        endings: How many of its rollouts ended in which way, the best first.
        primary: Its primary rate, as a count where it is one.
        difference: None for a baseline, and where no rollouts can be paired.
        distance: Median of its distance from the logged path.
        is_cut_short: Steps after an event are not in that distance.
        places: Ending -> scene and time of its failures, the gravest first.
    """

    key: str
    name: str
    endings: Mapping[str, int]
    primary: str
    difference: Difference | None
    distance: str
    is_cut_short: bool
    frame_ms: str
    places: Mapping[str, Sequence[str]]

    @property
    def n_rollouts(self) -> int:
        """Count its rollouts."""
        return sum(self.endings.values())

    @property
    def n_failed(self) -> int:
        """Count its rollouts that had an outcome or could not be run."""
        return sum(n for name, n in self.endings.items() if name not in UNHARMED)

    @property
    def where(self) -> str:
        """Give its first failures in words."""
        texts = []
        for ending, cells in self.places.items():
            more = f" and {len(cells) - PLACES} more" if len(cells) > PLACES else ""
            texts.append(f"{ending} in {', '.join(cells[:PLACES])}{more}")
        lost = self.endings.get(NOT_RUN)
        return "; ".join([*texts, *([f"{lost} not run"] if lost else [])])


@dataclass(frozen=True)
class Overview:
    """The first screen of a run.

    Attributes:
        context: Suite, preset, size and what all variants share.
        question: What the primary metric is.
        unit: Of the differences.
        decision: What is decided about the differences.
        cautions: What a reader must know.
    """

    context: str
    rows: tuple[VariantRow, ...]
    question: str
    unit: str
    higher_is_better: bool
    decision: str
    cautions: tuple[str, ...]

    @property
    def failing(self) -> list[VariantRow]:
        """List the variants with a failed rollout, the worst first."""
        failing = [row for row in self.rows if row.n_failed]
        return sorted(failing, key=lambda row: -row.n_failed / row.n_rollouts)

    @property
    def badge(self) -> tuple[str, Tone]:
        """Give how many variants fail and how many rollouts end early, and its colour."""
        if not self.rows:
            return "no rollouts", "unclear"
        n_short = sum(row.endings.get(SHORT_OF_END, 0) for row in self.rows)
        n_rollouts = sum(row.n_rollouts for row in self.rows)
        n = len(self.failing)
        total = plural(len(self.rows), "variant")
        if len(self.rows) == 1:
            n = self.rows[0].n_failed
            total = plural(n_rollouts, "rollout")
        tone: Tone = "worse" if n else "unclear" if n_short else "better"
        text = f"{n} of {total} fail{'s' if n == 1 else ''}" if n else f"no failure in {total}"
        if n_short:
            text += f"; end not reached in {n_short} of {plural(n_rollouts, 'rollout')}"
        return text, tone

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
        share = f"in {worst.n_failed} of {plural(worst.n_rollouts, 'rollout')}"
        return f"{worst.name} fails {most}{share}: {worst.where}"

    @property
    def endings(self) -> list[tuple[str, tuple[str, ...]]]:
        """List the columns of endings with what each counts: those that every table has, and one
        for all others that occur.
        """
        known = dict.fromkeys(name for row in self.rows for name in row.endings)
        columns: list[tuple[str, tuple[str, ...]]] = [(name, (name,)) for name in COLUMNS]
        others = tuple(name for name in known if name not in COLUMNS)
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
        notes = [f"primary rate: {self.question}"]
        _, others = self.endings[-1]
        if len(others) > 1:
            notes.append(f"other: {', '.join(others)}")
        if any(row.is_cut_short for row in self.rows):
            notes.append("*: cut short by an event")
        return notes

    @property
    def axis(self) -> str:
        """Say what the differences are and which side is worse; empty without any."""
        found = [row.difference for row in self.rows if row.difference is not None]
        if not found:
            return ""
        margin = f", band: margin of {found[0].margin:g}" if found[0].margin else ""
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
        found = [row.difference for row in self.rows if row.difference is not None]
        ends = [0.0]
        for one in found:
            ends += [one.centre, one.margin, -one.margin, *(one.bounds or ())]
        room = 0.04 * (max(ends) - min(ends)) or 1.0
        return min(ends) - room, max(ends) + room

    def share(self, value: float) -> float:
        """Return where a difference lies on the axis, in [0, 1]."""
        low, high = self.limits
        return (value - low) / (high - low)


def overview_of(run: Run) -> Overview:
    """Lay out the first screen of a run."""
    table = run.summary.get("outcomes") or outcome_table(run.rollouts)
    decision = read_decision(run.folder)
    boundary = run.summary.get("boundary")
    is_sequential = decision is not None or boundary is not None
    differences = {} if is_sequential else differences_of(run)
    rows = tuple(_row(run, name, entry, differences) for name, entry in table.items())
    primary = run.table.shown(run.table.primary)
    asked = run.info.get("asked") or ()
    size = (plural(len(run.scenes), "scene"), plural(len(run.info.get("seeds") or ()), "seed"))
    named = some_of(asked, 2)
    parts = [*([named] if named else []), str(run.summary.get("preset")), " \u00d7 ".join(size)]
    if len(run.policies) == 1:
        parts.append(f"policy {run.policies[0]}")
    elif len(run.renderers) == 1:
        parts.append(f"renderer {run.renderers[0]}")
    cautions = fixer_cautions(run.summary)
    copies = run.summary.get("copies")
    if copies:
        cautions.append(
            f"{copies} of {plural(len(run.rollouts), 'rollout')} are copies: "
            "a policy without a camera drives once for all renderers."
        )
    repeat = run.info.get("repeat") or {}
    if repeat.get("repeatable") is False:
        first = repeat.get("first_difference") or {"component": "log", "step": None}
        step = "" if first["step"] is None else f" at step {first['step']}"
        cautions.append(
            "The policy is not repeatable: a rollout that was driven twice differs first in "
            f"{first['component']}{step}. Paired differences hold that noise too."
        )
    return Overview(
        " \u00b7 ".join(parts),
        rows,
        primary.words,
        scale_and_unit(primary, primary.unit)[1],
        primary.direction == "higher",
        boundary["sentence"]
        if boundary
        else decided(rows)
        if decision is None
        else verdict_text(decision),
        tuple(cautions),
    )


def variant_name(run: Run, name: str) -> str:
    """Return what people call a variant: its policy where a run has one renderer and several
    policies, its renderer where it has one policy, else both.
    """
    if len(run.renderers) == 1 and len(run.policies) > 1:
        return name.removeprefix(f"{run.renderers[0]}/")
    return name.removesuffix(f"/{run.policies[0]}") if len(run.policies) == 1 else name


def tone_of(entry: JsonView) -> Tone:
    """Give the tone of one metric of ``summary.json``'s ``paired``.

    Neutral means non-inferior: no worse than its margin, and not shown to be better.
    """
    stated = entry.get("verdict")
    shown = entry.get("difference")
    if shown == "better" or (shown == "worse" and stated != "non-inferior"):
        return "better" if shown == "better" else "worse"
    known: dict[str, Tone] = {"worse": "worse", "undecided": "unclear"}
    return known.get(str(stated), "neutral")


def differences_of(run: Run) -> dict[str, Difference]:
    """Return KEY of ``summary.json`` -> the primary difference of that variant: to the baseline's
    renderer where there are several, else to its policy.
    """
    metric = run.table.shown(run.table.primary)
    tables = pair_tables(run.summary)
    entries = [(key, pairs.get(metric.name) or {}) for key, pairs in tables]
    p_values = {
        (number, metric.name): finite(entry.get("p_value"))
        for number, (_, entry) in enumerate(entries)
        if finite(entry.get("diff")) is not None
    }
    shown = shown_questions(p_values, metric.name)
    of_renderers = len(run.summary.get("paired") or ())
    scale, _ = scale_and_unit(metric, metric.unit)
    found: dict[str, Difference] = {}
    for number, metric_name in p_values:
        key, entry = entries[number]
        if key in found or (of_renderers and number >= of_renderers):
            continue
        tone = tone_of(entry)
        if tone in ("worse", "better") and (number, metric_name) not in shown:
            tone = "unclear"
        bounds = interval(entry.get("ci95"))
        values = [float(entry["diff"]), *(bounds or ())]
        texts = printed(metric, *values, sign=True)
        baseline = variant_name(run, str(entry.get("baseline") or "the baseline"))
        verdict = f"{VERDICTS.get(tone, '')} {baseline}"
        if tone in ("worse", "better") and entry.get("verdict") != "worse":
            verdict += " on these scenes"
        found[key] = Difference(
            baseline,
            scale * values[0],
            (scale * bounds[0], scale * bounds[1]) if bounds else None,
            scale * (finite(entry.get("margin")) or 0.0),
            tone,
            verdict,
            f"{texts[0]} ({' to '.join(texts[1:])})" if bounds else texts[0],
            int(entry.get("n_scenes") or 0),
            entry.get("more_scenes") if tone == "unclear" else None,
        )
    return found


def decided(rows: Sequence[VariantRow]) -> str:
    """Say once what is decided about the differences, and about how many scenes would decide the
    rest; empty without any.
    """
    found = {row.name: row.difference for row in rows if row.difference is not None}
    said: dict[str, list[str]] = {}
    for tone in VERDICTS:
        for name, one in found.items():
            if one.tone == tone:
                said.setdefault(one.verdict, []).append(name)
    parts = [f"{', '.join(names)} {verdict}" for verdict, names in said.items()]
    still_open = {name: one for name, one in found.items() if one.tone == "unclear"}
    if still_open:
        text = (
            f"Not decided with {plural(min(one.n_scenes for one in still_open.values()), 'scene')}"
        )
        if parts:
            text += f": {', '.join(still_open)}"
        needed = [
            one.n_scenes + one.more_scenes
            for one in still_open.values()
            if one.more_scenes is not None
        ]
        if needed:
            most = max(needed)
            text += f"; {'more than' if most > MANY_SCENES else 'at least'} "
            text += f"{min(most, MANY_SCENES)} scenes are needed"
        parts.append(text)
    return ". ".join(parts)


def _row(
    run: Run, variant: str, entry: JsonView, differences: Mapping[str, Difference]
) -> VariantRow:
    metrics = run.summary.get("metrics") or {}
    renderer = variant.removesuffix(f"/{run.policies[0]}") if len(run.policies) == 1 else variant
    key = variant if variant in metrics else renderer
    primary = metrics.get(key, {}).get(run.table.primary) or {}
    mean = finite(primary.get("mean"))
    n = int(primary.get("n_rollouts") or 0)
    rate = DASH
    if mean is not None:
        in_percent = run.table.shown(run.table.primary).in_percent
        rate = f"{short(100 * mean)}\u00a0%" if in_percent else short(mean)
        rate = count_of(mean, n) or rate
    censored = (run.summary.get("censoring") or {}).get(key) or {}
    cut_steps = [censored.get(name) or 0 for name in ("steps_after_event", "steps_after_drift")]
    mean_ms = finite(((run.summary.get("speed") or {}).get(key) or {}).get("ms_per_frame_mean"))
    median_m = finite(entry.get(f"{DISTANCE}_median"))
    # The failures of a variant by their ending, the gravest first.
    places: dict[str, list[str]] = {}
    for metric, facts in entry["outcomes"].items():
        outcome = OUTCOMES[metric]
        for cell in facts["cells"]:
            seed = f" seed {cell['seed']}" if cell["seed"] else ""
            when = "" if cell["t_s"] is None else f" at {cell['t_s']:.1f}\u00a0s"
            ending = places.setdefault(outcome.ending or outcome.words, [])
            ending.append(f"{cell['scene']}{seed}{when}")
    return VariantRow(
        key,
        variant_name(run, variant),
        entry["endings"],
        rate,
        differences.get(key),
        DASH if median_m is None else fixed(median_m, 2),
        median_m is not None and sum(cut_steps) > 0,
        DASH if mean_ms is None else fixed(mean_ms, 0 if mean_ms >= 10 else 1),
        places,
    )

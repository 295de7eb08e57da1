"""What a run was found to be, at the head of its report: by a gate, kept in the run folder, or by a
decision that ended the run.

Of a gate: verdict, baseline, every check, the worst scenes first. Of a decision: the last lines on
a terminal, the section with its picture, and the gate's verdict on a run decided so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.core.atomic import write_json
from alpasim_plugin.core.checksums import checksums_of
from alpasim_plugin.log.run_folder.reader import read_json
from alpasim_plugin.log.run_folder.schema import ROLLOUTS, WHY_NAME
from alpasim_plugin.log.run_folder.sides import Row, value_of
from evaluators.metrics import METRICS, MetricInfo, MetricTable
from evaluators.opening import Run
from evaluators.report.numbers import decimals, fixed, short
from evaluators.report.terminal import LABEL, labelled
from evaluators.statistics.arms import Arm, short_name
from evaluators.statistics.baselines import rows_of_run
from evaluators.statistics.decision import CAUSES, Decision, read_decision
from evaluators.statistics.gate import Check, GateVerdict
from evaluators.statistics.verdicts import WORDS

GATE_NAME = "gate.json"
WORST = 5  # scenes of a check that are named
TONES = {"pass": "better", "regression": "worse", "undecided": "unclear"}
WORST_CASE = "any bound"


def write_gate(
    run: Run, verdict: GateVerdict, gate: str, worst: Sequence[Mapping[str, Any]]
) -> Path:
    """Keep a verdict in the run folder, for its report, and return the file.

    Args:
        run: The run that was judged.
        verdict: What `evaluators.statistics.gate.judge` gave.
        gate: Name or file of the gate.
        worst: As `worst_of` gives it.
    """
    write_json(
        run.folder / GATE_NAME,
        {"of": _content(run), "gate": gate, "worst": list(worst), **verdict.as_dict()},
    )
    return run.folder / GATE_NAME


def worst_of(
    run: Run, verdict: GateVerdict, stored: Sequence[Row] | None = None
) -> list[dict[str, Any]]:
    """Return the pairs that did worst in every check that did not pass, once each, those of a shown
    regression first.

    Args:
        run: The run.
        verdict: Of a gate.
        stored: Rows of a stored baseline.
    """
    rows = rows_of_run(run)
    base_rows = rows if stored is None else stored
    checks = sorted(
        (check for check in verdict.checks if check.cause != "pass"),
        key=lambda check: check.cause != "regression",
    )
    pairs: dict[tuple[str, ...], dict[str, Any]] = {}
    for check in checks:
        for pair in worst_pairs(check, run, rows, base_rows):
            name = tuple(
                str(pair[key]) for key in ("metric", "renderer", "policy", "scene", "seed")
            )
            if name not in pairs:
                pairs[name] = pair
            elif (
                pairs[name]["was"] is None
            ):  # a limit has no baseline, the margin of the same metric has
                pairs[name] |= {"was": pair["was"]}
    return list(pairs.values())


def _content(run: Run) -> str:
    """Return the digest of the rollouts' table: a verdict on other rollouts is not shown."""
    return str(checksums_of(run.folder, [ROLLOUTS])[ROLLOUTS]["sha256"])


def worst_pairs(
    check: Check, run: Run, rows: Sequence[Row], base_rows: Sequence[Row]
) -> list[dict[str, Any]]:
    """Return the pairs in which an arm did worst against its baseline, or its worst rollouts where
    a limit is broken.

    Args:
        check: One that did not pass.
        run: The run, whose table says which side is better.
        rows, base_rows: Rollouts of the run and of the baseline.
    """
    arm = Arm(check.renderer, check.policy)
    sign = -1.0 if run.table.info(check.metric).direction == "higher" else 1.0
    was: dict[tuple[str, int], float | None] = {}
    for row in base_rows:
        other = Arm(str(row["renderer"]), str(row["policy"]))
        if check.kind == "margin" and short_name(other, arm) == check.entry["baseline"]:
            was[str(row["scene"]), int(row["seed"])] = value_of(row, check.metric)
    found: list[dict[str, Any]] = []
    for row in rows:
        key, now = (str(row["scene"]), int(row["seed"])), value_of(row, check.metric)
        before = was.get(key)
        if (
            (row["renderer"], row["policy"]) != (check.renderer, check.policy)
            or now is None
            or (check.kind == "margin" and before is None)
        ):
            continue
        worse = sign * (now - (before or 0.0))
        if worse > 0.0:
            pair: dict[str, Any] = {
                "scene": key[0],
                "seed": key[1],
                "was": before,
                "now": now,
                "worse": worse,
            }
            found.append(
                pair | {"metric": check.metric, "renderer": check.renderer, "policy": check.policy}
            )
    return sorted(found, key=lambda pair: -pair["worse"])[:WORST]


@dataclass(frozen=True)
class GateSection:
    """What the report shows.

    Attributes:
        tone: Colour of the verdict.
        checks: A row a check: metric, arm, tone, result, sentence with the numbers.
        worst: A row a pair: scene, seed, metric, value of the baseline, value, where it is shown.
    """

    title: str
    tone: str
    gate: str
    baseline: str
    exit_code: int
    checks: list[tuple[str, str, str, str, str]]
    worst: list[tuple[str, int, str, str, str, str | None]]


def gate_section(run: Run) -> GateSection | None:
    """Return the verdict of the last gate that judged these rollouts; None without one.

    Raises:
        InputError: gate.json is damaged.
    """
    path = run.folder / GATE_NAME
    if not path.is_file():
        return None
    told = read_json(path)
    if told["of"] != _content(run):
        return None
    places = {one.cell: run.href(one, WHY_NAME) or run.href(one) for one in run.rollouts}
    order = {"regression": 0, "undecided": 1}
    checks = sorted(
        told["checks"], key=lambda one: (order.get(one["cause"], 2), not one["binding"])
    )
    return GateSection(
        WORDS[told["outcome"]["cause"]],
        TONES.get(told["outcome"]["cause"], "broken"),
        told["gate"],
        told["baseline"],
        told["outcome"]["exit_code"],
        [
            (
                one["metric"],
                f"{one['renderer']}/{one['policy']}",
                TONES.get(one["cause"], "broken"),
                _result(one),
                one["text"],
            )
            for one in checks
        ],
        [_worst(run, one, places) for one in told["worst"]],
    )


def _result(check: Mapping[str, Any]) -> str:
    return f"{check['cause']}{'' if check['binding'] else ', not binding'}"


def _worst(
    run: Run, pair: Mapping[str, Any], places: Mapping[Any, str | None]
) -> tuple[str, int, str, str, str, str | None]:
    unit = run.table.shown(pair["metric"]).unit
    was, now = (
        "\u2014" if value is None else short(float(value), unit)
        for value in (pair["was"], pair["now"])
    )
    place = places.get((pair["renderer"], pair["policy"], pair["scene"], pair["seed"]))
    return pair["scene"], pair["seed"], pair["metric"], was, now, place


# --- a decision


@dataclass(frozen=True)
class MetricRow:
    """One metric in the report's table, printed."""

    metric: str
    verdict: str
    tone: str
    diff: str
    interval: str
    margin: str
    evidence: str
    n_scenes: int
    binding: bool


def verdict_line(decision: Decision) -> str:
    """Say in one line what was decided, after how much."""
    n, most = len(decision["order"]), decision["ceiling"]
    after = f"after {n} of {most['scenes']} scenes, {decision['rollouts']} of at most {most['rollouts']} rollouts"
    cause = decision["outcome"]["cause"]
    verdict = (
        decision["verdict"]
        if cause in ("pass", "regression", "undecided")
        else WORDS[cause].lower()
    )
    text = f"{decision['candidate']} against {decision['baseline']}: {verdict}, {after}"
    why = "" if decision["stopped"] == "decided" else f" ({decision['stopped']})"
    return labelled("verdict", text + why)


def metric_lines(decision: Decision) -> list[str]:
    """Return one line a metric, and one for the guarantee."""
    lines = []
    for row in metric_rows(decision):
        note = "" if row.binding else ", not binding"
        text = f"{row.metric}: {row.diff} ({row.interval}, margin {row.margin}{note}): {row.verdict}, e-values {row.evidence}"
        lines.append(labelled("", text))
    return [
        *lines,
        *(labelled("error" if i == 0 else "", text) for i, text in enumerate(guarantee(decision))),
    ]


def guarantee(decision: Decision) -> list[str]:
    """Say what is guaranteed, of what, and how far."""
    asked = decision["question"]
    of_what = {
        "scenes": "about the population that the scenes were drawn from",
        "suite": f"about the mean over the {decision['ceiling']['scenes']} scenes of this suite with these seeds",
    }[asked["population"]]
    percent = 100 * asked["alpha"]
    first = f"wrong in at most {percent:g} % of runs, over all interim analyses; {of_what}"
    return [first, asked["rule"]]


def metric_rows(decision: Decision, known: MetricTable = METRICS) -> list[MetricRow]:
    """Return the table of the last look."""
    if not decision["looks"]:
        return []
    last = decision["looks"][-1]["metrics"]
    rows = []
    for name, one in decision["question"]["metrics"].items():
        now = last[name]
        scale, unit, places = _print_as(
            known.info(name), [now["diff"], one["margin"], *now["interval"]]
        )
        ends = [None if v is None else fixed(scale * v, places, sign=True) for v in now["interval"]]
        tone = TONES[CAUSES[now["verdict"]]]
        rows.append(
            MetricRow(
                name,
                now["verdict"],
                tone,
                "no pair"
                if now["diff"] is None
                else f"{fixed(scale * now['diff'], places, sign=True)}{unit}",
                "no bound yet"
                if ends == [None, None]
                else f"{ends[0] or WORST_CASE} to {ends[1] or WORST_CASE}",
                f"{scale * one['margin']:g}",
                f"{now['e_good']:.3g} and {now['e_bad']:.3g}",
                now["n_scenes"],
                one["binding"],
            )
        )
    return rows


@dataclass(frozen=True)
class DecisionSection:
    """What the report shows of a decision."""

    decision: Decision
    title: str
    guarantee: list[str]
    rows: list[MetricRow]
    charts: list[Any]  # evaluators.report.charts.Chart


def decision_section(run: Run) -> DecisionSection | None:
    """Return the section of a decided run, None of any other.

    Raises:
        InputError: decision.json is damaged.
    """
    decision = read_decision(run.folder)
    if decision is None or not decision["looks"]:
        return None
    title = verdict_line(decision)[LABEL:]
    return DecisionSection(
        decision,
        title,
        guarantee(decision),
        metric_rows(decision, run.table),
        [chart(decision, run.table.info(name)) for name in decision["question"]["metrics"]],
    )


def chart(decision: Decision, metric: MetricInfo) -> Any:
    """Draw the confidence sequence of a metric over scenes, with the margin."""
    from evaluators.report.charts import INK, MUTED, VARIANT, Axes, Chart

    name, one = metric.name, decision["question"]["metrics"][metric.name]
    looks = decision["looks"]
    scale, unit, _ = _print_as(metric, [])
    n = np.array([look["n_scenes"] for look in looks], dtype=np.float64)
    seen = [look["metrics"][name] for look in looks]
    diff, low, high = (
        scale * np.array([[one["diff"], *one["interval"]] for one in seen], dtype=np.float64).T
    )  # None becomes NaN
    sign = -1.0 if metric.direction == "higher" else 1.0
    threshold = scale * sign * one["margin"]
    limits = [threshold, -threshold] if metric.direction == "none" else [threshold]
    axes = Axes()
    axes.band(n, low, high, VARIANT[1], 0.2)
    axes.line(n, diff, VARIANT[1])
    axes.points(n, diff, VARIANT[1], size=3.0)
    axes.across(0.0, MUTED, 0.8)
    for limit in limits:
        axes.across(limit, INK, 1.0, "5 2")
    late = len(looks) // 2  # the bounds of the first looks would make the rest flat
    known = np.concatenate([diff, limits, [0.0], low[late:], high[late:]])
    known = known[np.isfinite(known)]
    room = 0.15 * max(float(np.ptp(known)), 1e-9)
    axes.limits = [
        (0.0, float(n[-1]) * 1.02),
        (float(known.min()) - room, float(known.max()) + room),
    ]
    axes.labels = [
        "scenes",
        (f"{unit.strip()}, " if unit.strip() else "")
        + f"{decision['candidate']} minus {decision['baseline']}",
    ]
    return Chart(
        name,
        "Line: mean difference. Band: what is not refuted, at every look. Dashed: the margin.",
        axes.svg(),
    )


def _print_as(metric: MetricInfo, values: Sequence[float | None]) -> tuple[float, str, int]:
    """Return scale, unit and decimals in which a metric's differences are printed."""
    unit = metric.unit
    if metric.in_percent:
        return 100.0, " points", decimals(*(None if v is None else 100.0 * v for v in values))
    return 1.0, f" {unit}" if unit else "", decimals(*values)

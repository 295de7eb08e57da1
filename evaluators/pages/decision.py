"""The decision that ended a sequential run: its lines on the terminal, and its section and charts in
the report.
"""

import numpy as np

from alpasim_plugin.core.json_types import JsonObject
from evaluators.metrics import METRICS, MetricInfo, MetricTable
from evaluators.pages.charts import INK, MUTED, VARIANT, Chart, chart_of, new_axes
from evaluators.pages.gate import tone_of_cause
from evaluators.results import WORDS
from evaluators.statistics.decision import CAUSES, Decision, read_decision
from evaluators.statistics.numbers import labelled, printed, scale_and_unit
from evaluators.statistics.opening import Run
from evaluators.statistics.sentences import beyond_text

WORST_CASE = "any bound"


def verdict_text(decision: Decision) -> str:
    """Say in one line what was decided, after how much."""
    most = decision["ceiling"]
    cause = decision["outcome"]["cause"]
    is_answer = cause in ("pass", "regression", "undecided")
    verdict = decision["verdict"] if is_answer else WORDS[cause].lower()
    text = (
        f"{decision['candidate']} against {decision['baseline']}: {verdict}, after "
        f"{len(decision['order'])} of {most['scenes']} scenes, "
        f"{decision['rollouts']} of at most {most['rollouts']} rollouts"
    )
    stopped = decision["stopped"]
    return text if stopped == "decided" else f"{text} ({stopped})"


def guarantee(decision: Decision) -> list[str]:
    """Say what is guaranteed, of what, and how far."""
    question = decision["question"]
    share = f"{100 * question['alpha']:g} %"
    return [
        f"wrong in at most {share} of runs, over all interim analyses; "
        "about the population that the scenes were drawn from",
        question["rule"],
    ]


def metric_rows(decision: Decision, table: MetricTable = METRICS) -> list[JsonObject]:
    """Return the printed numbers of each metric at the last interim analysis."""
    if not decision["looks"]:
        return []
    last = decision["looks"][-1]["metrics"]
    rows = []
    for name, criterion in decision["question"]["metrics"].items():
        state = last[name]
        facts = table.info(name)
        scale, unit = _scale(facts)
        ends = [value for value in (state["diff"], *state["interval"]) if value is not None]
        texts = iter(printed(facts, criterion["margin"], *ends, sign=True)[1:])
        diff, low, high = (
            None if value is None else next(texts) for value in (state["diff"], *state["interval"])
        )
        interval = f"{low or WORST_CASE} to {high or WORST_CASE}"
        rows.append(
            {
                "metric": name,
                "claim": criterion["claim"],
                "beyond": "" if state["beyond"] is None else beyond_text(state["beyond"]),
                "verdict": state["verdict"],
                "tone": tone_of_cause(CAUSES[state["verdict"]]),
                "diff": "no pair" if diff is None else diff + unit,
                "interval": interval if low or high else "no bound yet",
                "margin": f"{scale * criterion['margin']:g}",
                "evidence": f"{state['e_good']:.3g} and {state['e_bad']:.3g}",
                "n_scenes": state["n_scenes"],
                "binding": criterion["binding"],
            }
        )
    return rows


def decision_lines(decision: Decision) -> list[str]:
    """Return the last lines of a sequential run: verdict, one line a metric, and the guarantee."""
    metrics = [
        f"{row['metric']}: {row['diff']} ({row['claim']}: {row['interval']}, margin {row['margin']}"
        f"{'' if row['binding'] else ', not binding'}): {row['verdict']}, e-values {row['evidence']}"
        f"{'; ' if row['beyond'] else ''}{row['beyond']}"
        for row in metric_rows(decision)
    ]
    error, rule = guarantee(decision)
    return [
        labelled("verdict", verdict_text(decision)),
        *(labelled("", text) for text in metrics),
        labelled("error", error),
        labelled("", rule),
    ]


def decision_section(run: Run) -> JsonObject | None:
    """Return the section of a run that a decision ended, None of any other.

    Raises:
        InputError: decision.json is damaged.
    """
    decision = read_decision(run.folder)
    if decision is None or not decision["looks"]:
        return None
    return {
        "title": verdict_text(decision),
        "guarantee": guarantee(decision),
        "rows": metric_rows(decision, run.table),
        "charts": [
            chart(decision, run.table.info(name)) for name in decision["question"]["metrics"]
        ],
    }


def chart(decision: Decision, metric: MetricInfo) -> Chart:
    """Draw the confidence sequence of a metric over scenes, with the margin."""
    looks = decision["looks"]
    scale, unit = _scale(metric)
    scenes = np.array([look["n_scenes"] for look in looks], dtype=np.float64)
    states = [look["metrics"][metric.name] for look in looks]
    numbers = [[state["diff"], *state["interval"]] for state in states]
    diff, low, high = scale * np.array(numbers, dtype=np.float64).T  # None becomes NaN
    worse = -1.0 if metric.direction == "higher" else 1.0
    margin = scale * worse * decision["question"]["metrics"][metric.name]["margin"]
    limits = [margin, -margin] if metric.direction == "none" else [margin]
    difference = f"{decision['candidate']} minus {decision['baseline']}"
    axes = new_axes("scenes", ", ".join(filter(None, (unit.strip(), difference))))
    axes.fill_between(scenes, low, high, color=VARIANT[1], alpha=0.2, linewidth=0)
    axes.plot(scenes, diff, "o-", color=VARIANT[1], markersize=3.0)
    axes.axhline(0.0, color=MUTED, linewidth=0.8)
    for limit in limits:
        axes.axhline(limit, color=INK, linewidth=1.0, linestyle="dashed")
    late = len(looks) // 2  # the bounds of the first analyses would make the rest flat
    extent = np.concatenate([diff, limits, [0.0], low[late:], high[late:]])
    extent = extent[np.isfinite(extent)]
    room = 0.15 * max(float(np.ptp(extent)), 1e-9)
    axes.set_xlim(0.0, float(scenes[-1]) * 1.02)
    axes.set_ylim(float(extent.min()) - room, float(extent.max()) + room)
    note = (
        "Line: mean difference. Band: what is not refuted, at every analysis. Dashed: the margin."
    )
    return chart_of(axes, metric.name, note)


def _scale(metric: MetricInfo) -> tuple[float, str]:
    """Return factor and unit, with a space before it, of a metric's printed differences."""
    scale, unit = scale_and_unit(metric, metric.unit)
    return scale, f" {unit}" if unit else ""

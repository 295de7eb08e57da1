"""Markdown of the comparison: the paper's value above ours for every arm, paired differences, and
the verdict of every claim.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from alpasim_plugin.lab.paper.measured import Difference, Measured
from alpasim_plugin.lab.paper.published import PaperMetric, Published
from alpasim_plugin.lab.paper.verdict import ORACLE, Judged
from alpasim_plugin.lab.video_metrics.facts import KNOWN
from alpasim_plugin.lab.video_metrics.table import DIGITS, SCALE
from evaluators.statistics.intervals import Interval

NOT_RUN = "not run"
NO_COUNTERPART = "no counterpart here"
SET_DIGITS = {"fd_syn_clip": 2, "fd_syn_16": 2, "fvmd_lk": 0}
ARROWS = {"higher": "↑", "lower": "↓"}


def paper_against_ours(published: Published, table: str, measured: Measured) -> str:
    """Return one table of the paper: for every arm a line of the paper's numbers and a line of
    ours; the first line names our metrics.

    Arms that the paper does not have (``3dgs``, the per-frame ``onefixer``, variants of another
    table) follow, with our line alone.
    """
    printed = published.tables[table]
    head = [
        "arm",
        "",
        *(
            f"{published.metrics[m].heading} {ARROWS[published.metrics[m].better]}"
            for m in printed.metrics
        ),
    ]
    rows = [
        [
            "",
            "*ours*",
            *(f"`{ours}`" if (ours := published.metrics[m].ours) else "-" for m in printed.metrics),
        ]
    ]
    for arm in printed.rows:
        rows.append(
            [
                f"**{arm}**",
                "paper",
                *("not reported" if cell == "-" else cell for cell in printed.cells(arm)),
            ]
        )
        missing = NO_COUNTERPART if arm in printed.no_counterpart else NOT_RUN
        rows.append(["", "ours", *_line_of(published, printed.metrics, arm, measured, missing)])
    others = [arm for arm in measured.arms if arm not in printed.rows]
    rows += [
        [f"**{arm}**", "ours", *_line_of(published, printed.metrics, arm, measured)]
        for arm in others
    ]
    title = f"{printed.title} ({printed.protocol}; {published.source})"
    return f"**{title}**\n\n" + markdown_table(head, rows)


def _line_of(
    published: Published,
    metrics: Sequence[str],
    arm: str,
    measured: Measured,
    missing: str = NOT_RUN,
) -> list[str]:
    if arm not in measured.values:
        return [missing, *[""] * (len(metrics) - 1)]
    return [_ours(published.metrics[metric], arm, measured) for metric in metrics]


def _ours(metric: PaperMetric, arm: str, measured: Measured) -> str:
    return "-" if metric.ours is None else interval_text(measured, arm, metric.ours, metric.scale)


def interval_text(measured: Measured, arm: str, metric: str, scale: float = 1.0) -> str:
    """Return an arm's mean with the half-width of its interval, ``null`` where it was not measured
    on two clips.
    """
    if not measured.has(arm, metric):
        return "null"
    digits = 1 if scale > 1 else 4 if metric in SCALE else (DIGITS | SET_DIGITS).get(metric, 3)
    return with_half(measured.mean(arm, metric), digits, scale, "±")


def with_half(
    found: Interval, digits: int, scale: float = 1.0, between: str = " ± ", sign: str = ""
) -> str:
    """Return a mean with half of its interval, where there is one."""
    half = (
        ""
        if found.low is None or found.high is None
        else f"{between}{(found.high - found.low) / 2 * scale:.{digits}f}"
    )
    return f"{found.centre * scale:{sign}.{digits}f}{half}"


def means_table(
    measured: Measured, metrics: Sequence[str], digits: Mapping[str, int], usual: int
) -> str:
    """Return every arm's means with half of their intervals: what the paper has no table for."""
    rows = [
        [
            arm,
            *(
                with_half(measured.mean(arm, m), digits.get(m, usual))
                if measured.has(arm, m)
                else "null"
                for m in metrics
            ),
        ]
        for arm in measured.arms
    ]
    return markdown_table(["arm", *metrics], rows)


def differences(measured: Measured, arm: str, rivals: Sequence[str], metrics: Sequence[str]) -> str:
    """Return the paired differences ``arm - rival``; those that are shown are bold."""
    rows = []
    for rival in rivals:
        cells = []
        for metric in metrics:
            there = measured.has(arm, metric) and measured.has(rival, metric)
            cells.append(
                difference_text(measured.difference(metric, arm, rival)) if there else NOT_RUN
            )
        rows.append([rival, *cells])
    return markdown_table(
        [f"{arm} minus", *(f"{m} {ARROWS.get(KNOWN.info(m).direction, '')}" for m in metrics)], rows
    )


def difference_text(found: Difference) -> str:
    """Return a difference with its half-width, its bounds where they lie unevenly, or its p-value
    for a whole set; bold where shown.
    """
    digits, scale = (DIGITS | SET_DIGITS).get(found.metric, 4), SCALE.get(found.metric, 1.0)
    text = f"{found.difference * scale:+.{digits}f}"
    if found.low is not None and found.high is not None:
        half = (found.high - found.low) / 2
        lopsided = abs((found.high + found.low) / 2 - found.difference) > 1e-6 * half
        bounds = f" [{found.low * scale:+.{digits}f}, {found.high * scale:+.{digits}f}]"
        text += bounds if lopsided else f" ± {half * scale:.{digits}f}"
    elif found.p_value is not None:
        text += f" (p {found.p_value:.2g})"
    return f"**{text}**" if found.favours else text


def verdicts(judged: Sequence[Judged]) -> str:
    """Return a line for every claim: its verdict, how its comparisons came out, what they could
    have shown, and the one that tells most.
    """
    rows = []
    for i, one in enumerate(judged, start=1):
        power = "-" if one.power is None else f"{100 * one.power:.0f} %"
        rows.append(
            [
                str(i),
                one.claim.text,
                one.claim.where,
                f"**{one.verdict}**",
                _tally(one),
                power,
                _telling(one),
            ]
        )
    head = ["", "claim", "where", "verdict", "comparisons", "power", "what tells most"]
    return markdown_table(head, rows)


def _tally(one: Judged) -> str:
    names = ("for", "against", "open", "not trained", "not measured")
    return ", ".join(f"{count} {name}" for name in names if (count := one.count(name)))  # type: ignore[arg-type]


def _telling(one: Judged) -> str:
    """Return what decides a claim: the oracle's gain, what is missing, or the comparison that is
    hardest to reconcile with it.
    """
    if one.verdict == "no room for a history" and one.oracle is not None:
        return f"the truth as history gains {difference_text(one.oracle)} dB"
    if one.verdict == "not measured":
        missing = list(dict.fromkeys(r.missing for r in one.results if r.outcome == "not measured"))
        return f"{'; '.join(missing[:2]) or f'{ORACLE} of {one.claim.comparisons[0].first}'}{' and others' if len(missing) > 2 else ''}"
    wanted = {"does not hold": "against", "undecided": "open", "holds": "for"}.get(
        one.verdict, one.verdict
    )
    telling = min(
        (r for r in one.results if r.outcome == wanted),
        key=lambda r: (1.0 if r.refutes is None else r.refutes, r.power or 0.0),
    )
    assert telling.difference is not None
    corrected = (
        f", corrected p {telling.refutes:.2g}"
        if wanted == "against" and telling.refutes is not None
        else ""
    )
    found = telling.difference
    aside = f" ({telling.missing})" if telling.missing else ""
    return f"`{found.metric}`: {found.first} minus {found.second} {difference_text(found)}{corrected}{aside}"


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table whose first column is left-aligned and the others right-aligned."""
    lines = [head, ["---", *(["---:"] * (len(head) - 1))], *rows]
    return "".join(f"| {' | '.join(cell for cell in line)} |\n" for line in lines)

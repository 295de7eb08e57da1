"""The paper's tables from our records, each cell beside the printed one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.lab.paper.claims import Decided, measured_as
from alpasim_plugin.lab.paper.config import RAW
from alpasim_plugin.lab.paper.printed import PrintedMetric, PrintedTable, printed
from alpasim_plugin.lab.paper.records import ClosedLoop, Quality
from alpasim_plugin.lab.video_metrics.facts import FACTS
from evaluators.statistics.intervals import median_interval

QUALITY_NOTE = (
    "Ours: the median over scenes, in brackets its 95 % interval by order statistics; the paper's: "
    "the mean, ± the half-width of Student's interval. `none`: a distance between sets of fewer clips "
    "than dimensions."
)
DRIVE_NOTE = "Ours and the paper's: the mean ± 1.96 sigma / sqrt(N) over rollouts, as if they were independent."


def quality_table(table: PrintedTable, rows: Sequence[str], quality: Quality) -> JsonObject:
    """Return a table of clips: ROW -> METRIC of the paper -> ours and the printed cell."""
    metrics = {name: printed().metrics[name] for name in table.metrics}
    return {
        row: {
            name: {**_clip_cell(row, facts, quality), "paper": table.cell(row, name)}
            for name, facts in metrics.items()
        }
        for row in rows
    }


def _clip_cell(row: str, facts: PrintedMetric, quality: Quality) -> JsonObject:
    for name in facts.ours:
        if name in quality.sets.get(row, {}):
            entry = quality.sets[row][name]
            words = f"{entry['vectors']} vectors, {entry['dimensions']} dimensions"
            return {"metric": name, "value": entry["value"], "interval": None, "about": words}
    ours = measured_as(facts, quality)
    if ours is None or ours not in quality.by_scene[row]:
        return {"metric": ours, "value": None, "interval": None, "about": "not measured"}
    interval = median_interval(np.array([*quality.by_scene[row][ours].values()]), "scenes")
    bounds = interval.bounds
    return {
        "metric": ours,
        "value": interval.centre,
        "interval": bounds,
        "about": f"{len(quality.by_scene[row][ours])} scenes",
    }


def drive_table(table: PrintedTable, rows: Sequence[str], drive: ClosedLoop) -> JsonObject:
    """Return the table of the closed loop: ROW -> METRIC of the paper -> ours and the printed
    cell.
    """
    out: JsonObject = {}
    for row in rows:
        out[row] = {}
        for name in table.metrics:
            facts = printed().metrics[name]
            mean = drive.means[row][facts.ours[0]]
            out[row][name] = {
                "metric": facts.ours[0],
                "value": mean.mean,
                "half_width": mean.ci95,
                "interval": mean.ci95_clustered,
                "about": f"{mean.n_rollouts} rollouts",
                "paper": table.cell(row, name),
            }
    return out


def markdown_table(table: PrintedTable, cells: JsonObject) -> str:
    """Return a table as markdown: ours, a bar, the paper's."""
    metrics = [printed().metrics[name] for name in table.metrics]
    headings = [f"{facts.heading} {'↑' if facts.better == 'higher' else '↓'}" for facts in metrics]
    rows = [["row", *headings], ["---", *["---:"] * len(metrics)]]
    for row, values in cells.items():
        texts = [
            _text(values[name], facts) for name, facts in zip(table.metrics, metrics, strict=True)
        ]
        rows.append([row, *texts])
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def _text(cell: JsonObject, facts: PrintedMetric) -> str:
    return f"{_ours(cell, facts)} / {cell['paper'] or '-'}"


def _ours(cell: JsonObject, facts: PrintedMetric) -> str:
    value = cell["value"]
    if value is None:
        return "none" if "vectors" in cell["about"] else "-"
    fact = FACTS.get(cell["metric"])
    digits = 1 if fact is None else fact.digits
    if facts.scale < 1.0:
        digits += 1
    if "half_width" in cell:
        half = cell["half_width"]
        text = f"{value * facts.scale:.2f}"
        return text if half is None else f"{text} ± {half * facts.scale:.2f}"
    text = f"{value * facts.scale:.{digits}f}"
    if cell["interval"] is None:
        return text
    low, high = (bound * facts.scale for bound in cell["interval"])
    return f"{text} ({low:.{digits}f} to {high:.{digits}f})"


def claims_table(decided: Sequence[Decided]) -> str:
    """Return the claims with their verdicts as markdown."""
    rows = [
        ["", "claim", "where", "verdict", "power", "what says most"],
        ["---:", "---", "---", "---", "---:", "---"],
    ]
    for item in decided:
        claim = item.expected.claim
        power = item.expected.power
        rows.append(
            [
                str(claim.number),
                claim.text,
                claim.place,
                _verdict(item),
                "-" if power is None else f"{100 * power:.0f} %",
                _most(item),
            ]
        )
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def _verdict(item: Decided) -> str:
    if item.verdict is None:
        return "left out"
    untested = item.expected.claim.untested
    return f"**{item.verdict}**" + (f", without what is not tested: {untested}" if untested else "")


def _most(item: Decided) -> str:
    """Return why a claim is left out, or its weakest comparison in words."""
    if item.verdict is None:
        return item.expected.left_out
    measured = [test for test in item.tests if test.p_value is not None]
    if not measured:
        return "nothing was measured"
    if item.verdict == "does not hold":
        measured = [test for test in measured if test.sign < 0] or measured
        test = min(measured, key=lambda tested: tested.p_value or 0.0)
    else:
        test = max(measured, key=lambda tested: tested.p_value or 0.0)
    text = f"`{test.metric}`: {test.row} better than {test.other} by {test.gain:+.4g}, p {test.p_value:.2g}"
    if item.verdict == "undecided":
        count = "no number of" if test.more is None else f"about {test.more}"
        text += f" on {test.n} scenes; {count} scenes would show a difference of this size"
    return text


def document(tables: Sequence[str], decided: Sequence[Decided], stages: Sequence[str]) -> str:
    """Return the page of the record."""
    parts = [
        "# The paper's comparison, made again",
        f"Rows are the paper's; `{RAW}` is the raw render. A cell is ours / the paper's. {QUALITY_NOTE} Absolute values do not compare: other scenes, other networks, other sizes.",
        *tables,
        "## Claims",
        "A claim holds where every comparison is shown (two-sided sign test over scenes, or the test of the run's summary, after Holm's correction over the claim), does not hold where one is shown to be the other way round, and is undecided otherwise. Power is the chance that its weakest comparison shows a difference of its margin.",
        claims_table(decided),
        "## Stages",
        "\n".join(f"- `{line}`" for line in stages),
    ]
    return "\n\n".join(parts) + "\n"

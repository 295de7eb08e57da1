"""What a command prints at its end: the result table, what a frame costs, and the next command
worth trying.
"""

import shlex
from collections.abc import Mapping, Sequence
from textwrap import wrap

from rich import box
from rich.table import Table
from rich.text import Text

from alpasim_plugin.core.escape import terminal as escape
from alpasim_plugin.log.run_folder.schema import cell_name
from evaluators.metrics import METRICS, MetricTable
from evaluators.metrics.outcomes import worst_of
from evaluators.metrics.presets import contact_note
from evaluators.metrics.score_table import SCORES
from evaluators.pages.overview import TONES, Overview
from evaluators.pages.tables import metric_rows
from evaluators.results import Summary
from evaluators.statistics.numbers import labelled
from evaluators.statistics.opening import Run

STYLES = {"worse": "red", "better": "green", "mixed": "yellow", "unclear": "yellow", "neutral": ""}
MOST_NAMED = 6  # variants whose failures are named
HEAD_WIDTH = 9
LEAST_PLOT = 20  # letters
MARGIN_NOTE = "a to b: 95 %, scenes as clusters"


def render_presets(summaries: Mapping[str, Summary]) -> Table:
    """Lay out the scores of several presets on the same logs: a benchmark's own scores, of the
    other presets their headline metrics.

    Args:
        summaries: Preset -> its results.

    A score that is not measured in every rollout shows the range of its mean, and what is missing.
    """
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    columns = list(
        dict.fromkeys(variant for summary in summaries.values() for variant in summary.metrics)
    )
    for head in ("preset", "score", *columns):
        table.add_column(Text(escape(head)), overflow="fold")
    for preset, summary in summaries.items():
        for name in [f"{preset}_{score}" for score in SCORES.get(preset, {})] or METRICS.headline:
            table.add_row(
                preset,
                name,
                *(
                    _score_cell(summary, variant, name, METRICS.shown(name).in_percent)
                    for variant in columns
                ),
            )
    return table


def _score_cell(summary: Summary, variant: str, name: str, in_percent: bool) -> Text:
    means = summary.metrics.get(variant, {})

    def text_of(metric: str) -> str:
        mean = means[metric].mean if metric in means else None
        if mean is None:
            return ""
        return f"{100 * mean:.1f} %" if in_percent else f"{mean:.3f}"

    ledger = summary.censoring.get(variant)
    reasons = ""
    if ledger is not None and name in ledger.invalid:
        reasons = "; ".join(ledger.invalid[name].reasons)
    number = text_of(name)
    note = reasons or ("" if number else "not measured")
    least = text_of(f"{name}_least")
    if reasons and least:
        number = f"{least} to {text_of(f'{name}_most')}"
    return Text(f"{number} ").append(escape(note), style="dim")


def metric_lines(summary: Summary, table: MetricTable = METRICS) -> list[str]:
    """Print the mean and 95 % interval of each metric, a line a variant.

    Args:
        summary: The results of a run.
        table: What the metrics are.
    """
    rows = metric_rows(summary, table=table)
    names = [escape(name) for name in summary.metrics]
    width = max(map(len, names), default=0)
    lines = []
    for row in rows:
        unit = "" if row.name.endswith(f"_{row.unit}") else row.unit
        facts = ", ".join(part for part in (unit, row.arrow_word) if part)
        lines.append(escape(row.name) + (f" ({facts})" if facts else ""))
        digits = max(len(cell.text) for cell in row.cells)
        for name, cell in zip(names, row.cells, strict=True):
            text = f"  {name.ljust(width)}  {cell.text.rjust(digits)}"
            lines.append(
                f"{text}  {cell.detail or cell.note}" if cell.detail or cell.missing else text
            )
    if rows:
        lines.append(MARGIN_NOTE)
        if any(row.name.startswith("collision") for row in rows):
            lines.append(contact_note(summary.preset))
    return [line.rstrip() for line in lines if line]


def overview_lines(overview: Overview, width: int) -> list[Text]:
    """Print the first screen of a run within a width: table, failures, differences, decision.

    A name that is too long for its column stands on a line of its own.
    """
    width = max(width, LEAST_PLOT)  # a terminal may say that it has no columns
    badge, tone = overview.badge
    lines = [Text(badge, f"{STYLES[tone]} bold")]
    lines += [Text(line) for line in _wrapped(overview.counts, width)]
    lines += [*(Text(line, "dim") for line in _wrapped(overview.context, width)), Text()]
    lines += _grid(overview, width)
    lines += [Text(line, "dim") for line in _wrapped("; ".join(overview.notes), width)]
    for row in overview.failing[:MOST_NAMED]:
        lines += [Text(line) for line in _wrapped(f"{row.name}: {row.where}", width)]
    if len(overview.failing) > MOST_NAMED:
        lines.append(Text(f"and {len(overview.failing) - MOST_NAMED} more variants: report.html"))
    if overview.axis:
        lines += [Text(), *(Text(line, "dim") for line in _wrapped(overview.axis, width))]
        lines += forest_lines(overview, width)
    if overview.decision:
        lines += [Text(line, "bold") for line in _wrapped(overview.decision, width)]
    for caution in overview.cautions:
        lines += [Text(line, "yellow") for line in _wrapped(f"caution: {caution}", width)]
    for remark in overview.remarks:
        lines += [Text(line, "dim") for line in _wrapped(remark, width)]
    for line in lines:
        line.no_wrap = True
        line.overflow = "ignore"
    return lines


def _wrapped(text: str, width: int) -> list[str]:
    """Break between words only, further lines indented."""
    plain = escape(text)
    return wrap(
        plain, width, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False
    )


def _grid(overview: Overview, width: int) -> list[Text]:
    heads = [wrap(head, HEAD_WIDTH, break_long_words=False) for head in overview.heads]
    body = [[escape(cell) for cell in overview.cells(row)] for row in overview.rows]
    columns = list(zip(*body, strict=True)) or [()] * len(heads)
    widths = [max(map(len, [*head, *column])) for head, column in zip(heads, columns, strict=True)]
    room = width - sum(widths[1:]) - len(widths[1:])
    names = [len(name) for name in (*columns[0], "variant") if len(name) <= room]
    widths[0] = max(names, default=0)
    tall = max(map(len, heads))
    lines = []
    for number in range(tall):
        texts = [([""] * (tall - len(head)) + head)[number] for head in heads]
        lines.append(_line(texts, widths, ["dim"] * len(heads)))
    styles = [STYLES[TONES.get(names[0], "mixed")] for _, names in overview.endings]
    for cells in body:
        if len(cells[0]) > widths[0]:
            lines.append(Text(cells[0], "bold"))
            cells = ["", *cells[1:]]
        counted = zip(styles, cells[1:], strict=False)
        shades = ["dim" if count == "0" else style for style, count in counted]
        lines.append(_line(cells, widths, ["bold", *shades, "", "", ""]))
    return lines


def _line(cells: Sequence[str], widths: Sequence[int], styles: Sequence[str]) -> Text:
    line = Text(cells[0].ljust(widths[0]), styles[0])
    for cell, width, style in zip(cells[1:], widths[1:], styles[1:], strict=True):
        line.append(f" {cell.rjust(width)}", style)
    return line


def forest_lines(overview: Overview, width: int) -> list[Text]:
    """Draw the differences with letters: dot, interval, margin band, and the numbers beside."""
    differences = [
        (escape(row.name), row.difference) for row in overview.rows if row.difference is not None
    ]
    beside = max((len(difference.text) for _, difference in differences), default=0)
    names = [len(name) for name, _ in differences if len(name) <= width - beside - LEAST_PLOT]
    name_width = max(names, default=0)
    last = max(width - name_width - beside, LEAST_PLOT) - 3

    def place(value: float) -> int:
        return round(last * overview.share(value))

    lines = []
    for name, difference in differences:
        letters = [" "] * (last + 1)
        for column in range(place(-difference.margin), place(difference.margin) + 1):
            letters[column] = "\u2591"
        low, high = difference.bounds or (difference.centre, difference.centre)
        for column in range(place(low), place(high) + 1):
            letters[column] = "\u2500"
        letters[place(0.0)] = "\u2502"
        letters[place(difference.centre)] = "\u25cf"
        if len(name) > name_width:
            lines.append(Text(name))
            name = ""
        line = Text(f"{name.ljust(name_width)} ").append("".join(letters), STYLES[difference.tone])
        lines.append(line.append(f" {difference.text.rjust(beside)}"))
    return lines


def next_line(run: Run) -> str:
    """Return the line that names the next command worth trying, and why."""
    command, why = next_command(run)
    return labelled("next", f"{shlex.join(command)}   # {why}")


def next_command(run: Run) -> tuple[list[str], str]:
    """Choose the command that most helps with what was found.

    Returns:
        Its words, and why.
    """
    failed = [rollout for rollout in run.rollouts if not rollout.ok]
    for rollout in failed:
        if rollout.failure_class == "policy":
            words = ["simrun", "check", "policy", rollout.policy]
            return words, "finds every fault of the policy in seconds"
    if failed:
        words = ["simrun", "check", "run", str(run.folder)]
        return words, "says what is damaged or missing; the same command runs it again"
    worst = worst_of(run.rollouts)
    if worst is not None:
        name = worst.path if worst.log else cell_name(*worst.cell)
        words = ["simrun", "why", f"{run.folder}/{name}"]
        return words, "what the policy saw and planned there"
    return ["simrun", "view", str(run.folder)], "replays the rollouts side by side in a browser"

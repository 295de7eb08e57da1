"""Write ``summary.md``: the finding and the tables, for a CI job's page."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from alpasim_plugin.core.escape import markdown as escape
from alpasim_plugin.core.escape import terminal
from alpasim_plugin.io.atomic import write_text
from alpasim_plugin.run_folder.reader import Run, reporting
from alpasim_plugin.run_folder.rows import Rollout
from evaluators.opening import read_run
from evaluators.report import tables
from evaluators.report.failures import LEDGER_COLUMNS, failure_rows, ledger
from evaluators.report.fixers import COLUMNS, fixer_rows
from evaluators.report.headline import find
from evaluators.report.numbers import Cell, plural
from evaluators.report.provenance import provenance
from evaluators.report.speed import speed

MAX_BYTES = 1_000_000  # job pages refuse more than 1 MiB
CUT_NOTE = "\n_Cut here: the full tables are in report.html and rollouts.parquet._\n"
LEDGER_RATES = ("collision_at_fault", "collision_any", "offroad")
LEDGER_NOTE = "Rates: least and greatest, had every missing rollout and every cut step been without, and with, the event."
INTERVAL_NOTE = "\u00b1 is 1.96 \u03c3/\u221aN over rollouts; a to b is the 95 % interval with scenes as clusters."


def write_summary_md(run_dir: Path | str) -> Path:
    """Write ``summary.md`` into a run folder and return its path.

    Raises:
        InputError: The run folder is not complete enough to be read.
    """
    run = read_run(run_dir)
    path = run.folder / "summary.md"
    with reporting(run):
        text = summary_md(run)
    write_text(path, cut(text), "writing a report")
    return path


def summary_md(run: Run) -> str:
    """Render the summary as Markdown, of any length."""
    finding = find(run)
    parts = [f"## {escape(finding.title)}\n"]
    parts += [f"- **{escape(finding.name_of(p))}**: {escape(p.text)}\n" for p in finding.points]
    parts += [f"> {escape(caution)}\n" for caution in finding.cautions]
    rows = tables.metric_rows(run.summary, run.invalid_reasons)
    if rows:
        head = ["metric", *(f"{c.variant} ({plural(c.n_rollouts, 'rollout')}, {plural(c.n_scenes, 'scene')})" for c in tables.columns(run))]
        body = [[metric_label(r.name, r.unit, r.arrow), *(cell_text(c) for c in r.cells)] for r in rows]
        parts.append(f"\n### Results, preset {escape(str(run.summary.get('preset')))}\n\n{table(head, body)}\n{INTERVAL_NOTE}\n")
    pairs = tables.pair_rows(run.summary)
    if pairs:
        head = ["renderer", "metric", "difference", "95 % interval", "p", "verdict"]
        for base in dict.fromkeys(p.baseline for p in pairs):
            body = [[p.variant, p.metric, p.diff.text, p.interval.text, p.p_value.text, p.verdict] for p in pairs if p.baseline == base]
            parts.append(f"\n### Paired differences from {escape(base)}\n\n{table(head, body)}")
    fixed = fixer_rows(run.summary)
    if fixed:
        head = ["renderer", *(name for name, _ in COLUMNS)]
        parts.append(f"\n### Fixers\n\n{table(head, [[row.renderer, *(c.text for c in row.cells)] for row in fixed])}")
    times = speed(run)
    if times.rows:
        head = ["renderer", "ms per frame, median", "95th percentile", "frames/s", "first frame, ms", *times.stages]
        body = [[r.renderer, *(c.text for c in r.cells), *(c.text for c in r.stages)] for r in times.rows]
        parts.append(f"\n### Speed\n\n{table(head, body)}" + (f"{escape(times.pool)}\n" if times.pool else ""))
    removed = ledger(run, LEDGER_RATES)
    if removed:
        head = ["renderer", *(name for _, name, _ in LEDGER_COLUMNS), *LEDGER_RATES]
        body = [[r.renderer, *(_tally(c) for c in r.counts), *(c.text for c in r.bounds)] for r in removed]
        parts.append(f"\n### Not in the numbers\n\n{table(head, body)}\n{LEDGER_NOTE}\n")
    failures, more = failure_rows(run)
    if failures:
        head = ["class", "renderer", "policy", "scene", "seed", "what happened"]
        body = [[*_key(f.rollout), "; ".join(f"{label}: {text}" for label, text in f.parts)] for f in failures]
        parts.append(f"\n### Failures\n\n{table(head, body)}" + (f"{more} more in rollouts.parquet.\n" if more else ""))
    command = provenance(run).command
    parts.append(f"\n### Made with\n\n```\n{terminal(command).replace('```', '')}\n```\n")
    return "".join(parts)


def table(head: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    """Render a Markdown table."""
    lines = [head, ["---"] * len(head), *body]
    return "".join("| " + " | ".join(cell if i == 1 else escape(cell) for cell in line) + " |\n" for i, line in enumerate(lines))


def cut(text: str, limit: int = MAX_BYTES) -> str:
    """Cut at the end of a line so that the text with its note stays within ``limit`` bytes of UTF-8."""
    data = text.encode()
    if len(data) <= limit:
        return text
    kept = data[: limit - len(CUT_NOTE.encode())]
    return kept[: kept.rfind(b"\n") + 1].decode() + CUT_NOTE


def _tally(cell: Cell) -> str:
    return f"{cell.text} ({cell.note})" if cell.note and cell.text != "0" else cell.text


def _key(rollout: Rollout) -> list[str]:
    return [rollout.failure_class, rollout.renderer, rollout.policy, rollout.scene, str(rollout.seed)]


def metric_label(name: str, unit: str, arrow: str) -> str:
    """Print a metric with its unit and the direction that is better."""
    return " ".join(part for part in (name, f"({unit})" if unit else "", arrow) if part)


def cell_text(cell: Cell) -> str:
    """Print a mean with its count and intervals, or why there is none."""
    if cell.missing:
        return f"{cell.text} ({cell.note})" if cell.note else cell.text
    return f"{cell.text}{f' ({cell.count})' if cell.count else ''}, {cell.detail}" if cell.detail else cell.text

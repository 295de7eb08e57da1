"""What a command prints at its end: the result table, what a frame costs, and the next command
worth trying.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from rich import box
from rich.table import Table
from rich.text import Text

from alpasim_plugin.core.escape import terminal as escape
from alpasim_plugin.log.run_folder.schema import cell_name
from evaluators.metrics import METRICS, MetricTable
from evaluators.metrics.outcomes import outcomes_of
from evaluators.metrics.presets import contact_note
from evaluators.opening import Run
from evaluators.report.flips import find_flips
from evaluators.report.numbers import Cell, finite, fixed, plural
from evaluators.report.tables import metric_rows
from evaluators.report.verdict import Finding, find
from evaluators.scores.table import SCORES

LABEL = 9  # width of the labels
MOST_VARIANTS = 12  # named at the end of a run
MORE_SCENES = "suites/urban"
SEEING = "lane-camera"  # a shipped policy with a camera
KEPT = ("--set", "--preset", "--controller")  # options of a command that the next one has too
OF_A_SCENE = r"(road|ego|actors)\b"  # settings that another scene cannot have
MARGIN_NOTE = "a to b: 95 %, scenes as clusters"
GAP_NOTE = (
    "; \u2014: one rollout or one scene is too few, or no valid value (report.html says which)"
)


def render_presets(
    summaries: Mapping[str, Mapping[str, Any]], known: MetricTable = METRICS
) -> Table:
    """Lay out the scores of several presets on the same logs: a benchmark's own scores, of the
    other presets their headline metrics.

    Args:
        summaries: Preset -> content of its ``summary.json``.
        known: What the metrics are.

    A score that is not measured in every rollout shows the range of its mean, and what is missing.
    """
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    columns = list(
        dict.fromkeys(variant for one in summaries.values() for variant in one.get("metrics") or {})
    )
    for head in ("preset", "score", *columns):
        table.add_column(Text(escape(head)), overflow="fold")
    for preset, summary in summaries.items():
        for name in [f"{preset}_{score}" for score in SCORES.get(preset, {})] or known.headline:
            table.add_row(
                preset,
                name,
                *(
                    _score_cell(summary, variant, name, known.shown(name).in_percent)
                    for variant in columns
                ),
            )
    return table


def _score_cell(summary: Mapping[str, Any], variant: str, name: str, in_percent: bool) -> Text:
    metrics = (summary.get("metrics") or {}).get(variant) or {}
    invalid = ((summary.get("censoring") or {}).get(variant) or {}).get("invalid") or {}
    reasons = "; ".join((invalid.get(name) or {}).get("reasons") or ())
    mean, least, most = (
        "" if value is None else f"{100 * value:.1f} %" if in_percent else f"{value:.3f}"
        for value in (
            (metrics.get(name + end) or {}).get("mean") for end in ("", "_least", "_most")
        )
    )
    number = f"{least} to {most}" if reasons and least else mean
    note = reasons or ("" if mean else "not measured")
    return Text(f"{number} ").append(escape(note), style="dim")


def render_table(
    summary: Mapping[str, Any], headline_only: bool = False, known: MetricTable = METRICS
) -> Table:
    """Lay out metrics x renderers with mean and 95 % interval.

    Args:
        summary: Content of ``summary.json``.
        headline_only: Leave out all but the headline metrics, where any of them is there.
        known: What the metrics are.

    Returns:
        A rich table; print it with ``rich.print`` or a Console (80 columns fit two renderers).
    """
    rows = metric_rows(summary, known=known)
    if headline_only and any(row.is_headline for row in rows):
        rows = [row for row in rows if row.is_headline]
    gaps = any("\u2014" in cell.text + cell.detail for row in rows for cell in row.cells)
    touch = (
        contact_note(str(summary.get("preset")))
        if any(row.name.startswith("collision") for row in rows)
        else ""
    )
    note = (
        MARGIN_NOTE + (GAP_NOTE if gaps else "") + (f"\n{touch}" if touch else "") if rows else None
    )
    table = Table(box=box.SIMPLE_HEAD, caption=note, caption_justify="left", pad_edge=False)
    table.add_column(
        Text(escape(f"preset {summary.get('preset', '?')}"), style="dim"), overflow="fold"
    )
    for variant, entries in (summary.get("metrics") or {}).items():
        counts = [
            (int(e.get("n_rollouts") or 0), int(e.get("n_scenes") or 0)) for e in entries.values()
        ]
        n_rollouts, n_scenes = max(counts, default=(0, 0))
        head = Text(escape(variant), style="bold") + Text(
            f"\n{plural(n_rollouts, 'rollout')}\n{plural(n_scenes, 'scene')}", style="dim"
        )
        table.add_column(head, justify="right", overflow="fold")
    for row in rows:
        label = Text(escape(row.name), style="bold" if row.is_headline else "")
        facts = " ".join(part for part in (row.unit, row.arrow) if part)
        label.append(f" {facts}" if facts else "", style="not bold dim")
        table.add_row(label, *(_cell(cell) for cell in row.cells))
    return table


def _cell(cell: Cell) -> Text:
    if cell.missing:
        return Text(cell.text, style="dim")
    return Text(cell.text, style="bold").append(
        f"\n{cell.detail}" if cell.detail else "", style="not bold dim"
    )


def ending_lines(run: Run) -> list[str]:
    """Return the last lines of a finished run's terminal output, without the path of its report."""
    finding = find(run)
    outcomes = [f"{name}: {text}" for name, text in finding.outcomes]
    if len(outcomes) > MOST_VARIANTS:
        more = f"and {len(outcomes) - MOST_VARIANTS} more variants: report.html"
        outcomes = [*outcomes[:MOST_VARIANTS], more]
    lines = [labelled("" if row else "outcome", text) for row, text in enumerate(outcomes)]
    if len(lines) != 1:
        lines.append(labelled("verdict", finding.title))
    lines += [
        labelled("", f"{finding.name_of(point)}: {point.lead}")
        for point in finding.points
        if point.lead
    ]
    cost = cost_text(run.summary)
    return [*lines, labelled("cost", cost)] if cost else lines


def next_line(run: Run) -> str:
    """Return the line that names the next command worth trying, and why."""
    command, why = next_command(run, find(run))
    return labelled("next", f"{shlex.join(command)}   # {why}")


def cost_text(summary: Mapping[str, Any]) -> str:
    """Say what a camera frame costs behind each renderer: the mean, which is what a rollout pays;
    empty where nothing was timed.
    """
    parts = []
    for name, times in (summary.get("speed") or {}).items():
        mean_ms = finite(times.get("ms_per_frame_mean"))
        if mean_ms is not None:
            parts.append(f"{name} {fixed(mean_ms, 0 if mean_ms >= 10 else 1)} ms")
    return f"{', '.join(parts)} a frame, the whole loop (mean)" if parts else ""


def next_command(run: Run, finding: Finding) -> tuple[list[str], str]:
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
    scenes = run.scenes_asked or [MORE_SCENES]
    other = next((name for name in ("3dgs", "onefixer") if name not in run.renderers), "clean")
    if all(rollout.frames == 0 for rollout in run.rollouts):
        names = run.renderers if len(run.renderers) > 1 else [*run.renderers, other]
        why = "a policy that looks: without a camera it drives alike behind every renderer"
        return _again(run, names, scenes, SEEING), why
    flips, _ = find_flips(run)
    changed = [rollout for flip in flips for rollout in (flip.other, flip.base)]
    for rollout in [*changed, *run.rollouts]:
        if outcomes_of(rollout):
            words = ["simrun", "why", f"{run.folder}/{cell_name(*rollout.cell)}"]
            return words, "what the policy saw and planned there"
    if not finding.points or len(run.variants) == 1:
        return _again(run, [*run.renderers, other], scenes), f"compares with {other}, pair by pair"
    if finding.tone == "unclear":
        why = "more scenes: the interval is too wide to decide"
        return _again(run, run.renderers, [MORE_SCENES]), why
    return ["simrun", "view", str(run.folder)], "replays the rollouts side by side in a browser"


def _again(
    run: Run, renderers: Sequence[str], scenes: Sequence[str], policy: str = ""
) -> list[str]:
    """Return the command of a run with other renderers or scenes, its settings kept."""
    words: list[str] = []
    for text in run.info.get("command") or ():
        words += text.split("=", 1) if text.startswith("--") else [text]
    settings = []
    for option, value in pairwise(words):
        is_elsewhere = scenes == [MORE_SCENES] and re.match(OF_A_SCENE, value)
        if option in KEPT and not is_elsewhere:
            settings += [option, value]
    return [
        "simrun",
        "--renderer",
        ",".join(dict.fromkeys(renderers)),
        "--policy",
        policy or ",".join(run.policies),
        "--seeds",
        str(max(1, len(run.info.get("seeds") or ()))),
        *settings,
        *scenes,
    ]


def labelled(label: str, text: str) -> str:
    """Print a line of the end of a command."""
    return f"{label:<{LABEL}}{text}".replace("\u00a0", " ")

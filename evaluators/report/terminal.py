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
from alpasim_plugin.log.run_folder.rows import Rollout
from alpasim_plugin.log.run_folder.schema import cell_name
from evaluators.metrics import METRICS, MetricTable
from evaluators.metrics.outcomes import outcomes_of
from evaluators.metrics.presets import contact_note
from evaluators.opening import Run
from evaluators.report.flips import find_flips, flip_bases
from evaluators.report.headline import Finding, find
from evaluators.report.numbers import Cell, finite, fixed, plural
from evaluators.report.tables import metric_rows
from evaluators.scores.table import SCORES
from evaluators.statistics.arms import Arm

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
    means = [(metrics.get(name + end) or {}).get("mean") for end in ("", "_least", "_most")]
    why = (
        ((summary.get("censoring") or {}).get(variant) or {})
        .get("invalid", {})
        .get(name, {})
        .get("reasons", {})
    )
    texts = [
        "" if mean is None else f"{100 * mean:.1f} %" if in_percent else f"{mean:.3f}"
        for mean in means
    ]
    reason = Text(escape("; ".join(why) or ("" if texts[0] else "not measured")), style="dim")
    if not why or not texts[1]:  # known in all rollouts, or without a range
        return Text(f"{texts[0]} ").append_text(reason)
    return Text(f"{texts[1]} to {texts[2]} ").append_text(reason)


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


LABEL = 9  # width of the labels
MOST_ARMS = 12  # named at the end of a run
MORE_SCENES = "suites/urban"
FORK_AT_S = 1.0  # seconds of the drive that a suggested fork keeps
SEEING = "lane-camera"  # a shipped policy with a camera
KEPT = ("--set", "--preset", "--controller")  # options of a command that the next one has too
OF_A_SCENE = ("road", "ego", "actors")  # settings that another scene cannot have


def ending_lines(run: Run) -> list[str]:
    """Return the last lines of a run's terminal output, without the path of its report.

    Args:
        run: A finished run.
    """
    finding = find(run)
    several = len(finding.outcomes) > 1
    lines = [
        labelled("" if i else "outcome", f"{name}: {text}")
        for i, (name, text) in enumerate(finding.outcomes[:MOST_ARMS])
    ]
    if len(finding.outcomes) > MOST_ARMS:
        lines.append(
            labelled("", f"and {len(finding.outcomes) - MOST_ARMS} more arms: report.html")
        )
    lines += [labelled("verdict", finding.title)] if several or not lines else []
    lines += [
        labelled("", f"{finding.name_of(point)}: {point.lead}")
        for point in finding.points
        if point.lead
    ]
    cost = cost_text(run.summary)
    return [*lines, *([labelled("cost", cost)] if cost else [])]


def next_line(run: Run) -> str:
    """Return the line that names the next command worth trying, and why."""
    command, why = next_command(run, find(run))
    return labelled("next", f"{shlex.join(command)}   # {why}")


def cost_text(summary: Mapping[str, Any]) -> str:
    """Say what a camera frame costs behind each renderer: the mean, which is what a drive pays;
    empty where nothing was timed.
    """
    means = {
        name: finite(times.get("ms_per_frame_mean"))
        for name, times in (summary.get("speed") or {}).items()
    }
    parts = [
        f"{name} {fixed(ms, 0 if ms >= 10 else 1)} ms"
        for name, ms in means.items()
        if ms is not None
    ]
    return f"{', '.join(parts)} a frame, the whole loop (mean)" if parts else ""


def next_command(run: Run, finding: Finding) -> tuple[list[str], str]:
    """Choose the command that most helps with what was found, and say why.

    Returns:
        Its words, and the reason.
    """
    failed = [r for r in run.rollouts if not r.ok]
    if any(r.failure_class == "policy" for r in failed):
        policy = next(r.policy for r in failed if r.failure_class == "policy")
        return ["simrun", "check", "policy", policy], "finds every fault of the policy in seconds"
    if failed:
        return [
            "simrun",
            "check",
            "run",
            str(run.folder),
        ], "says what is damaged or missing; the same command runs it again"
    if all(r.frames == 0 for r in run.rollouts):
        names = run.renderers if len(run.renderers) > 1 else [*run.renderers, _other(run)]
        why = "a policy that looks: without a camera it drives alike behind every renderer"
        return _again(run, names, run.scenes_asked or [MORE_SCENES], SEEING), why
    flips, _ = find_flips(run)
    changed = [one for flip in flips for one in (flip.other, flip.base)]
    ended = next((one for one in [*changed, *run.rollouts] if outcomes_of(one)), None)
    if ended is not None:
        words = ["simrun", "why", f"{run.folder}/{_named(ended)}"]
        return words, "what the policy saw and planned there"
    if not finding.points or len(run.renderers) * len(run.policies) == 1:
        more = _other(run)
        return _again(
            run, [*run.renderers, more], run.scenes_asked or [MORE_SCENES]
        ), f"compares with {more}, pair by pair"
    if finding.tone == "unclear":
        return _again(
            run, run.renderers, [MORE_SCENES]
        ), "more scenes: the interval is too wide to decide"
    point = finding.points[0]
    worst = max(
        run.rollouts_of(point.variant),
        key=lambda r: r.metrics.get("lateral_distance_m") or 0.0,
        default=run.rollouts[0],
    )
    arm = Arm(worst.renderer, worst.policy)
    bases = (base.of(arm) for base in flip_bases(run))
    other = next((base for base in bases if base != arm), arm)
    partners = (
        r
        for r in run.rollouts
        if (r.renderer, r.policy, r.scene, r.seed)
        == (other.renderer, other.policy, worst.scene, worst.seed)
    )
    return _of_pair(run, next(partners, worst), worst)


def _of_pair(run: Run, base: Rollout, other: Rollout) -> tuple[list[str], str]:
    """Return what shows why two rollouts differ: the page of evidence for two renderers; for two
    policies a fork of the first rollout to the second policy.
    """
    if base.renderer != other.renderer:
        words = ["simrun", "why", f"{run.folder}/{_named(other)}"]
        return words, "the same poses behind both: where the plans part"
    if base.policy != other.policy:
        words = [
            "simrun",
            "fork",
            f"{run.folder}/{_named(other)}",
            "--at",
            f"{FORK_AT_S:g}",
            "--policy",
            base.policy,
        ]
        return words, f"from the same instant on: what {base.policy} does where {other.policy} was"
    return ["simrun", "view", str(run.folder)], "replays the drives in a browser"


def _named(rollout: Rollout) -> str:
    return cell_name(*rollout.cell)


def _other(run: Run) -> str:
    return (
        "3dgs"
        if "3dgs" not in run.renderers
        else "onefixer"
        if "onefixer" not in run.renderers
        else "clean"
    )


def _again(run: Run, renderers: Sequence[str], scenes: list[str], policy: str = "") -> list[str]:
    seeds = max(1, len(run.info.get("seeds") or ()))
    drivers = policy or ",".join(run.policies)
    given = [
        word
        for text in run.info.get("command") or ()
        for word in (text.split("=", 1) if text.startswith("--") else [text])
    ]
    kept = [(flag, value) for flag, value in pairwise(given) if flag in KEPT]
    if scenes == [MORE_SCENES]:
        kept = [
            (flag, value)
            for flag, value in kept
            if not re.match(rf"({'|'.join(OF_A_SCENE)})\b", value)
        ]
    words = [
        "simrun",
        "--renderer",
        ",".join(dict.fromkeys(renderers)),
        "--policy",
        drivers,
        "--seeds",
        str(seeds),
    ]
    return [*words, *(word for pair in kept for word in pair), *scenes]


def labelled(label: str, text: str) -> str:
    """Print a line of the end of a command."""
    return f"{label:<{LABEL}}{text}".replace("\u00a0", " ")

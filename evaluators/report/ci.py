"""Files for a CI service: summary.md and junit.xml of a run, and the same of a gate."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from alpasim_plugin.core.atomic import write_text
from alpasim_plugin.core.escape import markdown as escape
from alpasim_plugin.core.escape import terminal
from alpasim_plugin.core.escape import xml as clean
from alpasim_plugin.core.reading import read_text, real
from alpasim_plugin.log.run_folder.reader import reporting
from alpasim_plugin.log.run_folder.rows import Rollout
from evaluators.metrics.outcomes import in_words, outcomes_of, told
from evaluators.metrics.presets import contact_note
from evaluators.numbers import Cell, plural, short
from evaluators.opening import Run, read_run
from evaluators.report import tables
from evaluators.report.gate import worst_of, write_gate
from evaluators.report.overview import Overview, overview_of
from evaluators.report.provenance import provenance
from evaluators.report.terminal import forest_lines
from evaluators.statistics.gate import Check, GateVerdict

PLOT_LETTERS = 80  # of a line of the plot
MAX_BYTES = 1_000_000  # job pages refuse more than 1 MiB
CUT_NOTE = "\n_Cut here: the full tables are in report.html and rollouts.parquet._\n"
# cases whose metric values are written, 2 KB each: CI servers refuse files of tens of megabytes
MAX_WITH_VALUES = 2000
SUMMARY_VARIABLE = "GITHUB_STEP_SUMMARY"
MARKS = {
    "pass": "pass",
    "regression": "FAIL",
    "undecided": "undecided",
    "renderer": "error",
    "incomplete": "error",
    "policy": "error",
    "infrastructure": "error",
    "evaluator": "error",
}
INTERVAL_NOTE = "a to b is the 95 % interval with scenes as clusters"
CHECK_FACTS = ("diff", "ci95", "interval", "margin", "mean", "max", "min", "n_scenes")


def write_summary_md(run_dir: Path | str | Run) -> Path:
    """Write ``summary.md`` into a run folder and return its path.

    Raises:
        InputError: The run folder is not complete enough to be read.
    """
    run = read_run(run_dir)
    path = run.folder / "summary.md"
    with reporting(run):
        text = summary_md(run)
    write_text(path, cut(text))
    return path


def summary_md(run: Run) -> str:
    """Render the summary as Markdown, of any length: the first screen, all metrics in a fold, and
    the command.
    """
    preset = str(run.summary.get("preset"))
    heads = [
        f"{c.variant} ({plural(c.n_rollouts, 'rollout')}, {plural(c.n_scenes, 'scene')})"
        for c in tables.columns(run)
    ]
    body = [
        [metric_label(row.name, row.unit, row.arrow), *map(cell_text, row.cells)]
        for row in tables.metric_rows(run.summary, run.invalid_reasons, run.table)
    ]
    note = ". ".join(filter(None, (INTERVAL_NOTE, contact_note(preset)))) + "."
    parts = [overview_md(overview_of(run))]
    parts += _fold(f"All {len(body)} metrics", ["metric", *heads], body, note)
    parts += _fold(
        "All paired differences",
        ["variant", "baseline", "metric", "difference", "95 % interval", "p", "verdict"],
        [
            [p.variant, p.baseline, p.metric, *_texts((p.diff, p.interval, p.p_value)), p.verdict]
            for p in tables.pair_rows(run.summary, run.table)
        ],
    )
    command = terminal(provenance(run)["command"]).replace("```", "")
    return "".join([*parts, f"\n### Made with\n\n```\n{command}\n```\n"])


def overview_md(shown: Overview, heading: str = "##") -> str:
    """Render the first screen of a run as Markdown."""
    badge, _ = shown.badge
    parts = [f"{heading} {badge}: {escape(shown.title)}\n\n{escape(shown.context)}\n\n"]
    if shown.rows:
        parts += [table(shown.heads, map(shown.cells, shown.rows)), "\n"]
        parts.append(f"{escape('; '.join(shown.notes))}\n\n")
    parts += [f"- **{escape(row.name)}**: {escape(row.where)}\n" for row in shown.failing]
    forest = "\n".join(line.plain.rstrip() for line in forest_lines(shown, PLOT_LETTERS))
    if forest:
        parts.append(f"\n{escape(shown.axis)}\n\n```\n{forest.replace('`', '')}\n```\n")
    if shown.decision:
        parts.append(f"\n**{escape(shown.decision)}**\n")
    parts += [f"\n> {escape(caution)}\n" for caution in shown.cautions]
    return "".join(parts)


def _fold(title: str, head: list[str], rows: list[list[str]], note: str = "") -> list[str]:
    """Render a table that opens by a click; nothing without rows."""
    if not rows:
        return []
    text = f"{table(head, rows)}\n{note}\n" if note else table(head, rows)
    return [f"\n<details><summary>{title}</summary>\n\n{text}\n</details>\n"]


def _texts(cells: Iterable[Cell]) -> list[str]:
    return [cell.text for cell in cells]


def table(head: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    """Render a Markdown table."""
    lines = [head, ["---"] * len(head), *body]
    return "".join(
        "| " + " | ".join(cell if i == 1 else escape(cell) for cell in line) + " |\n"
        for i, line in enumerate(lines)
    )


def cut(text: str, limit: int = MAX_BYTES) -> str:
    """Cut at the end of a line so that the text with its note stays within ``limit`` bytes of
    UTF-8.
    """
    data = text.encode()
    if len(data) <= limit:
        return text
    kept = data[: limit - len(CUT_NOTE.encode())]
    return kept[: kept.rfind(b"\n") + 1].decode() + CUT_NOTE


def metric_label(name: str, unit: str, arrow: str) -> str:
    """Print a metric with its unit and the direction that is better."""
    return " ".join(part for part in (name, f"({unit})" if unit else "", arrow) if part)


def cell_text(cell: Cell) -> str:
    """Print a mean with its count and interval, or why there is none."""
    if cell.missing:
        return f"{cell.text} ({cell.note})" if cell.note else cell.text
    return f"{cell.text}, {cell.detail}" if cell.detail else cell.text


def write_junit(run_dir: Path | str | Run) -> Path:
    """Write ``junit.xml`` into a run folder and return its path.

    Raises:
        InputError: The run folder is not complete enough to be read.
    """
    run = read_run(run_dir)
    with reporting(run):
        root = junit(run)
    return _write_xml(run.folder / "junit.xml", root)


def _write_xml(path: Path, root: ET.Element) -> Path:
    ET.indent(root)
    write_text(
        path,
        '<?xml version="1.0" encoding="utf-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n",
    )
    return path


def junit(run: Run, outcomes_fail: bool = True) -> ET.Element:
    """Build the document.

    Args:
        run: The run.
        outcomes_fail: A rollout with an outcome is a failed case; otherwise the outcome is a
            property of the case alone.
    """
    done = [rollout for rollout in run.rollouts if rollout.ok]
    counts = {
        "tests": str(len(run.rollouts)),
        "failures": str(sum(bool(outcomes_of(r)) for r in done) if outcomes_fail else 0),
        "errors": str(len(run.rollouts) - len(done)),
        "skipped": "0",
        "time": f"{sum(r.wall_s or 0.0 for r in run.rollouts):.3f}",
    }
    root = ET.Element("testsuites", {"name": "simrun", **counts})
    asked = run.info.get("asked") or []  # what the command named, if that was one thing
    name = str(asked[0]) if len(asked) == 1 else real(run.folder).name
    suite = ET.SubElement(root, "testsuite", {"name": clean(name), **counts})
    if run.info.get("started_at"):
        suite.set("timestamp", clean(str(run.info["started_at"])))
    facts = {
        "preset": run.summary.get("preset"),
        "version": run.info.get("version"),
        "key": run.info.get("key"),
        "command": " ".join(str(word) for word in run.info.get("command") or []),
    }
    _properties(suite, {key: str(value) for key, value in facts.items() if value})
    with_values = len(run.rollouts) <= MAX_WITH_VALUES
    for rollout in run.rollouts:
        _case(suite, rollout, with_values, outcomes_fail)
    return root


def _case(suite: ET.Element, rollout: Rollout, with_values: bool, outcomes_fail: bool) -> None:
    names = {
        "classname": clean(rollout.scene),
        "name": clean(f"{rollout.renderer}/{rollout.policy}/{rollout.seed}"),
        "time": f"{rollout.wall_s or 0.0:.3f}",
    }
    case = ET.SubElement(suite, "testcase", names)
    facts = {"path": rollout.path} if rollout.path else {}
    if not rollout.ok:
        _properties(case, facts)
        kind = clean(rollout.failure_class or "unknown")
        lines = [line for line in rollout.failure.splitlines() if line.strip()]
        message = clean(lines[0] if lines else "no message was recorded")
        error = ET.SubElement(case, "error", {"type": kind, "message": message})
        error.text = clean(rollout.failure)
        return
    outcomes = outcomes_of(rollout)
    facts["outcome"] = in_words(outcomes)
    if with_values:
        for name, value in rollout.metrics.items():
            facts[name] = "invalid" if value is None else repr(value)
    _properties(case, facts)
    if outcomes and outcomes_fail:
        _add_failure(case, told(outcomes)[0].name, in_words(outcomes))


def _add_failure(case: ET.Element, kind: str, text: str) -> None:
    failure = ET.SubElement(case, "failure", {"type": kind, "message": clean(text)})
    failure.text = clean(text)


def _properties(parent: ET.Element, values: Mapping[str, str]) -> None:
    if values:
        holder = ET.SubElement(parent, "properties")
        for name, value in values.items():
            ET.SubElement(holder, "property", {"name": clean(name), "value": clean(value)})


def gate_md(verdict: GateVerdict, gate: str, run: str) -> str:
    """Render a verdict as Markdown: heading, what led to it, every check, the scenes that did
    worst.

    Args:
        verdict: What `judge` gave.
        gate: Name or file of the gate.
        run: Name or folder of the run.
    """
    parts = [
        f"## Gate: {verdict.outcome.title}\n\n",
        f"Run {escape(run)}, gate {escape(gate)}, compared with {escape(verdict.baseline)}. "
        f"Exit code {verdict.exit_code}.\n\n",
    ]
    if verdict.outcome.cause != "pass":
        parts += [f"- {escape(reason)}\n" for reason in verdict.outcome.reasons]
    checks = []
    for check in verdict.checks:
        result = MARKS[check.cause] + ("" if check.binding else " (not binding)")
        checks.append([check.metric, _variant(check), result, check.kind, check.text])
    if checks:
        head = ["metric", "renderer", "result", "rule", "numbers"]
        parts.append(f"\n{table(head, checks)}")
    pairs = []
    for pair in worst_of(verdict.as_dict()["checks"]):
        variant = f"{pair['renderer']}/{pair['policy']}"
        names = [pair["scene"], variant, str(pair["seed"]), pair["metric"]]
        pairs.append([*names, short(pair["was"]), short(pair["now"])])
    if pairs:
        head = ["scene", "renderer", "seed", "metric", "baseline", "now"]
        parts.append(f"\nThe worst scenes:\n\n{table(head, pairs)}")
    n_failed, n_rollouts = (verdict.failures[key] for key in ("n_failed", "n_rollouts"))
    if n_failed:
        parts.append(f"\n{n_failed} of {n_rollouts} rollouts failed.\n")
    return "".join(parts)


def write_gate_files(verdict: GateVerdict, gate: str, run: Run, folder: Path) -> list[Path]:
    """Write ``gate.md``, ``gate.junit.xml`` and in the run folder ``gate.json``; append the
    Markdown to what $GITHUB_STEP_SUMMARY names.

    Raises:
        InfrastructureError: The disk refused.
    """
    text = gate_md(verdict, gate, str(run.folder))
    text += "\n" + overview_md(overview_of(run), "###")
    folder.mkdir(parents=True, exist_ok=True)
    page = folder / "gate.md"
    write_text(page, cut(text))
    tests = _write_xml(folder / "gate.junit.xml", gate_junit(verdict, gate, run))
    append_job_summary(text)
    if real(folder) != real(run.folder):
        return [page, tests]
    return [page, tests, write_gate(run, verdict, gate)]


def append_job_summary(text: str) -> Path | None:
    """Append Markdown to the CI job's summary file, if $GITHUB_STEP_SUMMARY names one; the whole
    file stays below 1 MiB.
    """
    named = os.environ.get(SUMMARY_VARIABLE)
    if not named:
        return None
    path = Path(named)
    before = read_text(path) if os.path.exists(path) else ""
    before = before.rstrip("\n") + "\n\n" if before else ""
    room = MAX_BYTES - len(before.encode())
    if room > len(CUT_NOTE):
        write_text(path, before + cut(text, room))
    return path


def gate_junit(verdict: GateVerdict, gate: str, run: Run) -> ET.Element:
    """Build one suite of checks in front of the run's own suite of rollouts.

    A check that is worse or over its limit is a failure of type ``regression``, one that is not
    decided a failure of type ``undecided``; one that does not bind is skipped. How the drives ended
    is said of them and fails nothing here: the gate's checks are the verdict.
    """
    root = junit(run, outcomes_fail=False)
    suite = ET.Element("testsuite", {"name": clean(f"gate {gate}")})
    counts = {"tests": len(verdict.checks), "failures": 0, "errors": 0, "skipped": 0}
    for check in verdict.checks:
        names = {
            "classname": clean(f"gate.{_variant(check)}"),
            "name": clean(f"{check.metric} {check.kind}"),
        }
        case = ET.SubElement(suite, "testcase", names)
        facts = {
            key: str(check.entry[key]) for key in CHECK_FACTS if check.entry.get(key) is not None
        }
        _properties(case, facts)
        if check.cause != "pass" and not check.binding:
            ET.SubElement(case, "skipped", {"message": clean(check.text)})
            counts["skipped"] += 1
        elif check.cause != "pass":
            _add_failure(case, check.cause, check.text)
            counts["failures"] += 1
    for key, value in counts.items():
        suite.set(key, str(value))
        root.set(key, str(value + int(root.get(key, "0"))))
    root.insert(0, suite)
    return root


def _variant(check: Check) -> str:
    return f"{check.renderer}/{check.policy}"

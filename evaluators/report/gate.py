"""What a gate found, as Markdown for a job's page and as JUnit XML for a CI system's test list."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ET
from pathlib import Path

from alpasim_plugin.core.escape import markdown as escape
from alpasim_plugin.core.escape import xml as clean
from alpasim_plugin.io.atomic import write_text
from alpasim_plugin.run_folder.reader import Run
from evaluators.gate.judge import Check, GateVerdict
from evaluators.report.junit import junit
from evaluators.report.summary import CUT_NOTE, MAX_BYTES, cut, table

SUMMARY_VARIABLE = "GITHUB_STEP_SUMMARY"
MARKS = {"pass": "pass", "regression": "FAIL", "undecided": "undecided", "policy": "error", "infrastructure": "error", "evaluator": "error"}


def gate_md(verdict: GateVerdict, gate: str, run: str) -> str:
    """Render a verdict as Markdown: heading, what led to it, every check.

    Args:
        verdict: What `judge` gave.
        gate: Name or file of the gate.
        run: Name or folder of the run.
    """
    head = f"## Gate: {verdict.outcome.title}\n\n"
    head += f"Run {escape(run)}, gate {escape(gate)}, compared with {escape(verdict.baseline)}. Exit code {verdict.exit_code}.\n\n"
    reasons = "".join(f"- {escape(reason)}\n" for reason in verdict.outcome.reasons) if verdict.outcome.cause != "pass" else ""
    rows = [
        [check.metric, _variant(check), MARKS[check.cause] + ("" if check.binding else " (not binding)"), check.kind, check.text]
        for check in verdict.checks
    ]
    checks = "\n" + table(["metric", "renderer", "result", "rule", "numbers"], rows) if rows else ""
    failures = verdict.failures
    failed = f"\n{failures['n_failed']} of {failures['n_rollouts']} rollouts failed.\n" if failures["n_failed"] else ""
    return head + reasons + checks + failed


def write_gate_files(verdict: GateVerdict, gate: str, run: Run, folder: Path) -> list[Path]:
    """Write ``gate.md`` and ``gate.junit.xml``; append the Markdown to the file that $GITHUB_STEP_SUMMARY names.

    Raises:
        InfrastructureError: The disk refused.
    """
    text = gate_md(verdict, gate, str(run.folder))
    folder.mkdir(parents=True, exist_ok=True)
    page, tests = folder / "gate.md", folder / "gate.junit.xml"
    write_text(page, cut(text), "writing a report")
    root = gate_junit(verdict, gate, run)
    ET.indent(root)
    write_text(tests, '<?xml version="1.0" encoding="utf-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n", "writing a report")
    append_job_summary(text)
    return [page, tests]


def append_job_summary(text: str) -> Path | None:
    """Append Markdown to the CI job's summary file, if $GITHUB_STEP_SUMMARY names one; the whole file stays below 1 MiB."""
    named = os.environ.get(SUMMARY_VARIABLE)
    if not named:
        return None
    path = Path(named)
    before = path.read_text(encoding="utf-8") if path.exists() else ""
    before = before.rstrip("\n") + "\n\n" if before else ""
    room = MAX_BYTES - len(before.encode())
    if room > len(CUT_NOTE):
        write_text(path, before + cut(text, room), "writing a report")
    return path


def gate_junit(verdict: GateVerdict, gate: str, run: Run) -> ET.Element:
    """Build one suite of checks in front of the run's own suite of rollouts.

    A check that is worse or over its limit is a failure of type ``regression``, one that is not decided a failure of type ``undecided``, or
    skipped where it does not bind.
    """
    root = junit(run)
    suite = ET.Element("testsuite", {"name": clean(f"gate {gate}")})
    n_failures = n_skipped = 0
    for check in verdict.checks:
        names = {"classname": clean(f"gate.{_variant(check)}"), "name": clean(f"{check.metric} {check.kind}")}
        case = ET.SubElement(suite, "testcase", names)
        values = {
            key: check.entry[key] for key in ("diff", "ci95", "interval", "margin", "mean", "max", "min", "n_scenes") if key in check.entry
        }
        holder = ET.SubElement(case, "properties")
        for key, value in values.items():
            ET.SubElement(holder, "property", {"name": clean(key), "value": clean(str(value))})
        if check.cause == "pass":
            continue
        if check.cause == "undecided" and not check.binding:
            ET.SubElement(case, "skipped", {"message": clean(check.text)})
            n_skipped += 1
            continue
        ET.SubElement(case, "failure", {"type": check.cause, "message": clean(check.text)}).text = clean(check.text)
        n_failures += 1
    counts = {"tests": len(verdict.checks), "failures": n_failures, "errors": 0, "skipped": n_skipped}
    for key, value in counts.items():
        suite.set(key, str(value))
        root.set(key, str(value + int(root.get(key, "0"))))
    root.insert(0, suite)
    return root


def _variant(check: Check) -> str:
    return f"{check.renderer}/{check.policy}"

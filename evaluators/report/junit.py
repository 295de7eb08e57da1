"""Write ``junit.xml``: suite = scene suite, class = scene, case = renderer, policy and seed.

A case is an ``error`` where its rollout could not be run or scored. Criteria (a collision is not one by itself) come with the gate.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

from alpasim_plugin.core.escape import xml as clean
from alpasim_plugin.io.atomic import write_text
from alpasim_plugin.run_folder.reader import Run, reporting
from alpasim_plugin.run_folder.rows import Rollout
from evaluators.opening import read_run

MAX_WITH_VALUES = 2000  # cases whose metric values are written, 2 KB each: CI servers refuse files of tens of megabytes


def write_junit(run_dir: Path | str) -> Path:
    """Write ``junit.xml`` into a run folder and return its path.

    Raises:
        InputError: The run folder is not complete enough to be read.
    """
    run = read_run(run_dir)
    with reporting(run):
        root = junit(run)
    ET.indent(root)
    path = run.folder / "junit.xml"
    write_text(path, '<?xml version="1.0" encoding="utf-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n", "writing a report")
    return path


def junit(run: Run) -> ET.Element:
    """Build the document."""
    failed = [r for r in run.rollouts if not r.ok]
    counts = {
        "tests": str(len(run.rollouts)),
        "failures": "0",
        "errors": str(len(failed)),
        "skipped": "0",
        "time": f"{sum(r.wall_s or 0.0 for r in run.rollouts):.3f}",
    }
    root = ET.Element("testsuites", {"name": "simrun", **counts})
    suite = ET.SubElement(root, "testsuite", {"name": clean(_suite_name(run)), **counts})
    if run.info.get("started_at"):
        suite.set("timestamp", clean(str(run.info["started_at"])))
    facts = {
        "preset": run.summary.get("preset"),
        "version": run.info.get("version"),
        "key": run.info.get("key"),
        "command": " ".join(str(word) for word in run.info.get("command") or []),
    }
    _properties(suite, {k: str(v) for k, v in facts.items() if v})
    with_values = len(run.rollouts) <= MAX_WITH_VALUES
    for rollout in run.rollouts:
        _case(suite, rollout, with_values)
    return root


def _suite_name(run: Run) -> str:
    """Return the suite or scenario that the command named, where it was one; a list of them has the name of the run's folder."""
    asked = run.info.get("asked") or []
    return str(asked[0]) if len(asked) == 1 else run.folder.resolve().name


def _case(suite: ET.Element, rollout: Rollout, with_values: bool) -> None:
    name = f"{rollout.renderer}/{rollout.policy}/{rollout.seed}"
    case = ET.SubElement(
        suite, "testcase", {"classname": clean(rollout.scene), "name": clean(name), "time": f"{rollout.wall_s or 0.0:.3f}"}
    )
    values = {m: "invalid" if v is None else repr(v) for m, v in rollout.metrics.items()} if rollout.ok and with_values else {}
    _properties(case, {"path": rollout.path, **values} if rollout.path else values)
    if not rollout.ok:
        first = next((line for line in rollout.failure.splitlines() if line.strip()), "no message was recorded")
        error = ET.SubElement(case, "error", {"type": clean(rollout.failure_class or "unknown"), "message": clean(first)})
        error.text = clean(rollout.failure)


def _properties(parent: ET.Element, values: dict[str, str]) -> None:
    if values:
        holder = ET.SubElement(parent, "properties")
        for name, value in values.items():
            ET.SubElement(holder, "property", {"name": clean(name), "value": clean(value)})

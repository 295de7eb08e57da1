"""``simrun report``: write a run's report again from its tables."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from alpasim_plugin.cli.progress import warn
from alpasim_plugin.run_folder.manifests import read_run_json
from alpasim_plugin.run_folder.reader import read_json
from alpasim_plugin.run_folder.schema import SUMMARY
from alpasim_plugin.runtime.repair import use_run
from alpasim_plugin.runtime.reports import write_reports
from evaluators.metrics import MetricTable
from evaluators.report import render_table

EPILOG = "Example: `simrun report runs/us101`"


def report_line(root: Path) -> str:
    """Return the lines that say where a run's report is, or how to get it, and how to watch its drives."""
    page, run = root / "report.html", shlex.quote(str(root))
    report = f"report   {shlex.quote(str(page))}" if page.exists() else f"report   not written; simrun report {run}"
    return f"{report}\nwatch    simrun view {run}"


def report(
    run: Annotated[Path, typer.Argument(help="A run folder.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Write report.html, summary.md and junit.xml of a run again and print its table."""
    del debug
    use_run(run, warn)
    summary = read_json(run / SUMMARY)
    page = write_reports(run, flips=read_run_json(run).get("kind") != "score")
    if as_json:
        print(json.dumps({"report": str(page), "summary": summary}))
    else:
        Console().print(render_table(summary, known=MetricTable.of_run(read_run_json(run))))
        print(f"report   {page}")

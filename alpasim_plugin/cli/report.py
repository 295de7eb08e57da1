"""``simrun report``: write a run's report again from its tables."""

from __future__ import annotations

import json

from rich.console import Console

from alpasim_plugin.cli.options import Json, Run
from alpasim_plugin.cli.progress import warn
from alpasim_plugin.run_folder.manifests import read_run_json
from alpasim_plugin.run_folder.reader import read_json
from alpasim_plugin.run_folder.schema import SUMMARY
from alpasim_plugin.runtime.repair import use_run
from alpasim_plugin.runtime.reports import write_reports
from evaluators.metrics import MetricTable
from evaluators.report import render_table

EPILOG = "Example: `simrun report runs/us101`"


def report(
    run: Run,
    as_json: Json = False,
) -> None:
    """Write report.html, summary.md and junit.xml of a run again and print its table."""
    use_run(run, warn)
    summary = read_json(run / SUMMARY)
    page = write_reports(run, flips=read_run_json(run).get("kind") != "score")
    if as_json:
        print(json.dumps({"report": str(page), "summary": summary}))
    else:
        Console().print(render_table(summary, known=MetricTable.of_run(read_run_json(run))))
        print(f"report   {page}")

"""``simrun aggregate``: the numbers of several runs as of one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

from rich.console import Console

from alpasim_plugin.cli.options import Every, Json
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.io.atomic import write_json
from alpasim_plugin.runtime.summary import aggregate_runs, joined_metrics
from evaluators.report import render_table
from evaluators.report.tables import pair_rows

EPILOG = """
Examples:

- `simrun aggregate runs/night-*`

- `simrun aggregate runs/night-* --baseline clean --out night.json`

- `simrun aggregate runs/mine --all`
"""


def aggregate(
    runs: Annotated[tuple[Path, ...], Positional("Finished run folders.")],
    baseline: Annotated[str | None, Flag("Renderer to compare against; by default the first run's.")] = None,
    out: Annotated[Path | None, Flag("Also write the numbers as JSON, in the form of summary.json.")] = None,
    every: Every = False,
    as_json: Json = False,
) -> None:
    """Print means, intervals and verdicts over the rollouts of several runs; tables of millions of rows are streamed."""
    found = aggregate_runs(runs, baseline)
    if out is not None:
        write_json(out, found)
    if as_json:
        print(json.dumps(found))
        return
    known = joined_metrics(runs)
    Console().print(render_table(found, headline_only=not every, known=known))
    for row in pair_rows(found, known):
        if every or known.shown(row.metric).is_headline:
            numbers = f"{row.diff.text}, 95 % {row.interval.text}, p {row.p_value.text}".replace("\u00a0", " ")
            print(f"{row.variant} minus {row.baseline}: {row.metric} {numbers}: {row.verdict}")
    failures = found["failures"]
    if failures["n_failed"]:
        causes = ", ".join(f"{name} {n}" for name, n in failures["by_class"].items())
        print(f"{failures['n_failed']} of {failures['n_rollouts']} rollouts failed ({causes}); they are in no average")
    if out is not None:
        print(f"numbers  {out}")

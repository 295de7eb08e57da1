"""``simrun why``: the page of evidence for a rollout that failed, made of what its run stored."""

import shlex
from pathlib import Path
from typing import Annotated

from alpasim_plugin.cli.options import Json, run_and_cell
from alpasim_plugin.cli.output import show, warn
from alpasim_plugin.core.flags import Positional
from alpasim_plugin.runs.logged_rollout import named_rollout
from alpasim_plugin.runs.reports import failure_cause
from alpasim_plugin.runs.tables import ensure_tables
from evaluators.pages.cause import write_cause
from evaluators.statistics.cause import worst_failure
from evaluators.statistics.opening import read_run

EPILOG = """
Examples:

- `simrun why`: the worst failure of the newest run

- `simrun why runs/us101`: the worst failure of that run

- `simrun why runs/us101/3dgs/lane-camera/us101/0`
"""


def why(
    cell: Annotated[
        Path | None,
        Positional(
            "A rollout, or a run: its worst failure.",
            metavar="RUN|RUN/CELL",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Show how a rollout failed, on one offline page.

    The page is made of what the run stored; nothing is driven or rendered. It holds what the check
    of the policy found, camera images with plan, route and road users, what the run's other
    renderers show at the same poses, where plans part, and behind which renderers the same rollout
    ends well.
    """
    root, name = run_and_cell(cell)
    ensure_tables(root, warn)
    run = read_run(root)
    rollout = named_rollout(run.rollouts, name) if name else worst_failure(run)
    cause = failure_cause(run, rollout)
    page = write_cause(run, cause)
    facts = {
        "rollout": rollout.path,
        "page": str(page),
        "outcome": cause.outcome,
        "found": list(cause.sentences),
    }
    lines = [f"rollout  {rollout.path}", f"outcome  {cause.outcome}"]
    lines += [f"         {text}" for text in cause.sentences]
    show(as_json, facts, *lines, f"page     {shlex.quote(str(page))}")

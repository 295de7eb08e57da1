"""``simrun fork``: continue a logged rollout with another part. ``simrun why``: the page of evidence
for a rollout that failed.
"""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from alpasim_plugin.cli.options import Json, run_and_cell
from alpasim_plugin.cli.output import show, warn
from alpasim_plugin.cli.run import last_lines
from alpasim_plugin.core.errors import InputError, error_text
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.core.parts import resolve, resolve_renderer, split_names
from alpasim_plugin.log.run_folder.reader import read_json
from alpasim_plugin.log.run_folder.schema import OUTPUT_NAME, slug
from alpasim_plugin.runs.fork import Change, fork_rollout
from alpasim_plugin.runs.logged_rollout import find_rollout, named_row
from alpasim_plugin.runs.tables import ensure_tables
from alpasim_plugin.runs.why import explain, worst_failure
from evaluators.opening import read_run
from evaluators.viewer.cause import write_cause

FORK_EPILOG = """
Examples:

- `simrun fork runs/us101/3dgs/lane-camera/us101/0 --at 2.2 --renderer clean`

- `simrun fork runs/us101/3dgs/lane-camera/us101/0 --at 2.2`: continue unchanged and check that the result equals the log
"""
WHY_EPILOG = """
Examples:

- `simrun why`: the worst failure of the newest run

- `simrun why runs/us101`: the worst failure of that run

- `simrun why runs/us101/3dgs/lane-camera/us101/0`
"""


def fork(
    cell: Annotated[
        Path, Positional("The rollout: RUN/RENDERER/POLICY/SCENE/SEED.", metavar="RUN/CELL")
    ],
    at: Annotated[float, Flag("Seconds after the first frame at which the change takes effect.")],
    renderer: Annotated[str | None, Flag("Renderer after the change.")] = None,
    policy: Annotated[
        str | None, Flag("Policy after the change; it has seen the frames before it.")
    ] = None,
    seed: Annotated[int | None, Flag("Seed of the new parts.", min=0)] = None,
    out: Annotated[
        Path | None, Flag("Run folder to write; by default one below RUN/forks/.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Continue a logged rollout from an instant on with another renderer, policy or seed.

    Writes a run folder with the original and the continuation, scored and reported like any run.
    """
    if renderer is not None:
        if len(split_names(renderer)) > 1:
            raise InputError(f"--renderer {renderer}: several names", "Name one renderer.")
        resolve_renderer(renderer)
    if policy is not None:
        resolve("policy", policy)
    run, name = run_and_cell(cell)
    if not name:
        raise InputError(f"{cell}: a run, not a rollout", "Name RUN/RENDERER/POLICY/SCENE/SEED.")
    ensure_tables(run, warn)
    past = find_rollout(run, name)
    change = Change(round(at * 1e6), renderer, policy, seed)
    root = out or run / "forks" / slug(f"{past.name} {change.label}")
    result = fork_rollout(past, change, root, ["simrun", *sys.argv[1:]])
    fork_facts = read_json(root / "run.json")["fork"]
    facts = {
        "out": str(root),
        "fork": fork_facts,
        "exit_code": result.exit_code,
        "summary": result.summary,
    }
    lines = []
    if fork_facts:
        lines.append(f"replay to {at:g} s   equal to the log, bit for bit")
        after = fork_facts.get("continuation")
        if after == "equal":
            lines.append("continuation      equal to the log, bit for bit")
        elif after is not None:
            where = f"{after['component']} at step {after['step']} ({after['what']})"
            lines.append(f"continuation      differs first in {where}")
    show(as_json, facts, *lines, f"report   {root / 'report.html'}")
    for failed in () if as_json else result.summary["failures"]["cells"]:
        warn(f"{failed['path']}\n{error_text(failed['error'])}")
    raise typer.Exit(result.exit_code)


def why(
    cell: Annotated[
        Path | None,
        Positional(
            "A rollout, or a run whose worst failure is shown; by default the newest run.",
            metavar="RUN|RUN/CELL",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Show how a rollout failed, on one offline page.

    The page holds camera images with plan, route and road users, what the run's other renderers
    show at the same poses, where plans part, and behind which renderers the same rollout ends well.
    """
    root, name = run_and_cell(cell)
    ensure_tables(root, warn)
    run = read_run(root)
    if name:
        row = named_row(root, name)
        rollout = next(one for one in run.rollouts if one.path == row["path"])
    else:
        rollout = worst_failure(run)
    cause = explain(run, rollout)
    page = None if cause is None else write_cause(run, cause)
    outcome = rollout.failure
    evidence = [] if cause is None else list(cause.sentences)
    if not rollout.ok:
        evidence += last_lines(root / rollout.path / OUTPUT_NAME)
    elif cause is not None:
        outcome = cause.outcome
    facts = {
        "rollout": rollout.path,
        "page": page and str(page),
        "outcome": outcome,
        "found": evidence,
    }
    lines = [f"rollout  {rollout.path}", f"outcome  {outcome}"]
    lines += [f"         {text}" for text in evidence]
    if page is not None:
        lines.append(f"page     {shlex.quote(str(page))}")
    show(as_json, facts, *lines)

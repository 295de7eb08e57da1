"""``simrun fork``: continue a logged rollout with another part."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from alpasim_plugin.cli.options import Json, run_and_cell
from alpasim_plugin.cli.output import show, warn
from alpasim_plugin.core.errors import InputError, error_lines
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.core.parts import resolve, resolve_renderer, split_names
from alpasim_plugin.log.run_folder.manifests import read_run_json
from alpasim_plugin.log.run_folder.records import json_of
from alpasim_plugin.log.run_folder.schema import slug
from alpasim_plugin.runs.fork import Change, fork_rollout
from alpasim_plugin.runs.logged_rollout import find_rollout
from alpasim_plugin.runs.tables import ensure_tables
from evaluators.results import to_json

EPILOG = """
Examples:

- `simrun fork runs/us101/3dgs/lane-camera/us101/0 --at 2.2 --renderer clean`
"""


def fork(
    cell: Annotated[
        Path, Positional("The rollout: RUN/RENDERER/POLICY/SCENE/SEED.", metavar="RUN/CELL")
    ],
    at: Annotated[float, Flag("Seconds after the first frame, of the change.")],
    renderer: Annotated[str | None, Flag("Renderer after the change.")] = None,
    policy: Annotated[str | None, Flag("Policy after the change.")] = None,
    seed: Annotated[int | None, Flag("Seed of the new parts.", min=0)] = None,
    own: Annotated[
        tuple[str, ...],
        Flag("A part of your own that drove the rollout, named again. Repeatable."),
    ] = (),
    out: Annotated[Path | None, Flag("Run folder to write; default: below RUN/forks/.")] = None,
    as_json: Json = False,
) -> None:
    """Continue a logged rollout from an instant with another renderer, policy or seed.

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
    past = find_rollout(run, name, {renderer, policy, *own})
    change = Change(round(at * 1e6), renderer, policy, seed)
    root = out or run / "forks" / slug(f"{past.name} {change.label}")
    result = fork_rollout(past, change, root, ["simrun", *sys.argv[1:]])
    fork_facts = read_run_json(root).fork
    facts = {
        "out": str(root),
        "fork": None if fork_facts is None else json_of(fork_facts),
        "exit_code": result.exit_code,
        "summary": to_json(result.summary),
    }
    lines = []
    if fork_facts is not None:
        lines.append(f"replay to {at:g} s   equal to the log, bit for bit")
    show(as_json, facts, *lines, f"report   {root / 'report.html'}")
    for failed in () if as_json else result.summary.failures.cells:
        warn(failed.path, *error_lines(to_json(failed.error)))
    raise typer.Exit(result.exit_code)

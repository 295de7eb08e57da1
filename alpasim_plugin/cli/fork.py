"""``simrun fork``, ``simrun probe`` and ``simrun why``: counterfactuals of a logged rollout, and
the page that shows why a drive failed.
"""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from alpasim_plugin.cli.options import Json, Run
from alpasim_plugin.cli.progress import warn
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.core.parts import resolve, resolve_renderer, split_names
from alpasim_plugin.log.run_folder.reader import read_json
from alpasim_plugin.log.run_folder.schema import PROBE_JSON, RUN_INFO, slug
from alpasim_plugin.runs.fork import Change, fork_rollout
from alpasim_plugin.runs.logged_rollout import find_rollout
from alpasim_plugin.runs.probe import probe_rollout, write_probe
from alpasim_plugin.runs.repair import use_run
from alpasim_plugin.runs.why import explain
from evaluators.opening import read_run
from evaluators.viewer.cause import write_cause

FORK_EPILOG = """
Examples:

- `simrun fork runs/us101 --cell 3dgs/lane-camera/us101/0 --at 2.2 --renderer clean`

- `simrun fork runs/us101 --cell 3dgs/lane-camera/us101/0 --at 2.2` continues unchanged and checks that the result equals the log
"""
PROBE_EPILOG = (
    "Example: `simrun probe runs/us101 --cell clean/lane-camera/us101/0 --renderers clean,3dgs`"
)

Name = Annotated[str, Flag("RENDERER/POLICY/SCENE/SEED as in the tables, or the rollout's folder.")]
Moved = Annotated[str | None, Flag("The rollout's scenario, if it has moved.")]


def fork(
    run: Run,
    cell: Name,
    at: Annotated[float, Flag("Seconds after the first frame at which the change takes effect.")],
    renderer: Annotated[str | None, Flag("Renderer after the change.")] = None,
    policy: Annotated[
        str | None, Flag("Policy after the change; it has the history of observations.")
    ] = None,
    seed: Annotated[int | None, Flag("Seed of the new parts.", min=0)] = None,
    out: Annotated[
        Path | None, Flag("Run folder to write; by default one below RUN/forks/.")
    ] = None,
    video: Annotated[bool, Flag("Write front.mp4 of the continuation.")] = False,
    scenario: Moved = None,
    as_json: Json = False,
) -> None:
    """Continue a logged rollout from an instant on with another renderer, policy or seed.

    Writes a run folder with the original and the continuation, scored and reported like any run.
    """
    _check_names([renderer] if renderer else [], policy)
    use_run(run, warn)
    past = find_rollout(run, cell, scenario)
    change = Change(round(at * 1e6), renderer, policy, seed)
    root = out or run / "forks" / slug(f"{past.name} {change.label}")
    result = fork_rollout(past, change, root, "all" if video else "none", ["simrun", *sys.argv[1:]])
    fork_facts = read_json(root / "run.json")["fork"]
    if as_json:
        print(
            json.dumps(
                {
                    "out": str(root),
                    "fork": fork_facts,
                    "exit_code": result.exit_code,
                    "summary": result.summary,
                }
            )
        )
        raise typer.Exit(result.exit_code)
    for failed in result.summary["failures"]["cells"]:
        print(
            f"failed: {failed['path']}: {failed['error']['message']} -> {failed['error']['hint']}",
            file=sys.stderr,
        )
    if fork_facts:
        print(f"replay to {at:g} s   equal to the log, bit for bit")
        after = fork_facts.get("continuation")
        if after == "equal":
            print("continuation      equal to the log, bit for bit")
        elif after is not None:
            print(
                f"continuation      differs first in {after['component']} at step {after['step']} ({after['what']})"
            )
    print(f"report   {root / 'report.html'}")
    raise typer.Exit(result.exit_code)


def probe(
    run: Run,
    cell: Name,
    renderers: Annotated[str, Flag("Two or more, comma-separated; the first is the reference.")],
    out: Annotated[
        Path | None, Flag("Folder to write; by default below RUN/probes/, where the report looks.")
    ] = None,
    scenario: Moved = None,
    as_json: Json = False,
) -> None:
    """Query the policy at a logged rollout's poses behind several renderers and measure the
    distance between its plans.
    """
    names = tuple(split_names(renderers))
    _check_names(names, None)
    use_run(run, warn)
    past = find_rollout(run, cell, scenario)
    folder = write_probe(probe_rollout(past, names), past, names, out)
    found = read_json(folder / PROBE_JSON)
    if as_json:
        print(json.dumps({"out": str(folder), "probe": found}))
        return
    for pair in found["pairs"]:
        gaps = [
            f"{key[4:-2]} ahead median {gap['median']:.3f} m, 95 % {gap['p95']:.3f} m"
            for key in pair
            if (gap := _gap(pair, key))
        ]
        first = pair["first_divergence"]
        divergence = (
            f"diverges by {first['gap_m']:.2f} m at {first['after_us'] * 1e-6:.1f} s"
            if first
            else "never diverges by the threshold"
        )
        print(
            f"{pair['renderer']} compared with {pair['reference']}: {'; '.join(gaps)}; {divergence} ({found['threshold_m']} m)"
        )
    print(f"probe  {folder}")


def _gap(pair: dict[str, dict[str, float]], key: str) -> dict[str, float] | None:
    return pair[key] if key.startswith("gap_") else None


def _check_names(renderers: list[str] | tuple[str, ...], policy: str | None) -> None:
    for name in renderers:
        resolve_renderer(name)
    if policy is not None:
        resolve("policy", policy)
    if any("," in name for name in renderers):
        raise InputError(f"--renderer {renderers[0]}: several names", "name one")


WHY_EPILOG = """
Examples:

- `simrun why runs/us101/3dgs/lane-camera/us101/0`

- `simrun why runs/us101/rollouts/3dgs/lane-camera/us101/0`: the same by its folder

The drive is repeated, its policy is asked again with one thing changed at a time, and changes that would mend it are driven.
"""


def why(
    cell: Annotated[
        Path,
        Positional(
            "RUN/RENDERER/POLICY/SCENE/SEED, or the folder of a rollout.", metavar="RUN/CELL"
        ),
    ],
    scenario: Moved = None,
    as_json: Json = False,
) -> None:
    """Show why a drive failed, on one offline page: what the policy saw, planned and said, and
    which single change mends it.
    """
    root = next((folder for folder in cell.parents if (folder / RUN_INFO).exists()), None)
    if root is None:
        raise InputError(
            f"{cell}: no run folder above it",
            "give RUN/RENDERER/POLICY/SCENE/SEED as in the tables of the run",
        )
    use_run(root, warn)
    past = find_rollout(root, cell.relative_to(root).as_posix(), scenario)
    run = read_run(root)
    cause = explain(past, run, warn)
    page = write_cause(run, cause)
    if as_json:
        found = [{"how": how, "text": text} for how, text in cause.sentences]
        print(
            json.dumps(
                {
                    "page": str(page),
                    "outcome": cause.outcome,
                    "found": found,
                    "tried": [list(row) for row in cause.tried],
                }
            )
        )
        return
    print(f"outcome  {cause.outcome}")
    for how, text in cause.sentences:
        print(f"{how:8} {text}")
    print(f"page     {shlex.quote(str(page))}")

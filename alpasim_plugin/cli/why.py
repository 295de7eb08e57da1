"""``simrun why``: the page that shows why a drive failed."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Annotated

from alpasim_plugin.cli.fork import Moved
from alpasim_plugin.cli.options import Json
from alpasim_plugin.cli.progress import warn
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.flags import Positional
from alpasim_plugin.run_folder.schema import RUN_INFO
from alpasim_plugin.runtime.logged_rollout import find_rollout
from alpasim_plugin.runtime.repair import use_run
from alpasim_plugin.runtime.why import DOING, explain
from alpasim_plugin.viewer.cause import write_cause
from evaluators.opening import read_run

EPILOG = """
Examples:

- `simrun why runs/us101/3dgs/lane-camera/us101/0`

- `simrun why runs/us101/rollouts/3dgs/lane-camera/us101/0`: the same by its folder

The drive is repeated, its policy is asked again with one thing changed at a time, and changes that would mend it are driven.
"""


def why(
    cell: Annotated[Path, Positional("RUN/RENDERER/POLICY/SCENE/SEED, or the folder of a rollout.", metavar="RUN/CELL")],
    scenario: Moved = None,
    as_json: Json = False,
) -> None:
    """Show why a drive failed, on one offline page: what the policy saw, planned and said, and which single change mends it."""
    root = next((folder for folder in cell.parents if (folder / RUN_INFO).exists()), None)
    if root is None:
        raise InputError(DOING, str(cell), "no run folder above it", "give RUN/RENDERER/POLICY/SCENE/SEED as in the tables of the run")
    use_run(root, warn)
    past = find_rollout(root, cell.relative_to(root).as_posix(), scenario)
    run = read_run(root)
    cause = explain(past, run, warn)
    page = write_cause(run, cause)
    if as_json:
        found = [{"how": how, "text": text} for how, text in cause.sentences]
        print(json.dumps({"page": str(page), "outcome": cause.outcome, "found": found, "tried": [list(row) for row in cause.tried]}))
        return
    print(f"outcome  {cause.outcome}")
    for how, text in cause.sentences:
        print(f"{how:9}{text}")
    print(f"page     {shlex.quote(str(page))}")

"""``simrun export``: runs and rollouts for AlpaSim's evaluation, Foxglove and Rerun."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from alpasim_plugin.cli.options import (
    Json,
    refuse_existing,
    run_and_cell,
    run_or_newest,
)
from alpasim_plugin.cli.output import Progress, show, warn
from alpasim_plugin.cli.view import cells_wanted
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.log.run_folder.schema import RUN_INFO, SUMMARY
from alpasim_plugin.runs.export import export_run, export_scenes
from alpasim_plugin.runs.recordings import export_mcap, require_mcap
from alpasim_plugin.runs.tables import ensure_tables
from evaluators.pages.cells import Wanted, cells_of, check_wanted, read_logs
from evaluators.statistics.opening import Run

SHOWN_CELLS = 4  # in the message that there are several

EPILOG = """
Examples:

- `simrun export runs/smoke --alpasim exported`, then, where AlpaSim is installed: `alpasim-reeval exported/3dgs/lane-camera`

- `simrun export smoke/lead_car real/us101 --alpasim exported` writes their scenes only

- `simrun export runs/smoke --scene smoke/curve --seed 0 --mcap curve.mcap`: one scene and seed behind every renderer, for Foxglove

- `simrun export runs/smoke/rollouts/3dgs/lane-camera/smoke-curve/0 --mcap curve.mcap`

Exit codes: 0 written; 2 no such run or rollout, several scenes, policies or seeds where one was needed, or a library is not installed; 4 the disk refuses.
"""


def export(
    items: Annotated[
        tuple[str, ...],
        Positional(
            "A run, a rollout, or scenarios (--alpasim).",
            metavar="RUN|ROLLOUT|SCENARIO...",
        ),
    ] = (),
    wanted: Wanted = Wanted(),
    alpasim: Annotated[
        Path | None, Flag("Write AlpaSim run folders; new or empty.", metavar="DIR")
    ] = None,
    mcap: Annotated[
        Path | None, Flag("Write a recording for Foxglove and Rerun; extra [mcap].", metavar="FILE")
    ] = None,
    as_json: Json = False,
) -> None:
    """Write a run as AlpaSim run folders and scenes, or the rollouts of one scene, policy and seed as a recording for Foxglove and
    Rerun.

    With `--alpasim`, one run folder for each renderer and policy: logs, `_complete` marks, metadata
    and settings, so that `alpasim-eval`, `alpasim-aggregation` and `alpasim-reeval` take them as
    they are, and `simrun score --preset alpasim` gives the same numbers.

    With `--mcap`, camera frames, boxes, map, driven path, plans and metrics behind every
    renderer on one time line.
    """
    if (alpasim is None) == (mcap is None):
        raise InputError("simrun export: --alpasim DIR or --mcap FILE", "Give one of both.")
    items = items or (str(run_or_newest(None)),)
    if alpasim is not None:
        if wanted.axes:
            raise InputError(
                "--alpasim: --scene, --policy, --seed or --renderer beside it",
                "Leave them out: a run is exported whole.",
            )
        _export_to_alpasim(items, alpasim, as_json)
        return
    assert mcap is not None
    facts = export_recording(items, wanted, mcap)
    size = f"{facts['bytes'] / 1e6:.1f} MB, {facts['messages']} messages"
    lines = [f"note     {note}" for note in facts["notes"]]
    show(as_json, facts, *lines, f"mcap     {mcap}  {size}: {facts['recording']}")


def _export_to_alpasim(items: Sequence[str], folder: Path, as_json: bool) -> None:
    runs = [item for item in items if os.path.exists(Path(item) / RUN_INFO)]
    if runs and len(items) > 1:
        raise InputError(
            f"{' '.join(items)}: a run folder among several items", "Export one run at a time."
        )
    if runs:
        run = Path(runs[0])
        ensure_tables(run, warn)
        done = export_run(run, folder, Progress(as_json).say)
    else:
        done = export_scenes(items, folder)
    lines = []
    for exported_run in done.runs:
        failed = f", {exported_run.failed} failed" if exported_run.failed else ""
        lines.append(
            f"run     {done.root / exported_run.folder}  {exported_run.rollouts} rollouts{failed}"
        )
    lines += [f"scene   {done.root / scene}" for scene in done.scenes]
    exported = [vars(exported_run) for exported_run in done.runs]
    facts = {"out": str(done.root), "runs": exported, "scenes": list(done.scenes)}
    show(as_json, facts, *lines)


def export_recording(items: Sequence[str], selection: Wanted, path: Path) -> dict[str, Any]:
    """Write an MCAP recording of one scene, policy and seed.

    Args:
        items: The run folder or the rollout's folder; one.
        selection: Which scene, policy and seed of a run, and which renderers.
        path: The file.

    Returns:
        As `export_mcap`.

    Raises:
        InputError: Not one run or rollout, several scenes, policies or seeds, a file that is there already, a damaged
            log, or the library is not installed.
        InfrastructureError: The disk refuses.
    """
    if len(items) > 1:
        raise InputError(
            f"{' '.join(items)}: several items",
            "Give one run folder, or the folder of one rollout.",
        )
    refuse_existing(path, "--mcap")
    require_mcap()  # before anything is read
    root, cell = run_and_cell(Path(items[0]))
    if os.path.exists(root / SUMMARY):
        ensure_tables(root, warn)
    run = Run.read_so_far(root)
    wanted = cells_wanted(run.rollouts, cell, selection)
    check_wanted(run, wanted)
    cells = cells_of(run, wanted)
    if len(cells) != 1:
        names = "; ".join(cell.name for cell in cells[:SHOWN_CELLS])
        raise InputError(
            f"{root}: {len(cells)} finished rollouts of scene, policy and seed: {names}",
            "Choose one by --scene, --policy and --seed, or name a rollout's folder.",
        )
    return export_mcap(run, cells[0], read_logs(run, cells[0]), path)

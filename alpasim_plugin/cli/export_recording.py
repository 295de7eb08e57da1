"""The part of ``simrun export`` that writes recordings: finds the cell that was asked for, and writes each file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from alpasim_plugin.cli.rollout_folders import find_cell, narrowed
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.recordings.content import DOING, Recording, collect
from alpasim_plugin.recordings.mcap_file import require_mcap, write_mcap
from alpasim_plugin.recordings.rerun_file import require_rerun, write_rrd
from alpasim_plugin.run_folder.schema import CONTENTS
from alpasim_plugin.runtime.repair import use_run
from alpasim_plugin.viewer.cells import Wanted, cells_of, check_wanted
from alpasim_plugin.viewer.page_data import read_logs
from evaluators.opening import read_so_far

FORMATS: dict[str, Callable[[Recording, Path], Mapping[str, int]]] = {"mcap": write_mcap, "rrd": write_rrd}
REQUIRE: dict[str, Callable[[], object]] = {"mcap": require_mcap, "rrd": require_rerun}
NAMED = 4  # cells in the message that there are several


@dataclass(frozen=True)
class Asked:
    """What is to be exported.

    Attributes:
        items: The run folder or the rollout's folder; one.
        wanted: Which cell of a run, and which renderers.
        files: Format -> file.
        overwrite: Replace files that are there.
    """

    items: Sequence[str]
    wanted: Wanted
    files: Mapping[str, Path]
    overwrite: bool


@dataclass(frozen=True)
class Exported:
    """What was written.

    Attributes:
        name: Scene, policy and seed.
        files: One entry each: ``format``, ``file``, ``bytes``, ``messages``, and ``channels`` with the number of messages of each.
        notes: What is missing, one sentence each.
    """

    name: str
    files: tuple[dict[str, Any], ...]
    notes: tuple[str, ...]


def export_recording(asked: Asked, say: Callable[[str], None]) -> Exported:
    """Write a recording of one cell, in each format that was asked for.

    Args:
        asked: What.
        say: Called with one line for each thing that is damaged.

    Raises:
        InputError: Not one run or rollout, several cells, a file that is there already, a damaged log, or a library is not installed.
        InfrastructureError: The disk refuses.
    """
    if len(asked.items) > 1:
        raise InputError(DOING, " ".join(asked.items), "several items", "give one run folder, or the folder of one rollout")
    there = [path for path in asked.files.values() if path.exists() and not asked.overwrite]
    if there:
        raise InputError(DOING, str(there[0]), "it exists already", "name another file, or pass --overwrite")
    for name in asked.files:
        REQUIRE[name]()  # before anything is read
    what = Path(asked.items[0])
    root, of_rollout = find_cell(what, DOING)
    if (root / CONTENTS).exists():
        use_run(root, say)
    run = read_so_far(root).run
    wanted = narrowed(what, of_rollout, asked.wanted, DOING)
    check_wanted(run, wanted)
    cells = cells_of(run, wanted)
    if len(cells) != 1:
        some = "; ".join(cell.name for cell in cells[:NAMED]) + (f"; {len(cells) - NAMED} more" if len(cells) > NAMED else "")
        found = f"{len(cells)} cells of scene, policy and seed: {some}" if cells else "no finished rollout that was asked for"
        raise InputError(DOING, str(root), found, "choose one by --scene, --policy and --seed, or name a rollout's folder")
    recording = collect(run, cells[0], read_logs(run, cells[0]))
    files = []
    for name, path in asked.files.items():
        counts = dict(FORMATS[name](recording, path))
        facts = {"format": name, "file": str(path), "bytes": path.stat().st_size, "messages": sum(counts.values()), "channels": counts}
        files.append(facts)
    return Exported(recording.name, tuple(files), recording.notes)

"""Write pages of a run: all that was asked for, or the changed outcomes that its report links to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlencode

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.io.atomic import write_text
from alpasim_plugin.run_folder.reader import reporting
from alpasim_plugin.viewer.cells import Wanted, WatchedCell, cells_of, check_wanted, shown_by_default, telling
from alpasim_plugin.viewer.page import MB, Options, make_page
from alpasim_plugin.viewer.pictures import Fineness
from evaluators.opening import Run, read_run

DOING = "writing a page to watch"
FLIPS_PAGE, REPORT = "flips.html", "report.html"
FLIPS_OPTIONS = Options(max_bytes=6 * MB, fine=Fineness(stride=2, width_px=384))
MAX_FLIP_CELLS = 8  # a run must not wait for its page


@dataclass(frozen=True)
class Written:
    """A page on the disk.

    Attributes:
        path: The file.
        size: Bytes.
        shown: Cells that it replays.
        known: All cells that were asked for.
        notes: What it leaves out.
    """

    path: Path
    size: int
    shown: tuple[WatchedCell, ...]
    known: tuple[WatchedCell, ...]
    notes: tuple[str, ...]


def write_page(run: Run, path: Path, wanted: Wanted, options: Options, at_most: int | None) -> Written:
    """Write an offline page.

    Args:
        run: The run.
        path: The file.
        wanted: Which rollouts.
        options: Size and frames.
        at_most: Most cells; None as `shown_by_default` says.

    Raises:
        InputError: Nothing was asked for that the run has, or a file of the run is damaged.
        InfrastructureError: The page cannot be written.
    """
    check_wanted(run, wanted)
    cells = cells_of(run, wanted)
    if not any(cell.watchable for cell in cells):
        raise InputError(DOING, str(run.folder), "no finished rollout that was asked for", "ask for others; simrun report lists failures")
    with reporting(run):
        page = make_page(run, cells, shown_by_default(cells, wanted, at_most), options, _report_beside(run, path))
    write_text(path, page.html, DOING)
    return Written(path, path.stat().st_size, page.cells, tuple(cells), page.notes)


def _report_beside(run: Run, path: Path) -> str:
    """Return the address of the run's report for a page in its folder; "" for other pages and without a report."""
    return REPORT if path.resolve().parent == run.folder.resolve() and (run.folder / REPORT).is_file() else ""


def write_flips_page(root: Path) -> Mapping[tuple[str, str, str, int], str]:
    """Write ``flips.html`` of a run folder: its changed outcomes alone, small. Without any, one of an earlier command is removed.

    Returns:
        Key of a changed rollout -> its address in the page, for those for which there was room.

    Raises:
        InputError: The run folder is not complete enough to be read.
    """
    run = read_run(root)
    flipped = telling(cells_of(run))
    if not flipped:
        (root / FLIPS_PAGE).unlink(missing_ok=True)
        return {}
    with reporting(run):
        page = make_page(run, flipped, flipped[:MAX_FLIP_CELLS], FLIPS_OPTIONS, REPORT)
    write_text(root / FLIPS_PAGE, page.html, DOING)
    return {flip.key: f"{FLIPS_PAGE}#{address(cell, flip.other.renderer)}" for cell in page.cells for flip in cell.flips}


def address(cell: WatchedCell, renderer: str) -> str:
    """Return the part of an address that opens a cell with one renderer followed."""
    return urlencode({"scene": cell.scene, "policy": cell.policy, "seed": cell.seed, "renderer": renderer})

"""The page: one HTML file without outside requests that holds cells as far as its size allows, or
the shell that a server fills.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from markupsafe import Markup

from alpasim_plugin.core.atomic import write_text
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.log.run_folder.reader import reporting
from evaluators.opening import Run, read_run
from evaluators.report.flips import FlipKey
from evaluators.report.html import asset, environment_of
from evaluators.report.numbers import plural
from evaluators.viewer.cells import (
    Wanted,
    WatchedCell,
    cell_data,
    cells_of,
    check_wanted,
    index_data,
    read_logs,
    shown_by_default,
    telling,
)
from evaluators.viewer.pictures import Fineness

MOST_STRIDE = 4  # coarser frames than this are worse to watch than fewer cells
NOTES_BYTES = 600  # what notes of what was left out may add to a page


@dataclass(frozen=True)
class Fitted:
    """What a page holds.

    Attributes:
        cells: In the order asked for.
        documents: Their JSON, one each.
        fine: How finely frames are kept.
        too_many: Cells for which there was no room.
    """

    cells: tuple[WatchedCell, ...]
    documents: tuple[str, ...]
    fine: Fineness
    too_many: tuple[WatchedCell, ...]


def fit(
    run: Run, cells: Sequence[WatchedCell], budget_bytes: int, wanted: Fineness, camera: str | None
) -> Fitted:
    """Choose how finely frames are kept, and how many cells there is room for; the first cell is
    always kept.

    Frames are thinned out evenly, down to every `MOST_STRIDE`-th, before cells are left out from
    the end.

    Args:
        run: The run.
        cells: The most telling first.
        budget_bytes: Most bytes of all documents.
        wanted: The finest that is kept.
        camera: As for `cell_data`.
    """
    factors = range(1, max(1, MOST_STRIDE // wanted.stride) + 1)
    made: list[dict[str, Any]] = []
    used = dict.fromkeys(factors, 0)  # bytes of what is made, by how much it is thinned
    for cell in cells:
        document = cell_data(run, cell, read_logs(run, cell), wanted, camera)
        sizes = {factor: len(as_json(thinned(document, factor))) for factor in factors}
        if made and used[factors[-1]] + sizes[factors[-1]] > budget_bytes:
            break
        made.append(document)
        used = {factor: used[factor] + sizes[factor] for factor in factors}
    factor = next((factor for factor in factors if used[factor] <= budget_bytes), factors[-1])
    fine = replace(wanted, stride=wanted.stride * factor)
    kept = len(made)
    return Fitted(
        tuple(cells[:kept]),
        tuple(as_json(thinned(one, factor)) for one in made),
        fine,
        tuple(cells[kept:]),
    )


def thinned(document: Mapping[str, Any], factor: int) -> dict[str, Any]:
    """Return a cell's document with every factor-th camera frame alone."""
    drives = [
        {
            **drive,
            "cameras": [
                {**one, "t": one["t"][::factor], "jpeg": one["jpeg"][::factor]}
                for one in drive["cameras"]
            ],
        }
        if "cameras" in drive
        else drive
        for drive in document["drives"]
    ]
    return {**document, "drives": drives}


def as_json(value: Any) -> str:
    """Write compact JSON that can stand in a script element: nothing in it can end the element or
    begin another.

    Example:
        >>> as_json({"scene": "</script><!--"})
        '{"scene":"\\\\u003c/script\\\\u003e\\\\u003c!--"}'
    """
    text = json.dumps(
        value, separators=(",", ":"), allow_nan=False
    )  # ASCII: line separators of JavaScript are escaped too
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def names(cells: Iterable[WatchedCell], at_most: int = 12) -> str:
    """List cells in words."""
    listed = [cell.name for cell in cells]
    more = len(listed) - at_most
    return "; ".join(listed[:at_most]) + (f"; and {more} more" if more > 0 else "")


MB = 1_000_000
DEFAULT_MB = 15.0  # megabytes, not mebibytes
SCRIPTS = (
    "theme.js",
    "timeline.js",
    "overlay.js",
    "cameras.js",
    "birdseye.js",
    "curves.js",
    "moments.js",
    "player.js",
)
STYLES = ("theme.css", "viewer.css")


@dataclass(frozen=True)
class Options:
    """How a page is made.

    Attributes:
        max_bytes: Size of the file.
        fine: The finest camera frames that are kept.
        camera: Keep this camera alone.
    """

    max_bytes: int = int(DEFAULT_MB * MB)
    fine: Fineness = Fineness()
    camera: str | None = None


@dataclass(frozen=True)
class Page:
    """A page, and what is in it."""

    html: str
    cells: tuple[WatchedCell, ...]
    notes: tuple[str, ...]


def make_page(
    run: Run,
    cells: Sequence[WatchedCell],
    shown: Sequence[WatchedCell],
    options: Options,
    report: str = "",
) -> Page:
    """Return an offline page.

    Args:
        run: The run.
        cells: All that were asked for, the most telling first.
        shown: Those that the page holds as far as its size allows.
        options: Bounds.
        report: Address of the run's report, relative to the page.

    Raises:
        InputError: A rollout's files are damaged.
    """
    shell = len(render(as_json(index_data(run, cells, (), {"notes": [], "report": report})), {}))
    fitted = fit(run, shown, options.max_bytes - shell - NOTES_BYTES, options.fine, options.camera)
    notes = _notes(cells, shown, fitted.too_many, fitted.fine)
    index = index_data(run, cells, fitted.cells, {"notes": notes, "report": report})
    documents = dict(zip((cell.id for cell in fitted.cells), fitted.documents, strict=True))
    return Page(render(as_json(index), documents), fitted.cells, tuple(notes))


def render(index: str, documents: Mapping[str, str]) -> str:
    """Fill the template.

    Args:
        index: JSON of `index_data`.
        documents: Cell id -> JSON of `cell_data`.
    """
    filled = {name: Markup(text) for name, text in documents.items()}
    return fill("viewer.html.j2", SCRIPTS, STYLES, index=Markup(index), documents=filled)


def fill(template: str, scripts: Sequence[str], styles: Sequence[str], **values: Any) -> str:
    """Fill a template of a page that holds its scripts and styles and allows no others."""
    environment = environment_of(
        "evaluators.viewer", "evaluators.report"
    )  # colours are the report's
    script = "\n".join(asset(environment, name) for name in scripts)
    style = "\n".join(asset(environment, name) for name in styles)
    own = {
        "style": Markup(style),
        "style_hash": _sha256(style),
        "script": Markup(script),
        "script_hash": _sha256(script),
    }
    return environment.get_template(template).render(**own, **values)


def _sha256(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _notes(
    cells: Sequence[WatchedCell],
    shown: Sequence[WatchedCell],
    too_many: Sequence[WatchedCell],
    fine: Fineness,
) -> list[str]:
    """Say what the page does not hold, one sentence each."""
    ids = {cell.id for cell in shown}
    left = [cell for cell in cells if cell.id not in ids and cell.watchable]
    failed = [cell for cell in cells if not cell.watchable]
    notes = []
    if too_many:
        notes.append(
            f"No room for {plural(len(too_many), 'cell')}: {names(too_many)}. --max-mb makes room."
        )
    if left:
        what = (
            "in which nothing happened"
            if all(cell.interest == "quiet" for cell in left)
            else "not chosen"
        )
        how = "--scene, --policy and --seed choose."
        notes.append(f"{plural(len(left), 'cell')} {what} left out: {names(left)}. {how}")
    if failed:
        notes.append(
            f"Nothing to see of {plural(len(failed), 'cell')} in which every rollout failed: {names(failed)}."
        )
    if fine.stride > 1:
        notes.append(
            f"Every {ordinal(fine.stride)} camera frame is kept: --max-mb makes room. Poses, plans and metrics are whole."
        )
    return notes


def ordinal(number: int) -> str:
    """Name a small number in order.

    Example:
        >>> ordinal(2), ordinal(3), ordinal(4)
        ('second', 'third', '4th')
    """
    return {2: "second", 3: "third"}.get(number, f"{number}th")


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


def write_page(
    run: Run, path: Path, wanted: Wanted, options: Options, at_most: int | None
) -> Written:
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
    cells = cells_of(run, wanted, arms=True)
    if not any(cell.watchable for cell in cells):
        raise InputError(
            f"{run.folder}: no finished rollout that was asked for",
            "ask for others; simrun report lists failures",
        )
    with reporting(run):
        beside = path.resolve().parent == run.folder.resolve() and (run.folder / REPORT).is_file()
        page = make_page(
            run, cells, shown_by_default(cells, wanted, at_most), options, REPORT if beside else ""
        )
    write_text(path, page.html)
    return Written(path, path.stat().st_size, page.cells, tuple(cells), page.notes)


def write_flips_page(run_dir: Path | Run) -> Mapping[FlipKey, str]:
    """Write ``flips.html`` of a run folder: its changed outcomes alone, small. Without any, one of
    an earlier command is removed.

    Returns:
        Key of a changed rollout -> its address in the page, for those for which there was room.

    Raises:
        InputError: The run folder is not complete enough to be read.
    """
    run = read_run(run_dir)
    flipped = telling(cells_of(run, arms=True))
    if not flipped:
        (run.folder / FLIPS_PAGE).unlink(missing_ok=True)
        return {}
    with reporting(run):
        page = make_page(run, flipped, flipped[:MAX_FLIP_CELLS], FLIPS_OPTIONS, REPORT)
    write_text(run.folder / FLIPS_PAGE, page.html)
    return {
        flip.key: f"{FLIPS_PAGE}#{address(cell, cell.side(flip.other))}"
        for cell in page.cells
        for flip in cell.flips
    }


def address(cell: WatchedCell, renderer: str) -> str:
    """Return the part of an address that opens a cell with one of its drives followed."""
    return urlencode(
        {"scene": cell.scene, "policy": cell.policy, "seed": cell.seed, "renderer": renderer}
    )

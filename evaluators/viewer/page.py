"""The replay of a run as one HTML file without outside requests: it holds cells as far as its size
allows.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from markupsafe import Markup

from alpasim_plugin.core.atomic import write_text
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.json_types import JsonObject, JsonView
from alpasim_plugin.core.reading import real
from alpasim_plugin.log.run_folder.reader import reporting
from evaluators.numbers import plural
from evaluators.opening import Run, read_run
from evaluators.report.flips import FlipKey
from evaluators.report.html import asset, environment_of
from evaluators.viewer.cells import (
    Wanted,
    WatchedCell,
    cell_data,
    cells_of,
    check_wanted,
    index_data,
    read_logs,
    shown_by_default,
)
from evaluators.viewer.pictures import Fineness

MB = 1_000_000
DEFAULT_MB = 15.0  # megabytes, not mebibytes
MOST_STRIDE = 4  # coarser frames than this are worse to watch than fewer cells
NOTES_BYTES = 600  # what notes of what was left out may add to a page
NAMED = 12  # cells that a note names
FLIPS_PAGE, REPORT = "flips.html", "report.html"
FLIPS_BYTES = 6 * MB
FLIPS_FRAMES = Fineness(stride=2, width_px=384)
MAX_FLIP_CELLS = 8  # a run must not wait for its page
ORDINALS = {2: "second", 3: "third"}
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
class Page:
    """A page, the cells that it replays, and what it leaves out, a sentence each."""

    html: str
    cells: tuple[WatchedCell, ...]
    notes: tuple[str, ...]


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
    run: Run, path: Path, wanted: Wanted, max_bytes: int = int(DEFAULT_MB * MB)
) -> Written:
    """Write an offline page.

    Args:
        run: The run.
        path: The file.
        wanted: Which rollouts.
        max_bytes: Size of the file.

    Raises:
        InputError: Nothing was asked for that the run has, or a file of the run is damaged.
        InfrastructureError: The page cannot be written.
    """
    check_wanted(run, wanted)
    cells = cells_of(run, wanted, arms=True)
    if not any(cell.watchable for cell in cells):
        raise InputError(
            f"{run.folder}: no finished rollout that was asked for",
            "Ask for others; simrun report lists failures.",
        )
    is_beside = real(path).parent == real(run.folder) and os.path.isfile(run.folder / REPORT)
    with reporting(run):
        shown = shown_by_default(cells, wanted)
        page = make_page(run, cells, shown, max_bytes, report=REPORT if is_beside else "")
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
    path = run.folder / FLIPS_PAGE
    flipped = [cell for cell in cells_of(run, arms=True) if cell.flips and cell.watchable]
    if not flipped:
        path.unlink(missing_ok=True)
        return {}
    with reporting(run):
        shown = flipped[:MAX_FLIP_CELLS]
        page = make_page(run, flipped, shown, FLIPS_BYTES, FLIPS_FRAMES, REPORT)
    write_text(path, page.html)
    addresses = {}
    for cell in page.cells:
        for flip in cell.flips:
            place = {"scene": cell.scene, "policy": cell.policy, "seed": cell.seed}
            place["renderer"] = cell.side(flip.other)
            addresses[flip.key] = f"{FLIPS_PAGE}#{urlencode(place)}"
    return addresses


def make_page(
    run: Run,
    cells: Sequence[WatchedCell],
    shown: Sequence[WatchedCell],
    max_bytes: int = int(DEFAULT_MB * MB),
    fine: Fineness = Fineness(),
    report: str = "",
) -> Page:
    """Return an offline page.

    Frames are thinned out evenly, down to every `MOST_STRIDE`-th, before cells are left out from
    the end; the first cell is always kept.

    Args:
        run: The run.
        cells: All that were asked for, the most telling first.
        shown: Those that the page holds as far as its size allows.
        max_bytes: Size of the file.
        fine: The finest camera frames that are kept.
        report: Address of the run's report, relative to the page.

    Raises:
        InputError: A rollout's files are damaged.
    """
    shell = len(render(as_json(index_data(run, cells, (), [], report)), {}))
    room = max_bytes - shell - NOTES_BYTES
    factors = range(1, max(1, MOST_STRIDE // fine.stride) + 1)
    used = dict.fromkeys(factors, 0)  # bytes of the documents, by how much they are thinned
    documents: list[JsonObject] = []
    for cell in shown:
        document = cell_data(run, cell, read_logs(run, cell), fine)
        sizes = {factor: len(as_json(thinned(document, factor))) for factor in factors}
        if documents and used[factors[-1]] + sizes[factors[-1]] > room:
            break
        documents.append(document)
        used = {factor: used[factor] + sizes[factor] for factor in factors}
    factor = next((factor for factor in factors if used[factor] <= room), factors[-1])
    kept = tuple(shown[: len(documents)])
    notes = _notes(cells, shown, shown[len(kept) :], fine.stride * factor)
    index = as_json(index_data(run, cells, kept, notes, report))
    texts = {
        cell.id: as_json(thinned(document, factor))
        for cell, document in zip(kept, documents, strict=True)
    }
    return Page(render(index, texts), kept, tuple(notes))


def thinned(document: JsonView, factor: int) -> JsonObject:
    """Return a cell's document with every factor-th camera frame alone."""
    drives = []
    for drive in document["drives"]:
        cameras = [
            camera | {"t": camera["t"][::factor], "jpeg": camera["jpeg"][::factor]}
            for camera in drive.get("cameras", ())
        ]
        drives.append(drive | {"cameras": cameras} if cameras else drive)
    return {**document, "drives": drives}


def as_json(value: Any) -> str:
    """Write compact JSON that can stand in a script element: nothing in it can end the element or
    begin another.

    Example:
        >>> as_json({"scene": "</script><!--"})
        '{"scene":"\\\\u003c/script\\\\u003e\\\\u003c!--"}'
    """
    # ASCII: line separators of JavaScript are escaped too
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def render(index: str, documents: Mapping[str, str]) -> str:
    """Fill the template.

    Args:
        index: JSON of `index_data`.
        documents: Cell id -> JSON of `cell_data`.
    """
    texts = {name: Markup(text) for name, text in documents.items()}
    return fill("viewer.html.j2", SCRIPTS, STYLES, index=Markup(index), documents=texts)


def fill(template: str, scripts: Sequence[str], styles: Sequence[str], **values: Any) -> str:
    """Fill a template of a page that holds its scripts and styles and allows no others."""
    environment = environment_of("evaluators.viewer", "evaluators.report")  # shared colours
    for kind, names in (("script", scripts), ("style", styles)):
        text = "\n".join(asset(environment, name) for name in names)
        values[kind] = Markup(text)
        values[f"{kind}_hash"] = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    return environment.get_template(template).render(**values)


def _notes(
    cells: Sequence[WatchedCell],
    shown: Sequence[WatchedCell],
    too_many: Sequence[WatchedCell],
    stride: int,
) -> list[str]:
    """Say what the page does not hold, one sentence each."""
    ids = {cell.id for cell in shown}
    left = [cell for cell in cells if cell.id not in ids and cell.watchable]
    failed = [cell for cell in cells if not cell.watchable]
    notes = []
    if too_many:
        notes.append(f"No room for {_named(too_many)}. --scene, --policy and --seed choose.")
    if left:
        why = "not chosen"
        if all(cell.interest == "quiet" for cell in left):
            why = "in which nothing happened"
        notes.append(f"Left out {why}: {_named(left)}. --scene, --policy and --seed choose.")
    if failed:
        notes.append(f"Every rollout failed, so that nothing is shown: {_named(failed)}.")
    if stride > 1:
        ordinal = ORDINALS.get(stride, f"{stride}th")
        notes.append(f"Every {ordinal} camera frame is kept. Poses, plans and metrics are whole.")
    return notes


def _named(cells: Sequence[WatchedCell]) -> str:
    """Count cells and list the first."""
    names = [cell.name for cell in cells[:NAMED]]
    if len(cells) > NAMED:
        names.append(f"and {len(cells) - NAMED} more")
    return f"{plural(len(cells), 'cell')}: {'; '.join(names)}"

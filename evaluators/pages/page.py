"""The replay of a run as one HTML file without outside requests: it holds cells as far as its size
allows.
"""

import base64
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import real
from alpasim_plugin.core.files.atomic import write_text
from alpasim_plugin.core.json_types import JsonObject, JsonView
from alpasim_plugin.log.run_folder.reader import reporting
from evaluators.pages.cells import (
    Wanted,
    WatchedCell,
    cell_data,
    cells_of,
    check_wanted,
    index_data,
    read_logs,
    shown_by_default,
)
from evaluators.pages.html import asset, environment_of
from evaluators.statistics.numbers import plural
from evaluators.statistics.opening import Run

MB = 1_000_000
MAX_BYTES = 15 * MB  # of a page; megabytes, not mebibytes
STRIDES = (1, 2, 3, 4)  # every how manieth frame is kept: coarser is worse than fewer cells
NOTES_BYTES = 600  # what notes of what was left out may add to a page
NAMED = 12  # cells that a note names
REPORT = "report.html"
ORDINALS = {2: "second", 3: "third", 4: "fourth"}
SCRIPTS = (
    "theme.js",
    "timeline.js",
    "lens.js",
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
    """A page on the disk.

    Attributes:
        path: The file.
        size: Bytes.
        cells: Cells that it replays.
        all_cells: All cells that were asked for.
        notes: What it leaves out, a sentence each.
    """

    path: Path
    size: int
    cells: Sequence[WatchedCell]
    all_cells: Sequence[WatchedCell]
    notes: Sequence[str]


def write_page(run: Run, path: Path, wanted: Wanted, max_bytes: int = MAX_BYTES) -> Page:
    """Write an offline page.

    Frames are thinned out evenly before cells are left out from the end; the first cell is always
    kept.

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
    report = REPORT if is_beside else ""
    default_cells = shown_by_default(cells, wanted)
    with reporting(run):
        shell = len(_render(index_data(run, cells, (), [], report), {}))
        room = max_bytes - shell - NOTES_BYTES
        used = np.zeros(len(STRIDES))  # bytes of the documents, by how much they are thinned
        documents: dict[str, JsonObject] = {}
        for cell in default_cells:
            document = cell_data(run, cell, read_logs(run, cell))
            sizes = [len(as_json(thinned(document, stride))) for stride in STRIDES]
            if documents and used[-1] + sizes[-1] > room:
                break
            documents[cell.id] = document
            used += sizes
        stride = next(
            (n for n, size in zip(STRIDES, used, strict=True) if size <= room), STRIDES[-1]
        )
        page_cells = default_cells[: len(documents)]
        notes = _notes(cells, default_cells, default_cells[len(page_cells) :], stride)
        texts = {name: as_json(thinned(document, stride)) for name, document in documents.items()}
        html = _render(index_data(run, cells, page_cells, notes, report), texts)
    write_text(path, html)
    return Page(path, path.stat().st_size, page_cells, cells, notes)


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


def _render(index: JsonObject, documents: Mapping[str, str]) -> str:
    """Fill the template with the index of the run and the JSON of its cells, by their ids."""
    texts = {name: Markup(text) for name, text in documents.items()}
    return fill("viewer.html.j2", SCRIPTS, STYLES, index=Markup(as_json(index)), documents=texts)


def fill(template: str, scripts: Sequence[str], styles: Sequence[str], **values: Any) -> str:
    """Fill a template of a page that holds its scripts and styles and allows no others."""
    environment = environment_of("evaluators.pages")  # shared colours
    for kind, names in (("script", scripts), ("style", styles)):
        text = "\n".join(asset(environment, name) for name in names)
        values[kind] = Markup(text)
        values[f"{kind}_hash"] = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    return environment.get_template(template).render(**values)


def _notes(
    cells: Sequence[WatchedCell],
    default_cells: Sequence[WatchedCell],
    too_many: Sequence[WatchedCell],
    stride: int,
) -> list[str]:
    """Say what the page does not hold, one sentence each."""
    ids = {cell.id for cell in default_cells}
    left = [cell for cell in cells if cell.id not in ids and cell.watchable]
    failed = [cell for cell in cells if not cell.watchable]
    reasons = {
        "No room for": (too_many, " --scene, --policy and --seed choose."),
        "Left out": (left, " --scene, --policy and --seed choose."),
        "Not shown, as every rollout failed,": (failed, ""),
    }
    notes = [
        f"{reason} {_named(left_out)}.{hint}"
        for reason, (left_out, hint) in reasons.items()
        if left_out
    ]
    if stride > 1:
        notes.append(
            f"Every {ORDINALS[stride]} camera frame is kept. Poses, plans and metrics are whole."
        )
    return notes


def _named(cells: Sequence[WatchedCell]) -> str:
    """Count cells and list the first."""
    names = [cell.name for cell in cells[:NAMED]]
    if len(cells) > NAMED:
        names.append(f"and {len(cells) - NAMED} more")
    return f"{plural(len(cells), 'rollout')}: {'; '.join(names)}"

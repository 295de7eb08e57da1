"""Fit the cells that somebody wants to watch into a page of bounded size."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from alpasim_plugin.viewer.cells import WatchedCell
from alpasim_plugin.viewer.page_data import cell_data, read_logs
from alpasim_plugin.viewer.pictures import Fineness
from evaluators.opening import Run

MOST_STRIDE = 4  # coarser frames than this are worse to watch than fewer cells


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


def fit(run: Run, cells: Sequence[WatchedCell], budget_bytes: int, wanted: Fineness, camera: str | None) -> Fitted:
    """Choose how finely frames are kept, and how many cells there is room for; the first cell is always kept.

    Frames are thinned out evenly, down to every `MOST_STRIDE`-th, before cells are left out from the end.

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
    return Fitted(tuple(cells[:kept]), tuple(as_json(thinned(one, factor)) for one in made), fine, tuple(cells[kept:]))


def thinned(document: Mapping[str, Any], factor: int) -> dict[str, Any]:
    """Return a cell's document with every factor-th camera frame alone."""
    drives = [
        {**drive, "cameras": [{**one, "t": one["t"][::factor], "jpeg": one["jpeg"][::factor]} for one in drive["cameras"]]}
        if "cameras" in drive
        else drive
        for drive in document["drives"]
    ]
    return {**document, "drives": drives}


def as_json(value: Any) -> str:
    """Write compact JSON that can stand in a script element: nothing in it can end the element or begin another.

    Example:
        >>> as_json({"scene": "</script><!--"})
        '{"scene":"\\\\u003c/script\\\\u003e\\\\u003c!--"}'
    """
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)  # ASCII: line separators of JavaScript are escaped too
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def names(cells: Iterable[WatchedCell], at_most: int = 12) -> str:
    """List cells in words."""
    listed = [cell.name for cell in cells]
    more = len(listed) - at_most
    return "; ".join(listed[:at_most]) + (f"; and {more} more" if more > 0 else "")

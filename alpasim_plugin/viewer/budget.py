"""Fit the cells that somebody wants to watch into a page of bounded size."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from alpasim_plugin.errors import SimrunError
from alpasim_plugin.viewer.cells import WatchedCell
from alpasim_plugin.viewer.page_data import cell_data, read_logs
from alpasim_plugin.viewer.pictures import Fineness, estimated_bytes, sources
from evaluators.report.run_folder import Run

MOST_STRIDE = 4  # coarser frames than this are worse to watch than fewer cells


@dataclass(frozen=True)
class Cost:
    """What a cell is about to cost: bytes without camera frames, number of frames, and bytes of one on the page."""

    bare_bytes: int
    frames: int
    frame_bytes: int

    def total(self, stride: int) -> int:
        """Return the bytes at a stride."""
        return self.bare_bytes + self.frame_bytes * -(-self.frames // stride)


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
    coarsest = max(wanted.stride, MOST_STRIDE)
    costs: list[Cost] = []
    for cell in cells:
        costs.append(_cost(run, cell, wanted.width_px, camera))
        if sum(cost.total(coarsest) for cost in costs) > budget_bytes:  # logs of cells that cannot fit are not read
            break
    count = len(costs)
    while count > 1 and sum(cost.total(coarsest) for cost in costs[:count]) > budget_bytes:
        count -= 1
    strides = range(wanted.stride, coarsest)
    stride = next((k for k in strides if sum(cost.total(k) for cost in costs[:count]) <= budget_bytes), coarsest)
    fine = replace(wanted, stride=stride)
    documents: list[str] = []
    for cell in cells[:count]:
        document = as_json(cell_data(run, cell, read_logs(run, cell), fine, camera))
        if documents and sum(map(len, documents)) + len(document) > budget_bytes:  # frames that are larger than the sampled ones
            break
        documents.append(document)
    kept = len(documents)
    return Fitted(tuple(cells[:kept]), tuple(documents), fine, tuple(cells[kept:]))


def _cost(run: Run, cell: WatchedCell, width_px: int, camera: str | None) -> Cost:
    logs = read_logs(run, cell)
    readable = [(r, logs[r.path]) for r in cell.rollouts if r.ok]
    found = [one for rollout, log in readable if not isinstance(log, SimrunError) for one in sources(run, rollout, log)]
    estimates = [estimated_bytes(one, width_px) for one in found if camera in (None, one.camera)]
    frames = sum(count for count, _ in estimates)
    each = round(sum(count * size for count, size in estimates) / frames) if frames else 0
    return Cost(len(as_json(cell_data(run, cell, logs, None))), frames, each)


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

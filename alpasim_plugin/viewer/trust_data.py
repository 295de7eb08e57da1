"""Where the pictures of a rollout come from, as a page shows it: by cell of a picture, and in words before an event."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from alpasim_plugin.fixers.trust import CELLS, GUESSED, RECORDED
from alpasim_plugin.log import read_facts
from alpasim_plugin.run_folder.rows import Rollout
from alpasim_plugin.run_folder.schema import FRAMES_NAME
from evaluators.opening import Run

BEFORE_US = 1_000_000  # of an event: the pictures that led to it

Rows = Sequence[Mapping[str, Any]]


def frame_rows(run: Run, rollout: Rollout) -> Rows:
    """Return the facts of a rollout's camera frames; none where the run kept none."""
    path = run.file_of(rollout, FRAMES_NAME)
    return read_facts(path) if path is not None else []


def cells_by_time(rows: Rows, camera: str) -> dict[int, str]:
    """Return the text of `trust_cells` of a camera's frames by time, microseconds."""
    return {int(row["t_us"]): str(row[CELLS]) for row in rows if row.get("camera") == camera and CELLS in row}


def seen_before(rows: Rows, t_us: int) -> str:
    """Say how much of the pictures in the second before an instant was guessed and recorded; empty where no fixer says so.

    Example:
        >>> seen_before([{"t_us": 0, "guessed_share": 0.1, "recorded_share": 0.5}], 300_000)
        '10 % of what it saw in the second before was made up by the fixer, 50 % was recorded'
    """
    near = [row for row in rows if GUESSED in row and t_us - BEFORE_US <= int(row["t_us"]) <= t_us]
    if not near:
        return ""
    guessed, recorded = (sum(float(row[name]) for row in near) / len(near) for name in (GUESSED, RECORDED))
    return f"{guessed:.0%} of what it saw in the second before was made up by the fixer, {recorded:.0%} was recorded".replace("%", " %")

"""Each rollout of a run: when and where its outcomes began, and all of them as columns inside the
page.

The browser draws the table row by row as it is scrolled, so it may have any length. The page holds
one compressed block of columns; a row of HTML each would take ten times the room. Numbers are
rounded to four digits, which the tables of the run are not.
"""

import base64
import gzip
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any
from urllib.parse import quote

import numpy as np

from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.log.run_folder.rows import CellSeries, Rollout, Series
from alpasim_plugin.log.run_folder.schema import VIDEO_NAME, WHY_NAME
from evaluators.metrics.outcomes import (
    ENDINGS,
    NOT_RUN,
    OUTCOMES,
    POLICY_FAULT,
    ending_of,
    has_ended,
    in_words,
    outcomes_of,
    told,
)
from evaluators.statistics.opening import Run

COLLISION = (
    "collision_any",
    "collision_at_fault",
    "collision_front",
    "collision_lateral",
    "collision_rear",
)
SIDES = {"collision_front": "front", "collision_lateral": "side", "collision_rear": "rear"}
# outcome -> the metric that shows its contact, and those by side where no step has it
CONTACTS = {
    "collision_at_fault": ("collision_at_fault", "collision_front", "collision_lateral"),
    "collision_any": ("collision_any", *SIDES),
}
OTHERS = tuple(
    name for name in OUTCOMES if name != POLICY_FAULT and not name.startswith("collision")
)
SERIES = (
    *COLLISION,
    *OTHERS,
    "eval_relevant",
    "ego_x_m",
    "ego_y_m",
    "ego_yaw_rad",
    "lateral_bias_m",
)


@dataclass(frozen=True)
class Event:
    """The first time of an outcome of one rollout.

    Attributes:
        kind: "collision", or the name of an outcome that touches nothing.
        t_s: Seconds since the rollout's first step; None where no step shows the event that the
            rollout's metric counts.
        t_us: The same instant on the rollout's own clock; None with ``t_s``.
        x_m, y_m, yaw_rad: Pose of the ego's rear axle at that time, world; None with ``t_s`` or
            where poses are not logged.
        side: Which part of the ego was touched, or "".
    """

    kind: str
    rollout: Rollout
    t_s: float | None = None
    x_m: float | None = None
    y_m: float | None = None
    yaw_rad: float | None = None
    side: str = ""
    t_us: int | None = None

    @property
    def what(self) -> str:
        """Name the event."""
        if self.kind != "collision":
            return OUTCOMES[self.kind].words
        return f"collision ({self.side})" if self.side else "collision"


def clock_zero_us(content: Mapping[str, Any], first_us: int) -> int:
    """Return the instant that the times of a scene count from: its first camera frame.

    Args:
        content: ``scenes/SCENE.json``.
        first_us: The first logged pose, which counts where the scene does not say when it runs
            (scored logs of others).
    """
    return max(int(content.get("start_us") or 0), first_us)


def events_of(rollout: Rollout, series: Series) -> list[Event]:
    """List the events that the rollout's own metrics count, at most one of each kind.

    Steps that do not count (``eval_relevant`` 0, during warm-up) are passed over, so that the time
    shown is that of the event counted.
    """
    cell_series = series.get(rollout.key, {})
    names = {outcome.name for outcome in told(outcomes_of(rollout))}
    contacts = [name for name in CONTACTS if name in names]
    return [
        *(_collision(rollout, cell_series, CONTACTS[name]) for name in contacts),
        *(_event(name, rollout, cell_series, [name]) for name in OTHERS if name in names),
    ]


def _collision(rollout: Rollout, cell_series: CellSeries, metrics: Sequence[str]) -> Event:
    """Return the contact that made an outcome, with the side that it touched at that instant. Where
    no step shows it, the side is named only if the ego was touched at no other.
    """
    event = _event("collision", rollout, cell_series, metrics[:1])
    if event.t_us is None:
        event = _event("collision", rollout, cell_series, metrics[1:])
    sides = [name for name in SIDES if rollout.flag(name)]
    if event.t_us is not None:
        sides = [name for name in sides if _is_on(cell_series, name, event.t_us)]
    elif len(sides) > 1:
        sides = []
    return replace(event, side=SIDES[sides[0]] if sides else "")


def _event(kind: str, rollout: Rollout, cell_series: CellSeries, metrics: Sequence[str]) -> Event:
    firsts = [t for metric in metrics if (t := _first(cell_series, metric)) is not None]
    if not firsts:
        return Event(kind, rollout)
    t_us = min(firsts)
    zero_us = min(int(t[0]) for t, _ in cell_series.values())
    x_m, y_m, yaw_rad = (
        _at(cell_series, name, t_us) for name in ("ego_x_m", "ego_y_m", "ego_yaw_rad")
    )
    return Event(kind, rollout, (t_us - zero_us) * 1e-6, x_m, y_m, yaw_rad, t_us=t_us)


def _first(cell_series: CellSeries, metric: str) -> int | None:
    if metric not in cell_series:
        return None
    t_us, value = cell_series[metric]
    hit = value >= 0.5
    if "eval_relevant" in cell_series:
        relevant_t, relevant = cell_series["eval_relevant"]
        hit &= np.isin(t_us, relevant_t[relevant >= 0.5])
    return int(t_us[int(np.argmax(hit))]) if hit.any() else None


def _is_on(cell_series: CellSeries, metric: str, t_us: int) -> bool:
    times, values = cell_series.get(metric, (np.zeros(0, dtype=np.int64), np.zeros(0)))
    return bool((values[times == t_us] >= 0.5).any())


def _at(cell_series: CellSeries, name: str, t_us: int) -> float | None:
    if name not in cell_series or not cell_series[name][0].size:
        return None
    times, values = cell_series[name]
    return float(values[int(np.argmin(np.abs(times - t_us)))])


MAX_ROLLOUTS = 200_000  # more make a page that browsers are slow with
MAX_TEXT = 300  # letters of a note
HAS_FOLDER, HAS_CLIP, HAS_WHY = (1 << bit for bit in range(3))
# Colours of what a row ended with; one without an event has none.
BROKEN, COLLIDED, OTHERWISE = "failed", "collision", "offroad"


@dataclass(frozen=True)
class RolloutBlock:
    """The block of the page.

    Attributes:
        data: Base64 of the compressed document.
        n_rows: Rollouts in it.
        left_out: Rollouts that are not.
    """

    data: str
    n_rows: int
    left_out: int


def rollout_block(run: Run) -> RolloutBlock:
    """Pack the rollouts of a run: base64 of compressed JSON.

    The document holds ``coloured``: the column whose names have colours, and those names;
    ``kinds``: the outcomes of the run, the gravest first, by name and words; ``texts``: NAME -> a
    text a rollout; ``had``: which of the kinds each had, as bits; ``state``: which files it has, as
    bits; and ``numbers``: metrics with ``name``, ``unit``, what they are, and ``data``, a number a
    rollout with four digits, null where it is missing.
    """
    rollouts = run.rollouts[:MAX_ROLLOUTS]
    had = [outcomes_of(rollout) for rollout in rollouts]
    kinds = [name for name in OUTCOMES if any(name in names for names in had)]
    texts = _texts(rollouts)
    by_policy = len(run.renderers) == 1 and len(run.policies) > 1
    document = {
        "coloured": ["policy", run.policies] if by_policy else ["renderer", run.renderers],
        "kinds": [[name, OUTCOMES[name].words] for name in kinds],
        "endings": [name for name in ENDINGS if name in texts["ending"]],
        "texts": texts,
        "had": [sum(1 << kinds.index(name) for name in names) for names in had],
        "state": [_state(run, rollout) for rollout in rollouts],
        "numbers": _numbers(run, rollouts),
    }
    plain = json.dumps(document, separators=(",", ":")).encode()
    data = base64.b64encode(gzip.compress(plain, mtime=0)).decode()
    return RolloutBlock(data, len(rollouts), len(run.rollouts) - len(rollouts))


def _texts(rollouts: Sequence[Rollout]) -> dict[str, list[str]]:
    """Return the columns of text, by name."""
    return {
        "scene": [rollout.scene for rollout in rollouts],
        "renderer": [rollout.renderer for rollout in rollouts],
        "policy": [rollout.policy for rollout in rollouts],
        "seed": [str(rollout.seed) for rollout in rollouts],
        "folder": [quote(rollout.path) for rollout in rollouts],
        "outcome": [
            in_words(outcomes_of(rollout)) if has_ended(rollout) else NOT_RUN
            for rollout in rollouts
        ],
        "ending": [ending_of(rollout) for rollout in rollouts],
        "tone": [_tone(rollout) for rollout in rollouts],
        "note": [_note(rollout)[:MAX_TEXT] for rollout in rollouts],
    }


def _numbers(run: Run, rollouts: Sequence[Rollout]) -> list[JsonObject]:
    """Return the columns of numbers: the wall time, and the metrics in the order of the run."""
    columns: list[JsonObject] = [
        {"name": "wall_s", "unit": "s", "data": [_short(rollout.wall_s) for rollout in rollouts]}
    ]
    for metric in run.table.ordered(run.metric_names):
        facts = run.table.shown(metric)
        columns.append(
            {
                "name": metric,
                "unit": facts.unit,
                "percent": facts.in_percent,
                "headline": facts.is_headline,
                "flag": facts.is_flag,
                "data": [_short(rollout.metrics.get(metric)) for rollout in rollouts],
            }
        )
    return columns


def _note(rollout: Rollout) -> str:
    """Say why a rollout failed, or which one it is a copy of."""
    if not rollout.ok:
        return f"{rollout.failure_class or 'unknown cause'}: {rollout.failure}"
    return f"copied from {rollout.copied_from}" if rollout.copied_from else ""


def _short(value: float | None) -> float | None:
    """Return a number with four digits: what says nothing does not compress."""
    return None if value is None else float(f"{value:.4g}")


def _tone(rollout: Rollout) -> str:
    """Return the colour of what a rollout ended with; empty without an event."""
    if not rollout.ok:
        return BROKEN
    if rollout.flag(*COLLISION):
        return COLLIDED
    return OTHERWISE if outcomes_of(rollout) else ""


def _state(run: Run, rollout: Rollout) -> int:
    """Return which files of a rollout are there, as bits."""
    state = 0
    folder = run.folder / rollout.path
    if rollout.path and os.path.isdir(folder):
        state |= HAS_FOLDER
        state |= HAS_CLIP if os.path.isfile(folder / VIDEO_NAME) else 0
        state |= HAS_WHY if os.path.isfile(folder / WHY_NAME) else 0
    return state

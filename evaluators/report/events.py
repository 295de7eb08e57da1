"""Find when and where each rollout collided or left the road."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from alpasim_plugin.run_folder.rows import Own, Rollout, Series, series_by_cell
from evaluators.opening import Run

COLLISION = ("collision_any", "collision_at_fault", "collision_front", "collision_lateral", "collision_rear")
SIDES = {"collision_front": "front", "collision_lateral": "side", "collision_rear": "rear"}
SERIES = (*COLLISION, "offroad", "eval_relevant", "ego_x_m", "ego_y_m", "ego_yaw_rad", "lateral_bias_m")


@dataclass(frozen=True)
class Event:
    """The first collision or the first departure from the road of one rollout.

    Attributes:
        t_s: Seconds since the rollout's first step; None where no step shows the event that the rollout's metric counts.
        t_us: The same instant on the rollout's own clock; None with ``t_s``.
        x_m, y_m, yaw_rad: Pose of the ego's rear axle at that time, world; None with ``t_s`` or where poses are not logged.
        side: Which part of the ego was touched, or "".
    """

    kind: Literal["collision", "offroad"]
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
        if self.kind == "offroad":
            return "off-road"
        return f"collision ({self.side})" if self.side else "collision"


def clock_zero_us(content: Mapping[str, Any], first_us: int) -> int:
    """Return the instant that the times of a scene count from: its first camera frame.

    Args:
        content: ``scenes/SCENE.json``.
        first_us: The first logged pose, which counts where the scene does not say when it runs (scored logs of others).
    """
    return max(int(content.get("start_us") or 0), first_us)


def read_series(run: Run, scenes: Sequence[str] | None = None) -> Series:
    """Read every series that events and plots need, for some scenes or all."""
    return series_by_cell(run.steps(SERIES, scenes))


def events_of(rollout: Rollout, series: Series) -> list[Event]:
    """List the events that the rollout's own metrics count, at most one of each kind.

    Steps that do not count (``eval_relevant`` 0, during warm-up) are passed over, so that the time shown is that of the event counted.
    """
    own = series.get(rollout.cell, {})
    found = []
    if rollout.flag(*COLLISION):
        found.append(_event("collision", rollout, own, [m for m in COLLISION if rollout.flag(m)]))
    if rollout.flag("offroad"):
        found.append(_event("offroad", rollout, own, ["offroad"]))
    return found


def _event(kind: Literal["collision", "offroad"], rollout: Rollout, own: Own, metrics: list[str]) -> Event:
    firsts = {m: t for m in metrics if (t := _first(own, m)) is not None}
    side = next((SIDES[m] for m in metrics if m in SIDES), "")
    if not firsts:
        return Event(kind, rollout, side=side)
    t_us = min(firsts.values())
    zero_us = min(int(t[0]) for t, _ in own.values())
    x_m, y_m, yaw_rad = (_at(own, name, t_us) for name in ("ego_x_m", "ego_y_m", "ego_yaw_rad"))
    return Event(kind, rollout, (t_us - zero_us) * 1e-6, x_m, y_m, yaw_rad, side, t_us)


def _first(own: Own, metric: str) -> int | None:
    if metric not in own:
        return None
    t_us, value = own[metric]
    hit = value >= 0.5
    if "eval_relevant" in own:
        relevant_t, relevant = own["eval_relevant"]
        hit &= np.isin(t_us, relevant_t[relevant >= 0.5])
    return int(t_us[int(np.argmax(hit))]) if hit.any() else None


def _at(own: Own, name: str, t_us: int) -> float | None:
    if name not in own or not own[name][0].size:
        return None
    times, values = own[name]
    return float(values[int(np.argmin(np.abs(times - t_us)))])

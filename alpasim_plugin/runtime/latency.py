"""Which plan is active: a plan takes effect after the latency of the policy and, where asked for, of the fixer before it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from alpasim_plugin.core.types import Latency, Trajectory


@dataclass
class PlanQueue:
    """Plans in order of the time they become effective.

    ``none`` applies a plan at its query, ``fixed`` after a constant delay, ``measured`` after the wall time of the query. With
    ``measured`` a run depends on the machine and is not repeatable; run.json records this.

    With ``latency.fixer`` the fixer is a queue of its own: the frames of an instant are done after those before them, so a fixer slower
    than the camera falls behind, and a query waits until its frames are done.
    """

    latency: Latency
    _pending: list[tuple[int, Trajectory]] = field(default_factory=list)
    _active: Trajectory | None = None
    _fixed_us: int = 0  # when the fixer is done with all frames so far

    def frames(self, t_us: int, stage_ms: Mapping[str, float]) -> None:
        """Take the wall time, by stage, that the fixer needed for the frames of ``t_us``."""
        if self.latency.fixer:
            self._fixed_us = max(self._fixed_us, t_us) + int(1e3 * sum(stage_ms.values()))

    def submit(self, plan_world: Trajectory, query_us: int, wall_us: int) -> None:
        """Add the plan of the query at ``query_us``, which took ``wall_us`` of wall time."""
        measured_us = max(self._fixed_us - query_us, 0) + wall_us
        delay = {"none": 0, "fixed": self.latency.fixed_us, "measured": measured_us}[self.latency.kind]
        self._pending.append((query_us + delay, plan_world))

    def copy(self) -> PlanQueue:
        """Return an independent copy."""
        return replace(self, _pending=list(self._pending))

    def active(self, t_us: int) -> Trajectory | None:
        """Return the active plan at ``t_us``: among those due, that of the newest query. None before the first."""
        while self._pending and self._pending[0][0] <= t_us:
            self._active = self._pending.pop(0)[1]
        # A later, faster query overtakes an earlier, slower one.
        overtaking = [i for i, (due, _) in enumerate(self._pending) if due <= t_us]
        if overtaking:
            self._active = self._pending[overtaking[-1]][1]
            del self._pending[: overtaking[-1] + 1]
        return self._active

"""Which plan is active: a plan takes effect after the policy's latency."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from alpasim_plugin.types import Latency, Trajectory


@dataclass
class PlanQueue:
    """Plans in order of the time they become effective.

    ``none`` applies a plan at its query, ``fixed`` after a constant delay, ``measured`` after the wall time of the query. With
    ``measured`` a run depends on the machine and is not repeatable; run.json records this.
    """

    latency: Latency
    _pending: list[tuple[int, Trajectory]] = field(default_factory=list)
    _active: Trajectory | None = None

    def submit(self, plan_world: Trajectory, query_us: int, wall_us: int) -> None:
        """Add the plan of the query at ``query_us``, which took ``wall_us`` of wall time."""
        delay = {"none": 0, "fixed": self.latency.fixed_us, "measured": wall_us}[self.latency.kind]
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

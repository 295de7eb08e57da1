"""Which plan is in force: a policy's answer takes effect only after its latency."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from alpasim_plugin.types import Latency, Trajectory


@dataclass
class PlanQueue:
    """Plans in order of the time they become effective.

    ``none`` applies a plan at the instant it was asked for, ``fixed`` after a constant delay, ``measured`` after the wall time the
    policy took. With ``measured`` a run depends on the machine and is not repeatable; run.json says so.
    """

    latency: Latency
    _pending: list[tuple[int, Trajectory]] = field(default_factory=list)
    _active: Trajectory | None = None

    def submit(self, plan_world: Trajectory, asked_us: int, wall_us: int) -> None:
        """Add the answer to a question asked at ``asked_us`` that took ``wall_us`` of wall time."""
        delay = {"none": 0, "fixed": self.latency.fixed_us, "measured": wall_us}[self.latency.kind]
        self._pending.append((asked_us + delay, plan_world))

    def copy(self) -> PlanQueue:
        """Return a queue that goes on separately: what will be in force if nothing more is submitted."""
        return replace(self, _pending=list(self._pending))

    def active(self, t_us: int) -> Trajectory | None:
        """Return the plan in force at ``t_us``: the newest question's answer among those due. None before the first."""
        while self._pending and self._pending[0][0] <= t_us:
            self._active = self._pending.pop(0)[1]
        # A later, faster answer overtakes an earlier, slower one.
        overtaking = [i for i, (due, _) in enumerate(self._pending) if due <= t_us]
        if overtaking:
            self._active = self._pending[overtaking[-1]][1]
            del self._pending[: overtaking[-1] + 1]
        return self._active

"""Wall time of each stage of the loop."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager


class StageTimes:
    """Collects durations by stage name."""

    def __init__(self) -> None:
        self.durations_s: dict[str, list[float]] = defaultdict(list)

    @contextmanager
    def measure(self, stage: str, shares: int = 1, within: Callable[[], Mapping[str, float]] | None = None) -> Iterator[None]:
        """Time one pass through a stage; a stage that raises is timed as well.

        Args:
            stage: Its name.
            shares: Number of equal passes it counts as (frames of a block); 0 records nothing.
            within: Called after the pass; returns the parts of it, in milliseconds, that belong to other stages.
        """
        began = time.perf_counter()
        try:
            yield
        finally:
            parts = dict(within()) if within is not None and shares else {}
            parts[stage] = parts.get(stage, 0.0) + 1e3 * (time.perf_counter() - began) - sum(parts.values())
            for name, part_ms in parts.items():
                self.durations_s[name] += [1e-3 * part_ms / shares] * shares if shares else []

    def as_ms(self) -> dict[str, list[float]]:
        """Return all durations in milliseconds, rounded to a microsecond."""
        return {stage: [round(1e3 * d, 3) for d in durations] for stage, durations in self.durations_s.items() if durations}

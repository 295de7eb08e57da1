"""Wall time of each stage of the loop."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager


class StageTimes:
    """Collects durations by stage name; the first call of each stage is kept apart because it may compile or load."""

    def __init__(self) -> None:
        self.durations_s: dict[str, list[float]] = defaultdict(list)

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Time one pass through a stage; a stage that raises is timed as well."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self.durations_s[stage].append(time.perf_counter() - began)

    def as_ms(self) -> dict[str, list[float]]:
        """Return all durations in milliseconds, rounded to a microsecond."""
        return {stage: [round(1e3 * d, 3) for d in durations] for stage, durations in self.durations_s.items()}

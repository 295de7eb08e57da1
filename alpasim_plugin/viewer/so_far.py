"""A run as far as it has got, for pages of a run that goes on."""

from __future__ import annotations

from dataclasses import dataclass

from evaluators.report.run_folder import Run


@dataclass(frozen=True)
class RunSoFar:
    """A run as far as it has got.

    Attributes:
        run: With the finished rollouts alone; an unfinished one has no summary.
        planned: Rollouts in all.
        damage: What cannot be read, one line each.
        finished: All of it is written, tables and reports too.
    """

    run: Run
    planned: int
    damage: tuple[str, ...]
    finished: bool

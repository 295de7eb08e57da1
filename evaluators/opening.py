"""Open a run folder together with what its metrics are: the one place where readers of run folders
meet `evaluators.metrics`.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

from alpasim_plugin.log.run_folder import reader
from alpasim_plugin.log.run_folder.reader import RunSoFar
from alpasim_plugin.log.run_folder.schema import ROLLOUTS, ROLLOUTS_TABLE
from evaluators.metrics import MetricTable


class Run(reader.Run):
    """A run folder with its table of metrics."""

    @cached_property
    def table(self) -> MetricTable:
        """Give what the run's metrics are, as the run itself says."""
        return MetricTable.of_run(self.info)

    @classmethod
    def of(cls, run: reader.Run) -> Run:
        """Return a run that was read with its table."""
        return cls(run.folder, run.info, run.summary, run.rollouts, run.metric_names)


def read_run(run_dir: Path | str | Run) -> Run:
    """Read a run folder, whose rates must lie in [0, 1]; see
    `alpasim_plugin.log.run_folder.reader.read_run`.

    A run that was read is returned as it is.
    """
    if isinstance(run_dir, Run):
        return run_dir
    run = Run.of(reader.read_run(run_dir))
    ROLLOUTS_TABLE.check(reader.table_path(run.folder, ROLLOUTS), rates=run.table.rates)
    return run


def read_so_far(root: Path) -> RunSoFar[Run]:
    """Read a run folder that may still be written; see
    `alpasim_plugin.log.run_folder.reader.read_so_far`.
    """
    progress = reader.read_so_far(root)
    return RunSoFar(Run.of(progress.run), progress.planned, progress.damage, progress.finished)

"""Open a run folder together with what its metrics are: the one place where readers of run folders
meet `evaluators.metrics`.
"""

from functools import cached_property
from pathlib import Path

from alpasim_plugin.log.run_folder import reader
from evaluators.metrics import MetricTable


class Run(reader.Run):
    """A run folder with its table of metrics."""

    @cached_property
    def table(self) -> MetricTable:
        """Give what the run's metrics are, as the run itself says."""
        return MetricTable.of_run(self.info)


def read_run(run_dir: Path | str | Run) -> Run:
    """Read a run folder; see `alpasim_plugin.log.run_folder.reader.Run.read`.

    A run that was read is returned as it is.
    """
    return run_dir if isinstance(run_dir, Run) else Run.read(Path(run_dir))

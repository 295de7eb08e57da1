"""Open a run folder together with its results and with what its metrics are: the one place where
readers of run folders meet `evaluators.metrics`.
"""

import shlex
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Self

from alpasim_plugin.log.run_folder import reader
from alpasim_plugin.log.run_folder.reader import table_path
from alpasim_plugin.log.run_folder.records import RunInfo
from alpasim_plugin.log.run_folder.schema import ROLLOUTS, SUMMARY
from evaluators.metrics import MetricTable
from evaluators.results import Failures, Summary, read_summary

# That of a run that is not finished.
NO_SUMMARY = Summary("", {}, {}, {}, {}, Failures(0, 0, {}))


@dataclass(frozen=True)
class Run(reader.Run):
    """A run folder with its results and its table of metrics.

    Attributes:
        summary: ``summary.json``; `NO_SUMMARY` where the run is not finished.
        folders: Of several runs that were joined; empty where this is the run of ``folder`` alone.
    """

    summary: Summary = NO_SUMMARY
    folders: tuple[Path, ...] = ()

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read a run folder.

        Raises:
            InputError: As the base class, or ``summary.json`` is absent, unreadable, or was written
                by a version that had other keys.
        """
        run = super().read(folder)
        path = table_path(folder, SUMMARY)
        return replace(run, summary=read_summary(path, command_again(run.info)))

    @property
    def tables(self) -> list[Path]:
        """List the files that hold the rollouts' results."""
        return [table_path(folder, ROLLOUTS) for folder in self.folders or (self.folder,)]

    @property
    def title(self) -> str:
        """Give the run's folder, or those of the runs that were joined, for sentences."""
        return ", ".join(map(str, self.folders or (self.folder,)))

    @property
    def is_finished(self) -> bool:
        """Tell whether the run has results."""
        return self.summary is not NO_SUMMARY

    @cached_property
    def table(self) -> MetricTable:
        """Give what the run's metrics are, as the run itself says."""
        return MetricTable.of_run(self.info.metrics)

    @property
    def variants(self) -> list[str]:
        """List the columns of the result tables: the keys under which the summary holds means."""
        return list(self.summary.metrics) or self.renderers

    @cached_property
    def invalid_reasons(self) -> dict[tuple[str, str], str]:
        """Give per (renderer, metric) why rollouts have no valid value: the most frequent reason,
        from the ledger or else the steps.
        """
        if self.folders:
            joined: dict[tuple[str, str], str] = {}
            for folder in self.folders:
                joined |= read_run(folder).invalid_reasons
            return joined
        reasons = dict(super().invalid_reasons)
        for renderer, ledger in self.summary.censoring.items():
            for metric, invalid in ledger.invalid.items():
                counts = invalid.reasons
                reasons[renderer, metric] = max(counts, key=lambda reason: counts[reason])
        return reasons


def command_again(info: RunInfo) -> str:
    """Return the hint to give the command of a run again; finished rollouts are kept."""
    return f"Give its command again: {shlex.join(info.command)}"


def read_run(run_dir: Path | str | Run) -> Run:
    """Read a run folder; see `Run.read`.

    A run that was read is returned as it is.
    """
    return run_dir if isinstance(run_dir, Run) else Run.read(Path(run_dir))

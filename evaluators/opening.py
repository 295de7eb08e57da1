"""Open a run folder with the facts of its metrics known: the one place where readers of run folders meet `evaluators.metrics`."""

from __future__ import annotations

from pathlib import Path

from alpasim_plugin.run_folder import reader
from evaluators.metrics import declare_from


def read_run(run_dir: Path | str) -> reader.Run:
    """Read a run folder, and declare the metrics of third parties that it names; see `alpasim_plugin.run_folder.reader.read_run`.

    Raises:
        EvaluatorError: It states other facts of a metric than are known here.
    """
    run = reader.read_run(run_dir)
    declare_from(run.info)
    return run


def read_so_far(root: Path) -> reader.RunSoFar:
    """Read a run folder that may still be written; see `read_run` and `alpasim_plugin.run_folder.reader.read_so_far`."""
    found = reader.read_so_far(root)
    declare_from(found.run.info)
    return found

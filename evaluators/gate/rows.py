"""A run folder as columns, for its own numbers, and as rows, for what is stored or joined with other rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from alpasim_plugin.run_folder.columns import RolloutTable
from alpasim_plugin.run_folder.schema import ROLLOUTS
from alpasim_plugin.run_folder.sides import Row
from evaluators.opening import Run


def table_of_run(run: Run) -> RolloutTable:
    """Return the rollouts of a run as columns, read from its folder one metric at a time.

    Raises:
        InputError: ``rollouts.parquet`` cannot be read.
    """
    return RolloutTable.of_files([run.folder / ROLLOUTS], lambda renderer, metric: run.invalid_reasons.get((renderer, metric), ""))


def rows_of_run(run: Run) -> list[dict[str, Any]]:
    """Return one flat row per planned rollout: key, status, and METRIC with METRIC_valid."""
    rows = []
    for rollout in run.rollouts:
        row: dict[str, Any] = {
            "renderer": rollout.renderer,
            "policy": rollout.policy,
            "scene": rollout.scene,
            "seed": rollout.seed,
            "status": rollout.status,
            "failure_class": rollout.failure_class or None,
        }
        for name in run.metric_names:
            value = rollout.metrics.get(name)
            row[name], row[f"{name}_valid"] = value, value is not None
            if value is None and rollout.ok:
                row[f"{name}_reason"] = run.invalid_reasons.get((rollout.renderer, name), "")
        rows.append(row)
    return rows


def of_policy(rows: Sequence[Row], policy: str) -> list[Row]:
    """Return the rows of one policy."""
    return [row for row in rows if row["policy"] == policy]


def policies_of(rows: Sequence[Row]) -> list[str]:
    """Return the policies in order of appearance."""
    return list(dict.fromkeys(str(row["policy"]) for row in rows))

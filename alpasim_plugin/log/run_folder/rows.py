"""Rows of a run folder's tables as plain records: rollouts, and the series of their metrics."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from alpasim_plugin.core.types import F64, I64
from alpasim_plugin.log.run_folder.records import CellStatus
from alpasim_plugin.log.run_folder.schema import (
    KEYS,
    LOG_COLUMN,
    ROLLOUTS_TABLE,
    VALID,
    cell_name,
    is_named,
    metrics_in,
)

# renderer, policy, scene, seed, and the name of a scored log
RolloutKey = tuple[str, str, str, int, str]


@dataclass(frozen=True)
class Rollout(CellStatus):
    """One row of ``rollouts.parquet``.

    Attributes:
        renderer, policy, scene, seed: Its key.
        status: It ran to its end and was scored, or not.
        metrics: Rollout values; None where the metric is invalid or was not computed.
        path: Folder of the rollout relative to the run folder, POSIX separators.
        copied_from: That of the rollout that it is a copy of; empty for a rollout that was driven.
        log: Of a scored log: its name, by which several logs of one cell differ.
    """

    failure_class: str = ""
    failure: str = ""
    path: str = ""
    copied_from: str = ""
    wall_s: float | None = None
    frames: int | None = None
    steps: int | None = None
    log: str = ""
    metrics: Mapping[str, float | None] = field(default_factory=dict)

    @property
    def is_named(self) -> bool:
        """Return whether it has names, which a log that cannot be read has not."""
        return is_named(self.cell, self.ok)

    @property
    def key(self) -> RolloutKey:
        """Give what names it among all rollouts of a run, repeats of its cell too."""
        return (*self.cell, self.log)

    def flag(self, *names: str) -> bool:
        """Return whether any of the named 0/1 metrics is 1."""
        return any((self.metrics.get(name) or 0.0) >= 0.5 for name in names)

    @property
    def variant(self) -> str:
        """Give ``RENDERER/POLICY``, its key in ``summary.json`` of a run of several policies; of
        one policy that is the renderer alone.
        """
        return cell_name(self.renderer, self.policy)


class StoredRollouts(Sequence[Rollout]):
    """The rows of ``rollouts.parquet``, read when the first one is asked for: what only needs
    columns never makes them.

    Args:
        path: The file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    @cached_property
    def _rows(self) -> tuple[Rollout, ...]:
        return rollouts_of_table(ROLLOUTS_TABLE.read(self._path))

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: Any) -> Any:
        return self._rows[index]

    def __iter__(self) -> Iterator[Rollout]:
        return iter(self._rows)


def rollouts_of_table(table: pa.Table) -> tuple[Rollout, ...]:
    """Return the rollouts of a table with the columns of ``rollouts.parquet``."""
    names = metrics_in(table.column_names)
    rows = []
    for row in table.to_pylist():
        facts = {key: row[key] for key in (*KEYS, "status")}
        facts |= {key: row.get(key) for key in ("frames", "steps")}
        facts |= {key: row.get(key) or "" for key in ("failure_class", "failure", "copied_from")}
        metrics = {name: _number(row[name]) if row[name + VALID] else None for name in names}
        facts |= {"path": (row.get("path") or "").strip("/"), "log": row.get(LOG_COLUMN.name) or ""}
        rows.append(Rollout(**facts, wall_s=_number(row.get("wall_s")), metrics=metrics))
    return tuple(rows)


def _number(value: float | None) -> float | None:
    return float(value) if value is not None and np.isfinite(value) else None


CellSeries = dict[str, tuple[I64, F64]]  # metric -> (t_us (T,), value (T,)) of one rollout
Series = dict[RolloutKey, CellSeries]


def series_by_rollout(table: pa.Table) -> Series:
    """Split a step table into valid, finite, time-sorted series.

    Returns:
        `Rollout.key` -> metric -> (``t_us (T,)``, ``value (T,)``).
    """
    table = table.filter(pc.and_(table["valid"], pc.is_finite(table["value"])))
    of_logs = LOG_COLUMN.name in table.column_names
    names = [*KEYS, *([LOG_COLUMN.name] if of_logs else []), "metric"]
    groups = (
        table.unify_dictionaries()
        .sort_by("t_us")
        .group_by(names, use_threads=False)
        .aggregate([("t_us", "list"), ("value", "list")])
    )
    series: Series = {}
    rows = zip(
        groups.select(names).to_pylist(), groups["t_us_list"], groups["value_list"], strict=True
    )
    for row, t_us, value in rows:
        log = row[LOG_COLUMN.name] if of_logs else ""
        key = (row["renderer"], row["policy"], row["scene"], row["seed"], log)
        cell_series = series.setdefault(key, {})
        cell_series[row["metric"]] = (t_us.values.to_numpy(), value.values.to_numpy())
    return series

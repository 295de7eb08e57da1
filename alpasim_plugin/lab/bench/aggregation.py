"""How long it takes to aggregate a large table of rollouts, how much memory, and whether the means
are right.
"""

from __future__ import annotations

import math
import multiprocessing
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

import alpasim_plugin.lab.video_metrics.facts  # noqa: F401  declares: the process that aggregates then knows the metrics that this one knows
from alpasim_plugin.core.processes import resident_mb
from alpasim_plugin.core.subprocesses import end_with_parent
from alpasim_plugin.log.run_folder.columns import RolloutTable
from evaluators.metrics import METRICS
from evaluators.statistics.summary import aggregate, aggregate_sides

RENDERERS = ("clean", "3dgs")
FAILED, INVALID = 0.01, 0.02  # shares of rollouts that failed, and of values that are not valid


@dataclass(frozen=True)
class TableRow:
    """One aggregation, in a process of its own, from a ``rollouts.parquet``, in columns as a run
    does it; CPU seconds.
    """

    rollouts: int
    scenes: int
    metrics: int
    read_s: float
    aggregate_s: float
    # the same from rows in memory, the readable reference, in the same process afterwards
    rows_s: float
    peak_mb: float | None  # of the whole process before that, interpreter and libraries included
    # largest difference of a mean from an exactly rounded sum over the same cells, relative to the
    # metric's spread
    mean_error: float
    count_errors: int  # entries whose number of rollouts differs from a plain count


def bench_table(rollouts: int = 100_000, scenes: int = 1_000) -> TableRow:
    """Write a table of random values to a temporary file and aggregate it in a fresh process."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rollouts.parquet"
        write_random_table(path, rollouts, scenes)
        with multiprocessing.get_context("spawn").Pool(1, end_with_parent) as pool:
            read_s, aggregate_s, rows_s, peak_mb, found = pool.apply(_measured, (path,))
        mean_error, count_errors = compared(found, path)
    return TableRow(
        rollouts,
        scenes,
        len(METRICS),
        read_s,
        aggregate_s,
        rows_s,
        peak_mb,
        mean_error,
        count_errors,
    )


def write_random_table(path: Path, rollouts: int, scenes: int) -> None:
    """Write a table as a run does: one row per renderer, scene and seed, each metric with its
    validity; some rollouts failed.
    """
    rng = np.random.Generator(np.random.Philox(2))
    i = np.arange(rollouts)
    cell = i // len(RENDERERS)
    columns: dict[str, Any] = {
        "renderer": np.array(RENDERERS)[i % len(RENDERERS)],
        "policy": np.full(rollouts, "lane-camera"),
        "scene": np.array([f"scene-{k:06d}" for k in range(scenes)])[cell % scenes],
        "seed": cell // scenes,
        "status": np.where(rng.random(rollouts) < FAILED, "failed", "ok"),
    }
    for name, facts in METRICS.items():
        value = (
            (rng.random(rollouts) < 0.1).astype(np.float64)
            if facts.is_flag
            else rng.normal(size=rollouts)
        )
        valid = rng.random(rollouts) >= INVALID
        columns[name], columns[f"{name}_valid"] = pa.array(value, mask=~valid), valid
    pq.write_table(pa.table(columns), path, compression="zstd")


def _measured(
    path: Path,
) -> tuple[float, float, float, float | None, dict[str, dict[str, dict[str, Any]]]]:
    began = time.process_time()
    table = RolloutTable.of_files([path])
    read = time.process_time()
    found = aggregate_sides(table.sides(table.policies[0]), table.metrics)
    done = time.process_time()
    peak = resident_mb("VmHWM")
    aggregate(pq.read_table(path).to_pylist())
    return read - began, done - read, time.process_time() - done, peak, found


def compared(found: Mapping[str, Mapping[str, Mapping[str, Any]]], path: Path) -> tuple[float, int]:
    """Return the largest error of a mean and the number of wrong counts, against plain sums over
    the file's columns.
    """
    table = pq.read_table(path)
    renderer, ok = table["renderer"].to_numpy(), table["status"].to_numpy() == "ok"
    worst, wrong = 0.0, 0
    for name in METRICS:
        value, valid = table[name].to_numpy(), table[f"{name}_valid"].to_numpy()
        for one in RENDERERS:
            mine = value[(renderer == one) & ok & valid].tolist()
            entry = found[one][name]
            wrong += entry["n_rollouts"] != len(mine)
            if mine:
                error = abs(entry["mean"] - math.fsum(mine) / len(mine)) / (
                    float(np.std(mine)) or 1.0
                )
                worst = max(worst, error)
    return worst, wrong

"""Time what `simrun gate` and `simrun compare` compute of a run: from rows in memory, the readable
reference, and from columns.

    python docs/scripts/rows_and_columns.py RUN [--turns 3]

Both ways take turns in one process; the least processor time of each counts. Peak memory is that of
a fresh process each.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from alpasim_plugin.core.processes import resident_mb
from evaluators.opening import read_run
from evaluators.statistics.across import compare_within
from evaluators.statistics.baselines import rows_of_run, table_of_run
from evaluators.statistics.gate import GateVerdict, judge, judge_table, load_gate
from evaluators.statistics.paired import paired


def gate_by_rows(folder: Path) -> GateVerdict:
    """Judge a run as rows."""
    return judge(rows_of_run(read_run(folder)), load_gate("default")[0])


def gate_by_columns(folder: Path) -> GateVerdict:
    """Judge a run as ``simrun gate`` does."""
    return judge_table(table_of_run(read_run(folder)), load_gate("default")[0])


def compare_by_rows(folder: Path) -> Any:
    """Compare the renderers of a run as rows."""
    rows = rows_of_run(read_run(folder))
    return paired(rows, rows[0]["renderer"])


def compare_by_columns(folder: Path) -> Any:
    """Compare the renderers of a run as ``simrun compare`` does."""
    return compare_within(read_run(folder)).paired


WAYS: dict[str, tuple[Callable[[Path], Any], Callable[[Path], Any]]] = {
    "gate": (gate_by_rows, gate_by_columns),
    "compare": (compare_by_rows, compare_by_columns),
}


def peak_gb(way: Callable[[Path], Any], folder: Path) -> float:
    """Return the peak memory of this process after one call."""
    way(folder)
    return (resident_mb("VmHWM") or math.nan) / 1e3


def seconds(way: Callable[[Path], Any], folder: Path) -> float:
    """Return the processor time of one call."""
    began = time.process_time()
    way(folder)
    return time.process_time() - began


def main() -> None:
    """Print a Markdown table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--turns", type=int, default=3)
    given = parser.parse_args()
    n = table_of_run(read_run(given.run)).n_rollouts
    print(
        f"| {n} rollouts | by rows s | by columns s | ratio | by rows GB | by columns GB |\n| --- | --- | --- | --- | --- | --- |"
    )
    for name, ways in WAYS.items():
        assert ways[0](given.run) == ways[1](given.run), name
        least = [
            min(times)
            for times in zip(
                *([seconds(way, given.run) for way in ways] for _ in range(given.turns)),
                strict=True,
            )
        ]
        with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
            peaks = [pool.apply(peak_gb, (way, given.run)) for way in ways]
        print(
            f"| {name} | {least[0]:.2f} | {least[1]:.2f} | {least[0] / least[1]:.1f} | {peaks[0]:.2f} | {peaks[1]:.2f} |"
        )


if __name__ == "__main__":
    main()

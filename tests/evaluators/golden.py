"""Read the golden logs for parity tests: a log with its scene, and AlpaSim's own scores of it.

``python -m tests.evaluators.golden DATA/alpasim-golden`` prints the parity table over all its logs.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from functools import lru_cache
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from alpasim_plugin.log import read_asl
from alpasim_plugin.types import MetricSeries, RolloutLog, Scene
from evaluators.presets import Preset
from scenarios.usdz import read_usdz_scene


def read_case(log: Path, scene: Path, rails: bool = True) -> tuple[RolloutLog, Scene]:
    return read_asl(log), read_usdz_scene(scene, rails)


@lru_cache(maxsize=128)
def scored(log: Path, archive: Path, preset: Preset, rails: bool = True) -> tuple[MetricSeries, ...]:
    """Score a log against its scene; several tests look at the same series."""
    from evaluators import score

    return tuple(score(*read_case(log, archive, rails), preset))


def close(got: float, want: float) -> bool:
    """Compare as the goldens do: 1e-4 absolute or 1e-5 relative, since poses are float32 there."""
    same = got == want or (np.isnan(got) and np.isnan(want))
    return same or abs(got - want) <= max(1e-4, 1e-5 * abs(want))


def expected(folder: Path) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return AlpaSim's table in a log's folder: metric -> times, values, valid; the placeholder row of an empty metric is left out."""
    table = pq.read_table(folder / "expected_metrics.parquet").to_pydict()
    out: dict[str, list] = {}
    for name, t, value, valid in zip(table["name"], table["timestamps_us"], table["values"], table["valid"], strict=True):
        rows = out.setdefault(name, [])
        if t is not None:
            rows.append((t, value, valid))
    empty = (np.zeros(0),) * 3
    return {name: tuple(np.array(column) for column in zip(*rows, strict=True)) if rows else empty for name, rows in out.items()}


def parity_table(folder: Path) -> str:
    """Compare every step of every metric over the logs of ``rollouts/``."""
    from evaluators import score

    compared: dict[str, list] = defaultdict(lambda: [0, 0, 0, 0.0])  # logs, values, equal, largest difference
    for log in sorted(folder.glob("rollouts/*/*/rollout.asl")):
        name = log.parent.parent.name
        rollout, scene = read_case(log, folder / "scenes" / f"{name}.usdz")
        found = {one.name: one for one in score(rollout, scene, "alpasim")}
        for metric, (_, value, _) in expected(log.parent).items():
            got = found[metric].value
            both_missing = np.isnan(got) & np.isnan(value)
            off = np.where((got == value) | both_missing, 0.0, np.abs(got - value))
            row = compared[metric]
            row[0], row[1], row[2] = row[0] + 1, row[1] + len(value), row[2] + int(np.sum(off == 0))
            row[3] = max(row[3], float(off.max(initial=0.0)))
    lines = ["| metric | logs | values | exactly equal | largest difference |", "|---|---|---|---|---|"]
    lines += [f"| `{metric}` | {n} | {total} | {equal} | {worst:.1e} |" for metric, (n, total, equal, worst) in sorted(compared.items())]
    return "\n".join(lines)


if __name__ == "__main__":
    print(parity_table(Path(sys.argv[1])))

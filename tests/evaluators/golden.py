"""Read the golden scenes for parity tests: the vector map of a scene archive, and AlpaSim's own scores of a log.

``python -m tests.evaluators.golden DATA/alpasim-golden`` prints the parity table over all its logs.
"""

from __future__ import annotations

import io
import sys
import zipfile
from collections import defaultdict
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from alpasim_plugin.log import read_asl
from alpasim_plugin.types import Lane, LaneMap, RolloutLog, Scene, Vehicle

MAX_STEP_M = 2.0


def densified(points: np.ndarray) -> np.ndarray:
    """Put floor(length / 2 m) equally spaced points into every segment; AlpaSim's map loader does so."""
    parts = [points[:1]]
    for a, b in pairwise(points):
        pieces = int(np.linalg.norm(b - a) // MAX_STEP_M) + 1
        parts.append(a + (b - a) * (np.arange(1, pieces + 1) / pieces)[:, None])
    return np.concatenate(parts)


def read_map(archive: Path, rails: bool = True) -> LaneMap:
    """Return lanes and road edges of the archive's clipgt tables; empty where it has none."""
    with zipfile.ZipFile(archive) as z:
        names = set(z.namelist())

        def rows(table: str) -> list[dict]:
            name = f"clipgt/{table}.parquet"
            return pq.read_table(io.BytesIO(z.read(name))).to_pylist() if name in names else []

        lanes = {}
        for row in rows("lane"):
            left, right = (xyz(row["lane"][side]) for side in ("left_rail", "right_rail"))
            key = row["key"]["map_id"]
            edges = (densified(left), densified(right)) if rails else (None, None)
            lanes[key] = Lane(key, densified((left + right) / 2), *edges)
        edges = tuple(densified(xyz(row["road_boundary"]["location"])) for row in rows("road_boundary"))
    return LaneMap(lanes, edges)


def xyz(points: list[dict] | dict[str, list]) -> np.ndarray:
    """Points come as a list of structs or as a struct of lists."""
    if isinstance(points, dict):
        return np.stack([np.asarray(points[axis], dtype=np.float64) for axis in "xyz"], axis=1)
    return np.array([[p["x"], p["y"], p["z"]] for p in points], dtype=np.float64)


def read_case(log: Path, scene: Path, rails: bool = True) -> tuple[RolloutLog, Scene]:
    rollout = read_asl(log)
    return rollout, Scene(rollout.scene_id, read_map(scene, rails), rollout.ego_log, Vehicle())


def expected(log: Path) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return AlpaSim's table of a log: metric -> times, values, valid; the placeholder row of an empty metric is left out."""
    table = pq.read_table(log.parent / "expected_metrics.parquet").to_pydict()
    out: dict[str, list] = {}
    for name, t, value, valid in zip(table["name"], table["timestamps_us"], table["values"], table["valid"], strict=True):
        rows = out.setdefault(name, [])
        if t is not None:
            rows.append((t, value, valid))
    empty = (np.zeros(0),) * 3
    return {name: tuple(np.array(column) for column in zip(*rows, strict=True)) if rows else empty for name, rows in out.items()}


def parity_table(folder: Path, skip: tuple[str, ...] = ("synthetic-opendrive-a",)) -> str:
    """Compare every step of every metric over the logs of ``rollouts/``; road metrics of the scenes in ``skip`` are left out."""
    from evaluators import score

    compared: dict[str, list] = defaultdict(lambda: [0, 0, 0, 0.0])  # logs, values, equal, largest difference
    for log in sorted(folder.glob("rollouts/*/*/rollout.asl")):
        name = log.parent.parent.name
        rollout, scene = read_case(log, folder / "scenes" / f"{name}.usdz")
        found = {one.name: one for one in score(rollout, scene, "alpasim")}
        for metric, (_, value, _) in expected(log).items():
            if name in skip and metric not in found:
                continue
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

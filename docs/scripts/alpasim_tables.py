"""Compare AlpaSim's metrics.parquet of exported rollouts with `simrun score --preset alpasim`,
number by number.

Run it with the Python of an AlpaSim environment (its tables hold 128-bit times, which only polars
reads):

    python docs/scripts/alpasim_tables.py EXPORTED/RENDERER/POLICY SCORED
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import polars as pl


def number(value: float | None) -> float:
    """Return a missing value as NaN."""
    return math.nan if value is None else float(value)


def gap(one: float, other: float) -> float:
    """Return the difference relative to the larger of 1 and the first; 0 where both are missing or
    equal, inf where one is missing.
    """
    if one == other or (math.isnan(one) and math.isnan(other)):
        return 0.0
    found = abs(one - other) / max(1.0, abs(one))
    return math.inf if math.isnan(found) else found


def steps(exported: Path, scored: Path) -> tuple[int, int, float, list[str]]:
    """Compare every step; return (logs, values, largest difference, problems)."""
    ours = pl.read_parquet(scored / "steps.parquet")
    logs = 0
    count = 0
    worst = 0.0
    problems = []
    for path in sorted(exported.glob("rollouts/*/*/metrics.parquet")):
        theirs = (
            pl.read_parquet(path)
            .with_columns(pl.col("timestamps_us").cast(pl.Int64))
            .filter(pl.col("timestamps_us").is_not_null())
        )
        own = ours.filter(pl.col("rollout") == path.parent.name)
        logs += 1
        for (name,), table in theirs.group_by("name"):
            have = {
                t: (number(v), ok)
                for t, v, ok in own.filter(pl.col("metric") == name)
                .select("t_us", "value", "valid")
                .iter_rows()
            }
            want = {
                t: (number(v), ok)
                for t, v, ok in table.select("timestamps_us", "values", "valid").iter_rows()
            }
            if have.keys() != want.keys():
                problems.append(
                    f"{path.parent.name} {name}: {len(want)} rows there, {len(have)} here"
                )
                continue
            for t, (value, ok) in want.items():
                found = gap(value, have[t][0])
                count, worst = count + 1, max(worst, found)
                if found > 1e-5 or ok != have[t][1]:
                    problems.append(
                        f"{path.parent.name} {name} at {t}: {value} {ok} there, {have[t]} here"
                    )
    return logs, count, worst, problems


def over_rollouts(exported: Path, scored: Path) -> tuple[int, float, list[str]]:
    """Compare the table over sweeps and every number of results-summary.json."""
    theirs, ours = (
        pl.read_parquet(f / "aggregate" / "metrics_results.parquet").row(0, named=True)
        for f in (exported, scored)
    )
    pairs = [
        (f"table {k}", v, ours.get(k, "absent"))
        for k, v in theirs.items()
        if not isinstance(v, str)
    ]
    one, other = (
        json.loads((f / "aggregate" / "results-summary.json").read_text())["rollouts"]
        for f in (exported, scored)
    )
    by_id = {row["rollout_id"]: row for row in other}
    for row in one:
        own = by_id.get(row["rollout_id"], {"metrics": {}, "score": "absent"})
        pairs.append((f"{row['rollout_id']} score", row["score"], own["score"]))
        numbers = {k: v for k, v in row["metrics"].items() if not isinstance(v, str)}
        pairs += [
            (f"{row['rollout_id']} {k}", v, own["metrics"].get(k, "absent"))
            for k, v in numbers.items()
        ]
    worst, problems = 0.0, []
    for name, value, own in pairs:
        found = math.inf if own == "absent" else gap(number(value), number(own))
        worst = max(worst, found)
        if found > 1e-5:
            problems.append(f"{name}: {value} there, {own} here")
    return len(pairs), worst, problems


def main() -> int:
    """Print one line, then every problem."""
    exported, scored = Path(sys.argv[1]), Path(sys.argv[2])
    logs, values, worst, problems = steps(exported, scored)
    count, over, more = over_rollouts(exported, scored)
    print(
        f"{exported}: {logs} logs, {values} step values, largest difference {worst:.1e}; {count} rollout values, {over:.1e}"
    )
    for line in [*problems, *more][:40]:
        print(f"  {line}")
    return 1 if problems or more or not logs else 0


if __name__ == "__main__":
    sys.exit(main())

"""Measure how much of their rollouts variants share: the frames before the first that differs.

``python docs/scripts/shared_past.py RUN`` prints, for each pair of variants that differ in the
policy alone or in the renderer alone, the instants at which frames, plans and the ego's poses part,
as medians over scenes and seeds, and the share of the frames that are equal up to there.
"""

from __future__ import annotations

import argparse
from itertools import combinations
from pathlib import Path
from statistics import median

from alpasim_plugin.log.run_folder.check import cells_of_run
from alpasim_plugin.log.run_folder.manifests import read_manifest, read_run_json
from alpasim_plugin.runs.repeat import log_trace

COMPONENTS = ("frames", "plans", "ego")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    root = parser.parse_args().run
    traces = {}
    for path in cells_of_run(read_run_json(root)):
        one = read_manifest(root / path)
        cell = (one["renderer"], one["policy"], one["scene"], one["seed"])
        traces[cell] = log_trace(root / path)
    pairs: dict[tuple[str, ...], list[list[float]]] = {}
    for (cell, trace), (other_cell, other) in combinations(traces.items(), 2):
        is_alike = [a == b for a, b in zip(cell, other_cell, strict=True)]
        if is_alike[2:] == [True, True] and sum(is_alike[:2]) == 1:
            names = ("/".join(cell[:2]), "/".join(other_cell[:2]))
            pairs.setdefault(names, []).append(parting(trace, other))
    print("| variants | frames part | plans part | poses part | frames shared |")
    print("|---|---:|---:|---:|---:|")
    for names, rows in pairs.items():
        *parted, share = (median(column) for column in zip(*rows, strict=True))
        times = " | ".join(f"{t_s:.1f} s" for t_s in parted)
        print(f"| {' and '.join(names)} | {times} | {100 * share:.0f} % |")


def parting(one: dict, other: dict) -> list[float]:
    """Return when each component of two rollouts differs first, seconds after the first frame, and
    the share of the frames before; the end of the rollout where none differs.
    """
    times_us = [t_us for t_us, _ in one["frames"]]
    start_us, end_us = min(times_us), max(times_us)
    parted_us = [
        min((key[0] for key in one[name] if one[name][key] != other[name].get(key)), default=end_us)
        for name in COMPONENTS
    ]
    shared = sum(t_us < parted_us[0] for t_us in times_us) / len(times_us)
    return [*(1e-6 * (t_us - start_us) for t_us in parted_us), shared]


if __name__ == "__main__":
    main()

"""Drive the held-out scenes and put the tables into docs/experiments/fixer-closed-loop.md.

    python docs/scripts/closed_loop.py SCENES [RUNS] [--policies learned:5,lane-camera:5]

Then ``python docs/scripts/headline.py`` writes what README.md and docs/experiments/index.md say of it. SCENES
is the folder that ``simrun train scenes`` wrote, with both test splits, which must be the frozen
ones; RUNS (default: runs/closed-loop) keeps the run folders, so a second call continues an
interrupted first one. Behind a policy's name stands its number of seeds.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import yaml
from headline import BARE, BASELINE, DISTANCE, EVENT, FIXED, RECORD, TRUE, replace

from alpasim_plugin.lab.training.frozen_scenes import check_scenes

VERDICTS = (1, 3)  # exit codes of a run that ended with a regression, or undecided
RENDERERS = (TRUE, BASELINE, FIXED, BARE)
SHOWN = (
    "collision_at_fault",
    "offroad",
    EVENT,
    DISTANCE,
    "progress",
    "min_distance_to_obstacle_m",
)


def drive(out: Path, arguments: list[str]) -> None:
    """Run simrun; a verdict, whatever it is, is a result."""
    command = [sys.executable, "-m", "alpasim_plugin.cli.main", *arguments, "--out", str(out)]
    code = subprocess.run(command, check=False, stdout=subprocess.DEVNULL).returncode
    if code not in (0, *VERDICTS):
        sys.exit(f"exit code {code}; see {out}")


def mean_cell(entry: dict[str, Any], scale: float, digits: int) -> str:
    """Return a mean with the paper's half width and the interval over scenes."""
    low, high = entry["ci95_clustered"]
    return (
        f"{scale * entry['mean']:.{digits}f} ± {scale * entry['ci95']:.{digits}f} "
        f"[{scale * low:.{digits}f}, {scale * high:.{digits}f}]"
    )


def paired_cell(entry: dict[str, Any], scale: float, digits: int) -> str:
    """Return a paired difference with its interval over scenes and its p-value."""
    low, high = entry["ci95"]
    return (
        f"{scale * entry['diff']:+.{digits}f} [{scale * low:+.{digits}f}, "
        f"{scale * high:+.{digits}f}], p {entry['p_value']:.3f}"
    )


def metric_tables(summary: dict[str, Any]) -> str:
    """Return metrics x renderers, and below it the paired differences from the baseline."""
    others = [name for name in RENDERERS if name != BASELINE]
    means = [f"| metric | {' | '.join(RENDERERS)} |", "|---" * (len(RENDERERS) + 1) + "|"]
    pairs = [f"| minus {BASELINE} | {' | '.join(others)} |", "|---" * (len(others) + 1) + "|"]
    for metric in SHOWN:
        unit = summary["metrics"][TRUE][metric]["unit"] or "%"
        scale, digits = (1.0, 3) if unit != "%" else (100.0, 1)
        of = [mean_cell(summary["metrics"][name][metric], scale, digits) for name in RENDERERS]
        minus = [paired_cell(summary["paired"][name][metric], scale, digits) for name in others]
        means.append(f"| `{metric}` ({unit}) | {' | '.join(of)} |")
        pairs.append(f"| `{metric}` ({unit}) | {' | '.join(minus)} |")
    return "\n".join(means) + "\n\n" + "\n".join(pairs)


def family(row: dict[str, Any]) -> str:
    """Return the family in a scene's name: SPLIT-FAMILY-NUMBER."""
    return str(row["scene"]).split("-")[-2].replace("_", " ")


def family_table(rows: list[dict[str, Any]]) -> str:
    """Return how many rollouts of each family of scenes had the event, by renderer."""
    lines = [
        f"| left the road or at fault, rollouts | {' | '.join(RENDERERS)} |",
        "|---" * (len(RENDERERS) + 1) + "|",
    ]
    for name in sorted({family(row) for row in rows}):
        cells = []
        for renderer in RENDERERS:
            events = [
                row[EVENT] for row in rows if family(row) == name and row["renderer"] == renderer
            ]
            known = [event for event in events if event is not None]
            cells.append(f"{int(sum(known))} of {len(known)}")
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Run what is missing and fill in the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", type=Path)
    parser.add_argument("runs", type=Path, nargs="?", default=Path("runs/closed-loop"))
    parser.add_argument("--policies", default="learned:5,lane-camera:5")
    given = parser.parse_args()
    scenes = [
        given.scenes / split / f"{name}.yaml"
        for split, frozen in check_scenes(given.scenes).items()
        for name in frozen.scenes
    ]
    suite = given.runs / "suite.yaml"
    given.runs.mkdir(parents=True, exist_ok=True)
    suite.write_text(
        yaml.safe_dump({"version": 1, "scenarios": [str(path.resolve()) for path in scenes]})
    )
    duration_us = int(yaml.safe_load(scenes[0].read_text())["timing"]["duration_us"])
    parts = [f"{duration_us / 1e6:g} s each."]
    for name in given.policies.split(","):
        policy, seeds = name.split(":")
        run = given.runs / f"{policy}-{seeds}"
        options = ["--renderer", ",".join(RENDERERS), "--baseline", BASELINE]
        options += ["--policy", policy, "--seeds", seeds, "--images", "none", "--resume"]
        drive(run, [*options, str(suite)])
        summary = json.loads((run / "summary.json").read_text())
        rows = pq.read_table(run / "rollouts.parquet").to_pylist()
        head = f"**{policy}**: {len(scenes)} scenes x {seeds} seeds"
        parts.append("\n\n".join((head, metric_tables(summary), family_table(rows))))
    RECORD.write_text(replace(RECORD.read_text(), "closed-loop", "\n\n".join(parts)))


if __name__ == "__main__":
    main()

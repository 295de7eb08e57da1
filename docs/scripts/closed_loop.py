"""Drive the held-out scenes behind some renderers and put the tables into
docs/experiments/fixer-closed-loop.md.

    python docs/scripts/closed_loop.py SCENES [RUNS] [--policies
    learned:5:clean+3dgs+onefixer,learned:2] [--seconds 8]

and then ``python docs/scripts/headline.py``, which writes what README.md and docs/results.md say of
it.

SCENES is the folder that ``simrun train scenes`` wrote, with both test splits, which must be the
frozen ones; RUNS (default: runs/closed-loop) keeps the run folders, so a second call continues an
interrupted first one. Behind a policy's name stand its number of seeds and its renderers, all four
by default. Scenes are driven as long as they were drawn. With ``--seconds`` they are cut, which the
headline then says, and a scene whose events need more is driven for as many seconds as it needs. A
run that other code began would be driven again from its start; with ``--finished`` nothing is
driven, and the tables are those of the runs as they stand.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import yaml
from headline import DOCS, replace

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.training.frozen_scenes import check_scenes
from scenarios.load import load_scenario

VERDICTS = (1, 3)  # exit codes of a run that ended with a regression, or undecided
BASELINE = "3dgs"
RENDERERS = ("clean", BASELINE, "onefixer", "onefixer[references=0]")
SECONDS_MOST = 21  # the scenes are drawn for 19.8 s
EVENT = "offroad_or_collision_at_fault"
SHOWN = (
    "collision_at_fault",
    "offroad",
    EVENT,
    "lateral_distance_m",
    "progress",
    "min_distance_to_obstacle_m",
)


def drive(out: Path, arguments: list[str]) -> None:
    """Run simrun; a verdict, whatever it is, is a result."""
    command = [sys.executable, "-m", "alpasim_plugin.cli.main", *arguments, "--out", str(out)]
    code = subprocess.run(command, check=False, stdout=subprocess.DEVNULL).returncode
    if code not in (0, *VERDICTS):
        sys.exit(f"exit code {code}; see {out}")


def number(entry: dict[str, Any], rate: bool) -> str:
    """Return a mean with the paper's half width and the interval over scenes."""
    if entry["mean"] is None:
        return "-"
    scale, digits = (100.0, 1) if rate else (1.0, 3)
    half = "" if entry["ci95"] is None else f" ± {scale * entry['ci95']:.{digits}f}"
    bounds = ""
    if entry["ci95_clustered"] is not None:
        low, high = entry["ci95_clustered"]
        bounds = f" [{scale * low:.{digits}f}, {scale * high:.{digits}f}]"
    return f"{scale * entry['mean']:.{digits}f}{half}{bounds}"


def paired_cell(entry: dict[str, Any] | None, rate: bool) -> str:
    """Write a paired difference with its interval over scenes and its p-value."""
    if not entry or entry["diff"] is None:
        return "-"
    scale, digits = (100.0, 1) if rate else (1.0, 3)
    bounds = (
        ""
        if entry["ci95"] is None
        else f" [{scale * entry['ci95'][0]:+.{digits}f}, {scale * entry['ci95'][1]:+.{digits}f}]"
    )
    p = "" if entry["p_value"] is None else f", p {entry['p_value']:.3f}"
    return f"{scale * entry['diff']:+.{digits}f}{bounds}{p}"


def table(summary: dict[str, Any], renderers: Sequence[str]) -> str:
    """Return metrics x renderers, and below it the paired differences from the baseline."""
    others = [name for name in renderers if name != BASELINE]
    means = ["| metric | " + " | ".join(renderers) + " |", "|---" * (len(renderers) + 1) + "|"]
    pairs = [f"| minus {BASELINE} | " + " | ".join(others) + " |", "|---" * (len(others) + 1) + "|"]
    for metric in SHOWN:
        entries = [summary["metrics"][name][metric] for name in renderers]
        rate = entries[0]["unit"] == ""
        unit = " (%)" if rate else f" ({entries[0]['unit']})" if entries[0]["unit"] else ""
        means.append(
            f"| `{metric}`{unit} | " + " | ".join(number(entry, rate) for entry in entries) + " |"
        )
        differences = [
            paired_cell(summary["paired"].get(name, {}).get(metric), rate) for name in others
        ]
        pairs.append(f"| `{metric}`{unit} | " + " | ".join(differences) + " |")
    return "\n".join(means) + "\n\n" + "\n".join(pairs)


def families(rows: list[dict[str, Any]], renderers: Sequence[str]) -> str:
    """Return how many rollouts of each family of scenes left the road or were at fault in a
    contact, by renderer.
    """
    names = sorted({family(row) for row in rows})
    lines = [
        "| left the road or at fault, rollouts | " + " | ".join(renderers) + " |",
        "|---" * (len(renderers) + 1) + "|",
    ]
    for name in names:
        cells = []
        for renderer in renderers:
            events = [
                row[EVENT] for row in rows if family(row) == name and row["renderer"] == renderer
            ]
            known = [event for event in events if event is not None]
            cells.append(f"{int(sum(known))} of {len(known)}")
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def family(row: dict[str, Any]) -> str:
    """Return the family in a scene's name: SPLIT-FAMILY-NUMBER."""
    return str(row["scene"]).split("-")[-2].replace("_", " ")


def duration_us(scenario: Path, seconds: int | None) -> int:
    """Return a drive's length: as drawn, as asked, or the least number of whole seconds above that
    in which the scenario's events fit.
    """
    if seconds is None:
        return int(yaml.safe_load(scenario.read_text())["timing"]["duration_us"])
    for longer in range(seconds, SECONDS_MOST):
        try:
            load_scenario(scenario, overrides=[f"timing.duration_us={longer * 1_000_000}"])
        except InputError:
            continue
        return longer * 1_000_000
    sys.exit(f"{scenario}: no duration below {SECONDS_MOST} s fits its events")


def main() -> None:
    """Run what is missing and fill in the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", type=Path)
    parser.add_argument("runs", type=Path, nargs="?", default=Path("runs/closed-loop"))
    parser.add_argument("--policies", default="learned:5,lane-camera:5")
    parser.add_argument("--seconds", type=int, help="Cut the drives; whole by default.")
    parser.add_argument(
        "--finished", action="store_true", help="Drive nothing; read the runs as they stand."
    )
    given = parser.parse_args()
    scenes = [
        given.scenes / split / f"{name}.yaml"
        for split, frozen in check_scenes(given.scenes).items()
        for name in frozen.scenes
    ]
    suite = given.runs / "suite.yaml"
    given.runs.mkdir(parents=True, exist_ok=True)
    entries = [
        {
            "path": str(path.resolve()),
            "set": {"timing.duration_us": duration_us(path, given.seconds)},
        }
        for path in scenes
    ]
    suite.write_text(yaml.safe_dump({"version": 1, "scenarios": entries}))
    lengths_us = [of["set"]["timing.duration_us"] for of in entries]
    usual_us = min(lengths_us)
    longer = [
        f"`{path.stem}` {us / 1e6:g} s"
        for path, us in zip(scenes, lengths_us, strict=True)
        if us != usual_us
    ]
    parts = [f"{usual_us / 1e6:g} s each{'; ' + ', '.join(longer) if longer else ''}."]
    for name in given.policies.split(","):
        words = name.split(":")
        policy, seeds, renderers = words + ["", "5", "+".join(RENDERERS)][len(words) :]
        shown = renderers.split("+")
        options = [
            "--renderer",
            ",".join(shown),
            "--baseline",
            BASELINE,
            "--policy",
            policy,
            "--seeds",
            seeds,
        ]
        run = given.runs / f"{policy}-{seeds}"
        if not given.finished:
            drive(run, [*options, "--images", "none", "--resume", str(suite)])
        summary = json.loads((run / "summary.json").read_text())
        rows = pq.read_table(run / "rollouts.parquet").to_pylist()
        head = f"**{policy}**: {len(scenes)} scenes x {seeds} seeds"
        parts.append("\n\n".join((head, table(summary, shown), families(rows, shown))))
    page = DOCS / "experiments" / "fixer-closed-loop.md"
    page.write_text(replace(page.read_text(), "closed-loop", "\n\n".join(parts)))


if __name__ == "__main__":
    main()

"""Write the tables of docs/experiments/fixer-closed-loop.md, and README's sentence about driving.

    python docs/scripts/closed_loop.py [--check] [RUN...]

Each RUN is a run of one policy over the frozen scenes. Its numbers go into the record beside that
page, of which the pages are made. With ``--check`` nothing is written, and the exit code is 1
where a page is stale.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pages import DOCS, replaced, table, write
from scipy.special import stdtrit

RECORD = DOCS / "experiments" / "closed-loop.json"
TRUE, BASELINE, FIXED, BARE = RENDERERS = ("clean", "3dgs", "onefixer", "onefixer[references=0]")
OTHERS = (TRUE, FIXED, BARE)
POLICY = "learned"  # of README's sentence
EVENT = "offroad_or_collision_at_fault"
UNITS = {"collision_at_fault": "%", "offroad": "%", EVENT: "%", "lateral_distance_m": "m",
         "progress": "%", "min_distance_to_obstacle_m": "m"}  # fmt: skip
Entry = dict[str, Any]


def read_run(run: Path) -> tuple[str, Entry]:
    """Return the policy of a run, and its numbers: means with half width and bounds, differences
    with bounds and p-value, and for each family of scenes the rollouts with the event.
    """
    summary = json.loads((run / "summary.json").read_text())
    rows = pd.read_parquet(run / "rollouts.parquet")
    rows["family"] = rows["scene"].str.split("-").str[-2].str.replace("_", " ")
    counts = (
        rows.astype({EVENT: float}).groupby(["family", "renderer"])[EVENT].agg(["sum", "count"])
    )
    entry: Entry = {key + "s": rows[key].nunique() for key in ("scene", "seed")}
    for kind, section, names, keys in (
        ("means", "metrics", RENDERERS, ("mean", "ci95", "ci95_clustered")),
        ("minus", "paired", OTHERS, ("diff", "ci95", "p_value")),
    ):
        entry[kind] = {
            metric: {name: list(np.hstack([summary[section][name][metric][key] for key in keys]))
                     for name in names} for metric in UNITS
        }  # fmt: skip
    entry["events"] = {
        family: {name: [int(count) for count in counts.loc[family, name]] for name in RENDERERS}
        for family in rows["family"].sort_values().unique()
    }
    return rows["policy"].iloc[0], entry


def tables(policy: str, entry: Entry) -> str:
    """Return a policy's three tables."""
    means, minus = [], []
    for metric, unit in UNITS.items():
        n, scale = (1, 100) if unit == "%" else (3, 1)
        name = f"`{metric}` ({unit})"
        cells = [[f"{scale * value:.{n}f}" for value in cell]
                 for cell in entry["means"][metric].values()]  # fmt: skip
        means.append(
            [name, *(f"{mean} ± {half} [{low}, {high}]" for mean, half, low, high in cells)]
        )
        cells = [[*(f"{scale * value:+.{n}f}" for value in bounds), f"{p:.3f}"]
                 for *bounds, p in entry["minus"][metric].values()]  # fmt: skip
        minus.append([name, *(f"{diff} [{low}, {high}], p {p}" for diff, low, high, p in cells)])
    events = [[family, *(f"{number} of {rollouts}" for number, rollouts in counts.values())]
              for family, counts in entry["events"].items()]  # fmt: skip
    parts = (
        f"**{policy}**: {entry['scenes']} scenes x {entry['seeds']} seeds\n",
        table(["metric", *RENDERERS], means),
        table([f"minus {BASELINE}", *OTHERS], minus),
        table(["left the road or at fault, rollouts", *RENDERERS], events),
    )
    return "\n".join(parts)


def over_families(events: Entry) -> tuple[float, float, str, float]:
    """Return the bounds of the difference in points with families as the unit, the family that moves
    the difference most, and the difference without it.

    The variance of the mean is that of the sums of families' residuals (Liang and Zeger,
    Biometrika 73, 1986), times F / (F - 1), which needs a family's sum and not its scenes.
    """
    change = np.array([counts[FIXED][0] - counts[BASELINE][0] for counts in events.values()])
    rollouts = np.array([counts[BASELINE][1] for counts in events.values()])
    mean = change.sum() / rollouts.sum()
    n = len(change)
    variance = n / (n - 1) * np.sum((change - mean * rollouts) ** 2) / rollouts.sum() ** 2
    half = stdtrit(n - 1, 0.975) * np.sqrt(variance)
    without_family = (change.sum() - change) / (rollouts.sum() - rollouts)
    most = int(np.argmax(np.abs(without_family - mean)))
    return 100 * (mean - half), 100 * (mean + half), list(events)[most], 100 * without_family[most]


def sentence(entry: Entry, length: str) -> str:
    """Return README's sentence."""
    share = {name: f"{100 * cell[0]:.1f} %" for name, cell in entry["means"][EVENT].items()}
    diff, low, high = (f"{100 * bound:+.1f}" for bound in entry["minus"][EVENT][FIXED][:3])
    lowest, highest, family, without_family = over_families(entry["events"])
    scenes, seeds, families = entry["scenes"], entry["seeds"], len(entry["events"])
    return (
        f"In {scenes * seeds} rollouts of the policy `{POLICY}`, {length} ({scenes} scenes of the "
        f"two frozen test sets, {families} families, {seeds} seeds), the share that\nleaves the "
        f"road or is at fault in a contact is {share[BASELINE]} behind `{BASELINE}`, "
        f"{share[FIXED]} behind `{FIXED}` and {share[TRUE]} behind `{TRUE}`. `{FIXED}` minus "
        f"`{BASELINE}`: {diff} points, 95 % interval {low} to {high} over scenes and {lowest:+.1f} "
        f"to {highest:+.1f}\nover families; {without_family:+.1f} points without the family that moves it "
        f"most, {family} ([closed loop](docs/experiments/fixer-closed-loop.md)).\n"
    )


def written(record: Entry) -> dict[Path, str]:
    """Return the pages as they should be."""
    page, readme = DOCS / "experiments" / "fixer-closed-loop.md", DOCS.parent / "README.md"
    length, policies = record["length"], record["policies"]
    parts = [tables(policy, entry) for policy, entry in policies.items()]
    text = "\n\n".join([f"{length}.", *parts])
    claim = sentence(policies[POLICY], length)
    return {
        page: replaced(page.read_text(encoding="utf-8"), "closed-loop", text),
        readme: replaced(readme.read_text(encoding="utf-8"), "headline", claim),
    }


if __name__ == "__main__":
    record = json.loads(RECORD.read_text())
    record["policies"] |= dict(read_run(Path(word)) for word in sys.argv[1:] if word != "--check")
    if "--check" not in sys.argv:
        RECORD.write_text(json.dumps(record) + "\n")
    write(written(record))

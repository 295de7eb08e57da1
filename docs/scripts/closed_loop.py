"""Write the tables of docs/experiments/fixer-closed-loop.md, and README's sentence about driving.

    python docs/scripts/closed_loop.py [--check] [RUN...]

Each RUN is a run of one policy over the frozen scenes. Its numbers go into the record beside that
page, of which the pages are made. With ``--check`` nothing is written, and the exit code is 1
where a page is stale.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pages import DOCS, replaced, table, write

from evaluators.statistics.differences import flag_interval
from evaluators.statistics.verdicts import sign_test

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
    with bounds and p-value, for each family of scenes the rollouts with the event, and when and by
    which commit it was driven.
    """
    summary = json.loads((run / "summary.json").read_text())
    facts = json.loads((run / "run.json").read_text())
    rows = pd.read_parquet(run / "rollouts.parquet")
    rows["family"] = rows["scene"].str.split("-").str[-2].str.replace("_", " ")
    counts = (
        rows.astype({EVENT: float}).groupby(["family", "renderer"])[EVENT].agg(["sum", "count"])
    )
    entry: Entry = {key + "s": rows[key].nunique() for key in ("scene", "seed")}
    entry["date"] = facts["started_at"][: len("2026-11-25")]
    entry["commit"] = facts["project"]["commit"][:8]
    for kind, section, names, keys in (
        ("means", "metrics", RENDERERS, ("mean", "ci95", "ci95_clustered")),
        ("minus", "paired", OTHERS, ("diff", "ci95", "p_value")),
    ):
        entry[kind] = {
            metric: {name: numbers_of(summary[section][name][metric], keys) for name in names}
            for metric in UNITS
        }  # fmt: skip
    entry["events"] = {
        family: {name: [int(count) for count in counts.loc[family, name]] for name in RENDERERS}
        for family in rows["family"].sort_values().unique()
    }
    return rows["policy"].iloc[0], entry


def numbers_of(entry: Entry, keys: Sequence[str]) -> list[float | None]:
    """Return the numbers of a mean or a difference; an interval is two of them, None without one."""
    numbers: list[float | None] = []
    for key in keys:
        value = entry[key]
        is_interval = key == "ci95_clustered" or ("p_value" in keys and key == "ci95")
        if is_interval and value is None:
            value = [None, None]
        numbers += value if isinstance(value, list) else [value]
    return numbers


def bracket(low: float | None, high: float | None, scale: float, form: str) -> str:
    """Print an interval; nothing where there is none."""
    if low is None or high is None:
        return ""
    return f" [{scale * low:{form}}, {scale * high:{form}}]"


def chance(p: float) -> str:
    """Print a p-value with three digits."""
    return "< 0.001" if p < 0.0005 else f"{p:.3f}"


def tables(policy: str, entry: Entry) -> str:
    """Return a policy's three tables."""
    means, minus = [], []
    for metric, unit in UNITS.items():
        n, scale = (1, 100) if unit == "%" else (3, 1)
        name = f"`{metric}` ({unit})"
        plain, signed = f".{n}f", f"+.{n}f"
        means.append([
            name,
            *(f"{scale * mean:{plain}} ± {scale * half:{plain}}{bracket(low, high, scale, plain)}"
              for mean, half, low, high in entry["means"][metric].values()),
        ])  # fmt: skip
        minus.append([
            name,
            *(f"{scale * diff:{signed}}{bracket(low, high, scale, signed)}, p {chance(p)}"
              for diff, low, high, p in entry["minus"][metric].values()),
        ])  # fmt: skip
    events = [[family, *(f"{number} of {rollouts}" for number, rollouts in counts.values())]
              for family, counts in entry["events"].items()]  # fmt: skip
    parts = (
        f"**{policy}**: {entry['scenes']} scenes x {entry['seeds']} seeds, driven on "
        f"{entry['date']} by commit {entry['commit']}\n",
        table(["metric", *RENDERERS], means),
        table([f"minus {BASELINE}", *OTHERS], minus),
        table(["left the road or at fault, rollouts", *RENDERERS], events),
    )
    return "\n".join(parts)


@dataclass(frozen=True)
class OverFamilies:
    """The difference with families of scenes as the unit, in points.

    Attributes:
        n_better, n_worse: Families that changed.
        p_value: Of the exact sign test on them.
        bounds: Of the mean over families, also those that were not driven: nothing is assumed about
            how families are spread (Student's interval misses the mean in 17 % of cases where one
            family in ten changes greatly).
        family: That moves the difference over rollouts most.
        without_family: The difference without it.
    """

    n_better: int
    n_worse: int
    p_value: float
    bounds: tuple[float, float]
    family: str
    without_family: float


def over_families(events: Entry) -> OverFamilies:
    """Return the difference of the share with the event, over families."""
    change = np.array([counts[FIXED][0] - counts[BASELINE][0] for counts in events.values()])
    rollouts = np.array([counts[BASELINE][1] for counts in events.values()])
    mean = change.sum() / rollouts.sum()
    n_better, n_worse = int(np.sum(change < 0)), int(np.sum(change > 0))
    interval = flag_interval(change / rollouts, np.arange(len(change)))
    without_family = (change.sum() - change) / (rollouts.sum() - rollouts)
    most = int(np.argmax(np.abs(without_family - mean)))
    return OverFamilies(
        n_better,
        n_worse,
        sign_test(n_worse, n_better),
        (100 * interval.low, 100 * interval.high),
        list(events)[most],
        100 * without_family[most],
    )


def sentence(entry: Entry, length: str) -> str:
    """Return README's sentence."""
    share = {name: f"{100 * cell[0]:.1f} %" for name, cell in entry["means"][EVENT].items()}
    diff, low, high, p_value = entry["minus"][EVENT][FIXED]
    interval = "" if low is None else f", 95 % interval {100 * low:+.1f} to {100 * high:+.1f}"
    over = over_families(entry["events"])
    scenes, seeds, families = entry["scenes"], entry["seeds"], len(entry["events"])
    return (
        f"In {scenes * seeds} rollouts of the policy `{POLICY}`, {length} ({scenes} scenes of the "
        f"two frozen test sets, {families} families, {seeds} seeds), the share that\nleaves the "
        f"road or is at fault in a contact is {share[BASELINE]} behind `{BASELINE}`, "
        f"{share[FIXED]} behind `{FIXED}` and {share[TRUE]} behind `{TRUE}`. `{FIXED}` minus "
        f"`{BASELINE}`: {100 * diff:+.1f} points (sign-flip test over scenes, p = {p_value:.3f})"
        f"{interval}.\n{over.n_better} families are better and {over.n_worse} worse (sign test, p = "
        f"{over.p_value:.3f}); without the one that moves it most, {over.family}, it is "
        f"{over.without_family:+.1f} points. For families that were not driven the interval is wide: "
        f"{over.bounds[0]:+.1f} to {over.bounds[1]:+.1f}. The rollouts were driven on {entry['date']} "
        f"at commit {entry['commit']} and not again since, so that today's program may give other numbers "
        "([closed loop](docs/experiments/fixer-closed-loop.md)).\n"
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

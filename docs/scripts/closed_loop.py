"""Write the tables of docs/experiments/fixer-closed-loop.md, and what README.md and
docs/experiments/index.md say of them.

    python docs/scripts/closed_loop.py [--check] [RUN...]

Each RUN is a run of one policy over the frozen scenes. Its numbers go into the record beside that
page, from which the pages are made. With ``--check`` nothing is written, and the exit code is 1
where a page is stale.
"""

from __future__ import annotations

import json
import re
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from scipy.special import stdtrit

REPO = Path(__file__).resolve().parents[2]
EXPERIMENTS = REPO / "docs" / "experiments"
RECORD = EXPERIMENTS / "closed-loop.json"
TRUE, BASELINE, FIXED, BARE = RENDERERS = ("clean", "3dgs", "onefixer", "onefixer[references=0]")
OTHERS = (TRUE, FIXED, BARE)
EVENT, DISTANCE = "offroad_or_collision_at_fault", "lateral_distance_m"
UNITS = {"collision_at_fault": "%", "offroad": "%", EVENT: "%", DISTANCE: "m", "progress": "%",
         "min_distance_to_obstacle_m": "m"}  # fmt: skip
SAFER, KEEPS = "| Does it make driving safer? ", "| Does it keep the car on its path? "
Entry = dict[str, Any]


def read_run(run: Path) -> tuple[str, Entry]:
    """Return the policy of a run, and its numbers: means with half width and bounds, differences
    with bounds and p-value, and for each family of scenes the rollouts with the event.
    """
    summary = json.loads((run / "summary.json").read_text())
    rows = pq.read_table(run / "rollouts.parquet").to_pylist()
    entry: Entry = {"scenes": len({row["scene"] for row in rows}),
                    "seeds": len({row["seed"] for row in rows}), "means": {}, "minus": {}}  # fmt: skip
    for metric, unit in UNITS.items():
        scale = 100 if unit == "%" else 1
        means = {name: summary["metrics"][name][metric] for name in RENDERERS}
        pairs = {name: summary["paired"][name][metric] for name in OTHERS}
        entry["means"][metric] = {
            name: [scale * one["mean"], scale * one["ci95"], *_scaled(one["ci95_clustered"], scale)]
            for name, one in means.items()
        }
        entry["minus"][metric] = {
            name: [scale * one["diff"], *_scaled(one["ci95"], scale), one["p_value"]]
            for name, one in pairs.items()
        }
    events: Counter[tuple[str, str]] = Counter()
    rollouts: Counter[tuple[str, str]] = Counter()
    for row in rows:
        if row[EVENT] is not None:
            key = row["scene"].split("-")[-2].replace("_", " "), row["renderer"]
            events[key] += int(row[EVENT])
            rollouts[key] += 1
    entry["events"] = {
        family: {name: [events[family, name], rollouts[family, name]] for name in RENDERERS}
        for family in sorted({family for family, _ in rollouts})
    }
    return rows[0]["policy"], entry


def _scaled(bounds: list[float], scale: float) -> list[float]:
    return [scale * bound for bound in bounds]


def tables(policy: str, entry: Entry) -> str:
    """Return a policy's three tables."""
    means = [f"| metric | {' | '.join(RENDERERS)} |", "|---" * 5 + "|"]
    minus = [f"| minus {BASELINE} | {' | '.join(OTHERS)} |", "|---" * 4 + "|"]
    for metric, unit in UNITS.items():
        n = 1 if unit == "%" else 3
        cells = [f"{mean:.{n}f} ± {half:.{n}f} [{low:.{n}f}, {high:.{n}f}]"
                 for mean, half, low, high in entry["means"][metric].values()]  # fmt: skip
        means.append(f"| `{metric}` ({unit}) | {' | '.join(cells)} |")
        cells = [f"{diff:+.{n}f} [{low:+.{n}f}, {high:+.{n}f}], p {p:.3f}"
                 for diff, low, high, p in entry["minus"][metric].values()]  # fmt: skip
        minus.append(f"| `{metric}` ({unit}) | {' | '.join(cells)} |")
    events = [f"| left the road or at fault, rollouts | {' | '.join(RENDERERS)} |", means[1]]
    for family, counts in entry["events"].items():
        cells = [f"{number} of {rollouts}" for number, rollouts in counts.values()]
        events.append(f"| {family} | {' | '.join(cells)} |")
    head = f"**{policy}**: {entry['scenes']} scenes x {entry['seeds']} seeds"
    return "\n\n".join((head, *("\n".join(lines) for lines in (means, minus, events))))


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
    rest = (change.sum() - change) / (rollouts.sum() - rollouts)
    most = int(np.argmax(np.abs(rest - mean)))
    return 100 * (mean - half), 100 * (mean + half), list(events)[most], 100 * rest[most]


def statements(entry: Entry, length: str) -> tuple[str, dict[str, str]]:
    """Return README's sentence, and the rows of docs/experiments/index.md by how they begin."""
    share = {name: f"{cell[0]:.1f} %" for name, cell in entry["means"][EVENT].items()}
    metres = {name: f"{cell[0]:.2f} m" for name, cell in entry["means"][DISTANCE].items()}
    scenes, seeds, count = entry["scenes"], entry["seeds"], len(entry["events"])
    diff, low, high = (f"{bound:+.1f}" for bound in entry["minus"][EVENT][FIXED][:3])
    lowest, highest, family, rest = over_families(entry["events"])
    wide = f"{lowest:+.1f} to {highest:+.1f}"
    link = "[closed loop](fixer-closed-loop.md)"
    sentence = (
        f"In {scenes * seeds} rollouts of the policy `learned`, {length} ({scenes} scenes of the "
        f"two frozen test sets, {count} families, {seeds} seeds), the share that\nleaves the road "
        f"or is at fault in a contact is {share[BASELINE]} behind `{BASELINE}`, {share[FIXED]} "
        f"behind `{FIXED}` and {share[TRUE]} behind `{TRUE}`. `{FIXED}` minus `{BASELINE}`: {diff} "
        f"points, 95 % interval {low} to {high} over scenes and {wide}\nover families; {rest:+.1f} "
        f"points without the family that moves it most, {family} "
        "([closed loop](docs/experiments/fixer-closed-loop.md))."
    )
    safer = (
        f"{SAFER}`learned`, {scenes} test scenes x {seeds} seeds, {length}: off-road or at-fault "
        f"contact, `{TRUE}` {share[TRUE]}, `{BASELINE}` {share[BASELINE]} | {share[FIXED]}; minus "
        f"`{BASELINE}` {diff} points ({low} to {high}; {wide} over {count} families; {rest:+.1f} "
        f"without {family}); without references {share[BARE]} | {link} |"
    )
    keeps = (
        f"{KEEPS}The same rollouts: mean distance, `{TRUE}` {metres[TRUE]}, `{BASELINE}` "
        f"{metres[BASELINE]} | {metres[FIXED]} | {link} |"
    )
    return sentence, {SAFER: safer, KEEPS: keeps}


def written(record: Entry) -> dict[Path, str]:
    """Return the pages as they should be."""
    page, readme, index = (
        EXPERIMENTS / "fixer-closed-loop.md",
        REPO / "README.md",
        EXPERIMENTS / "index.md",
    )
    length, policies = record["length"], record["policies"]
    sentence, rows = statements(policies["learned"], length)
    parts = "\n\n\n".join(tables(policy, entry) for policy, entry in policies.items())
    text = index.read_text()
    for begins, row in rows.items():
        text = re.sub(rf"^{re.escape(begins)}.*$", row.replace("\\", r"\\"), text, flags=re.M)
    return {
        page: replaced(page.read_text(), "closed-loop", f"{length}.\n\n{parts}"),
        readme: replaced(readme.read_text(), "headline", sentence),
        index: text,
    }


def replaced(text: str, marker: str, content: str) -> str:
    """Replace what stands between a marker's two comments."""
    begin, end = f"<!-- begin {marker} -->\n", f"\n<!-- end {marker} -->"
    before, _, rest = text.partition(begin)
    return before + begin + content + end + rest.partition(end)[2]


if __name__ == "__main__":
    record = json.loads(RECORD.read_text())
    runs = [Path(word) for word in sys.argv[1:] if word != "--check"]
    record["policies"] |= dict(map(read_run, runs))
    if runs:
        RECORD.write_text(json.dumps(record, indent=1) + "\n")
    stale = [path for path, text in written(record).items() if path.read_text() != text]
    if "--check" in sys.argv:
        sys.exit("stale: " + ", ".join(map(str, stale)) if stale else 0)
    for path in stale:
        path.write_text(written(record)[path])

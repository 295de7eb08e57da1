"""Write the headline about driving into README.md and docs/experiments/index.md, from one record:
docs/experiments/fixer-closed-loop.md.

    python docs/scripts/headline.py [--check]

``docs/scripts/closed_loop.py`` makes the record's tables. With ``--check`` nothing is written, and
the exit code is 1 where a page is stale.
"""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.special import stdtrit

DOCS = Path(__file__).resolve().parents[1]
RECORD = DOCS / "experiments" / "fixer-closed-loop.md"
POLICY = "learned"
BASELINE = "3dgs"
TRUE = "clean"
FIXED, BARE = "onefixer", "onefixer[references=0]"
EVENT, DISTANCE = "offroad_or_collision_at_fault", "lateral_distance_m"
SAFER = "| Does it make driving safer? "  # how rows of docs/experiments/index.md begin
KEEPS = "| Does it keep the car on its path? "


@dataclass(frozen=True)
class Record:
    """What the record says of one policy.

    Attributes:
        length: How long the rollouts are, such as ``19.8 s each``.
        scenes, seeds: Their numbers.
        means, minus: METRIC -> renderer -> the cell; ``minus`` is against the baseline.
        events: Family -> renderer -> rollouts with the event, and rollouts.
    """

    length: str
    scenes: int
    seeds: int
    means: dict[str, dict[str, str]]
    minus: dict[str, dict[str, str]]
    events: dict[str, dict[str, tuple[int, int]]]

    def share(self, renderer: str) -> str:
        """Return the share of rollouts with the event, as ``2.3 %``."""
        return f"{self.means[EVENT][renderer].split()[0]} %"

    def metres(self, renderer: str) -> str:
        """Return the mean distance from the path, as ``0.36 m``."""
        return f"{float(self.means[DISTANCE][renderer].split()[0]):.2f} m"

    def difference(self, renderer: str) -> tuple[str, str, str]:
        """Return the difference in points with its bounds over scenes."""
        cell = re.match(r"([-+\d.]+) \[([-+\d.]+), ([-+\d.]+)\]", self.minus[EVENT][renderer])
        assert cell, self.minus[EVENT][renderer]
        return cell[1], cell[2], cell[3]

    def over_families(self, renderer: str) -> tuple[float, float]:
        """Return the bounds of the difference in points with families as the unit.

        The variance of the mean is that of the sums of families' residuals (Liang and Zeger,
        Biometrika 73, 1986), times F / (F - 1), which needs a family's sum and not its scenes.
        """
        change = np.array([c[renderer][0] - c[BASELINE][0] for c in self.events.values()])
        rollouts = np.array([c[BASELINE][1] for c in self.events.values()])
        mean = change.sum() / rollouts.sum()
        n = len(change)
        variance = n / (n - 1) * np.sum((change - mean * rollouts) ** 2) / rollouts.sum() ** 2
        half = float(stdtrit(n - 1, 0.975) * np.sqrt(variance))
        return 100.0 * (mean - half), 100.0 * (mean + half)

    def without(self, renderer: str) -> tuple[str, float]:
        """Return the family that moves the difference most, and the difference in points without
        it.
        """
        changes = {
            name: (cells[renderer][0] - cells[BASELINE][0], cells[BASELINE][1])
            for name, cells in self.events.items()
        }
        events = sum(change for change, _ in changes.values())
        rollouts = sum(count for _, count in changes.values())
        rest = {
            name: 100.0 * (events - change) / (rollouts - count)
            for name, (change, count) in changes.items()
        }
        name = max(rest, key=lambda family: abs(rest[family] - 100.0 * events / rollouts))
        return name, rest[name]


def replace(text: str, marker: str, content: str) -> str:
    """Replace what stands between a marker's two comments."""
    pattern = re.compile(rf"(<!-- begin {marker} -->\n).*?(<!-- end {marker} -->)", re.S)
    assert pattern.search(text), f"the page has no marker {marker}"
    return pattern.sub(lambda match: f"{match[1]}{content}\n{match[2]}", text)


def read_record(text: str) -> Record:
    """Read the tables of a record's page."""
    made = re.search(
        r"<!-- begin closed-loop -->\n([\d.]+ s each)\.\n(.*)<!-- end closed-loop -->", text, re.S
    )
    assert made, "the record has no tables, or does not say how long its rollouts are"
    part = re.search(
        rf"\*\*{POLICY}\*\*: (\d+) scenes x (\d+) seeds\n(.*?)(?=\n\*\*|\Z)", made[2], re.S
    )
    assert part, f"the record has no policy {POLICY}"
    tables: dict[str, dict[str, dict[str, str]]] = {}
    for block in re.findall(r"(?:^\|.*\n?)+", part[3], re.M):
        head, _, *lines = [
            [cell.strip() for cell in line.strip("|").split("|")] for line in block.splitlines()
        ]
        tables[head[0]] = {
            re.sub(r"`(\w+)`.*", r"\1", name): dict(zip(head[1:], cells, strict=True))
            for name, *cells in lines
        }
    events = {
        name: {key: (int(cell.split()[0]), int(cell.split()[-1])) for key, cell in cells.items()}
        for name, cells in tables["left the road or at fault, rollouts"].items()
    }
    numbers = int(part[1]), int(part[2])
    return Record(made[1], *numbers, tables["metric"], tables[f"minus {BASELINE}"], events)


def sentence(record: Record) -> str:
    """Return README's sentence."""
    diff, low, high = record.difference(FIXED)
    wide = record.over_families(FIXED)
    family, rest = record.without(FIXED)
    return (
        f"In {record.scenes * record.seeds} rollouts of the policy `{POLICY}`, {record.length} "
        f"({record.scenes} scenes of the two frozen test sets, {len(record.events)} families, "
        f"{record.seeds} seeds), the share that\nleaves the road or is at fault in a contact is "
        f"{record.share(BASELINE)} behind `{BASELINE}`, {record.share(FIXED)} behind `{FIXED}` "
        f"and {record.share(TRUE)} behind `{TRUE}`. `{FIXED}` minus `{BASELINE}`: {diff} points, "
        f"95 % interval {low} to {high} over scenes and {wide[0]:+.1f} to {wide[1]:+.1f}\n"
        f"over families; {rest:+.1f} points without the family that moves it most, {family} "
        "([closed loop](docs/experiments/fixer-closed-loop.md))."
    )


def rows(record: Record) -> dict[str, str]:
    """Return the rows of docs/experiments/index.md, by how they begin."""
    diff, low, high = record.difference(FIXED)
    wide = record.over_families(FIXED)
    family, rest = record.without(FIXED)
    link = "[closed loop](fixer-closed-loop.md)"
    return {
        SAFER: f"{SAFER}`{POLICY}`, {record.scenes} test scenes x {record.seeds} seeds, "
        f"{record.length}: off-road or at-fault contact, `{TRUE}` {record.share(TRUE)}, "
        f"`{BASELINE}` {record.share(BASELINE)} | {record.share(FIXED)}; minus `{BASELINE}` "
        f"{diff} points ({low} to {high}; {wide[0]:+.1f} to {wide[1]:+.1f} over "
        f"{len(record.events)} families; {rest:+.1f} without {family}); without references "
        f"{record.share(BARE)} | {link} |",
        KEEPS: f"{KEEPS}The same rollouts: mean distance, `{TRUE}` {record.metres(TRUE)}, "
        f"`{BASELINE}` {record.metres(BASELINE)} | {record.metres(FIXED)} | {link} |",
    }


def written(record: Record) -> dict[Path, str]:
    """Return the pages as they should be."""
    readme, results = DOCS.parent / "README.md", DOCS / "experiments" / "index.md"
    text = results.read_text(encoding="utf-8")
    for begins, row in rows(record).items():
        text, found = re.subn(rf"^{re.escape(begins)}.*$", lambda _, row=row: row, text, flags=re.M)
        assert found == 1, f"{results} has {found} rows that begin with {begins!r}"
    return {
        readme: replace(readme.read_text(encoding="utf-8"), "headline", sentence(record)),
        results: text,
    }


def main() -> None:
    """Write the pages, or compare them."""
    pages = written(read_record(RECORD.read_text(encoding="utf-8")))
    stale = [path for path, text in pages.items() if path.read_text(encoding="utf-8") != text]
    if "--check" in sys.argv[1:]:
        for path in stale:
            print(f"{path} does not say what {RECORD.name} says: run docs/scripts/headline.py")
        sys.exit(1 if stale else 0)
    for path in stale:
        path.write_text(pages[path], encoding="utf-8")


if __name__ == "__main__":
    main()

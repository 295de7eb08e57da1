"""Write the headline about driving into README.md and docs/results.md, from one record:
docs/experiments/fixer-closed-loop.md.

    python docs/scripts/headline.py [--check]

The record holds the tables that ``docs/scripts/closed_loop.py`` makes. A sentence says how long the
drives are, of which sets and how many families, and gives the difference with scenes and with
families as the unit. With ``--check`` nothing is written, and the exit code is 1 where a page
differs. The record need not be repeated for that: what it says is on the page.
"""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy  # its submodules load on first use

from alpasim_plugin.core.types import F64, I64

DOCS = Path(__file__).resolve().parents[1]
RECORD = DOCS / "experiments" / "fixer-closed-loop.md"
DRAWN_S = 19.8  # length of the test sets' drives
SETS = "the two frozen test sets"
POLICY = "learned"
BASELINE = "3dgs"
TRUE = "clean"
FIXED, BARE = "onefixer", "onefixer[references=0]"
EVENT, DISTANCE = "offroad_or_collision_at_fault", "lateral_distance_m"
SAFER, KEEPS = (
    "| Does it make driving safer? ",
    "| Does it keep the car on its path? ",
)  # rows of docs/results.md


def family_bounds(means: F64, family: I64) -> list[float]:
    """Return [low, high] of the mean ``(G,)`` of scenes with their families ``(G,)`` as clusters: t
    with one degree less than families.

    The variance is that of sums of families' residuals (Liang and Zeger, Biometrika 73, 1986),
    times F / (F - 1).

    >>> [round(end, 3) for end in family_bounds(np.array([0.0, 0.0, 1.0, 1.0, 2.0, 2.0]), np.array([0, 0, 1, 1, 2, 2]))]
    [-1.484, 3.484]
    """
    centre, sums = float(np.mean(means)), np.bincount(family, means - np.mean(means))
    n = len(sums)
    half = float(
        scipy.special.stdtrit(n - 1, 0.975) * np.sqrt(n / (n - 1) * np.sum(sums**2)) / len(means)
    )
    return [centre - half, centre + half]


@dataclass(frozen=True)
class Record:
    """What the record says of one policy.

    Attributes:
        length: How long the drives are, in words.
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
        """Return the share of drives with the event, as ``2.3 %``."""
        return f"{self.means[EVENT][renderer].split()[0]} %"

    def difference(self, renderer: str) -> tuple[str, str, str]:
        """Return the difference in points with its bounds over scenes."""
        found = re.match(r"([-+\d.]+) \[([-+\d.]+), ([-+\d.]+)\]", self.minus[EVENT][renderer])
        assert found, self.minus[EVENT][renderer]
        return found[1], found[2], found[3]

    def over_families(self, renderer: str) -> tuple[float, float]:
        """Return the bounds of the difference in points with families as the unit.

        The tables hold a family's sum and not its scenes, which is all that the variance of sums of
        residuals asks for.
        """
        means, family = [], []
        for k, (name, cells) in enumerate(self.events.items()):
            here, there = cells[renderer], cells[BASELINE]
            n = here[1] // self.seeds
            assert here[1] == there[1] == n * self.seeds, (
                f"{name}: {here[1]} and {there[1]} rollouts of {self.seeds} seeds"
            )
            means += [(here[0] - there[0]) / here[1]] * n
            family += [k] * n
        low, high = family_bounds(np.array(means), np.array(family))
        return 100.0 * low, 100.0 * high

    def without(self, renderer: str) -> tuple[str, float]:
        """Return the family that moves the difference most, and the difference in points without
        it.
        """

        def rest(left_out: str | None) -> float:
            pairs = [
                (cells[renderer], cells[BASELINE])
                for name, cells in self.events.items()
                if name != left_out
            ]
            return (
                100.0
                * sum(here[0] - there[0] for here, there in pairs)
                / sum(here[1] for here, _ in pairs)
            )

        name = max(self.events, key=lambda one: abs(rest(one) - rest(None)))
        return name, rest(name)


def replace(text: str, marker: str, content: str) -> str:
    """Replace what stands between a marker's two comments."""
    pattern = re.compile(rf"(<!-- begin {marker} -->\n).*?(<!-- end {marker} -->)", re.S)
    if not pattern.search(text):
        raise SystemExit(f"the page has no marker {marker}")
    return pattern.sub(lambda match: f"{match[1]}{content}\n{match[2]}", text)


def read_record(text: str) -> Record:
    """Read the tables of a record's page."""
    made = re.search(r"<!-- begin closed-loop -->\n(.*?)<!-- end closed-loop -->", text, re.S)
    assert made, "the record has no tables"
    length, rest = made[1].split("\n", 1)
    part = re.search(
        rf"\*\*{POLICY}\*\*: (\d+) scenes x (\d+) seeds\n(.*?)(?=\n\*\*|\Z)", rest, re.S
    )
    assert part, f"the record has no policy {POLICY}"
    tables: dict[str, dict[str, dict[str, str]]] = {}
    rows: dict[str, dict[str, str]] = {}
    columns: list[str] = []
    for line in part[3].splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if not line.startswith("|"):
            columns = []
        elif not columns:
            columns = cells[1:]
            rows = tables[cells[0]] = {}
        elif not cells[0].startswith("-"):
            rows[re.sub(r"`(\w+)`.*", r"\1", cells[0])] = dict(zip(columns, cells[1:], strict=True))
    counts = tables["left the road or at fault, rollouts"]
    events = {
        name: {key: _counted(cell) for key, cell in cells.items()} for name, cells in counts.items()
    }
    return Record(
        _length(length),
        int(part[1]),
        int(part[2]),
        tables["metric"],
        tables[f"minus {BASELINE}"],
        events,
    )


def _counted(cell: str) -> tuple[int, int]:
    had, of = cell.split(" of ")
    return int(had), int(of)


def _length(line: str) -> str:
    """Return the length of the drives in words, from the record's first line: ``8 s each; `scene` 9
    s.``.
    """
    found = re.match(r"([\d.]+) s each", line)
    assert found, f"the record does not say how long its drives are: {line!r}"
    seconds = float(found[1])
    return (
        f"{seconds:g} s each"
        if seconds >= np.floor(DRAWN_S)
        else f"each cut to its first {seconds:g} of {DRAWN_S:g} s"
    )


def sentence(record: Record, renderer: str = FIXED) -> str:
    """Return README's sentence."""
    diff, low, high = record.difference(renderer)
    wide, (family, rest) = record.over_families(renderer), record.without(renderer)
    return (
        f"In {record.scenes * record.seeds} rollouts of the policy `{POLICY}`, {record.length} ({record.scenes} scenes of {SETS}, "
        f"{len(record.events)} families, {record.seeds} seeds), the share that\nleaves the road or is at fault in a contact is "
        f"{record.share(BASELINE)} behind `{BASELINE}`, {record.share(renderer)} behind `{renderer}` and {record.share(TRUE)} behind "
        f"`{TRUE}`. `{renderer}` minus `{BASELINE}`: {diff} points, 95 % interval {low} to {high} over scenes and {wide[0]:+.1f} to "
        f"{wide[1]:+.1f}\nover families; {rest:+.1f} points without the family that moves it most, {family} "
        "([closed loop](docs/experiments/fixer-closed-loop.md))."
    )


def rows(record: Record) -> dict[str, str]:
    """Return the rows of docs/results.md, by how they begin."""
    of = f"{record.scenes} test scenes x {record.seeds} seeds, {record.length}"
    link = "[closed loop](experiments/fixer-closed-loop.md)"
    diff, low, high = record.difference(FIXED)
    wide, (family, rest) = record.over_families(FIXED), record.without(FIXED)
    bare = f"; without references {record.share(BARE)}" if BARE in record.means[EVENT] else ""
    safer = (
        f"{record.share(FIXED)}; minus `{BASELINE}` {diff} points ({low} to {high}; {wide[0]:+.1f} to {wide[1]:+.1f} over "
        f"{len(record.events)} families; {rest:+.1f} without {family}){bare}"
    )
    keeps = f"{float(record.means[DISTANCE][FIXED].split()[0]):.2f} m"
    true, base = (float(record.means[DISTANCE][name].split()[0]) for name in (TRUE, BASELINE))
    head = f"{SAFER}`{POLICY}`, {of}: off-road or at-fault contact, `{TRUE}` {record.share(TRUE)}, `{BASELINE}` {record.share(BASELINE)}"
    return {
        SAFER: f"{head} | {safer} | {link} |",
        KEEPS: f"{KEEPS}The same rollouts: mean distance, `{TRUE}` {true:.2f} m, `{BASELINE}` {base:.2f} m | {keeps} | {link} |",
    }


def written(record: Record) -> dict[Path, str]:
    """Return the pages as they should be."""
    readme, results = DOCS.parent / "README.md", DOCS / "results.md"
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

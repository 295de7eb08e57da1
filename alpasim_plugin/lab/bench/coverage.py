"""The tables of docs/experiments/verdict-error.md, from the study of the intervals.

``python -m alpasim_plugin.lab.bench.coverage`` prints the tables; ``--write PAGE`` puts them
between the markers of that page.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F64
from alpasim_plugin.lab.bench.interval_study import (
    CORRELATIONS,
    PAPER_SCENES,
    PAPER_SEEDS,
    RATES,
    SHARED_NOISE,
    Design,
    bootstrap_coverage,
    coverage,
    coverage_of,
    in_blocks,
    paired_coverage,
    pairs,
    power_of,
)
from evaluators.statistics.intervals import t_bounds
from evaluators.statistics.verdicts import more_scenes, scenes_needed

SCENES = (5, 10, 20, 60, 150)
LEAST, MOST = 0.93, 0.97
REPEATS = 20_000


def tables(repeats: int) -> dict[str, str]:
    """Return every table as Markdown, by the name of its marker."""
    makers: dict[str, Callable[[int], str]] = {
        "coverage": _coverage,
        "coverage-scenes": _coverage_scenes,
        "coverage-means": _coverage_means,
        "coverage-paired": _coverage_paired,
        "power": _power,
        "planning": _planning,
        "planning-check": _planning_check,
    }
    return {name: make(repeats) for name, make in makers.items()}


def write_into(page: Path, made: dict[str, str]) -> None:
    """Replace what stands between ``<!-- begin NAME -->`` and ``<!-- end NAME -->``.

    Raises:
        InputError: A marker is missing.
    """
    text = page.read_text(encoding="utf-8")
    for name, table in made.items():
        begin, end = f"<!-- begin {name} -->\n", f"<!-- end {name} -->"
        if begin not in text or end not in text:
            raise InputError(
                f"{page}: no markers for {name!r}",
                f"add {begin.strip()} and {end}",
            )
        text = text[: text.index(begin) + len(begin)] + table + text[text.index(end) :]
    page.write_text(text, encoding="utf-8")


def _coverage(repeats: int) -> str:
    rows = []
    for rate in RATES:
        for correlation in CORRELATIONS:
            design = Design(rate=rate, correlation=correlation)
            found = coverage_of(design, repeats)
            drawn = bootstrap_coverage(design, max(200, repeats // 10))
            rows.append(
                [
                    f"{100 * rate:g} %",
                    f"{correlation:g}",
                    *map(_percent, found[:3]),
                    _percent(drawn),
                    _judged(found[3]),
                ]
            )
    return _markdown(
        ["rate", "correlation", "paper", "Wilson", "t on scenes", "bootstrap", "`ci95_clustered`"],
        rows,
    )


def _coverage_scenes(repeats: int) -> str:
    rows = []
    for rate in (0.5, 0.106, 0.069, 0.02):
        for n_scenes in SCENES:
            found = [
                coverage_of(Design(n_scenes, PAPER_SEEDS, rate, c), repeats // 2)
                for c in CORRELATIONS
            ]
            rows.append(
                [
                    f"{100 * rate:g} %",
                    str(n_scenes),
                    *(f"{_percent(f[2])} / {_judged(f[3])}" for f in found),
                ]
            )
    return _markdown(["rate", "scenes", *(f"correlation {c:g}" for c in CORRELATIONS)], rows)


def _coverage_means(repeats: int) -> str:
    """Coverage of t on scenes for metrics that are no rates, by the shape of the scenes' means."""
    shapes: dict[str, tuple[Callable[[np.random.Generator, tuple[int, int]], F64], float]] = {
        "normal": (lambda g, s: g.standard_normal(s), 0.0),
        "log-normal, sigma 0.5": (
            lambda g, s: np.exp(0.5 * g.standard_normal(s)),
            float(np.exp(0.125)),
        ),
        "log-normal, sigma 1": (lambda g, s: np.exp(g.standard_normal(s)), float(np.exp(0.5))),
        "difference of two log-normal, sigma 1": (
            lambda g, s: np.exp(g.standard_normal(s)) - np.exp(g.standard_normal(s)),
            0.0,
        ),
    }
    rows = []
    for name, (draw, truth) in shapes.items():
        row = [name]
        for n_scenes in SCENES:

            def measure(
                n: int, generator: np.random.Generator, n_scenes: int = n_scenes
            ) -> list[float]:
                return [coverage(t_bounds(draw(generator, (n, n_scenes))), truth)]  # noqa: B023 - called before the loop moves on

            row.append(_judged(in_blocks(measure, repeats, f"{name} {n_scenes}")[0]))
        rows.append(row)
    return _markdown(["scene means", *(f"{n} scenes" for n in SCENES)], rows)


def _coverage_paired(repeats: int) -> str:
    rows = []
    for rates in ((RATES[0], RATES[1]), (RATES[1], RATES[1]), (0.3, 0.3)):
        for n_scenes in SCENES[1:]:
            designs = [Design(n_scenes, PAPER_SEEDS, rates[0], c) for c in CORRELATIONS]
            found = [_judged(paired_coverage(design, rates[1], repeats // 2)) for design in designs]
            rows.append([f"{100 * rates[0]:g} and {100 * rates[1]:g} %", str(n_scenes), *found])
    return _markdown(["rates", "scenes", *(f"correlation {c:g}" for c in CORRELATIONS)], rows)


def _power(repeats: int) -> str:
    rows = []
    for correlation in CORRELATIONS:
        found = power_of(Design(rate=RATES[0], correlation=correlation), RATES[1], repeats)
        rows.append([f"{correlation:g}", *(f"{100 * p:.0f} %" for p in found)])
    return _markdown(
        ["correlation", "unpaired", "paired by scene", "paired, shared random numbers"], rows
    )


def _planning(repeats: int) -> str:
    """Scenes for 80 % power against the two rates, from the spread that the model gives."""
    rows = []
    for n_seeds in (1, 3, 5):
        needed = [
            scenes_needed(RATES[0] - RATES[1], _spread(n_seeds, correlation, repeats))
            for correlation in CORRELATIONS
        ]
        rows.append([str(n_seeds), *map(_scenes, needed)])
    return _markdown(["seeds", *(f"correlation {c:g}" for c in CORRELATIONS)], rows)


def _planning_check(repeats: int) -> str:
    """How often a run of the planned size decides, and what a small first run says is needed."""
    rows = []
    for correlation in CORRELATIONS:
        needed = scenes_needed(RATES[0] - RATES[1], _spread(PAPER_SEEDS, correlation, repeats))
        if needed is None:
            raise AssertionError("a difference of this size can be planned for")
        decided = power_of(
            Design(needed, PAPER_SEEDS, RATES[0], correlation), RATES[1], min(repeats, 4000)
        )[2]
        said = _advice(correlation)
        quartiles = [
            ("out of reach" if q > 1e5 else f"{q:.0f}")
            for q in np.quantile(said, [0.25, 0.5, 0.75])
        ]
        rows.append(
            [
                f"{correlation:g}",
                str(needed),
                f"{100 * decided:.0f} %",
                str(needed - PAPER_SCENES),
                " / ".join(quartiles),
            ]
        )
    head = [
        "correlation",
        "planned scenes",
        "decided",
        "missing after 60 scenes",
        "`more_scenes` of undecided runs, quartiles",
    ]
    return _markdown(head, rows)


def _advice(correlation: float, runs: int = 400) -> F64:
    """Return `more_scenes` after 60 scenes ``(runs,)``, over undecided runs; infinite where it is
    None.
    """
    design = Design(rate=RATES[0], correlation=correlation)
    worse, base = pairs(
        design,
        RATES[1],
        SHARED_NOISE,
        runs,
        np.random.Generator(np.random.Philox(int(10 * correlation))),
    )
    delta = (worse - base).mean(axis=2)
    low, high = t_bounds(delta)
    undecided = delta[(low <= 0) & (high >= 0)]
    said = [
        more_scenes(float(d.mean()), float(d.std(ddof=1)), PAPER_SCENES, 0.0, 1.0)
        for d in undecided
    ]
    return np.array([np.inf if s is None else float(s) for s in said])


def _spread(n_seeds: int, correlation: float, repeats: int) -> float:
    """Return the standard deviation between scenes of the paired difference."""
    generator = np.random.Generator(np.random.Philox(n_seeds))
    first, second = pairs(
        Design(repeats, n_seeds, RATES[0], correlation), RATES[1], SHARED_NOISE, 4, generator
    )
    return float((first - second).mean(axis=2).std(ddof=1))


def _percent(share: float) -> str:
    return f"{100 * share:.1f}"


def _judged(share: float) -> str:
    """Print a coverage, bold where it lies outside 93 to 97 %."""
    return _percent(share) if LEAST <= share <= MOST else f"**{_percent(share)}**"


def _scenes(n: int | None) -> str:
    return "out of reach" if n is None else str(n)


def _markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "".join("| " + " | ".join(line) + " |\n" for line in (head, ["---"] * len(head), *rows))


def main() -> None:
    """Print the tables, or write them into a page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument(
        "--repeats", type=int, default=REPEATS, help="Simulated runs per cell of the grid."
    )
    parser.add_argument("--write", type=Path, help="Page whose tables are replaced.")
    options = parser.parse_args()
    made = tables(options.repeats)
    if options.write is None:
        for name, text in made.items():
            print(f"\n{name}\n\n{text}")
    else:
        write_into(options.write, made)


if __name__ == "__main__":
    main()

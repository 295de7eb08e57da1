"""Measure the sentences of `simrun --vary` in simulated worlds whose truth is known.

    python -m tests.boundary_worlds             # all worlds; a minute
    python -m tests.boundary_worlds --quick     # a second

A world says at which values of one or two parameters a policy fails. For each number of first points
the table gives the drives of a seed, the share of searches that leave something unseen (a change of
outcome between driven points that do not differ), and the share of sentences that are false: about a
driven point, about a bracket, or about the difference of two variants at their points.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from alpasim_plugin.core.printing import say
from alpasim_plugin.core.seeding import stream
from evaluators.statistics.boundary import (
    PARTS,
    difference_of,
    median_boundary,
    next_points,
    stretches_of,
)
from evaluators.statistics.boundary_area import AREA_PARTS, Point, claims_of, next_area_points
from tests.calibration import table

FINE = 2_000  # values of a range at which the truth is looked at
Fails = Callable[[float], bool]  # value between 0 and 1 -> whether the drive fails


@dataclass(frozen=True)
class World:
    """Where policies fail along one parameter.

    Attributes:
        name: In words.
        draw: Random numbers -> the ends of the windows in which a seed fails, between 0 and 1.
        noise: Standard deviation of the value at which a drive is looked up.
    """

    name: str
    draw: Callable[[np.random.Generator], list[tuple[float, float]]]
    noise: float = 0.0


def island(width: float) -> Callable[[np.random.Generator], list[tuple[float, float]]]:
    """Return a world that fails below a boundary and in an island above it."""

    def draw(rng: np.random.Generator) -> list[tuple[float, float]]:
        boundary = float(rng.uniform(0.1, 0.5))
        start = float(rng.uniform(boundary + 0.05, 1.0 - width))
        return [(-1.0, boundary), (start, start + width)]

    return draw


def one_boundary(rng: np.random.Generator) -> list[tuple[float, float]]:
    """Draw a boundary below which a policy fails."""
    return [(-1.0, float(rng.uniform(0.1, 0.9)))]


def two_windows(rng: np.random.Generator) -> list[tuple[float, float]]:
    """Draw two windows; a policy passes at both ends."""
    low, high = rng.uniform(0.05, 0.25), rng.uniform(0.55, 0.75)
    return [(float(low), float(low + 0.15)), (float(high), float(high + 0.15))]


def island_of_some_seeds(rng: np.random.Generator) -> list[tuple[float, float]]:
    """Draw a boundary, and in one seed of five an island of 15 % above it."""
    return island(0.15)(rng)[: 1 + int(rng.random() < 0.2)]


WORLDS = (
    World("one boundary", one_boundary),
    World("an island of 10 %", island(0.10)),
    World("an island of 15 %", island(0.15)),
    World("an island of 20 %", island(0.20)),
    World("a window of 30 %", lambda rng: [(start := float(rng.uniform(0.1, 0.6)), start + 0.3)]),
    World("two windows of 15 %", two_windows),
    World("one boundary, noise of 3 %", one_boundary, 0.03),
    World("one seed of five with an island of 15 %", island_of_some_seeds),
)


def searched(fails: Fails, spacings: int) -> dict[int, bool]:
    """Drive one seed until its search has ended."""
    steps = spacings * PARTS
    failed: dict[int, bool] = {}
    while points := next_points(failed, range(0, steps + 1, PARTS), frozenset()):
        failed |= {point: fails(point / steps) for point in points}
    return failed


def outcomes_of(failed: dict[int, bool], spacings: int) -> dict[str, list[list[float]]]:
    """Return the outcomes of one seed as a record has them."""
    steps = spacings * PARTS
    return {"0": [[point / steps, failed[point]] for point in sorted(failed)]}


def is_false(failed: dict[int, bool], spacings: int) -> bool:
    """Tell whether a stretch contradicts a driven point, or a bracket holds no change."""
    steps = spacings * PARTS
    stretches = stretches_of(outcomes_of(failed, spacings))
    for stretch in stretches:
        inside = [
            has_failed
            for point, has_failed in failed.items()
            if stretch.low <= point / steps <= stretch.high
        ]
        if set(inside) != {stretch.most > 0} or len(inside) != stretch.points:
            return True
    return any((low.most > 0) == (high.most > 0) for low, high in pairwise(stretches))


def is_incomplete(fails: Fails, failed: dict[int, bool], spacings: int) -> bool:
    """Tell whether the outcome changes between driven neighbours that do not differ."""
    steps = spacings * PARTS
    for low, high in pairwise(sorted(failed)):
        values = np.linspace(low / steps, high / steps, FINE // spacings)
        if failed[low] == failed[high] and len({fails(value) for value in values}) > 1:
            return True
    return False


def policy_of(windows: list[tuple[float, float]], noise: float, rng: np.random.Generator) -> Fails:
    """Return a policy that fails in some windows; with noise its value is moved in every drive."""

    def fails(value: float) -> bool:
        at = value + noise * rng.standard_normal() if noise else value
        return any(low <= at < high for low, high in windows)

    return fails


def along_one_key(policies: int) -> Iterator[Sequence[str]]:
    """Give a row for each world: drives, searches that leave something unseen, and false sentences,
    for 4, 8 and 16 spacings.
    """
    for world in WORLDS:
        row = [world.name]
        for spacings in (4, 8, 16):
            drives, unseen, false, false_difference = [], [], [], []
            for number in range(policies):
                rng = stream("boundary", number, f"worlds/{world.name}")
                windows = world.draw(rng)

                fails = policy_of(windows, world.noise, rng)
                failed = searched(fails, spacings)
                drives.append(len(failed))
                false.append(is_false(failed, spacings))
                if not world.noise:
                    unseen.append(is_incomplete(fails, failed, spacings))
                false_difference.append(misses_a_window(failed, windows, spacings))
            # noise makes outcomes between driven points chance: what is unseen has no truth
            share_unseen = f"{100 * np.mean(unseen):.0f}" if unseen else "-"
            row.append(
                f"{np.mean(drives):.1f} / {share_unseen} / "
                f"{100 * np.mean(np.logical_or(false, false_difference)):.0f}"
            )
        yield row


def misses_a_window(
    failed: dict[int, bool], windows: list[tuple[float, float]], spacings: int
) -> bool:
    """Tell whether the difference to the policy without its last window hides a pair that differs."""
    steps = spacings * PARTS
    kept = windows[:-1]
    baseline = {point: any(low <= point / steps < high for low, high in kept) for point in failed}
    now, was = (outcomes_of(side, spacings) for side in (failed, baseline))
    difference = difference_of(now, was, [[0.0, 1.0]])
    differing = sum(failed[point] != baseline[point] for point in failed)
    return difference is None or difference.gained + difference.lost != differing


def discs(policies: int) -> Iterator[Sequence[str]]:
    """Give a row for each share of a rectangle that a disc takes: drives, and discs unseen."""
    for share in (0.02, 0.05, 0.10):
        row = [f"a disc of {100 * share:g} %"]
        radius = float(np.sqrt(share / np.pi))
        for spacings in (4, 6, 8):
            lines = (range(0, spacings * AREA_PARTS + 1, AREA_PARTS),) * 2
            drives, unseen = [], []
            for number in range(policies):
                rng = stream("boundary", number, f"discs/{share}")
                centre = rng.uniform(radius, 1.0 - radius, 2)
                failed: dict[Point, bool] = {}
                while points := next_area_points(failed, lines, set()):
                    for point in points:
                        place = np.array(point) / (spacings * AREA_PARTS)
                        failed[point] = bool(np.hypot(*(place - centre)) < radius)
                drives.append(len(failed))
                unseen.append(claims_of(failed, lines).failed == 0)
            row.append(f"{np.mean(drives):.0f} / {100 * np.mean(unseen):.0f}")
        yield row


def medians(policies: int) -> Iterator[Sequence[str]]:
    """Give how often the interval over seeds holds the median boundary, where one seed in five fails
    far from the others.
    """
    for seeds in (3, 5, 6, 10, 20):
        held = []
        for number in range(policies):
            rng = stream("boundary", number, f"medians/{seeds}")
            outcomes = {}
            for seed in range(seeds):
                centre = 0.8 if rng.random() < 0.2 else 0.3
                boundary = centre + 0.05 * rng.standard_normal()
                failed = searched(lambda value, boundary=boundary: value < boundary, 16)
                outcomes[str(seed)] = outcomes_of(failed, 16)["0"]
            interval = median_boundary(outcomes)
            if interval is not None:
                held.append(interval.low <= MEDIAN <= interval.high)
        yield (str(seeds), f"{100 * np.mean(held):.1f}" if held else "none is given")


@dataclass(frozen=True)
class SeedWorld:
    """Where the seeds of a policy fail along one parameter.

    Attributes:
        name: In words.
        draw: Random numbers -> the windows in which a seed fails, between 0 and 1.
        median: Of the lowest value above which a seed's outcome first changes, over seeds; None where
            half of them never change.
    """

    name: str
    draw: Callable[[np.random.Generator], list[tuple[float, float]]]
    median: float | None


def normal(centre: float) -> Callable[[np.random.Generator], list[tuple[float, float]]]:
    """Return a world that fails below a boundary that varies by 5 %."""
    return lambda rng: [(-1.0, float(centre + 0.05 * rng.standard_normal()))]


def fifth(
    usual: Callable[[np.random.Generator], list[tuple[float, float]]],
    other: Callable[[np.random.Generator], list[tuple[float, float]]],
    share: float = 0.2,
) -> Callable[[np.random.Generator], list[tuple[float, float]]]:
    """Return a world in which a share of seeds is another."""
    return lambda rng: other(rng) if rng.random() < share else usual(rng)


def window(rng: np.random.Generator) -> list[tuple[float, float]]:
    """Draw a window of 15 % and nothing else."""
    start = float(rng.uniform(0.4, 0.8))
    return [(start, start + 0.15)]


def with_window(rng: np.random.Generator) -> list[tuple[float, float]]:
    """Draw a boundary at 0.3 and a window above it."""
    return [*normal(0.3)(rng), *window(rng)]


def above(rng: np.random.Generator) -> list[tuple[float, float]]:
    """Draw a boundary above which a seed fails."""
    return [(float(0.7 + 0.05 * rng.standard_normal()), 2.0)]


def never(rng: np.random.Generator) -> list[tuple[float, float]]:
    """Fail nowhere."""
    return []


SEED_WORLDS = (
    SeedWorld("a boundary that varies by 5 %", normal(0.3), 0.3),
    SeedWorld("the same, one seed in five elsewhere", fifth(normal(0.3), normal(0.8)), 0.315930),
    SeedWorld("the same, one in five with a window too", fifth(normal(0.3), with_window), 0.3),
    SeedWorld("one in five fails in a window only", fifth(never, window), None),
    SeedWorld("one in fifty does", fifth(never, window, 0.02), None),
    SeedWorld("half fail below, half above", fifth(normal(0.3), above, 0.5), 0.5),
)


def searched_together(policies: Sequence[Fails], spacings: int) -> list[dict[int, bool]]:
    """Drive several seeds until the search of each has ended, all at the points that any asks for."""
    steps = spacings * PARTS
    failed: list[dict[int, bool]] = [{} for _ in policies]
    while True:
        points = {
            point
            for seed in failed
            for point in next_points(seed, range(0, steps + 1, PARTS), frozenset())
        }
        if not points:
            return failed
        for seed, fails in zip(failed, policies, strict=True):
            seed |= {point: fails(point / steps) for point in points}


def is_false_over_seeds(outcomes: dict[str, list[list[float]]]) -> bool:
    """Tell whether the stretches of several seeds contradict a driven point, or leave one out."""
    counts: dict[float, int] = {}
    for points in outcomes.values():
        for value, has_failed in points:
            counts[value] = counts.get(value, 0) + int(has_failed)
    stated = 0
    for stretch in stretches_of(outcomes):
        inside = [count for value, count in counts.items() if stretch.low <= value <= stretch.high]
        stated += len(inside)
        if (min(inside), max(inside), len(inside)) != (stretch.least, stretch.most, stretch.points):
            return True
        if stretch.most and not stretch.least:  # "fails in 0 to 2 of 5 seeds"
            return True
    return stated != len(counts)


def over_seeds(policies: int, sizes: Sequence[int] = (3, 6, 20)) -> Iterator[Sequence[str]]:
    """Give a row for each world of seeds: false sentences, false verdicts of a gate with a margin of 0
    against a baseline whose seeds are drawn anew, intervals of the median that are given, and those
    that are false; for numbers of seeds.
    """
    for world in SEED_WORLDS:
        row = [world.name]
        for seeds in sizes:
            flags = np.zeros(4)
            for number in range(policies):
                rng = stream("boundary", number, f"seeds/{world.name}/{seeds}")
                sides = []
                for _ in range(2):
                    drawn = [world.draw(rng) for _ in range(seeds)]
                    sides.append([policy_of(windows, 0.0, rng) for windows in drawn])
                # both variants are driven at the points that either asks for
                driven = searched_together([*sides[0], *sides[1]], 16)
                now, was = (
                    {str(i): outcomes_of(seed, 16)["0"] for i, seed in enumerate(part)}
                    for part in (driven[:seeds], driven[seeds:])
                )
                difference = difference_of(now, was, [[0.0, 1.0]])
                assert difference is not None, "both have driven the same points"
                is_new = any(
                    seed[point] and not base[point]
                    for seed, base in zip(driven[:seeds], driven[seeds:], strict=True)
                    for point in seed
                )
                interval = median_boundary(now)
                is_missed = interval is not None and not (
                    world.median is not None and interval.low <= world.median <= interval.high
                )
                flags += [
                    is_false_over_seeds(now),
                    (difference.anew > 0.0) != is_new,
                    interval is not None,
                    is_missed,
                ]
            row.append(" / ".join(f"{100 * flag / policies:.0f}" for flag in flags))
        yield row


# of 0.8 N(0.3, 0.05) + 0.2 N(0.8, 0.05): 0.8 Phi(z) = 0.5 at z = 0.3186
MEDIAN = 0.3 + 0.05 * 0.3186


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a second in place of a minute")
    policies = 5 if parser.parse_args().quick else 300
    say(f"One key, {policies} policies: drives of a seed / unseen, % / false sentences, %\n")
    table(("world", "5 first points", "9", "17"), along_one_key(policies))
    say("Two keys: drives of a seed / discs unseen, %\n")
    table(("world", "5 x 5 first points", "7 x 7", "9 x 9"), discs(policies))
    say(
        "Several seeds, 17 first points: false sentences / false verdicts / intervals of a median "
        "boundary that are given / false ones, %\n"
    )
    table(("world", "3 seeds", "6", "20"), over_seeds(policies))
    say("Coverage of the median boundary over seeds, %\n")
    table(("seeds", "coverage"), medians(policies))


if __name__ == "__main__":
    main()

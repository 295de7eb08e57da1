"""Calibrate every rule of `evaluators.statistics` that gives a verdict or prints an interval.

    python -m tests.calibration             # all laws; under an hour on two cores
    python -m tests.calibration --quick     # some seconds

It prints the tables of docs/experiments/calibration.md. A law is a distribution of rollouts whose
truth is known. Where outcomes can be enumerated the shares are exact, else drawn. Beside each rule
stands a plain one that a reader may expect in its place and that fails in some law: a sign-flip
test about a margin, two bounds of rates, an interval without a covariance, Student's t.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln, xlogy

from alpasim_plugin.core.printing import say
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F64
from evaluators.metrics import METRICS
from evaluators.statistics.bounded import mean_interval
from evaluators.statistics.decision import Question, metric_question, state_after
from evaluators.statistics.differences import difference_bounds, flag_interval, reach_of
from evaluators.statistics.intervals import TAIL, exact_rate, paired_rate, t_interval
from evaluators.statistics.noise import (
    CUT_MARGINS,
    beyond,
    chance_at_margin,
    chance_at_rate,
    chance_within,
    cut,
)
from evaluators.statistics.power import size_table
from evaluators.statistics.suite import LEVEL, flipped
from evaluators.statistics.verdicts import verdict

SIZES = ((3, 3), (6, 1), (14, 1), (42, 1), (14, 6))  # scenes, seeds


@dataclass(frozen=True)
class Effort:
    """How much is drawn.

    Attributes:
        draws: Runs a case.
        flips: Of them, those of slow rules.
        most_cells: Larger ones are left out.
    """

    draws: int
    flips: int
    most_cells: int


FULL = Effort(draws=2_000, flips=200, most_cells=100_000)
QUICK = Effort(draws=40, flips=5, most_cells=40)


@dataclass(frozen=True)
class Law:
    """Harms of the cells of a variant.

    Attributes:
        name: In words.
        margin: That is accepted.
        draw: Numbers of random streams, and how many -> the harms.
    """

    name: str
    margin: float
    draw: Callable[[np.random.Generator, int], F64]

    @property
    def cut_mean(self) -> float:
        """Give the true mean of the harms that are cut at three margins."""
        rng = stream("calibration", 0, f"truth/{self.name}")
        return float(np.mean(cut(self.draw(rng, 2_000_000), self.margin)))


def two_values(share: float, rare: float, usual: float = 0.0) -> Callable[..., F64]:
    """Return a law of a rare harm and a usual one."""
    return lambda rng, n: np.where(rng.random(n) < share, rare, usual)


DISTANCES = (
    Law("2.5 % of drives 4 m off", 0.1, two_values(0.025, 4.0)),
    Law("5 % of drives 3 m off", 0.1, two_values(0.05, 3.0)),
    Law("progress: 6 % of drives stop at a tenth", 0.05, two_values(0.06, 0.9)),
    Law("+0.15 m in 95 %, -0.85 m in 5 %", 0.1, two_values(0.05, -0.85, 0.15)),
    Law("+0.12 m in 90 %, -0.08 m in 10 %", 0.1, two_values(0.1, -0.08, 0.12)),
    Law("a third of drives 0.3 m off", 0.1, two_values(1 / 3, 0.3)),
    Law("alike, noise of 0.05 m", 0.1, lambda rng, n: 0.05 * rng.standard_normal(n)),
    Law("alike, noise of 0.17 m, tails of t(3)", 0.1, lambda rng, n: 0.1 * rng.standard_t(3, n)),
)


def share(flags: Sequence[bool]) -> str:
    """Print a share in percent."""
    return f"{100 * float(np.mean(flags)):.1f}"


def table(head: Sequence[str], rows: Iterator[Sequence[str]]) -> None:
    """Print a table in Markdown."""
    say("| " + " | ".join(head) + " |")
    say("|" + " --- |" * len(head))
    for row in rows:
        say("| " + " | ".join(row) + " |")
    say("")


def gates_of_distances(effort: Effort) -> Iterator[Sequence[str]]:
    """Give a row for each law and size: how often each answer is given, and whether it is wrong
    about what it states.
    """
    for law in DISTANCES:
        truth = law.cut_mean
        for scenes, seeds in SIZES:
            n = scenes * seeds
            if n > effort.most_cells:
                continue
            flips, green, red, far = [], [], [], []
            for number in range(effort.draws):
                rng = stream("calibration", number, f"distance/{law.name}/{n}")
                harms = law.draw(rng, n)
                drives = beyond(harms, law.margin)
                is_far = drives.is_red(LEVEL)
                far.append(is_far)
                if number < effort.flips:  # the sign-flip test draws its flips
                    flips.append(bool(flipped((law.margin - harms)[None])[0] <= TAIL))
                green.append(
                    drives.is_answered
                    and not is_far
                    and chance_at_margin(harms, law.margin) <= TAIL
                )
                red.append(chance_within(harms, law.margin) <= LEVEL)
            is_green_wrong = truth >= law.margin - 1e-3
            is_red_wrong = truth <= law.margin + 1e-3
            yield (
                law.name,
                f"{scenes} x {seeds}",
                f"{truth / law.margin:.2f}",
                share(flips),
                share(green) + (" (wrong)" if is_green_wrong else ""),
                share(red) + (" (wrong)" if is_red_wrong else ""),
                share(far),
            )


def outcomes(n: int, new: float, gone: float) -> Iterator[tuple[int, int, float]]:
    """Give the numbers of new and gone events of ``n`` cells that matter, and their chances."""
    for a in range(n + 1):
        for b in range(n + 1 - a):
            log_chance = (
                gammaln(n + 1)
                - gammaln(a + 1)
                - gammaln(b + 1)
                - gammaln(n - a - b + 1)
                + xlogy(a, new)
                + xlogy(b, gone)
                + xlogy(n - a - b, 1 - new - gone)
            )
            if log_chance > -14.0:
                yield a, b, math.exp(log_chance)


def gates_of_events(effort: Effort) -> Iterator[Sequence[str]]:
    """Give a row for each rate and number of cells: how often a gate with a margin of ten points is
    green where both are alike, and where the rate has risen by the margin; exact.
    """
    margin = 0.1
    for n in (36, 42, 84, 210):
        if n > effort.most_cells:
            continue
        for rate in (0.02, 0.05, 0.1, 0.3):
            changed = rate * (1.0 - rate)
            cells = []
            for rise in (0.0, margin):
                bounds, tango, exact = 0.0, 0.0, 0.0
                for new, gone, chance in outcomes(n, changed + rise, changed):
                    two = exact_rate(new, n)[1] - exact_rate(gone, n)[0]
                    bounds += chance * (two < margin)
                    tango += chance * (paired_rate(new, gone, n)[1] < margin)
                    exact += chance * (chance_at_rate(new, gone, n, margin) <= TAIL)
                cells += [f"{100 * value:.1f}" for value in (bounds, tango, exact)]
            yield (f"{100 * rate:g} %", str(n), *cells)


def differences_of_rates(effort: Effort) -> Iterator[Sequence[str]]:
    """Give the exact coverage of the interval of a difference of rates of scenes with one seed."""
    for rate in (0.05, 0.1, 0.3, 0.5):
        row = [f"{100 * rate:g} % each way"]
        for n in (12, 20, 60):
            if n > effort.most_cells // 2:
                continue
            covered, apart = 0.0, 0.0
            total = 0.0
            for new, gone, chance in outcomes(n, rate, rate):
                delta = np.repeat([1.0, -1.0, 0.0], [new, gone, n - new - gone])
                interval = flag_interval(delta, np.arange(n))
                low, high = joined_apart(new, gone, n)
                total += chance
                covered += chance * (interval.low <= 0.0 <= interval.high)
                apart += chance * (low <= 0.0 <= high)
            row.append(f"{100 * apart / total:.1f} / {100 * covered / total:.1f}")
        yield row


def joined_apart(new: int, gone: int, n: int) -> tuple[float, float]:
    """Return the interval of a difference as if new and gone events were independent."""
    up, down = new / n, gone / n
    (up_low, up_high), (down_low, down_high) = (exact_rate(count, n) for count in (new, gone))
    low = up - down - math.hypot(up - up_low, down_high - down)
    return low, up - down + math.hypot(up_high - up, down - down_low)


CLAIMS = (  # name, harms of scenes, the answer that may be wrong
    ("0.5 % of scenes by 20 m", two_values(0.005, 20.0), "non-inferior"),
    ("1 % of scenes by 15 m", two_values(0.01, 15.0), "non-inferior"),
    ("2.5 % of scenes by 4 m", two_values(0.025, 4.0), "non-inferior"),
    ("3 % of scenes by 20 m", two_values(0.03, 20.0), "non-inferior"),
    ("3 % by 15 m, others better by 0.02 m", two_values(0.03, 15.0, -0.02), "non-inferior"),
    ("half of scenes by 0.2 m", two_values(0.5, 0.2), "non-inferior"),
    (
        "2.5 % of scenes better by 20 m, others worse by 0.2 m",
        two_values(0.025, -20.0, 0.2),
        "worse",
    ),
    ("half of scenes worse by 0.2 m", two_values(0.5, 0.2), "worse"),
)


def claims_beyond_the_cap(effort: Effort) -> Iterator[Sequence[str]]:
    """Give how often a claim about other scenes is made: of a distance, whose mean is cut at 4 m,
    where a share of scenes goes far beyond that; of a fixed number of scenes, and until decided.
    """
    metric = METRICS.info("lateral_distance_m")
    margin, cap = 0.1, metric.cap or 4.0
    question = Question((metric_question(metric.name, margin),))
    for name, draw, answer in CLAIMS:
        rng = stream("calibration", 0, f"truth/{name}")
        many = draw(rng, 2_000_000)
        truth = float(np.mean(np.clip(many, -cap, cap)))
        sign = 1.0 if answer == "non-inferior" else -1.0
        is_wrong = sign * (truth - margin) >= -3e-3
        row = [f"{name}: `{answer}`", f"{truth:.3f}", f"{np.mean(many):.3f}"]
        for n in (20, 60, 200, 400):
            fixed, betting = [], []
            for number in range(min(effort.draws, 1_000)):
                rng = stream("calibration", number, f"cap/{name}/{n}")
                harms = draw(rng, n)
                _, bounds = difference_bounds(harms, harms, np.arange(n), metric, margin)
                given = (
                    None
                    if bounds is None
                    else verdict((bounds[0], bounds[1]), 0.0, margin, "lower")
                )
                fixed.append(given == answer)
                if number < effort.flips:
                    state = state_after(question, {metric.name: harms}, n)
                    betting.append(state.metrics[metric.name]["verdict"] == answer)
            row.append(f"{share(fixed)} / {share(betting)}" + (" (wrong)" if is_wrong else ""))
        yield row


PRINTED = (  # name, values of scenes, metric, whether they are differences
    ("difference of a distance, 3 % of scenes by 3 m", two_values(0.03, 3.0), "lateral_distance_m", True),
    ("a distance, 3 % of scenes 3 m", two_values(0.03, 3.0, 0.1), "lateral_distance_m", False),
    ("difference of a rate, one family of ten by 80 points", two_values(0.1, 0.8), "offroad", True),
    ("difference of `progress`, one family of ten by half", two_values(0.1, -0.5), "progress", True),
    (
        "difference of the distance to obstacles, 5 % by 20 m",
        two_values(0.05, -20.0),
        "min_distance_to_obstacle_m",
        True,
    ),
    ("the distance to obstacles, 5 % 20 m", two_values(0.05, 20.0, 1.0), "min_distance_to_obstacle_m", False),
    ("difference of a plan's deviation, 5 % by 3 m", two_values(0.05, 3.0), "plan_deviation", True),
)  # fmt: skip


def printed_intervals(effort: Effort) -> Iterator[Sequence[str]]:
    """Give the coverage of Student's interval about the mean, and of the printed one about what it
    states: of differences without bounds, the mean that is cut.
    """
    for name, draw, metric_name, is_difference in PRINTED:
        metric = METRICS.info(metric_name)
        row = [name]
        many = draw(stream("calibration", 0, f"truth/{name}"), 2_000_000)
        truth = float(np.mean(many))
        reach = reach_of(metric, metric.accepted)
        claimed = float(np.mean(np.clip(many, -reach, reach))) if is_difference else truth
        for n in (3, 12, 20, 60):
            plain, printed = [], []
            for number in range(effort.draws):
                rng = stream("calibration", number, f"printed/{name}/{n}")
                values = draw(rng, n)
                student = t_interval(values)
                plain.append(student.low is not None and student.low <= truth <= student.high)
                if is_difference:
                    places = np.arange(n)
                    interval, _ = difference_bounds(values, values, places, metric, metric.accepted)
                else:
                    interval = mean_interval(values, metric)
                if interval.low is not None:
                    printed.append(interval.low <= claimed <= interval.high)
            row.append(f"{share(plain)} / {share(printed) if printed else 'not printed'}")
        yield row


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="some seconds in place of an hour")
    parser.add_argument("--sizes", action="store_true", help="the table of docs/ci.md alone")
    options = parser.parse_args()
    if options.sizes:
        for line in size_table():
            say(line)
        return
    effort = QUICK if options.quick else FULL
    say(
        f"Gates of distances of policies that are not repeatable, {effort.draws} draws; the truth in "
        f"margins is the mean of cells cut at {CUT_MARGINS:g} margins; percent:\n"
    )
    head = ("law", "scenes x seeds", "truth", "green by sign flips", "green", "red by the mean")
    table((*head, "red by a drive beyond"), gates_of_distances(effort))
    say("Gates of events, margin 10 points, green in percent, exact:\n")
    head = ("rate", "cells", "alike: two bounds", "alike: Tango", "alike: exact")
    wrong = ("on the margin: two bounds", "on the margin: Tango", "on the margin: exact")
    table((*head, *wrong), gates_of_events(effort))
    say("Coverage of differences of rates, as if independent / in use, exact:\n")
    table(("law", "12 scenes", "20 scenes", "60 scenes"), differences_of_rates(effort))
    say(
        "Claims about other scenes: how often the mean of a distance, cut at 4 m, is said to be within "
        "or beyond its margin of 0.1 m, of a fixed number of scenes / until decided:\n"
    )
    head = ("law and answer", "cut mean, m", "mean not cut, m")
    sizes = ("20 scenes", "60 scenes", "200 scenes", "400 scenes")
    table((*head, *sizes), claims_beyond_the_cap(effort))
    say("Coverage: of t about the mean / of the printed interval about what it states:\n")
    table(("law", "3", "12", "20", "60"), printed_intervals(effort))


if __name__ == "__main__":
    main()

"""Calibrate every rule of `evaluators.statistics` that gives a verdict or prints an interval.

    python -m tests.calibration             # all laws; some minutes on one core
    python -m tests.calibration --quick     # some seconds

It prints the tables of docs/experiments/calibration.md. A law is a distribution of rollouts whose
truth is known. Where outcomes can be enumerated, as those of a law of two values, the shares are
exact, else drawn. Beside each rule
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
from scipy.stats import binom

from alpasim_plugin.core.printing import say
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F64
from evaluators.metrics import METRICS
from evaluators.statistics.betting import Draws, Plan, bet_sizes, log_capital
from evaluators.statistics.bounded import mean_interval
from evaluators.statistics.differences import difference_bounds, flag_interval, reach_of
from evaluators.statistics.intervals import TAIL, Interval, exact_rate, paired_rate, t_interval
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
        most_cells: Larger ones are left out.
    """

    draws: int
    most_cells: int


FULL = Effort(draws=2_000, most_cells=100_000)
QUICK = Effort(draws=40, most_cells=40)
LEAST_CHANCE = 1e-7  # of an outcome that is enumerated


@dataclass(frozen=True)
class TwoValues:
    """A law of a rare value and a usual one.

    Attributes:
        share: Chance of the rare one.
        rare, usual: The values.
    """

    share: float
    rare: float
    usual: float = 0.0

    def __call__(self, rng: np.random.Generator, n: int) -> F64:
        """Draw values ``(n,)``."""
        return np.where(rng.random(n) < self.share, self.rare, self.usual)

    @property
    def mean(self) -> float:
        """Give the true mean."""
        return self.share * self.rare + (1.0 - self.share) * self.usual

    def cut(self, least: float, most: float) -> TwoValues:
        """Return the law of the values that are cut."""
        rare, usual = np.clip([self.rare, self.usual], least, most)
        return TwoValues(self.share, float(rare), float(usual))

    def outcomes(self, n: int) -> Iterator[tuple[F64, float]]:
        """Give the values ``(n,)`` of every outcome that matters, in any order, and its chance."""
        for count, chance in enumerate(binom.pmf(np.arange(n + 1), n, self.share)):
            if chance > LEAST_CHANCE:
                yield np.repeat([self.rare, self.usual], [count, n - count]), float(chance)


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
        most = CUT_MARGINS * self.margin
        if isinstance(self.draw, TwoValues):
            return self.draw.cut(-most, most).mean
        rng = stream("calibration", 0, f"truth/{self.name}")
        return float(np.mean(cut(self.draw(rng, 2_000_000), self.margin)))

    def outcomes(self, n: int, draws: int) -> Iterator[tuple[F64, float]]:
        """Give harms ``(n,)`` and their chances: every outcome of two values, else drawn ones."""
        if isinstance(self.draw, TwoValues):
            yield from self.draw.outcomes(n)
            return
        for number in range(draws):
            yield (
                self.draw(stream("calibration", number, f"distance/{self.name}/{n}"), n),
                1 / draws,
            )


DISTANCES = (
    Law("2.5 % of drives 4 m off", 0.1, TwoValues(0.025, 4.0)),
    Law("5 % of drives 3 m off", 0.1, TwoValues(0.05, 3.0)),
    Law("progress: 6 % of drives stop at a tenth", 0.05, TwoValues(0.06, 0.9)),
    Law("+0.15 m in 95 %, -0.85 m in 5 %", 0.1, TwoValues(0.05, -0.85, 0.15)),
    Law("+0.12 m in 90 %, -0.08 m in 10 %", 0.1, TwoValues(0.1, -0.08, 0.12)),
    Law("a third of drives 0.3 m off", 0.1, TwoValues(1 / 3, 0.3)),
    Law("alike, noise of 0.05 m", 0.1, lambda rng, n: 0.05 * rng.standard_normal(n)),
    Law("alike, noise of 0.17 m, tails of t(3)", 0.1, lambda rng, n: 0.1 * rng.standard_t(3, n)),
)


def percent(share: float) -> str:
    """Print a share in percent."""
    return f"{100 * share:.1f}"


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
            shares = np.zeros(4)
            for harms, chance in law.outcomes(n, effort.draws):
                drives = beyond(harms, law.margin)
                is_far = drives.is_red(LEVEL)
                is_within = chance_at_margin(harms, law.margin) <= TAIL
                shares += chance * np.array([
                    flipped((law.margin - harms)[None])[0] <= TAIL,
                    drives.is_answered and not is_far and is_within,
                    chance_within(harms, law.margin) <= LEVEL,
                    is_far,
                ])  # fmt: skip
            flips, green, red, far = (percent(value) for value in shares)
            yield (
                law.name,
                f"{scenes} x {seeds}",
                f"{truth / law.margin:.2f}",
                flips,
                green + (" (wrong)" if truth >= law.margin - 1e-3 else ""),
                red + (" (wrong)" if truth <= law.margin + 1e-3 else ""),
                far,
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
    ("0.5 % of scenes by 20 m", TwoValues(0.005, 20.0), "non-inferior"),
    ("1 % of scenes by 15 m", TwoValues(0.01, 15.0), "non-inferior"),
    ("2.5 % of scenes by 4 m", TwoValues(0.025, 4.0), "non-inferior"),
    ("3 % of scenes by 20 m", TwoValues(0.03, 20.0), "non-inferior"),
    ("3 % by 15 m, others better by 0.02 m", TwoValues(0.03, 15.0, -0.02), "non-inferior"),
    ("half of scenes by 0.2 m", TwoValues(0.5, 0.2), "non-inferior"),
    (
        "2.5 % of scenes better by 20 m, others worse by 0.2 m",
        TwoValues(0.025, -20.0, 0.2),
        "worse",
    ),
    ("half of scenes worse by 0.2 m", TwoValues(0.5, 0.2), "worse"),
)


def claims_beyond_the_cap(effort: Effort) -> Iterator[Sequence[str]]:
    """Give how often a claim about other scenes is made: of a distance, whose mean is cut at 4 m,
    where a share of scenes goes far beyond that; of a fixed number of scenes (exact), and until
    decided.
    """
    metric = METRICS.info("lateral_distance_m")
    margin, cap = 0.1, metric.cap or 4.0
    for name, law, answer in CLAIMS:
        truth = law.cut(-cap, cap).mean
        sign = 1.0 if answer == "non-inferior" else -1.0
        is_wrong = sign * (truth - margin) >= -1e-9
        row = [f"{name}: `{answer}`", f"{truth:.3f}", f"{law.mean:.3f}"]
        for n in (20, 60, 200, 400):
            fixed = 0.0
            for harms, chance in law.outcomes(n):
                _, bounds = difference_bounds(harms, harms, np.arange(n), metric, margin)
                assert bounds is not None, "a distance with a cap has a claim"
                fixed += chance * (verdict((bounds[0], bounds[1]), 0.0, margin, "lower") == answer)
            drawn = law(stream("calibration", 0, f"cap/{name}/{n}"), effort.draws * n)
            answers = decided(drawn.reshape(effort.draws, n), margin, cap)
            share = float(np.mean([given == answer for given in answers]))
            row.append(f"{percent(fixed)} / {percent(share)}" + (" (wrong)" if is_wrong else ""))
        yield row


def decided(harms: F64, margin: float, cap: float, alpha: float = 0.05) -> list[str]:
    """Return the answers of `evaluators.statistics.decision.state_after` about one distance, of many
    runs ``(runs, scenes)`` at once.
    """
    draws = Draws(np.clip(harms, -cap, cap), cap)
    plan = Plan(margin, harms.shape[1], alpha)
    first = []
    for side, mean in ((draws.mirrored(), -margin), (draws, margin)):
        is_refuted = log_capital(side, mean, bet_sizes(side, mean, plan)) >= plan.log_bar
        first.append(np.where(is_refuted.any(axis=1), is_refuted.argmax(axis=1), harms.shape[1]))
    good, bad = first
    words = np.where(good < bad, "non-inferior", "worse")
    return np.where((good == bad) & (good == harms.shape[1]), "undecided", words).tolist()


PRINTED = (  # name, values of scenes, metric, whether they are differences
    ("difference of a distance, 3 % of scenes by 3 m", TwoValues(0.03, 3.0), "lateral_distance_m", True),
    ("a distance, 3 % of scenes 3 m", TwoValues(0.03, 3.0, 0.1), "lateral_distance_m", False),
    ("difference of a rate, one family of ten by 80 points", TwoValues(0.1, 0.8), "offroad", True),
    ("difference of `progress`, one family of ten by half", TwoValues(0.1, -0.5), "progress", True),
    (
        "difference of the distance to obstacles, 5 % by 20 m",
        TwoValues(0.05, -20.0),
        "min_distance_to_obstacle_m",
        True,
    ),
    ("the distance to obstacles, 5 % 20 m", TwoValues(0.05, 20.0, 1.0), "min_distance_to_obstacle_m", False),
    ("difference of a plan's deviation, 5 % by 3 m", TwoValues(0.05, 3.0), "plan_deviation", True),
)  # fmt: skip


def printed_intervals(effort: Effort) -> Iterator[Sequence[str]]:
    """Give the coverage of Student's interval about the mean, and of the printed one about what it
    states: of differences without bounds, the mean that is cut.
    """
    for name, law, metric_name, is_difference in PRINTED:
        metric = METRICS.info(metric_name)
        row = [name]
        reach = reach_of(metric, metric.accepted)
        claimed = law.cut(-reach, reach).mean if is_difference else law.mean
        for n in (3, 12, 20, 60):
            plain, printed = 0.0, 0.0
            is_printed = False
            for values, chance in law.outcomes(n):
                student = t_interval(values)
                plain += chance * holds(student, law.mean)
                if is_difference:
                    places = np.arange(n)
                    interval, _ = difference_bounds(values, values, places, metric, metric.accepted)
                else:
                    interval = mean_interval(values, metric)
                is_printed = interval.bounds is not None
                printed += chance * holds(interval, claimed)
            row.append(f"{percent(plain)} / {percent(printed) if is_printed else 'not printed'}")
        yield row


def holds(interval: Interval, truth: float) -> bool:
    """Tell whether an interval has bounds and holds the truth, but for rounding."""
    if interval.low is None or interval.high is None:
        return False
    return interval.low - 1e-9 <= truth <= interval.high + 1e-9


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="some seconds in place of minutes")
    parser.add_argument("--sizes", action="store_true", help="the table of docs/ci.md alone")
    options = parser.parse_args()
    if options.sizes:
        for line in size_table():
            say(line)
        return
    effort = QUICK if options.quick else FULL
    say(
        "Gates of distances of policies that are not repeatable, exact; of noise "
        f"{effort.draws:,} draws; the truth in margins is the mean of cells cut at "
        f"{CUT_MARGINS:g} margins; percent:\n"
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
        "or beyond its margin of 0.1 m, of a fixed number of scenes (exact) / until decided "
        f"({effort.draws:,} draws):\n"
    )
    head = ("law and answer", "cut mean, m", "mean not cut, m")
    sizes = ("20 scenes", "60 scenes", "200 scenes", "400 scenes")
    table((*head, *sizes), claims_beyond_the_cap(effort))
    say("Coverage, exact: of t about the mean / of the printed interval about what it states:\n")
    table(("law", "3", "12", "20", "60"), printed_intervals(effort))


if __name__ == "__main__":
    main()

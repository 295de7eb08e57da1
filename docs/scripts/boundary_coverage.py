"""How often the interval of `simrun --vary` holds the truth, with simulated policies, which fail in
every seed below a boundary of their own, drawn around the true one: along one parameter, or in a
corner of a rectangle, whose share is the truth. With noise, outcomes near it are not monotone.
"""

from __future__ import annotations

import numpy as np
from scipy.special import gamma

from alpasim_plugin.core.printing import say
from alpasim_plugin.core.seeding import stream
from evaluators.statistics import boundary as line
from evaluators.statistics.boundary import STEPS, Interval
from evaluators.statistics.boundary_area import AREA_STEPS, Point, area_of, next_area_points

POLICIES = 300
VALUES = {point: 4.0 + 10.0 * point / STEPS for point in range(STEPS + 1)}
LINE = (STEPS + 1, 1.0, 6.0, 11.0)
AREA = ((AREA_STEPS + 1) ** 2, 0.05, 0.15, 0.35)


def along(boundary: float, noise: float, rng: np.random.Generator) -> tuple[Interval | str, int]:
    """Return the bracket of one seed that fails below a boundary, and how many points it drove."""
    failed: dict[int, bool] = {}
    while points := line.next_points(failed, set()):
        for point in points:
            failed[point] = bool(VALUES[point] < boundary + noise * rng.standard_normal())
    return line.bracket_of(failed, VALUES), len(failed)


def within(share: float, noise: float, rng: np.random.Generator) -> tuple[Interval | str, int]:
    """Return the area of one seed that fails below x^p + y^p = r^p, and how many points it drove."""
    power, failed = rng.uniform(1.0, 3.0), dict[Point, bool]()
    radius = np.sqrt(share * gamma(1 + 2 / power)) / gamma(1 + 1 / power)
    while points := next_area_points(failed, set()):
        for point in points:
            place = np.array(point) / AREA_STEPS + noise * rng.standard_normal(2)
            failed[point] = bool((place.clip(0) ** power).sum() < radius**power)
    return area_of(failed, range(AREA_STEPS + 1)), len(failed)


def main() -> None:
    """Print one line a case: spread over seeds, noise of a drive, seeds, and what was found."""
    lines = (0.3, 0, 4), (0.3, 0, 10), (1, 0, 4), (1, 0, 10), (0.3, 0.3, 10)
    areas = (0, 0, 1), (0, 0.03, 1), (0.03, 0.03, 4)
    for number, (spread, noise, seeds) in enumerate(lines + areas):
        search, (grid, scale, low, high) = (along, LINE) if number < 5 else (within, AREA)
        held, held_difference, driven, width = 0, 0, 0, []
        for policy in range(POLICIES):
            rng = stream("boundary", policy, f"coverage/{spread}/{noise}/{seeds}")
            truth = rng.uniform(low, high)
            true_difference = scale * rng.uniform(-1.0, 1.0)
            first_arm = truth + spread * rng.standard_normal(seeds)
            other = first_arm - true_difference + 0.3 * spread * rng.standard_normal(seeds)
            searches = [[search(one, noise, rng) for one in side] for side in (first_arm, other)]
            driven += sum(count for _, count in searches[0])
            brackets, others = (
                [x for x, _ in side if isinstance(x, Interval)] for side in searches
            )
            if len(brackets) < seeds or len(others) < seeds:
                continue
            estimate, difference = line.boundary_of(brackets), line.difference_of(brackets, others)
            width.append(estimate.high - estimate.low)
            held += estimate.low <= truth <= estimate.high
            held_difference += difference.low <= true_difference <= difference.high
        shares = (100 * one / len(width) for one in (held, held_difference))
        say(
            f"{search.__name__}, spread {spread:g}, noise {noise:g}, {seeds} seeds: truth in {next(shares):.1f} %, "
            f"difference in {next(shares):.1f} %, of {len(width)} answers; median width {np.median(width):.3f}; "
            f"{100 * driven / POLICIES / seeds / grid:.0f} % of a grid's rollouts"
        )


if __name__ == "__main__":
    main()

"""How often the interval of `simrun --vary` holds the true boundary, with simulated policies.

A simulated policy has a boundary of its own in every seed, drawn around the true one, and fails
below it. With a noise in every drive its outcomes near the boundary are not monotone.
"""

from __future__ import annotations

import numpy as np

from alpasim_plugin.core.printing import say
from alpasim_plugin.core.seeding import stream
from evaluators.statistics.boundary import (
    STEPS,
    Bracket,
    boundary_of,
    bracket_of,
    difference_of,
    next_points,
)

POLICIES = 300
LOW, HIGH = 4.0, 14.0
VALUES = {point: LOW + (HIGH - LOW) * point / STEPS for point in range(STEPS + 1)}


def search(boundary: float, noise: float, rng: np.random.Generator) -> tuple[Bracket | str, int]:
    """Return the bracket of one seed, and how many points it drove."""
    failed: dict[int, bool] = {}
    while points := next_points(failed, (0, STEPS), set()):
        for point in points:
            failed[point] = bool(VALUES[point] < boundary + noise * rng.standard_normal())
    return bracket_of(failed, VALUES), len(failed)


def main() -> None:
    """Print one line a case: spread over seeds, noise of a drive, seeds, and what was found."""
    cases = (0.3, 0, 4), (0.3, 0, 10), (1, 0, 4), (1, 0, 10), (0.3, 0.3, 10)
    for spread_m, noise_m, seeds in cases:
        held, held_difference, answered, driven, width_m = 0, 0, 0, 0, []
        for number in range(POLICIES):
            rng = stream("boundary", number, f"coverage/{spread_m}/{noise_m}/{seeds}")
            truth = float(rng.uniform(6.0, 11.0))
            true_difference = float(rng.uniform(-1.0, 1.0))
            own = truth + spread_m * rng.standard_normal(seeds)
            other = own - true_difference + 0.3 * spread_m * rng.standard_normal(seeds)
            found = [search(one, noise_m, rng) for one in own]
            base = [search(one, noise_m, rng) for one in other]
            driven += sum(count for _, count in found)
            brackets = [one for one, _ in found if isinstance(one, Bracket)]
            others = [one for one, _ in base if isinstance(one, Bracket)]
            if len(brackets) < seeds or len(others) < seeds:
                continue
            answered += 1
            estimate = boundary_of(brackets)
            held += estimate.low <= truth <= estimate.high
            width_m.append(estimate.high - estimate.low)
            difference = difference_of(brackets, others)
            held_difference += difference.low <= true_difference <= difference.high
        share = driven / (POLICIES * seeds * (STEPS + 1))
        say(
            f"spread {spread_m:g} m, noise {noise_m:g} m, {seeds} seeds: boundary in "
            f"{100 * held / answered:.1f} %, difference in {100 * held_difference / answered:.1f} %, "
            f"of {answered} of {POLICIES} with an answer; median width {np.median(width_m):.2f} m; "
            f"{100 * share:.0f} % of a grid's rollouts"
        )


if __name__ == "__main__":
    main()

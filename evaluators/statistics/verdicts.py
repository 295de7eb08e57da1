"""Verdicts: on a paired difference with a margin, how many scenes would decide it, and the outcome
of a run with its exit code.
"""

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import scipy  # its submodules load on first use; scipy.stats would take a second

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F64, Direction
from evaluators.results import EXIT_CODES, Bounds, Cause, Contrast, Failures, Outcome, Verdict
from evaluators.statistics.intervals import LEAST_SCENES, ROUNDING, TAIL, scaled

# Where causes meet, the first one found here decides: numbers from an incomplete run may mislead
# either way.
SEVERITY: tuple[Cause, ...] = (
    "evaluator",
    "infrastructure",
    "policy",
    "renderer",
    "fixer",
    "incomplete",
    "regression",
    "undecided",
    "pass",
)


def worst(outcomes: list[Outcome]) -> Outcome:
    """Return the outcome that decides, with the reasons of all that share its cause.

    Example:
        >>> worst([Outcome("pass"), Outcome("undecided", ("too few scenes",))]).exit_code
        3
    """
    for cause in SEVERITY:
        same_cause = [outcome for outcome in outcomes if outcome.cause == cause]
        if same_cause:
            return Outcome(
                cause, tuple(reason for outcome in same_cause for reason in outcome.reasons)
            )
    return Outcome("pass")


def worst_code(codes: Sequence[int]) -> int:
    """Return the exit code that decides among several, in the order of causes.

    Example:
        >>> worst_code([3, 1, 0])
        1
    """
    order = list(dict.fromkeys(EXIT_CODES[cause] for cause in SEVERITY))
    return min(codes, key=order.index)


# By failure class; that of any other class is the infrastructure.
CAUSES: dict[str, Cause] = {
    "evaluator": "evaluator",
    "input": "incomplete",
    "policy": "policy",
    "renderer fault": "renderer",
    "fixer fault": "fixer",
}


def outcome_of_failures(failures: Failures, max_share: float = 0.0) -> Outcome:
    """Decide about rollouts that could not be run or scored.

    Args:
        failures: How many there are.
        max_share: Share of the planned rollouts that may fail.
    """
    if failures.n_failed <= max_share * failures.n_rollouts:
        return Outcome("pass")
    counts = ", ".join(f"{name} {count}" for name, count in failures.by_class.items())
    share = f"{failures.n_failed} of {failures.n_rollouts}"
    text = f"{share} rollouts could not be run or scored ({counts})"
    causes = {CAUSES.get(name, "infrastructure") for name in failures.by_class}
    return Outcome(min(causes, key=SEVERITY.index), (text,))


ALPHA = 0.05
FLIPS = 9_999  # drawn where not all of them are counted
FLIPPED = 10_000_000  # signs that are drawn at most


def harm(bounds: Bounds, direction: Direction) -> tuple[float, float]:
    """Turn the bounds of a difference so that positive means worse."""
    return (bounds[0], bounds[1]) if direction == "lower" else (-bounds[1], -bounds[0])


def verdict(bounds: Bounds | None, p: float | None, margin: float, direction: Direction) -> Verdict:
    """Decide about a difference by its 95 % interval.

    Non-inferior: the whole interval is better than ``margin`` worse. Worse: the whole interval is
        more than ``margin`` worse, and the test
    of no difference rejects too (p < 0.05). Undecided: neither. A metric without a better side
    needs a margin, and a change to either side counts as worse. If the bounds are those of a claim
    (`evaluators.statistics.bounded`), each answer is wrong in at most 2.5 % of runs, also where a
    few scenes differ greatly and none was drawn (docs/experiments/verdict-error.md).

    Args:
        bounds: [low, high] of renderer minus baseline, or None.
        p: Of the test of no difference; None where there is none.
        margin: How much worse is accepted, in the metric's unit, at least 0.
        direction: The better side of the metric.
    """
    if bounds is None or (direction == "none" and margin == 0.0):
        return "undecided"
    low, high = harm(bounds, direction)
    if direction == "none":
        low, high = (
            0.0 if low <= 0.0 <= high else min(abs(low), abs(high)),
            max(abs(low), abs(high)),
        )
    if high < margin:
        return "non-inferior"
    return "worse" if low > margin and p is not None and p < ALPHA else "undecided"


def difference(diff: float, p: float, direction: Direction) -> Contrast | None:
    """Return whether a difference is shown on the scenes driven, whatever the margin and whatever
    other scenes may do: the test rejects. None where it does not.

    Args:
        diff: Variant minus baseline.
        p: Of the test of no difference, corrected where several differences are tested.
        direction: The better side of the metric.
    """
    if direction == "none" or p >= ALPHA:
        return None
    return "worse" if (diff > 0.0) == (direction == "lower") else "better"


def sign_test(up: int, down: int) -> float:
    """Return the exact two-sided p of ``up`` against ``down`` under a fair coin; 1 where both are
    0.

    On scenes that changed it is the sign test; on discordant cells of a flag it is the exact
    McNemar test.

    Example:
        >>> round(sign_test(6, 0), 5)
        0.03125
    """
    return min(1.0, 2.0 * float(scipy.special.bdtr(min(up, down), up + down, 0.5)))


def sign_flip(means: F64) -> tuple[float, str]:
    """Return the two-sided p of scene differences ``(G,)`` under flips of their signs, and the name
    of the test.

    Two variants that are alike give each difference either sign with the same chance, whatever
    their tails; so p is the share of all choices of signs whose sum is as far from 0 as the one
    seen. Where more than `FLIPS` exist, so many are drawn, and the one seen counts among them.

    Source: Fisher, The Design of Experiments, 1935; Phipson and Smyth, Permutation p-values should
        never be zero, Statistical Applications in Genetics and Molecular Biology 9, 2010.

    Example:
        >>> sign_flip(np.array([0.2, 0.1, 0.3, 0.2, 0.0, 0.1, 0.2]))
        (0.03125, 'exact sign-flip test on scenes')
    """
    changed = scaled(means[means != 0.0])[0]
    sums, first = flipped_sums(changed[None])
    far = abs(float(np.sum(changed))) - ROUNDING * float(np.sum(np.abs(changed)))
    beyond = first + int(np.count_nonzero(np.abs(sums) >= far))
    words = "exact sign-flip test on scenes"
    if first:
        words = f"sign-flip test on scenes, {len(sums):,} draws"
    return beyond / (first + len(sums)), words


def flipped_sums(rows: F64) -> tuple[F64, int]:
    """Return the sums ``(K, M)`` of differences ``(M, N)`` for choices of signs that all M share,
    and 1 where the choices are drawn, so that the one seen counts among them.
    """
    n = rows.shape[1]
    is_all = 2**n <= FLIPS
    is_flipped = np.arange(2**n)[:, None] >> np.arange(n) & 1 if is_all else _drawn_flips(n)
    total = rows.sum(axis=1)
    blocks = np.array_split(is_flipped, 10)
    return np.concatenate([total - 2.0 * (block @ rows.T) for block in blocks]), int(not is_all)


@lru_cache(maxsize=1)
def _drawn_flips(scenes: int) -> npt.NDArray[np.int8]:
    """Return drawn flips ``(draws, scenes)``, 0 or 1; the same ones for every metric."""
    draws = min(FLIPS, max(FLIPS // 10, FLIPPED // scenes))
    return stream("", 0, "paired/sign-flip").integers(0, 2, (draws, scenes), np.int8)


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Return p-values corrected for their number by Holm's step-down method; what is None is no
    test and stays so.

    Source: Holm, Scandinavian Journal of Statistics 6 (1979).

    Example:
        >>> holm([0.01, None, 0.04, 0.03])
        [0.03, None, 0.06, 0.06]
    """
    tested = sorted((p_value, i) for i, p_value in enumerate(p_values) if p_value is not None)
    out: list[float | None] = [None] * len(p_values)
    largest = 0.0
    for rank, (p, i) in enumerate(tested):
        largest = max(largest, min((len(tested) - rank) * p, 1.0))
        out[i] = largest
    return out


Question = tuple[str, str, str]  # block of comparisons, variant, metric


def corrected(
    p_values: Mapping[Question, float | None], primary: str
) -> dict[Question, float | None]:
    """Return the p-values of everything that is tested together, corrected by Holm's method: the
    primary metric of all comparisons is one family, all other metrics are another.

    Args:
        p_values: Of every question; None where there is no test.
        primary: The metric that was declared before driving.

    Example:
        >>> corrected({("paired", "b", "a"): 0.03, ("paired", "c", "a"): 0.04}, "a")
        {('paired', 'b', 'a'): 0.06, ('paired', 'c', 'a'): 0.06}
    """
    out: dict[Question, float | None] = {}
    for is_primary in (True, False):
        family = [question for question in p_values if (question[2] == primary) == is_primary]
        values = holm([p_values[question] for question in family])
        out |= dict(zip(family, values, strict=True))
    return out


POWER = 0.8
MOST_SCENES = 100_000  # beyond, this suite cannot decide it


def scenes_needed(distance: float, spread: float, n_tests: int = 1) -> float:
    """Return the number of scenes at which a 95 % interval leaves out a value with probability
    `POWER`: the sample size of a one-sample test.

    Args:
        distance: Of the true difference from that value, in the metric's unit.
        spread: Standard deviation of the difference between scenes (seeds averaged), same unit.
        n_tests: Tests that share the error.

    Example:
        >>> round(scenes_needed(distance=0.5, spread=1.0), 1)
        31.4
    """
    if distance == 0.0:
        return math.inf
    quantiles = scipy.special.ndtri([1 - TAIL / n_tests, POWER])
    return float((np.sum(quantiles) * spread / distance) ** 2)


def scenes_to_differ(diff: float, spread: float, n_tests: int) -> float:
    """Return the number of scenes at which the test of no difference rejects with probability
    `POWER`, after the correction for ``n_tests`` of them; infinite without a difference.

    Example:
        >>> scenes_to_differ(1.0, 0.0, 1)  # all to one side: 2 / 2^6 < 5 %
        6.0
    """
    fewest = math.ceil(math.log2(2.0 * n_tests / ALPHA))
    return max(scenes_needed(diff, spread, n_tests), float(fewest))


def scenes_without_event(margin: float, reach: float = 1.0) -> float:
    """Return how many scenes that are all alike show that the mean is not worse by the margin than
    they are (exact bound).

    Args:
        margin: How much worse is accepted.
        reach: How much worse than what was seen a scene can be.

    Example:
        >>> scenes_without_event(0.05), scenes_without_event(0.1, 4.0)
        (72, 146)
    """
    if margin <= 0.0:
        return math.inf
    return 2 if margin >= reach else max(2, math.ceil(math.log(TAIL) / math.log1p(-margin / reach)))


def scenes_to_decide(
    harm: float, spread: float, margin: float, reach: float, n_tests: int
) -> float:
    """Return how many scenes would decide about a margin at the least: with 80 % probability if what
    was seen is true, and no other scene is far worse.

    Args:
        harm: The mean difference that the claim is about, positive is worse.
        spread: Standard deviation of the difference between scenes.
        margin: As for the verdict.
        reach: The most that counts of a scene.
        n_tests: Differences that are tested together; a verdict of "worse" needs the test as well.
    """
    needed = max(scenes_needed(abs(harm - margin), spread), LEAST_SCENES)
    # as many as show that nothing was missed
    worst = reach - harm if harm < margin else reach + harm
    needed = max(needed, scenes_without_event(abs(margin - harm), worst))
    if harm > margin:
        needed = max(needed, scenes_to_differ(harm, spread, n_tests))
    return needed


def more_than(needed: float, n_scenes: int) -> int | None:
    """Return how many scenes are missing, at least 1; None where more than `MOST_SCENES` are needed."""
    return None if needed > MOST_SCENES else max(1, math.ceil(needed) - n_scenes)

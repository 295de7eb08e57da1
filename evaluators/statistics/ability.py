"""How able a driver is, from which scenes it passes: the Rasch model of item response theory, with
scenes weighed by known drivers.

A driver of ability a passes a scene of difficulty d with the chance 1 / (1 + exp(d - a)). Both are
in logits; 0 is the mean difficulty of the known scenes. Difficulties have normal priors and come
with a spread, which every chance is averaged over. Given difficulties, the number of scenes passed
says all about an ability, and larger numbers are more likely the abler a driver is. So the interval
holds those abilities under which the number is neither too small nor too large, each with a chance
of 2.5 % at most: no prior on the driver, no large sample. Scenes discriminate alike: a slope a
scene (2PL) would need dozens of known drivers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy  # its submodules load on first use

from alpasim_plugin.core.types import F64
from evaluators.statistics.intervals import TAIL

ABILITY_SD, DIFFICULTY_SD = 3.0, 2.0  # of the priors of known drivers and of scenes, logits
MOST = 40.0  # no ability beyond is looked for, logits
NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(21)


@dataclass(frozen=True)
class Calibration:
    """Scenes and drivers on one scale.

    Attributes:
        difficulty: ``(I,)`` of scenes, logits; their mean is 0.
        spread: ``(I,)`` standard deviations of the difficulties.
        ability: ``(J,)`` of the known drivers, logits.
    """

    difficulty: F64
    spread: F64
    ability: F64


@dataclass(frozen=True)
class Ability:
    """The ability of a driver, in logits. Where it passes all scenes or none there is no estimate
    but one bound, one-sided at 95 %.

    Attributes:
        estimate: Under which the expected number of passes is the observed one.
        low: Lower bound; None where nothing bounds it.
        high: Upper bound.
        reason: Why there is no estimate.
    """

    estimate: float | None
    low: float | None
    high: float | None
    reason: str = ""


def calibrate(passed: F64) -> Calibration:
    """Fit abilities and difficulties to what known drivers passed: the mode under the priors, and
    the spread by its curvature.

    Args:
        passed: ``(J, I)`` of J drivers in I scenes: 1 passed, 0 failed, NaN not driven.

    Example:
        >>> found = calibrate(np.array([[1.0, 1.0, 0.0], [1.0, 0.0, 0.0]]))
        >>> bool(found.difficulty[0] < found.difficulty[1] < found.difficulty[2])
        True
    """
    drivers, scenes = passed.shape
    driven, x = np.isfinite(passed), np.nan_to_num(passed)
    precision = np.repeat([ABILITY_SD**-2, DIFFICULTY_SD**-2], [drivers, scenes])
    at = np.zeros(drivers + scenes)
    for _ in range(50):
        chance = scipy.special.expit(at[:drivers, None] - at[None, drivers:])
        left, weight = (x - chance) * driven, chance * (1 - chance) * driven
        slope = np.append(left.sum(axis=1), -left.sum(axis=0)) - precision * at
        curvature = np.diag(precision + np.append(weight.sum(axis=1), weight.sum(axis=0)))
        curvature[:drivers, drivers:], curvature[drivers:, :drivers] = -weight, -weight.T
        step = np.linalg.solve(curvature, slope)
        at += np.clip(step, -1.0, 1.0)
        if np.abs(step).max() < 1e-9:
            break
    centred = (
        np.eye(scenes) - 1.0 / scenes
    )  # where the scale begins is a convention, and no uncertainty
    spread = np.sqrt(np.diag(centred @ np.linalg.inv(curvature)[drivers:, drivers:] @ centred))
    zero = at[drivers:].mean()
    return Calibration(at[drivers:] - zero, spread, at[:drivers] - zero)


def chances(ability: float, difficulty: F64, spread: F64) -> F64:
    """Return the chance ``(I,)`` to pass each scene, averaged over what is not known of its
    difficulty ``(I,)``.

    Example:
        >>> chances(0.0, np.array([0.0, 1.0]), np.zeros(2)).round(3).tolist()
        [0.5, 0.269]
    """
    found = scipy.special.expit(ability - difficulty[:, None] - spread[:, None] * NODES)
    return np.asarray(found @ WEIGHTS / WEIGHTS.sum())


def count_chances(chance: F64) -> F64:
    """Return the chance ``(I + 1,)`` of each number of passes in independent scenes.

    Example:
        >>> count_chances(np.array([0.5, 0.5])).tolist()
        [0.25, 0.5, 0.25]
    """
    out = np.ones(1)
    for one in chance:
        out = np.convolve(out, [1.0 - one, one])
    return out


def ability_of(passes: int, difficulty: F64, spread: F64) -> Ability:
    """Return the ability of a driver with its 95 % interval.

    Args:
        passes: Scenes that it passed.
        difficulty: ``(I,)`` of the scenes that it drove, logits.
        spread: ``(I,)`` of their difficulties.

    Raises:
        ValueError: More passes than scenes, or no scene.
    """
    n = len(difficulty)
    if n == 0 or not 0 <= passes <= n:
        raise ValueError(f"{passes} passes in {n} scenes")
    one_sided = passes in (0, n)
    tail = 2 * TAIL if one_sided else TAIL

    def root(excess: Callable[[F64], float]) -> float:
        return float(
            scipy.optimize.brentq(
                lambda a: excess(chances(a, difficulty, spread)), -MOST, MOST, xtol=1e-6
            )
        )

    low = root(lambda p: float(count_chances(p)[passes:].sum()) - tail) if passes > 0 else None
    high = (
        root(lambda p: tail - float(count_chances(p)[: passes + 1].sum())) if passes < n else None
    )
    if one_sided:
        what = "passes" if passes else "fails"
        return Ability(
            None, low, high, f"it {what} all {n} scenes: there is one bound, and no score"
        )
    return Ability(root(lambda p: float(p.sum()) - passes), low, high)

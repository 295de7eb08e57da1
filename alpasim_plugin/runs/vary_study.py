"""The study of a search over two parameters: what was driven, as trials, and the points that the rule
of `evaluators.statistics.boundary_area` asks for next.
"""

from collections.abc import Mapping

import optuna
from optuna.distributions import BaseDistribution, IntDistribution
from optuna.trial import TrialState

from evaluators.statistics.boundary_area import Lines, Point, next_area_points

optuna.logging.set_verbosity(optuna.logging.WARNING)  # of each study it says that it was made


def next_points(failed: Mapping[Point, bool], lines: Lines, skipped: set[Point]) -> list[Point]:
    """Return the points that a seed drives in the next round; none where its search has ended.

    Args:
        failed: Point -> whether the drive failed there.
        lines: The steps of the first points.
        skipped: Points at which the scene cannot be built.
    """
    space: dict[str, BaseDistribution] = {
        name: IntDistribution(0, steps[-1]) for name, steps in zip("xy", lines, strict=True)
    }
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))  # draws nothing
    for point, has_failed in sorted(failed.items()):
        params = dict(zip(space, point, strict=True))
        study.add_trial(optuna.create_trial(params=params, distributions=space, value=has_failed))
    for point in next_area_points(failed, lines, skipped):
        study.enqueue_trial(dict(zip(space, point, strict=True)))
    waiting = study.get_trials(states=[TrialState.WAITING])
    return [tuple(study.ask(space).params.values()) for _ in waiting]

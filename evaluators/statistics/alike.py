"""What the failed rollouts of a policy have in common that its other rollouts have not: weather,
time of day, the side of the road, the bend. Counts over all its rollouts behind one renderer.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.types import F64
from alpasim_plugin.log.run_folder.rows import Rollout
from evaluators.metrics.outcomes import first_failure, has_ended, outcomes_of
from evaluators.statistics.approach import LEAST_BEND_RAD, environment_words, turn_around
from evaluators.statistics.evidence import ASIDE_M
from evaluators.statistics.opening import Run

LEAST_ROLLOUTS = 3  # on each side, where no scene stands on the same road
SAME_ROAD_M = 0.5
SIDE_METRIC = "lateral_bias_m"
MOST_SCENES = 200  # whose roads are compared


@dataclass(frozen=True)
class Common:
    """What failed rollouts have in common.

    Attributes:
        decisive: Scenes on the same road differ in it and in how they end, or there are
            `LEAST_ROLLOUTS` on each side.
        sentence: With the counts.
    """

    decisive: bool
    sentence: str


def common_to_failures(run: Run, rollout: Rollout) -> list[Common]:
    """Say what the failed rollouts of a variant have in common, as one of them has it.

    Args:
        run: The run.
        rollout: One of its failed rollouts.
    """
    others = [
        other
        for other in run.rollouts
        if (other.renderer, other.policy) == (rollout.renderer, rollout.policy) and has_ended(other)
    ]
    failed = [other for other in others if outcomes_of(other)]
    passed = [other for other in others if not outcomes_of(other)]
    if rollout not in failed:
        return []
    candidates = [
        _by_surroundings(run, rollout, failed, passed, key) for key in ("time", "weather")
    ]
    candidates.append(_by_side(run, rollout, failed))
    return sorted(
        (common for common in candidates if common is not None),
        key=lambda common: not common.decisive,
    )


def _surroundings(run: Run, rollout: Rollout, key: str) -> str | None:
    """Return the weather or the time of day of a rollout's scene; None where the run does not say."""
    scene = run.info.scenes.get(rollout.scene)
    environment = None if scene is None else scene.environment
    if not environment:
        return None
    return environment_words(environment)[key]


def _by_surroundings(
    run: Run, rollout: Rollout, failed: Sequence[Rollout], passed: Sequence[Rollout], key: str
) -> Common | None:
    """Compare failures by weather or by time of day; None where they do not differ in it."""
    label = _surroundings(run, rollout, key)
    if label is None or not passed:
        return None
    has_label = [_surroundings(run, other, key) == label for other in (*failed, *passed)]
    n_failed_in = sum(has_label[: len(failed)])
    n_passed_in = sum(has_label[len(failed) :])
    n_out = len(has_label) - n_failed_in - n_passed_in
    n_failed_out = len(failed) - n_failed_in
    if not n_out or n_failed_out or n_passed_in:
        return None
    passed_on_same_road = [
        other
        for other in passed[:MOST_SCENES]
        if _surroundings(run, other, key) != label and _same_road(run, rollout, other)
    ]
    elsewhere = sorted(
        {_surroundings(run, other, key) or "elsewhere" for other in passed} - {label}
    )
    same = f", on the same road in {passed_on_same_road[0].scene}" if passed_on_same_road else ""
    sentence = (
        f"It fails {label} alone: in {n_failed_in} of {n_failed_in} rollouts {label}, in "
        f"0 of {n_out} {' or '.join(elsewhere)}{same}."
    )
    return Common(bool(passed_on_same_road) or min(n_failed_in, n_out) >= LEAST_ROLLOUTS, sentence)


def _same_road(run: Run, rollout: Rollout, other: Rollout) -> bool:
    """Tell whether the recorded drives of two rollouts lead the same way."""
    paths = [_recorded_xy(run, driven.scene) for driven in (rollout, other)]
    if any(path is None for path in paths):
        return False
    first, second = (path - path[0] for path in paths if path is not None)
    count = min(len(first), len(second))
    steps = np.linspace(0, count - 1, 20).astype(int)
    return count >= 20 and bool(np.hypot(*(first[steps] - second[steps]).T).max() < SAME_ROAD_M)


def _recorded_xy(run: Run, scene: str) -> F64 | None:
    content = run.scene_data(scene)
    if content is None:
        return None
    return np.column_stack([content["ego_log"]["x_m"], content["ego_log"]["y_m"]]).astype(float)


def _by_side(run: Run, rollout: Rollout, failed: Sequence[Rollout]) -> Common | None:
    """Compare failures by the side of the recorded path on which they lie; None where there are
    fewer than two, or they lie on both.
    """
    places = [place for place in (_side_and_bend(run, other) for other in failed) if place]
    sides = Counter(side for side, _ in places)
    if len(places) < 2 or len(sides) != 1:
        return None
    bends = {bend for _, bend in places}
    (side,) = sides
    in_bends = f", in {bends.pop()}-hand bends" if len(bends) == 1 and "" not in bends else ""
    sentence = (
        f"All {len(places)} failures of this policy beside the recorded path lie to the {side} of "
        f"it{in_bends}."
    )
    return Common(False, sentence)


def _side_and_bend(run: Run, rollout: Rollout) -> tuple[str, str] | None:
    """Return on which side of the recorded path a rollout failed and which bend that is, ``left``,
    ``right`` or empty; None where it failed on the path or its tables do not say.
    """
    manifest = run.manifest(rollout)
    failure = None if manifest is None else first_failure(manifest.events)
    path = _recorded_xy(run, rollout.scene)
    if failure is None or path is None:
        return None
    rows = run.steps_of(rollout).to_pylist()
    offsets = [
        (row["t_us"], row["value"]) for row in rows if row["metric"] == SIDE_METRIC and row["valid"]
    ]
    if not offsets:
        return None
    left_m = min(offsets, key=lambda row: abs(row[0] - failure.t_us))[1]
    if abs(left_m) < ASIDE_M:
        return None
    away_m = np.hypot(*(path - [failure.x_m, failure.y_m]).T)
    steps = np.hypot(*np.diff(path, axis=0).T)
    along_m = np.concatenate([[0.0], np.cumsum(steps)])[int(np.argmin(away_m))]
    turn = float(turn_around(path, np.array([along_m]))[0])
    bend = "" if abs(turn) < LEAST_BEND_RAD else "left" if turn > 0.0 else "right"
    return "left" if left_m > 0.0 else "right", bend

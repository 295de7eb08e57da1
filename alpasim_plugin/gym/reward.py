"""Reward and termination of a step, from the evaluators that score runs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.geometry import trajectory_from_poses
from alpasim_plugin.core.parts import build
from alpasim_plugin.core.types import F64, Actor, EgoState, MetricSeries, RolloutLog, Scenario
from alpasim_plugin.log.schema import T_rig_box
from evaluators import resolve_evaluators
from evaluators.metrics.presets import preset as find_preset
from evaluators.metrics.score import check_rollout, run_evaluator

# Evaluators whose values at an instant need no more of the drive than the instant before.
USED = ("collision", "offroad", "route")

Instant = tuple[EgoState, Mapping[str, F64]]  # the ego, and T_world_box (4, 4) of the others by id


@dataclass(frozen=True)
class Reward:
    """What a step is worth, in terms of the metrics of docs/metrics.md.

    ``progress_per_m`` for each metre gained along the recorded path, minus ``lateral_per_m_s`` for
    each metre beside it and second, minus ``collision`` or ``offroad`` once, at the end of the
    episode that it makes.
    """

    progress_per_m: float = 0.1
    lateral_per_m_s: float = 0.5
    collision: float = 5.0
    offroad: float = 5.0


class Scorer:
    """Score the steps of one episode.

    Args:
        scenario: What is driven.
        preset: Evaluator preset.
        reward: Weights.

    Raises:
        EvaluatorError: The scene has no recorded path to make progress on, or no road.
    """

    def __init__(self, scenario: Scenario, preset: str, reward: Reward) -> None:
        chosen = find_preset(preset)
        self._scenario = scenario
        self._reward = reward
        specs = [spec for spec in resolve_evaluators() if spec.name in USED]
        self._evaluators = [(spec.name, build(spec, preset=chosen)) for spec in specs]
        self._kinds = {actor.actor_id: actor for actor in scenario.actors}
        self._before: Instant | None = None
        self._along_m: float | None = None

    def score(self, instants: Sequence[Instant]) -> tuple[float, str, dict[str, float]]:
        """Score what happened since the last call.

        Args:
            instants: Every control instant since then, in order.

        Returns:
            The reward; ``collision``, ``offroad`` or an empty text; the metrics at the last
            instant.

        Raises:
            EvaluatorError: A metric that is needed has no value.
        """
        window = [*([] if self._before is None else [self._before]), *instants]
        rollout = self._as_log(window)
        check_rollout(rollout)
        scene = self._scenario.scene
        metrics = {
            metric.name: metric
            for name, evaluator in self._evaluators
            for metric in run_evaluator(name, evaluator, rollout, scene)
        }
        is_first = self._before is None
        self._before = instants[-1]
        lateral_m = float(self._value(metrics["lateral_distance_m"])[-1])
        share = self._value(metrics["progress"])
        length_m = self._value(metrics["gt_dist_traveled_m"])
        self._along_m = float(share[-1] * length_m[-1])
        collision, offroad = (
            bool((self._value(metrics[name])[0 if is_first else 1 :] > 0.5).any())
            for name in ("collision_any", "offroad")
        )
        gained_m = 0.0 if is_first else float((share[-1] - share[0]) * length_m[-1])
        seconds = (window[-1][0].t_us - window[0][0].t_us) * 1e-6
        weights = self._reward
        worth = weights.progress_per_m * gained_m - weights.lateral_per_m_s * lateral_m * seconds
        worth -= weights.collision * collision + weights.offroad * offroad
        ended = "collision" if collision else "offroad" if offroad else ""
        return worth, ended, {"lateral_distance_m": lateral_m, "progress": float(share[-1])}

    def _value(self, series: MetricSeries) -> F64:
        if not series.valid.all():
            raise EvaluatorError(
                f"scene {self._scenario.scene_id!r}, {series.name}: {series.reason}",
                "choose a scene with a road and a recorded drive that moves",
            )
        return series.value

    def _as_log(self, window: Sequence[Instant]) -> RolloutLog:
        """Return the window as a log of its own; it has no plans and no images, which these
        evaluators do not read.
        """
        scenario = self._scenario
        to_box = T_rig_box(scenario.vehicle)
        times = np.array([ego.t_us for ego, _ in window], dtype=np.int64)
        ego = trajectory_from_poses(
            times, np.array([ego.T_world_rig @ to_box for ego, _ in window])
        )
        actors = {}
        for actor_id in dict.fromkeys(name for _, others in window for name in others):
            steps = [i for i, (_, others) in enumerate(window) if actor_id in others]
            track = trajectory_from_poses(
                times[steps], np.array([window[i][1][actor_id] for i in steps])
            )
            kind = self._kinds[actor_id]
            actors[actor_id] = Actor(actor_id, kind.label, kind.box, track, kind.is_static)
        start_us = scenario.start_us
        log = scenario.ego_log
        return RolloutLog(
            scene_id=scenario.scene_id,
            session_uuid="a step",
            ego_box=scenario.vehicle.box,
            T_rig_box=to_box,
            ego=ego,
            actors=actors,
            plans=(),
            images=(),
            ego_log=log,
            start_us=int(log.t_us[0]),
            render_start_us=start_us,
            force_gt_us=scenario.warmup_us,
            control_us=scenario.rates.control_us,
            along_m=self._along_m,
        )

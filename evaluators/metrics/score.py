"""The entry point `score`, and the checks that a log must pass before any number is taken from
it.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.interfaces import Evaluator
from alpasim_plugin.core.parts import PartSpec, build, names, resolve
from alpasim_plugin.core.parts.blame import blaming, defined, is_own
from alpasim_plugin.core.parts.registry import entries
from alpasim_plugin.core.types import (
    I64,
    Bool,
    MetricSeries,
    RolloutLog,
    Scene,
    Trajectory,
    shielded,
)
from evaluators.metrics.presets import DEFAULT, Preset
from evaluators.metrics.presets import preset as find_preset
from evaluators.metrics.table import METRICS, MetricTable, table_of


def resolve_evaluators(more: Sequence[str] = ()) -> tuple[PartSpec, ...]:
    """Resolve every registered evaluator; `evaluators.metrics.table_of` gives their metrics.

    Args:
        more: Further evaluators, as ``package.module:Class``.

    Raises:
        InputError: An evaluator cannot be imported, or two are named alike.
        EvaluatorError: Two declare one metric differently.
    """
    specs = tuple(resolve("evaluator", name) for name in (*names("evaluator"), *more))
    table_of(specs)
    return specs


def resolve_plugins() -> tuple[PartSpec, ...]:
    """Resolve the evaluators of other packages alone."""
    return tuple(
        resolve("evaluator", name)
        for name, part in entries("evaluator").items()
        if not part.is_shipped
    )


def score(
    rollout: RolloutLog,
    scene: Scene,
    preset: str | Preset = DEFAULT,
    evaluators: Sequence[PartSpec] | None = None,
) -> list[MetricSeries]:
    """Score one rollout.

    A value is NaN and ``valid`` is False where an evaluator has no ground to give one; ``reason``
    then says why.

    Args:
        rollout: What was driven.
        scene: Map and recorded drive.
        preset: Name of a preset or a `Preset`.
        evaluators: From `resolve_evaluators`; None for every registered one.

    Returns:
        One series per metric, over the whole log including the warm-up.

    Raises:
        EvaluatorError: The log cannot be scored (NaN pose, repeated time), an evaluator failed, or
            two gave the same metric.
        InputError: Unknown preset.
    """
    chosen = find_preset(preset)
    check_rollout(rollout)
    if chosen.until_recorded and scene.path_end == "goal":
        rollout = up_to(rollout, int(rollout.ego_log.t_us[-1]))
        check_rollout(rollout)
    out: dict[str, MetricSeries] = {}
    specs = resolve_evaluators() if evaluators is None else evaluators
    metric_table = table_of(specs)
    for spec in specs:
        for metric_series in run_evaluator(
            spec.name, build(spec, preset=chosen), rollout, scene, metric_table
        ):
            if metric_series.name in out:
                raise EvaluatorError(
                    f"evaluator {spec.name!r}: metric {metric_series.name!r} was given twice",
                    "rename one of them",
                )
            out[metric_series.name] = metric_series
    return list(out.values())


def up_to(rollout: RolloutLog, last_us: int) -> RolloutLog:
    """Return a rollout as it would be had it ended at its last pose at a time or before: with what
    was logged by then, and no plan of that pose. Road users who came later are left out.
    """
    ego = _poses_up_to(rollout.ego, last_us)
    if len(ego) in (0, len(rollout.ego)):
        return replace(rollout, ego=ego)
    ended_us = int(ego.t_us[-1])
    tracks = {name: _poses_up_to(actor.track, ended_us) for name, actor in rollout.actors.items()}
    return replace(
        rollout,
        ego=ego,
        actors={
            name: replace(actor, track=tracks[name])
            for name, actor in rollout.actors.items()
            if len(tracks[name])
        },
        plans=tuple(plan for plan in rollout.plans if plan.now_us < ended_us),
        images=tuple(image for image in rollout.images if image.start_us <= ended_us),
    )


def _poses_up_to(track: Trajectory, last_us: int) -> Trajectory:
    rows = track.t_us <= last_us
    return Trajectory(track.t_us[rows], track.xyz[rows], track.quat[rows])


def run_evaluator(
    name: str,
    evaluator: Evaluator,
    rollout: RolloutLog,
    scene: Scene,
    metric_table: MetricTable = METRICS,
) -> list[MetricSeries]:
    """Run one evaluator, check its answer and give every series its metric from a table.

    Raises:
        EvaluatorError: It failed, gave a metric that the table does not hold, or series of unlike
            lengths; it is named.
    """
    called = defined(evaluator, "__call__")
    subject = f"evaluator {name!r}, scene {rollout.scene_id!r}"
    if not is_own(evaluator):  # the next one must see the same
        rollout = shielded(rollout)
        scene = shielded(scene)
    with blaming(EvaluatorError, subject, called, not is_own(evaluator)):
        answer = [
            replace(metric_series, metric=metric_table.info(metric_series.name))
            for metric_series in evaluator(rollout, scene)
        ]
    for metric_series in answer:
        if not (
            metric_series.t_us.shape == metric_series.value.shape == metric_series.valid.shape
        ) or (metric_series.reason == "" and not bool(np.all(metric_series.valid))):
            raise EvaluatorError(
                f"evaluator {name!r}, metric {metric_series.name!r}: shapes {metric_series.t_us.shape}, {metric_series.value.shape}, {metric_series.valid.shape}; {int(np.sum(~metric_series.valid))} invalid steps, reason {metric_series.reason!r}",
                "give one time, value and validity per step, and a reason where any is invalid",
            )
    return answer


def series(
    name: str,
    t_us: I64,
    value: npt.ArrayLike,
    valid: Bool | bool = True,
    reason: str = "",
    *,
    keep_values: bool = False,
) -> MetricSeries:
    """Build a series of one of our metrics, or of one that the evaluator's ``metrics`` hold:
    `score` then gives it what they say.

    Args:
        name: Metric.
        t_us: ``(T,)`` times.
        value: ``(T,)`` values; replaced by NaN where invalid, unless ``keep_values``.
        valid: ``(T,)`` or one flag for all.
        reason: Why steps are invalid; dropped where none is.
        keep_values: Leave values of invalid steps as they are (AlpaSim's tables do).
    """
    ok = np.broadcast_to(np.asarray(valid, dtype=np.bool_), t_us.shape).copy()
    values = np.array(np.broadcast_to(np.asarray(value, dtype=np.float64), t_us.shape))
    if not keep_values:
        values[~ok] = np.nan
    return MetricSeries(METRICS.shown(name), t_us, values, ok, "" if bool(ok.all()) else reason)


def relevant(rollout: RolloutLog) -> Bool:
    """Return for every ego time ``(T,)`` whether the warm-up with the forced recording is over."""
    return rollout.ego.t_us >= handover_us(rollout)


def handover_us(rollout: RolloutLog) -> int:
    """Return the time at which the policy takes over."""
    return rollout.render_start_us + rollout.force_gt_us


def check_rollout(rollout: RolloutLog) -> None:
    """Refuse logs from which no number may be taken.

    Raises:
        EvaluatorError: No ego pose, times that do not increase, poses that are not finite,
            quaternions that are not rotations, or a size that is not positive; for the ego, the
            recorded drive or any actor.
    """
    _check_track("the ego", rollout.ego, rollout)
    _check_track("the recorded drive", rollout.ego_log, rollout)
    _check_size("the ego", rollout.ego_box.length_m, rollout.ego_box.width_m, rollout)
    for actor in rollout.actors.values():
        _check_track(f"actor {actor.actor_id!r}", actor.track, rollout)
        _check_size(f"actor {actor.actor_id!r}", actor.box.length_m, actor.box.width_m, rollout)
    for plan in rollout.plans:
        for track in (plan.trajectory, *plan.samples):
            if len(track):
                _check_track(f"the plan at {plan.now_us} us", track, rollout)


def _check_track(who: str, track: Trajectory, rollout: RolloutLog) -> None:
    def refuse(problem: str) -> EvaluatorError:
        return EvaluatorError(
            f"{who} in scene {rollout.scene_id!r}, session {rollout.session_uuid!r}: {problem}",
            "repair or leave out this log",
        )

    if len(track) == 0:
        raise refuse("no pose at all")
    if track.xyz.shape != (len(track), 3) or track.quat.shape != (len(track), 4):
        raise refuse(
            f"{len(track)} times, positions of shape {track.xyz.shape}, rotations of shape {track.quat.shape}"
        )
    steps = np.diff(track.t_us)
    if np.any(steps <= 0):
        i = int(np.argmax(steps <= 0))
        kind = (
            "is repeated"
            if steps[i] == 0
            else f"is followed by the earlier {int(track.t_us[i + 1])} us"
        )
        raise refuse(f"time {int(track.t_us[i])} us {kind}")
    finite = np.isfinite(track.xyz).all(axis=1) & np.isfinite(track.quat).all(axis=1)
    if not finite.all():
        raise refuse(f"a pose that is not finite at {int(track.t_us[int(np.argmin(finite))])} us")
    off = np.abs(np.linalg.norm(track.quat, axis=1) - 1.0)
    if float(off.max()) > 1e-3:
        i = int(np.argmax(off))
        raise refuse(
            f"a quaternion of length {float(np.linalg.norm(track.quat[i])):.6g} at {int(track.t_us[i])} us"
        )


def _check_size(who: str, length_m: float, width_m: float, rollout: RolloutLog) -> None:
    if not (np.isfinite([length_m, width_m]).all() and length_m > 0 and width_m > 0):
        raise EvaluatorError(
            f"{who} in scene {rollout.scene_id!r}, session {rollout.session_uuid!r}: a box of {length_m} x {width_m} m",
            "give every box a positive length and width",
        )


def with_preset(function: Callable[..., list[MetricSeries]]) -> Callable[[Preset], Any]:
    """Return the factory of an evaluator that is a function ``(rollout, scene, preset) ->
    series``.
    """
    return lambda preset: partial(function, preset=preset)

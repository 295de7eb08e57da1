"""When the policy is queried, and which frames are rendered when."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.clock import Clock
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import I64, BlockRule, Scenario, SensorSpec

DOING = "setting up a loop in whole blocks of frames"


@dataclass(frozen=True)
class Cadence:
    """The instants at which the policy is queried.

    With ``whole_blocks`` all frames since the last query are rendered together at the next query. Otherwise a frame is rendered at its own
    instant, and only if it is the camera's newest at the next query.
    """

    query_times_us: I64  # (Q,) increasing
    whole_blocks: bool = False

    def queries_at(self, t_us: int) -> bool:
        """Return whether the policy is queried at ``t_us``."""
        return self.next_query_us(t_us) == t_us

    def next_query_us(self, t_us: int) -> int | None:
        """Return the first query at or after ``t_us``; None after the last."""
        i = int(np.searchsorted(self.query_times_us, t_us))
        return int(self.query_times_us[i]) if i < len(self.query_times_us) else None

    def needs_frame(self, t_us: int, period_us: int) -> bool:
        """Return whether a query uses the frame at ``t_us`` of a camera with that period."""
        query = self.next_query_us(t_us)
        return query is not None and (self.whole_blocks or query - t_us < period_us)


def make_cadence(clock: Clock, scenario: Scenario, sensors: Sequence[SensorSpec], block: BlockRule | None = None) -> Cadence:
    """Return the cadence of a rollout: the policy's own period, or with ``block`` one query at the end of each block of frames.

    ``block`` is AlpaSim's rule for video models: the control step is one block, and a plan is committed for the whole next block. The
    warm-up must cover the first block, since there is no query before its end. A policy without cameras has no blocks and keeps its own
    period. There is no query at the last instant, because no control step follows it.

    Args:
        clock: Ticks of the rollout.
        scenario: Rates and warm-up.
        sensors: Cameras of the policy.
        block: Frames of the first block and of each later one.

    Raises:
        InputError: Cameras of different periods, a warm-up shorter than the first block, or a scenario in which no block ends.
    """
    end_us = clock.start_us + clock.n_steps * clock.rates.control_us
    if block is None or not sensors:
        return Cadence(np.array([tick.t_us for tick in clock.ticks() if tick.policy_due and not tick.is_last], dtype=np.int64))
    first, then = block.first, block.then
    periods = {sensor.interval_us or scenario.rates.camera_us for sensor in sensors}
    if len(periods) > 1:
        raise InputError(
            DOING,
            f"cameras {', '.join(sensor.camera for sensor in sensors)}",
            f"periods of {' and '.join(map(str, sorted(periods)))} us",
            "give all cameras one period, or use the mode 'speculative'",
        )
    (period_us,) = periods
    warm_up_us = (first - 1) * period_us
    if warm_up_us > scenario.warmup_us:
        raise InputError(
            DOING,
            f"scene {scenario.scene_id!r}",
            f"the first block of {first} frames ends after {warm_up_us} us, the warm-up after {scenario.warmup_us} us",
            f"--set timing.warmup_us={warm_up_us}, or use the mode 'speculative'",
        )
    queries = np.arange(clock.start_us + warm_up_us, end_us, then * period_us, dtype=np.int64)
    if not len(queries):
        raise InputError(
            DOING,
            f"scene {scenario.scene_id!r}",
            f"it ends after {end_us - clock.start_us} us, before the first block of {first} frames",
            "lengthen timing.duration_us, or use the mode 'speculative'",
        )
    return Cadence(queries, whole_blocks=True)

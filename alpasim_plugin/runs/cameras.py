"""When the policy is queried, and which frames are rendered for it: only those that it uses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from alpasim_plugin.cameras.shutter import rolling_exposure
from alpasim_plugin.core.clock import Clock, Tick
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import interpolate, inverse
from alpasim_plugin.core.interfaces import BlockRule
from alpasim_plugin.core.types import (
    F64,
    I64,
    CameraSpec,
    RenderRequest,
    RolloutLog,
    Scenario,
    SensorSpec,
    Trajectory,
    read_only,
)
from alpasim_plugin.gaussians.scene.log_views import actors_at
from alpasim_plugin.runs.loop_state import (
    Forecaster,
    PredictedRequests,
    shutter_poses,
    visible_actors,
)


@dataclass(frozen=True)
class Cadence:
    """The instants at which the policy is queried.

    With ``whole_blocks`` all frames since the last query are rendered together at the next query.
    Otherwise a frame is rendered at its own instant, and only if it is the camera's newest at the
    next query.
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


def make_cadence(
    clock: Clock, scenario: Scenario, sensors: Sequence[SensorSpec], block: BlockRule | None = None
) -> Cadence:
    """Return the cadence of a rollout: the policy's own period, or with ``block`` one query at the
    end of each block of frames.

    ``block`` is AlpaSim's rule for video models: the control step is one block, and a plan is
    committed for the whole next block. The warm-up must cover the first block, since there is no
    query before its end. A policy without cameras has no blocks and keeps its own period. There is
    no query at the last instant, because no control step follows it.

    Args:
        clock: Ticks of the rollout.
        scenario: Rates and warm-up.
        sensors: Cameras of the policy.
        block: Frames of the first block and of each later one.

    Raises:
        InputError: Cameras of different periods, a warm-up shorter than the first block, or a
            scenario in which no block ends.
    """
    end_us = clock.start_us + clock.n_steps * clock.rates.control_us
    if block is None or not sensors:
        return Cadence(
            np.array(
                [tick.t_us for tick in clock.ticks() if tick.policy_due and not tick.is_last],
                dtype=np.int64,
            )
        )
    first = block.first
    then = block.then
    periods = {scenario.period_us(sensor) for sensor in sensors}
    if len(periods) > 1:
        raise InputError(
            f"cameras {', '.join(sensor.camera for sensor in sensors)}: periods of {' and '.join(map(str, sorted(periods)))} us",
            "give all cameras one period, or use the mode 'speculative'",
        )
    (period_us,) = periods
    warm_up_us = (first - 1) * period_us
    if warm_up_us > scenario.warmup_us:
        raise InputError(
            f"scene {scenario.scene_id!r}: the first block of {first} frames ends after {warm_up_us} us, the warm-up after {scenario.warmup_us} us",
            f"--set timing.warmup_us={warm_up_us}, or use the mode 'speculative'",
        )
    queries = np.arange(clock.start_us + warm_up_us, end_us, then * period_us, dtype=np.int64)
    if not len(queries):
        raise InputError(
            f"scene {scenario.scene_id!r}: it ends after {end_us - clock.start_us} us, before the first block of {first} frames",
            "lengthen timing.duration_us, or use the mode 'speculative'",
        )
    return Cadence(queries, whole_blocks=True)


class CameraRig:
    """The cameras of one policy.

    Args:
        scenario: Has the cameras.
        sensors: Which of them the policy uses, at which period.
        clock: Ticks of the rollout.
        cadence: When the policy is queried; by default at its own period.
        forecaster: Predicts the next `lookahead` frames of a request.
        lookahead: How many of a camera's next frames a request predicts.

    Raises:
        InputError: The scenario lacks a camera of the policy, or a period is no multiple of the
            control period.
    """

    def __init__(
        self,
        scenario: Scenario,
        sensors: Sequence[SensorSpec],
        clock: Clock,
        cadence: Cadence | None = None,
        forecaster: Forecaster | None = None,
        lookahead: int = 0,
    ) -> None:
        cameras_by_name = {camera.name: camera for camera in scenario.cameras}
        self._due: list[tuple[CameraSpec, int]] = []
        self._held: list[RenderRequest] = []
        self._clock = clock
        self._cadence = cadence or make_cadence(clock, scenario, sensors)
        self._forecaster = forecaster
        self._lookahead = lookahead
        self._before: Mapping[str, F64] = {}  # the road users one control period ago
        for sensor in sensors:
            if sensor.camera not in cameras_by_name:
                names = ", ".join(sorted(cameras_by_name)) or "none"
                raise InputError(
                    f"scene {scenario.scene_id!r}: the policy asks for camera {sensor.camera!r}; the scenario's cameras: {names}",
                    "Name one of them in the policy's sensors, or add the camera to `cameras` of the scenario.",
                )
            period = scenario.period_us(sensor)
            if period % clock.rates.control_us:
                raise InputError(
                    f"camera {sensor.camera!r}: period {period} us is no multiple of the control period {clock.rates.control_us} us",
                    "choose a whole multiple",
                )
            self._due.append((read_only(cameras_by_name[sensor.camera]), period))

    @property
    def specs(self) -> dict[str, CameraSpec]:
        """Give the cameras in use by name."""
        return {camera.name: camera for camera, _ in self._due}

    def count(self) -> int:
        """Count the frames of the rollout."""
        ticks = list(self._clock.ticks())
        return sum(self._is_due(tick.t_us, period) for tick in ticks for _, period in self._due)

    def requests(
        self, tick: Tick, history: Trajectory, actors: Mapping[str, F64]
    ) -> list[RenderRequest]:
        """Return the requests to render now. Shutter-start poses come from the history, the shutter
        ends now.

        In a cadence of whole blocks the requests of a block are returned together when its last
        frame is due.
        """
        actor_poses = visible_actors(actors)
        forecast = self._forecaster.now() if self._forecaster and self._lookahead else None
        for camera, period in self._due:
            if self._is_due(tick.t_us, period):
                ahead = (
                    PredictedRequests(forecast, camera, self._next_us(tick.t_us, period))
                    if forecast
                    else ()
                )
                T_world_camera = shutter_poses(history, camera, tick.t_us)
                exposure = rolling_exposure(
                    camera, self._before, actor_poses, self._clock.rates.control_us
                )
                request = RenderRequest(
                    tick.t_us, camera, T_world_camera, actor_poses, ahead, exposure
                )
                self._held.append(read_only(request))
        self._before = actor_poses
        if self._cadence.whole_blocks and not self._cadence.queries_at(tick.t_us):
            return []
        ready = self._held
        self._held = []
        return ready

    def _is_due(self, t_us: int, period: int) -> bool:
        return (t_us - self._clock.start_us) % period == 0 and self._cadence.needs_frame(
            t_us, period
        )

    def _next_us(self, t_us: int, period: int) -> tuple[int, ...]:
        end_us = self._clock.start_us + self._clock.n_steps * self._clock.rates.control_us
        coming = (t for t in range(t_us + period, end_us, period) if self._is_due(t, period))
        return tuple(islice(coming, self._lookahead))


def recorded_requests(scenario: Scenario, t_us: int) -> list[RenderRequest]:
    """Return a request for each camera of a scenario at an instant of its recorded path."""
    poses = actors_at(scenario.actors, t_us)
    T_world_rig = interpolate(scenario.ego_log, t_us)
    return [
        RenderRequest(t_us, camera, np.stack([T_world_rig @ camera.T_rig_camera] * 2), poses)
        for camera in scenario.cameras
    ]


def logged_request(log: RolloutLog, camera: CameraSpec, t_us: int) -> RenderRequest:
    """Return the request for a camera's frame whose shutter ends at an instant of a log, from the
    logged poses.
    """
    shutter_us = [max(t_us - camera.shutter_us, int(log.ego.t_us[0])), t_us]
    T_world_rig = interpolate(log.ego, shutter_us) @ inverse(log.T_rig_box)
    actor_poses = visible_actors(actors_at(log.actors.values(), t_us))
    before = visible_actors(actors_at(log.actors.values(), t_us - log.control_us))
    exposure = rolling_exposure(camera, before, actor_poses, log.control_us)
    return RenderRequest(
        t_us, camera, T_world_rig @ camera.T_rig_camera, actor_poses, exposure=exposure
    )

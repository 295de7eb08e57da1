"""From a tick to render requests: only frames that the policy uses are rendered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import islice

from alpasim_plugin.core.clock import Clock, Tick
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F64, CameraSpec, RenderRequest, Scenario, SensorSpec, Trajectory
from alpasim_plugin.runtime.cadence import Cadence, make_cadence
from alpasim_plugin.runtime.forecast import Forecaster, PredictedRequests, shutter_poses


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
        InputError: The scenario lacks a camera of the policy, or a period is no multiple of the control period.
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
        known = {camera.name: camera for camera in scenario.cameras}
        self._due: list[tuple[CameraSpec, int]] = []
        self._held: list[RenderRequest] = []
        self._clock = clock
        self._cadence = cadence or make_cadence(clock, scenario, sensors)
        self._forecaster, self._lookahead = forecaster, lookahead
        for sensor in sensors:
            if sensor.camera not in known:
                raise InputError(
                    "connecting a policy to its cameras",
                    f"scene {scenario.scene_id!r}",
                    f"the policy needs camera {sensor.camera!r}; the scenario has {sorted(known)}",
                    "add that camera to the scenario or choose another policy",
                )
            period = sensor.interval_us or scenario.rates.camera_us
            if period % clock.rates.control_us:
                raise InputError(
                    "connecting a policy to its cameras",
                    f"camera {sensor.camera!r}",
                    f"period {period} us is no multiple of the control period {clock.rates.control_us} us",
                    "choose a whole multiple",
                )
            self._due.append((known[sensor.camera], period))

    @property
    def specs(self) -> dict[str, CameraSpec]:
        """Give the cameras in use by name."""
        return {camera.name: camera for camera, _ in self._due}

    def requests(self, tick: Tick, history: Trajectory, actors: Mapping[str, F64]) -> list[RenderRequest]:
        """Return the requests to render now. Shutter-start poses come from the history, the shutter ends now.

        In a cadence of whole blocks the requests of a block are returned together when its last frame is due.
        """
        forecast = self._forecaster.now() if self._forecaster and self._lookahead else None
        for camera, period in self._due:
            if self._is_due(tick.t_us, period):
                ahead = PredictedRequests(forecast, camera, self._next_us(tick.t_us, period)) if forecast else ()
                self._held.append(RenderRequest(tick.t_us, camera, shutter_poses(history, camera, tick.t_us), actors, ahead))
        if self._cadence.whole_blocks and not self._cadence.queries_at(tick.t_us):
            return []
        ready, self._held = self._held, []
        return ready

    def _is_due(self, t_us: int, period: int) -> bool:
        return (t_us - self._clock.start_us) % period == 0 and self._cadence.needs_frame(t_us, period)

    def _next_us(self, t_us: int, period: int) -> tuple[int, ...]:
        end_us = self._clock.start_us + self._clock.n_steps * self._clock.rates.control_us
        coming = (t for t in range(t_us + period, end_us, period) if self._is_due(t, period))
        return tuple(islice(coming, self._lookahead))

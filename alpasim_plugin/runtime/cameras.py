"""From a tick to render requests: only frames that the policy will take are rendered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import islice

from alpasim_plugin.clock import Clock, Tick
from alpasim_plugin.errors import InputError
from alpasim_plugin.runtime.cadence import Cadence, make_cadence
from alpasim_plugin.runtime.forecast import Ahead, Forecaster, shutter_poses
from alpasim_plugin.types import F64, CameraSpec, RenderRequest, Scenario, SensorSpec, Trajectory


class CameraRig:
    """The cameras one policy listens to.

    Args:
        scenario: Has the cameras.
        sensors: Which of them, at which period.
        clock: Ticks of the rollout.
        cadence: When the policy looks; by default at its own period.
        forecaster: Source of the forecasts that requests carry, for `lookahead` frames.
        lookahead: How many of a camera's next frames a request predicts.

    Raises:
        InputError: The policy asks for a camera the scenario lacks, or for a period that is no multiple of the control period.
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
                    f"the policy wants camera {sensor.camera!r}; the scenario has {sorted(known)}",
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
        """Return what to render now. Shutter-start poses come from the motion so far, the shutter end is now.

        In a cadence of whole blocks requests are held until the block's last frame is due and then handed over together.
        """
        forecast = self._forecaster.now() if self._forecaster and self._lookahead else None
        for camera, period in self._due:
            if self._is_due(tick.t_us, period):
                ahead = Ahead(forecast, camera, self._next_us(tick.t_us, period)) if forecast else ()
                self._held.append(RenderRequest(tick.t_us, camera, shutter_poses(history, camera, tick.t_us), actors, ahead))
        if self._cadence.whole_blocks and not self._cadence.queries_at(tick.t_us):
            return []
        ready, self._held = self._held, []
        return ready

    def _is_due(self, t_us: int, period: int) -> bool:
        return (t_us - self._clock.start_us) % period == 0 and self._cadence.wants(t_us, period)

    def _next_us(self, t_us: int, period: int) -> tuple[int, ...]:
        end_us = self._clock.start_us + self._clock.n_steps * self._clock.rates.control_us
        coming = (t for t in range(t_us + period, end_us, period) if self._is_due(t, period))
        return tuple(islice(coming, self._lookahead))

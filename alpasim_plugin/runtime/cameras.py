"""From a tick to render requests: only frames that the policy will take are rendered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from alpasim_plugin.clock import Clock, Tick
from alpasim_plugin.errors import InputError
from alpasim_plugin.geometry import interpolate
from alpasim_plugin.types import F64, CameraSpec, RenderRequest, Scenario, SensorSpec, Trajectory


class CameraRig:
    """The cameras one policy listens to.

    A frame is due every sensor period; it is rendered only if no newer frame of that camera will exist when the policy next looks.

    Raises:
        InputError: The policy asks for a camera the scenario lacks, or for a period that is no multiple of the control period.
    """

    def __init__(self, scenario: Scenario, sensors: Sequence[SensorSpec], clock: Clock) -> None:
        known = {camera.name: camera for camera in scenario.cameras}
        self._due: list[tuple[CameraSpec, int]] = []
        self._clock = clock
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
        """Return what to render now. Shutter-start poses come from the motion so far, the shutter end is now."""
        elapsed = tick.t_us - self._clock.start_us
        to_policy = -elapsed % self._clock.rates.policy_us
        out = []
        for camera, period in self._due:
            is_due = elapsed % period == 0
            superseded = to_policy >= period  # a newer frame arrives before the policy looks
            nobody_looks = tick.t_us + to_policy > self._clock.start_us + (self._clock.n_steps - 1) * self._clock.rates.control_us
            if is_due and not superseded and not nobody_looks:
                start_us = max(tick.t_us - camera.shutter_us, int(history.t_us[0]))
                poses = interpolate(history, np.array([start_us, tick.t_us])) @ camera.T_rig_camera
                out.append(RenderRequest(tick.t_us, camera, poses, actors))
        return out

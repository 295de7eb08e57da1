"""Predicted poses of cameras and road users, for `RenderRequest.ahead`.

The controller moves the predicted ego along the active plan and along plans that become active after their latency. During the warm-up
the prediction is the log itself. A forecast queries no policy and leaves the state of the loop unchanged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import overload

import numpy as np

from alpasim_plugin.control import Controller
from alpasim_plugin.core.geometry import interpolate, quat_from_matrix
from alpasim_plugin.core.types import F64, CameraSpec, EgoState, RenderRequest, Scenario, Trajectory
from alpasim_plugin.runtime.latency import PlanQueue
from alpasim_plugin.runtime.loop_state import LoopState, advance_ego
from alpasim_plugin.world.actors import ActorForecast, Actors


def shutter_poses(history: Trajectory, camera: CameraSpec, t_us: int) -> F64:
    """Return ``T_world_camera`` ``(2, 4, 4)`` at shutter start and end, from rig poses of which the last is at ``t_us``."""
    start_us = max(t_us - camera.shutter_us, int(history.t_us[0]))
    return np.asarray(interpolate(history, np.array([start_us, t_us])) @ camera.T_rig_camera)


class Forecaster:
    """Makes forecasts of a running loop."""

    def __init__(self, scenario: Scenario, controller: Controller, plans: PlanQueue, actors: Actors, state: LoopState) -> None:
        self._parts = scenario, controller, plans, actors, state

    def now(self) -> Forecast:
        """Return the forecast from the present instant. It is computed when read."""
        scenario, controller, plans, actors, state = self._parts
        return Forecast(scenario, controller, plans.copy(), actors.forecast(), state.history, state.ego)


@dataclass
class Forecast:
    """A forecast from one instant, computed as far as it is read."""

    scenario: Scenario
    controller: Controller
    plans: PlanQueue
    actors: ActorForecast
    history: Trajectory  # rig poses up to the instant, then predicted ones
    ego: EgoState  # at the end of the history

    def request(self, camera: CameraSpec, t_us: int) -> RenderRequest:
        """Return the predicted render request at a future control instant."""
        self._extend(t_us)
        upto = int(np.searchsorted(self.history.t_us, t_us, side="right"))
        past = Trajectory(self.history.t_us[:upto], self.history.xyz[:upto], self.history.quat[:upto])
        return RenderRequest(t_us, camera, shutter_poses(past, camera, t_us), self.actors.at(t_us))

    def _extend(self, to_us: int) -> None:
        states = []
        while self.ego.t_us < to_us:
            next_us = self.ego.t_us + self.scenario.rates.control_us
            self.ego, _ = advance_ego(self.scenario, self.controller, self.ego, self.plans.active(self.ego.t_us), next_us)
            states.append(self.ego)
        if states:
            past, poses = self.history, np.stack([state.T_world_rig for state in states])
            self.history = Trajectory(
                np.concatenate([past.t_us, np.array([state.t_us for state in states], dtype=np.int64)]),
                np.concatenate([past.xyz, poses[:, :3, 3]]),
                np.concatenate([past.quat, quat_from_matrix(poses[:, :3, :3])]),
            )


@dataclass
class PredictedRequests(Sequence[RenderRequest]):
    """The predicted next requests of one camera, computed when read."""

    forecast: Forecast
    camera: CameraSpec
    times_us: tuple[int, ...]
    _made: dict[int, RenderRequest] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.times_us)

    @overload
    def __getitem__(self, index: int) -> RenderRequest: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[RenderRequest]: ...
    def __getitem__(self, index: int | slice) -> RenderRequest | Sequence[RenderRequest]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        t_us = self.times_us[index]
        if t_us not in self._made:
            self._made[t_us] = self.forecast.request(self.camera, t_us)
        return self._made[t_us]
